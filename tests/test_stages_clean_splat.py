"""Floaters leave a splat of any tool; all else in it stays as it was."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import orbit, random_gaussians, write_capture

from sagesplat.cli.stages import clean as command
from sagesplat.core.config import CleanConfig
from sagesplat.core.errors import SageError
from sagesplat.core.events import Event, StageDone
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.formats.labels import sidecar
from sagesplat.formats.ply import read_ply, select_ply, write_ply
from sagesplat.formats.splats import read_splat
from sagesplat.io.ply_header import read_header
from sagesplat.stages.clean_splat import clean_splat

N = 90
CONFIG = CleanConfig()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture, and a splat of it with three Gaussians that no camera sees."""
    made = tmp_path_factory.mktemp("splat")
    truth = random_gaussians(N, degree=0, log_scale=-1.6, logit=3.0)
    write_capture(made / "capture", truth, views=6)
    hidden = replace(truth.select(torch.arange(3)), means=torch.tensor([[0.0, 0, -9]]).repeat(3, 1))
    write_ply(made / "scene.ply", concat([truth, hidden]), {3: "car", 184: "tree-merged"})
    return made


def run(folder: Path, out: Path, **options) -> tuple[Gaussians, tuple[str, ...]]:
    events: list[Event] = []
    options = {"cameras": folder / "capture", **options}
    clean_splat(options.pop("source", folder / "scene.ply"), out, CONFIG, events.append, **options)
    return read_splat(out).gaussians, next(e.lines for e in events if isinstance(e, StageDone))


def test_hidden_gaussians_go_and_a_picture_shows_it(folder: Path, tmp_path: Path) -> None:
    left, lines = run(folder, tmp_path / "out.ply", picture=tmp_path / "out.png")
    before = read_ply(folder / "scene.ply")
    assert len(left) <= N
    assert float(left.means[:, 2].min()) > -8
    rows = set(map(tuple, before.means.tolist()))
    assert set(map(tuple, left.means.tolist())) <= rows
    assert lines[0].startswith(f"{N + 3 - len(left)} of {N + 3} Gaussians removed: ")
    assert lines[-1] == f"6 photos of {folder / 'capture'}"
    assert (tmp_path / "out.png").read_bytes().startswith(b"\x89PNG")
    there = dict(zip(map(tuple, before.means.tolist()), before.label_ids.tolist(), strict=True))
    assert [there[row] for row in map(tuple, left.means.tolist())] == left.label_ids.tolist()
    assert sidecar(tmp_path / "out.ply").exists()


def test_rows_of_a_ply_keep_properties_that_nobody_knows(folder: Path, tmp_path: Path) -> None:
    strange = tmp_path / "strange.ply"
    with (folder / "scene.ply").open("rb") as file:
        known = read_header(file)
        rows = np.fromfile(file, known.dtype, known.count)
    types = known.types | {"heat": "f8"}
    dtype = np.dtype([(name, f"<{kind}") for name, kind in types.items()])
    wider = np.zeros(len(rows), dtype)
    for name in rows.dtype.names or ():
        wider[name] = rows[name]
    wider["heat"] = np.arange(len(rows))
    wider["opacity"][5] = np.nan  # cannot be drawn, and is left out
    words = {"f4": "float", "i2": "short", "f8": "double"}
    lines = ["ply", "format binary_little_endian 1.0", "comment by hand", f"element vertex {len(rows)}"]
    lines += [f"property {words[kind]} {name}" for name, kind in types.items()]
    lines += ["element camera 2", "property float x", "end_header", ""]
    strange.write_bytes("\n".join(lines).encode() + wider.tobytes() + bytes(8))
    run(folder, tmp_path / "out.ply", source=strange)
    with (tmp_path / "out.ply").open("rb") as file:
        header = read_header(file)
        left = np.fromfile(file, header.dtype)
    assert header.comments == ("by hand",)
    assert header.dtype == dtype
    heat = left["heat"].astype(int)
    assert set(heat) <= set(range(N)) - {5}
    np.testing.assert_array_equal(left, wider[heat])
    with pytest.raises(SageError, match=r"93 Gaussians, not 2; it changed"):
        select_ply(strange, tmp_path / "two.ply", np.ones(2, bool))


def test_cameras_without_photos_serve_too(folder: Path, tmp_path: Path) -> None:
    entries = []
    for i, camera in enumerate(orbit(6)):
        c2w = np.linalg.inv(camera.w2c.astype(float))
        size = {"width": camera.width, "height": camera.height}
        focal = {"fx": float(camera.K[0, 0]), "fy": float(camera.K[1, 1])}
        pose = {"rotation": c2w[:3, :3].tolist(), "position": c2w[:3, 3].tolist()}
        entries.append({"id": i, "img_name": f"{i}", **size, **focal, **pose})
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    left, lines = run(folder, tmp_path / "out.ply", cameras=tmp_path / "cameras.json")
    assert float(left.means[:, 2].min()) > -8
    assert len(lines) == 2  # no PSNR where there is no photo
    elsewhere = [{**entry, "position": [500.0, 0, 0]} for entry in entries]
    (tmp_path / "cameras.json").write_text(json.dumps(elsewhere))
    with pytest.raises(SageError, match=r"cameras\.json: no camera has .* in sight; give cameras"):
        run(folder, tmp_path / "none.ply", cameras=tmp_path / "cameras.json")
    assert not (tmp_path / "none.ply").exists()


@pytest.mark.parametrize(
    ("names", "options", "words"),
    [
        (("scene.ply", "scene.ply"), {}, r"the splat itself; name another file"),
        (("scene.ply", "lod-meta.json"), {}, r"several levels; name a \.ply"),
        (("scene.ply", "out.ply"), {"clean": CleanConfig(floaters="keep")}, r"nothing would be removed"),
        (("scene.ply", None), {}, r"not a run folder; of a splat, name the file to write after it"),
    ],
)
def test_what_cannot_be_done_is_one_line(folder: Path, names, options: dict, words: str) -> None:
    source, out = (name and folder / name for name in names)
    before = (folder / "scene.ply").read_bytes()
    with pytest.raises(SageError, match=words):
        command(source, out, **options)
    assert (folder / "scene.ply").read_bytes() == before
