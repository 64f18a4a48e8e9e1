"""The GPU script end to end on a CPU, its small functions, and gsplat's recipe over our rasteriser."""

import json
from pathlib import Path
from typing import Any

import gsplat
import numpy as np
import pytest
import torch
from conftest import random_gaussians, write_capture

from benchmarks.gpu import __main__ as script
from benchmarks.gpu import base, gsplat_trainer, split
from sagesplat.core.config import TrainConfig
from sagesplat.demo.capture import make_capture
from sagesplat.raster import cuda, rasterize
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera
from sagesplat.train.state import from_points


def tried(folder: Path, only: tuple[str, ...] = ()) -> dict[str, dict[str, Any]]:
    """What a trial on the CPU writes, by check."""
    make_capture(folder / "capture", views=9, width=64, height=48)
    asked = base.Asked(folder / "capture", steps=60, device="cpu", only=only, out=folder / "out")
    assert script.check(asked) == 0
    return {name: json.loads((folder / f"out/{name}.json").read_text()) for name in only or script.CHECKS}


def test_a_trial_of_the_script(tmp_path):
    figures = tried(tmp_path, ("agreement", "full"))
    assert figures["agreement"]["figures"]["frozen"]["kept"]
    assert figures["agreement"]["figures"]["frozen"]["others_grew"] > 0
    run = figures["full"]["figures"]
    assert run["steps"] == run["curve"][-1]["step"] == 60
    assert run["curve"][-1]["ssim"] > run["curve"][0]["ssim"]


@pytest.mark.slow
def test_a_trial_of_the_whole_script(tmp_path, capsys):
    figures = tried(tmp_path)
    table = capsys.readouterr().out.splitlines()[-len(script.CHECKS) :]
    assert [line.split()[:2] for line in table] == [
        ["agreement", "ok"], ["full", "ok"], ["race", "ok"], ["split", "ok"], ["multi", "skipped"],
    ]  # fmt: skip
    race = figures["race"]["figures"]
    assert (set(race["runs"]), set(race["missed"])) == ({"ours", "ours-mcmc"}, {"gsplat", "mcmc", "large"})
    assert set(figures["split"]["figures"]["kernels"]) == {*(name for name, _ in split.KERNELS), "rest"}


def test_a_machine_without_a_gpu_says_so_in_one_line(capsys):
    if cuda.missing() is None:
        pytest.skip("there is one")
    assert script.check(base.Asked(Path("nowhere"), device="cuda")) == 2
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    assert "; " in line or " or use --device cpu" in line


# --- gsplat's recipe -------------------------------------------------------------------------------------


def test_the_recipe_trains_and_densifies(tmp_path, monkeypatch):
    """gsplat draws on a GPU only: here our rasteriser stands in, with what its strategy reads."""

    def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options):
        assert options["packed"] is False
        g = gsplat_trainer.gaussians(
            {
                "means": means, "quats": quats, "scales": scales, "opacities": opacities,
                "sh0": colors[:, :1], "shN": colors[:, 1:],
            }
        )  # fmt: skip
        leaves = {"means": means, "quats": quats, "log_scales": scales.log()}
        leaves |= {"logit_opacities": opacities.logit(), "sh0": colors[:, :1], "shN": colors[:, 1:]}
        camera = Camera(viewmats[0].numpy(), Ks[0].numpy(), width, height)
        render = rasterize(type(g)(**leaves, label_ids=g.label_ids), camera, sh_degree=options["sh_degree"])

        class Means2d:
            def retain_grad(self) -> None:
                pass

            @property
            def grad(self) -> torch.Tensor:
                assert render.means2d.grad is not None
                return render.means2d.grad[None]

        radii = render.radii[None, :, None].expand(-1, -1, 2)
        info = {"means2d": Means2d(), "radii": radii, "width": width, "height": height}
        return render.rgb[None], render.alpha[None], info | {"n_cameras": 1, "gaussian_ids": None}

    monkeypatch.setattr(gsplat, "rasterization", rasterization)
    scene = write_capture(tmp_path / "capture", random_gaussians(60, degree=1))
    photos = [torch.from_numpy(Photos(scene.views)[row]).float() / 255 for row in scene.train_ids]
    cameras = [scene.views[row].camera for row in scene.train_ids]
    initial = from_points(scene.points, np.full(len(scene.points.xyz), -1, np.int16), 3)
    config = TrainConfig(
        max_steps=120, level_every=40, refine_stop=30_000, refine_every=20, grow_grad=1e-6
    )  # fmt: skip

    def error(g) -> float:
        renders = [rasterize(g, camera).rgb for camera in cameras]
        return float(torch.stack([(r - p).abs().mean() for r, p in zip(renders, photos, strict=True)]).mean())

    found = list(gsplat_trainer.train(initial, cameras, photos, scene.extent, config))
    assert [step for step, _ in found] == [40, 80, 120]
    assert len(found[-1][1]) > len(initial)
    assert error(found[-1][1]) < 0.7 * error(initial)
