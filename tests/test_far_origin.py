"""Captures and splats far from their origin, such as in UTM: nothing is lost to float32."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import random_gaussians
from PIL import Image
from scipy.spatial.transform import Rotation

from sagesplat.core.config import AdoptConfig, LabelsConfig, MasksConfig, SceneConfig
from sagesplat.core.errors import DataError, RunError
from sagesplat.core.events import Event, StageDone, Warned
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import NO_OFFSET, offset_of
from sagesplat.formats.increments import read_increments, read_index, write_increments
from sagesplat.formats.ply import read_ply, write_ply
from sagesplat.formats.splats import read_splat, write_splat
from sagesplat.io.ply_header import read_header
from sagesplat.run.capture import fingerprint
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene import describe, load_scene
from sagesplat.scene.cameras import read_camera_file
from sagesplat.scene.colmap_write import ModelCamera, ModelImage, write_model
from sagesplat.scene.scene import Scene
from sagesplat.stages.adopt import open_splat
from sagesplat.stages.adopt_levels import make_levels
from sagesplat.stages.export import export_scene

UTM = np.array([412346.0, 5312345.0, 188.0])
VIEWS = 6


def _poses(at: np.ndarray) -> list[np.ndarray]:
    """World to camera, on an arc around `at`."""
    poses = []
    for angle in np.linspace(-0.5, 0.5, VIEWS):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("xyz", [0.1, angle, 0.2]).as_matrix()
        pose[:3, 3] = [0.05, -0.1, 4] - pose[:3, :3] @ at
        poses.append(pose)
    return poses


def _photos(folder: Path) -> list[str]:
    folder.mkdir(parents=True)
    names = [f"{i}.png" for i in range(VIEWS)]
    for i, name in enumerate(names):
        pixels = np.random.default_rng(i).integers(0, 255, (30, 40, 3), np.uint8)
        Image.fromarray(pixels).save(folder / name)
    return names


def _colmap(folder: Path, at: np.ndarray, outlier: float = 0.0) -> Scene:
    xyz = np.random.default_rng(0).uniform(-0.8, 0.8, (20, 3))
    xyz[0] += outlier
    images = []
    for i, (name, w2c) in enumerate(zip(_photos(folder / "images"), _poses(at), strict=True)):
        local = (xyz + at) @ w2c[:3, :3].T + w2c[:3, 3]
        uv = local[:, :2] / local[:, 2:] * 35 + [20, 15]
        images.append(ModelImage(i + 1, name, 1, w2c, uv, np.arange(20)))
    camera = ModelCamera(1, "PINHOLE", 40, 30, (35.0, 35.0, 20.0, 15.0))
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    write_model(model, [camera], images, xyz + at, np.zeros((20, 3), np.uint8), np.zeros(20))
    return load_scene(folder)


def _transforms(folder: Path, at: np.ndarray) -> Scene:
    xyz = np.random.default_rng(0).uniform(-0.8, 0.8, (20, 3)) + at
    flip = np.diag([1.0, -1, -1, 1])
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": (np.linalg.inv(w2c) @ flip).tolist()}
        for name, w2c in zip(_photos(folder / "images"), _poses(at), strict=True)
    ]
    content = {"w": 40, "h": 30, "fl_x": 35, "fl_y": 35, "frames": frames, "ply_file_path": "points.ply"}
    (folder / "transforms.json").write_text(json.dumps(content))
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 20\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    (folder / "points.ply").write_bytes(head.encode() + xyz.astype("<f8").tobytes())
    return load_scene(folder)


def _same(far: Scene, near: Scene, at: np.ndarray) -> None:
    """The same capture: positions to float32's own rounding, and nothing else differs."""
    by = np.array(far.offset) - at
    assert np.abs(by).max() < 5  # the offset is in the middle of the capture: cameras are 4 from its points
    for one, other in zip(far.views, near.views, strict=True):
        assert np.abs(one.camera.position + by - other.camera.position).max() < 1e-5 * near.extent
        assert np.array_equal(one.camera.w2c[:3, :3], other.camera.w2c[:3, :3])
        assert np.array_equal(one.camera.K, other.camera.K)
    assert np.abs(far.points.xyz + by - near.points.xyz).max() < 1e-5 * near.extent
    assert far.extent == pytest.approx(near.extent, rel=1e-5)


