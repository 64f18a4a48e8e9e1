"""The whole way that training takes on a GPU, without one.

Tensors say that they are on a GPU and lie on the CPU; gsplat's own torch code stands in for its kernels, and
Triton's interpreter runs ours.
"""

import os
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")  # before triton is imported
pytest.importorskip("triton", reason="needs triton, which is on Linux x86-64 only")

import gsplat_standin
import numpy as np
from test_train_trainer import BUSY, LABEL_IDS, scene  # noqa: F401 - a fixture

from sagesplat.core.gaussians import PARAMETERS
from sagesplat.metrics import ssim_triton
from sagesplat.metrics.image import _PhotometricLoss
from sagesplat.raster import Workspace
from sagesplat.scene.images import Photos
from sagesplat.segment.masks import Taxonomy
from sagesplat.train import schedule, stepper, trainer
from sagesplat.train.early_stopping import ActiveTiles, label_quality, measured_views
from sagesplat.train.events import LabelFrozen, LevelSaved, Resumed, Step, Trained
from sagesplat.train.stepper import Stepper
from sagesplat.train.trainer import train

CPU = torch.device("cpu")
# a reset after step 9
SHORT = replace(BUSY, max_steps=26, level_every=12, refine_every=4)


@pytest.fixture(scope="module", autouse=True)
def early_resets() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(schedule, "_MIN_RESET_INTERVAL", 9)
        yield


class Halves:
    """Label images: 3 on the left, 184 on the right, in which the last column is unlabelled."""

    taxonomy = Taxonomy({3: "three", 184: "tree"})

    def __getitem__(self, view) -> np.ndarray:
        labels = np.full((view.camera.height, view.camera.width), 184, np.int16)
        labels[:, : view.camera.width // 2] = 3
        labels[:, -1] = -1
        return labels


@pytest.fixture
def on_gpu(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    if "default" not in request.node.name:  # the interpreter takes a third of a second for a tile
        monkeypatch.setattr(ssim_triton, "photometric_loss", cpu_loss)
    gsplat_standin.install(monkeypatch)
    for module in (trainer, stepper):
        monkeypatch.setattr(module, "device_of", lambda *_: CPU)
    monkeypatch.setattr(ActiveTiles, "mask", mask)
    monkeypatch.setattr(torch.Tensor, "is_cuda", property(lambda _: True), raising=False)
    monkeypatch.setattr(trainer, "LOOK_EVERY", 1)


def mask(work: ActiveTiles, row: int, factor: int = 1) -> torch.Tensor | None:
    tiles = work.tiles(row, factor)
    return None if tiles is None else torch.from_numpy(tiles)


def cpu_loss(rgb, photo, ssim_weight, tile_mask):
    tiles = None if tile_mask is None else np.asarray(tile_mask)
    return _PhotometricLoss.apply(rgb, photo, ssim_weight, tiles, Workspace())


def run(scene, config, **options):  # noqa: F811
    return list(train(scene, Photos(scene.views), LABEL_IDS, config, backend="cuda", **options))


def final(events):
    assert isinstance(events[-1], Trained)
    return events[-1].gaussians


@pytest.mark.parametrize(
    "config",
    [
        replace(SHORT, max_steps=5, refine_every=50),
        pytest.param(replace(SHORT, batch=2), marks=pytest.mark.slow),
    ],
    ids=["default", "batch"],
)
def test_it_trains_as_on_the_cpu(scene, on_gpu, monkeypatch, config):  # noqa: F811
    gpu = run(scene, config)
    monkeypatch.undo()
    cpu = list(train(scene, Photos(scene.views), LABEL_IDS, config, backend="cpu"))
    losses = [[e.loss for e in events if isinstance(e, Step)] for events in (gpu, cpu)]
    np.testing.assert_allclose(losses[0][:8], losses[1][:8], rtol=2e-3)  # then rows come in another order
    assert abs(len(final(gpu)) - len(final(cpu))) <= 0.05 * len(final(cpu))
    assert (len(final(gpu)) > len(LABEL_IDS)) == (config.refine_every < config.max_steps)
    np.testing.assert_allclose(losses[0][-6:], losses[1][-6:], rtol=0.1)


@pytest.mark.slow
def test_a_category_stops(scene, on_gpu, monkeypatch):  # noqa: F811
    masks, seen = Halves(), []
    drawn = stepper.rasterize

    def watched(*args, **options):
        seen.append(options["tile_mask"])
        return drawn(*args, **options)

    monkeypatch.setattr(stepper, "rasterize", watched)
    monkeypatch.setattr(trainer, "label_quality", lambda *_, **__: {3: 0.9, 184: 0.1, -1: 0.1})
    kept: dict[int, np.ndarray] = {}
    config = replace(SHORT, freeze_at=0.5)
    for event in train(scene, Photos(scene.views), LABEL_IDS, config, masks=masks, backend="cuda"):  # type: ignore[arg-type]
        if isinstance(event, LevelSaved | Trained):
            g = STATES[-1].gaussians
            rows = np.concatenate([p[g.label_ids == 3].numpy().reshape(-1) for p in g.parameters().values()])
            kept[len(kept)] = np.sort(rows)
        if isinstance(event, LabelFrozen):
            assert (event.label_id, event.step) == (3, 12)
    np.testing.assert_array_equal(kept[1], kept[0])
    np.testing.assert_array_equal(kept[len(kept) - 1], kept[0])
    assert seen[0] is None
    assert 0 < float(seen[-1].float().mean()) < 1


STATES: list = []


@pytest.fixture(autouse=True)
def watched_states(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the state that steps are taken on."""
    call = Stepper.__call__

    def watched(self, state, *args, **options):
        STATES.append(state)
        return call(self, state, *args, **options)

    monkeypatch.setattr(Stepper, "__call__", watched)


@pytest.mark.slow
def test_mcmc_and_what_was_killed(scene, on_gpu, tmp_path):  # noqa: F811
    config = replace(SHORT, strategy="mcmc", max_gaussians=100)
    whole = run(scene, config)
    for event in train(
        scene, Photos(scene.views), LABEL_IDS, config, backend="cuda", folder=tmp_path, settings="s"
    ):
        if isinstance(event, Step) and event.step == 20:
            break
    again = run(scene, config, folder=tmp_path, settings="s")
    assert again[0] == Resumed(12)
    assert len(final(whole)) == len(final(again)) > 60
    for name in PARAMETERS:
        assert torch.equal(getattr(final(whole), name), getattr(final(again), name)), name


@pytest.mark.slow
def test_quality_is_what_the_cpu_measures(scene, on_gpu, monkeypatch):  # noqa: F811
    g = final(run(scene, replace(SHORT, max_steps=8)))
    work, rows = ActiveTiles(scene, Halves()), measured_views(scene, Halves())  # type: ignore[arg-type]
    feed = stepper.PhotoLoader(scene, Photos(scene.views), CPU)
    there = label_quality(g, work, feed, rows, SHORT, 3, backend="cuda")
    monkeypatch.undo()
    here = label_quality(g, work, feed, rows, SHORT, 3, backend="cpu")
    assert there.keys() == here.keys() == {-1, 3, 184}
    np.testing.assert_allclose(list(there.values()), list(here.values()), atol=2e-3)