@pytest.mark.parametrize("make", [_colmap, _transforms])
@pytest.mark.parametrize("at", [UTM + 0.678, np.array([4177123.4, 855012.3, 4728456.7])])
def test_a_far_capture_is_the_near_one(tmp_path, make, at):
    far, near = make(tmp_path / "far", at), make(tmp_path / "near", np.zeros(3))
    assert near.offset == NO_OFFSET
    _same(far, near, at)
    assert dict(describe(far))["offset"].endswith("subtracted from all positions")
    assert "offset" not in dict(describe(near))
    assert fingerprint(replace(far, offset=NO_OFFSET)) != fingerprint(far)


def test_training_of_a_far_capture_sees_the_same_numbers(tmp_path):
    """Those of the capture that lies where the offset moves it to, to the last bit of float32."""
    far = _colmap(tmp_path / "far", UTM)
    near = _colmap(tmp_path / "near", UTM - far.offset)
    assert near.offset == NO_OFFSET
    np.testing.assert_allclose(
        [view.camera.w2c for view in far.views], [view.camera.w2c for view in near.views], atol=2e-7
    )
    np.testing.assert_allclose(far.points.xyz, near.points.xyz, atol=1e-7)
    assert np.abs(far.points.track_uv - near.points.track_uv).max() < 1e-3
    assert float(dict(describe(far))["reprojection error"].split()[0]) < 0.01


def test_what_is_near_stays_where_it_is(tmp_path):
    """One point far off moves nothing, nor does a capture beside its origin."""
    assert _colmap(tmp_path / "outlier", np.zeros(3), outlier=1e7).offset == NO_OFFSET
    assert _colmap(tmp_path / "beside", np.array([40.0, -30, 5])).offset == NO_OFFSET
    camera = np.array([[0.0, 0, 5]]) + 1e-4 * np.random.default_rng(0).normal(size=(5, 3))
    wide = np.random.default_rng(0).normal(size=(50, 3)) * 3
    assert offset_of(camera, wide) == NO_OFFSET  # cameras that hardly move, in a scene of some size
    assert any(offset_of(camera))  # nothing else is known: moving is right, too
    road = np.stack([np.linspace(0, 6e4, 50), np.zeros(50), np.zeros(50)], 1)
    assert any(offset_of(road + UTM))  # long, but with steps of half a metre in float32
    assert offset_of(road) == NO_OFFSET
    nan = np.array([[math.nan, 0, 0], [math.inf, 0, 0]])
    assert offset_of(nan) == offset_of(nan[:0]) == NO_OFFSET
    assert offset_of(np.full((3, 3), 1e30)) == NO_OFFSET


def test_camera_files_say_their_offset(tmp_path):
    """cameras.json of 3DGS and transforms.json without photos."""
    entries = [
        {"rotation": w2c[:3, :3].T.tolist(), "position": (-w2c[:3, :3].T @ w2c[:3, 3]).tolist(),
         "fx": 35, "fy": 35, "width": 40, "height": 30}
        for w2c in _poses(UTM)
    ]  # fmt: skip
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    found = read_camera_file(tmp_path / "cameras.json")
    near = [np.linalg.inv(pose)[:3, 3] for pose in _poses(np.zeros(3))]
    got = [one.camera.position + (np.array(one.offset) - UTM) for one in found]
    assert np.abs(np.array(got) - near).max() < 1e-5


def _ball() -> Gaussians:
    g = random_gaussians(300, degree=1, logit=2.0)
    return replace(g, label_ids=torch.full_like(g.label_ids, -1))


def _doubles(path: Path, g: Gaussians, at: np.ndarray) -> Path:
    """A splat PLY whose x y z are doubles, moved by `at`."""
    write_ply(path, g)
    with path.open("rb") as file:
        header = read_header(file)
        start = file.tell()
        rows = np.fromfile(file, header.dtype, header.count)
    kinds = [(name, "<f8" if name in "xyz" else header.dtype[name]) for name in header.dtype.names or ()]
    wide = rows.astype(kinds)
    for axis, by in zip("xyz", at, strict=True):
        wide[axis] += by
    text = path.read_bytes()[:start].decode()
    for axis in "xyz":
        text = text.replace(f"property float {axis}\n", f"property double {axis}\n")
    path.write_bytes(text.encode() + wide.tobytes())
    return path


def test_a_splat_of_far_doubles_keeps_its_positions(tmp_path):
    g, at = _ball(), UTM + 0.678
    splat = read_splat(_doubles(tmp_path / "far.ply", g, at))
    by = torch.from_numpy(np.array(splat.offset) - at)
    assert any(splat.offset)
    assert (splat.gaussians.means.double() + by - g.means.double()).abs().max() < 1e-6
    near = read_splat(_doubles(tmp_path / "near.ply", g, np.zeros(3)))
    assert near.offset == NO_OFFSET
    assert torch.equal(near.gaussians.means, g.means)
    assert torch.equal(read_ply(tmp_path / "near.ply").means, g.means)
    wide = read_ply(tmp_path / "far.ply")  # without a place for an offset: as float32 has them
    assert (wide.means.double() - torch.from_numpy(at) - g.means).abs().max() < 0.6


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.sog"])
def test_an_offset_lies_beside_what_is_written(tmp_path, name):
    g = _ball()
    write_splat(tmp_path / name, g, offset=(412346.0, 5312345.0, 188.0))
    assert (tmp_path / f"{name}.offset.xyz").read_text() == "412346 5312345 188\n"
    splat = read_splat(tmp_path / name)
    assert splat.offset == (412346.0, 5312345.0, 188.0)
    assert (splat.gaussians.means.mean(0) - g.means.mean(0)).abs().max() < 0.01
    write_splat(tmp_path / name, g)
    assert read_splat(tmp_path / name).offset == NO_OFFSET
    for text in ("1 2", "a b c", "nan 0 0", ""):
        (tmp_path / f"{name}.offset.xyz").write_text(text)
        with pytest.raises(DataError, match=r"offset\.xyz: .*; delete it"):
            read_splat(tmp_path / name)


def test_a_far_splat_is_adopted_and_exported(tmp_path):
    """Its last level is what came in, the offset is kept, and the export gives it back."""
    g, at = _ball(), UTM + 0.25
    source = _doubles(tmp_path / "far.ply", g, at)
    config = AdoptConfig(fit="none", views=6, size=(32, 24), shares=(0.5, 1.0), kind="object")
    events: list[Event] = []
    job = Job(RunDir(tmp_path / "run"), events.append, "cpu")
    open_splat(job, source, config, SceneConfig(), MasksConfig(), LabelsConfig())
    make_levels(job, config)
    assert np.abs(np.array(job.scene.offset) - at).max() < 5
    said = [line for event in events if isinstance(event, StageDone) for line in event.lines]
    assert any("far from the origin" in line for line in said)
    decibels = next(float(line.split("PSNR ")[1].split(" dB")[0]) for line in said if "PSNR" in line)
    assert decibels > 45
    assert job.came_in is not None
    assert len(job.came_in) == len(g)
    assert job.references.at(job.scene.views[0].camera).image.shape == (24, 32, 3)
    export_scene(job, tmp_path / "out.ply", level=2, labels=(), target=None)
    assert any(isinstance(event, Warned) and "relative to" in event.text for event in events)
    back = read_splat(tmp_path / "out.ply")
    assert back.offset == job.scene.offset
    centre = (back.gaussians.means.double() + torch.tensor(back.offset)).mean(0) - torch.from_numpy(at)
    assert (centre - g.means.double().mean(0)).abs().max() < 0.01
    export_scene(job, tmp_path / "wide.ply", level=2, labels=(), target=None, doubles=True)
    with (tmp_path / "wide.ply").open("rb") as file:
        header = read_header(file)
        rows = np.fromfile(file, header.dtype, header.count)
    assert {header.types[axis] for axis in "xyz"} == {"f8"}
    assert not (tmp_path / "wide.ply.offset.xyz").exists()
    wide = read_splat(tmp_path / "wide.ply")
    assert np.abs(rows["x"].mean() - at[0] - g.means[:, 0].mean().item()) < 0.01
    by = torch.tensor(wide.offset) - torch.tensor(back.offset)
    assert (wide.gaussians.means + by - back.gaussians.means).abs().max() < 1e-5
    with pytest.raises(RunError, match=r"wide\.spz: --doubles is for \.ply"):
        export_scene(job, tmp_path / "wide.spz", level=2, labels=(), target=None, doubles=True)


@pytest.mark.parametrize("lossless", [False, True])
def test_harmonics_above_one_are_kept(tmp_path, lossless):
    """SPZ cuts them at 1; streams of adopted splats do not."""
    g = replace(_ball(), shN=torch.full((len(_ball()), 3, 3), 8.0))
    write_ply(tmp_path / "a.ply", g)
    config = AdoptConfig(
        fit="none", views=6, size=(32, 24), shares=(0.5, 1.0), kind="object", lossless=lossless
    )
    events: list[Event] = []
    job = Job(RunDir(tmp_path / "run"), events.append, "cpu")
    open_splat(job, tmp_path / "a.ply", config, SceneConfig(), MasksConfig(), LabelsConfig())
    make_levels(job, config)
    said = [event.text for event in events if isinstance(event, Warned)]
    assert not any("--lossless keeps the last level as it came in" in text for text in said)


def test_positions_that_float32_has_rounded_are_said(tmp_path):
    g = _ball()
    far = replace(g, means=(g.means.double() + torch.from_numpy(UTM)).float())
    write_ply(tmp_path / "far.ply", far)
    (note,) = read_splat(tmp_path / "far.ply").notes
    assert "rounds them to 0.5, more than the size of most Gaussians" in note
    write_ply(tmp_path / "large.ply", replace(far, log_scales=torch.full_like(g.log_scales, 2.0)))
    assert not read_splat(tmp_path / "large.ply").notes


def test_spz_refuses_steps_that_are_larger_than_gaussians(tmp_path):
    g = _ball()
    g.means[0] = 1e6
    small = replace(g, log_scales=torch.full_like(g.log_scales, -4.0))
    with pytest.raises(DataError, match=r"a\.spz: positions reach 1e\+06.*write a \.ply"):
        write_splat(tmp_path / "a.spz", small)
    write_splat(tmp_path / "a.ply", small)
    assert torch.equal(read_splat(tmp_path / "a.ply").gaussians.means, small.means)


def test_increments_are_ply_where_spz_is_too_coarse(tmp_path):
    g = replace(_ball(), label_ids=torch.zeros(300, dtype=torch.int16))
    g.means[0] = 1e6
    g = replace(g, log_scales=torch.full_like(g.log_scales, -4.0))
    written = write_increments(tmp_path / "out", g, {0: (100, 300)}, {0: "scene"}, label_of={0: 0})
    assert [one.format for one in written] == ["ply", "spz"]
    sent = read_increments(tmp_path / "out", read_index(tmp_path / "out"))
    assert (sent.means - g.means).abs().max() < 0.01
