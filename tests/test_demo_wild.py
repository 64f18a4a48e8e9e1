import json
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sagesplat.demo.cameras import demo_cameras
from sagesplat.demo.capture import make_capture
from sagesplat.demo.figures import PERSON
from sagesplat.demo.off_path import APART, UNSEEN
from sagesplat.demo.wild import Wild, noisy_cameras
from sagesplat.scene.colmap import load_colmap
from sagesplat.scene.nerfstudio import load_transforms

SIZE: dict[str, Any] = {"views": 12, "width": 64, "height": 48}
WILD = Wild(0.7, 0.15, 0.4, 2, True, 0.5, 0.005, keep=0.75, half_circle=True, off_path=4)


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wild") / "clean"
    make_capture(folder, **SIZE)
    return folder


@pytest.fixture(scope="module")
def wild(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wild") / "wild"
    make_capture(folder, **SIZE, wild=WILD)
    return folder


def pictures(folder):
    return np.stack([np.array(Image.open(path)) for path in sorted(folder.glob("*.png"))]).astype(int)


def test_loads_as_a_scene_with_its_truth(wild):
    scene, truth = load_colmap(wild), load_transforms(wild / "truth", test_every=0)
    assert len(scene.views) == len(truth.views) == 9
    for view, exact in zip(scene.views, truth.views, strict=True):
        assert view.name == exact.image_path.name
        off = np.linalg.norm(view.camera.position - exact.camera.position) / scene.extent
        assert 0 < off < 0.025
        turn = view.camera.w2c[:3, :3] @ exact.camera.w2c[:3, :3].T
        assert 0 < np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 2.5
    angle = np.arctan2(*np.stack([view.camera.position for view in truth.views])[:, 1::-1].T)
    assert np.ptp(angle % (2 * np.pi)) < 1.2 * np.pi


def test_each_disturbance_alone_leaves_the_truth(clean, tmp_path):
    make_capture(tmp_path / "half", **SIZE, wild=Wild(vignetting=0.4))
    np.testing.assert_array_equal(pictures(tmp_path / "half/truth/images"), pictures(clean / "images"))
    np.testing.assert_array_equal(pictures(tmp_path / "half/masks"), pictures(clean / "masks"))
    fall = pictures(tmp_path / "half/images") / pictures(clean / "images").clip(1)
    assert fall[:, 22:26, 30:34].mean() == pytest.approx(1, abs=0.01)
    assert fall[:, [0, 0, -1, -1], [0, -1, 0, -1]].mean() < 0.9


def test_pose_noise_has_the_size_that_was_asked():
    cameras = demo_cameras(400, 64, 48, 0)
    noisy = noisy_cameras(Wild(pose_degrees=0.5, pose_shift=0.005), cameras, 0)
    turns = [n.w2c[:3, :3].astype(float) @ c.w2c[:3, :3].T for n, c in zip(noisy, cameras, strict=True)]
    angle = np.degrees([np.arcsin(np.linalg.norm(t - t.T) / np.sqrt(8)) for t in turns])
    assert np.sqrt(np.mean(angle**2)) == pytest.approx(0.5, rel=0.1)
    centres = np.stack([c.position for c in cameras])
    extent = 1.1 * np.linalg.norm(centres - centres.mean(0), axis=1).max()
    moved = np.linalg.norm(np.stack([c.position for c in noisy]) - centres, axis=1)
    assert np.sqrt(np.mean(moved**2)) == pytest.approx(0.005 * extent, rel=0.1)
    assert noisy_cameras(Wild(), cameras, 0) is cameras


def test_figures_are_in_photos_and_masks_where_the_truth_says(wild, tmp_path):
    standing = pictures(wild / "truth/figures") == 255
    assert 0.01 < standing.mean() < 0.3
    np.testing.assert_array_equal(pictures(wild / "masks") == PERSON, standing)
    assert json.loads((wild / "masks/labels.json").read_text())["labels"]["1"] == "person"
    off = np.abs(pictures(wild / "images") - pictures(wild / "truth/images")).mean(-1)
    assert off[standing].mean() > 1.5 * off[~standing].mean()
    make_capture(tmp_path / "bare", **SIZE, wild=Wild(figures=2, figure_masks=False))
    assert PERSON not in pictures(tmp_path / "bare/masks")
    assert "1" not in json.loads((tmp_path / "bare/masks/labels.json").read_text())["labels"]


def test_no_track_is_on_a_figure(wild):
    points, standing = load_colmap(wild).points, pictures(wild / "truth/figures") == 255
    column, row = points.track_uv.astype(int).T
    assert standing[points.track_views, row, column].mean() < 0.01  # features have noise


def test_off_path_pictures_show_what_the_photos_saw(wild):
    scene, path = load_transforms(wild / "truth/off_path", test_every=0), load_transforms(wild / "truth")
    seen = pictures(wild / "truth/off_path/seen") == 255
    assert len(scene.views) == 4
    assert (seen.mean((1, 2)) >= 1 - UNSEEN).all()
    photos = np.stack([view.camera.position for view in path.views])
    for view in scene.views:
        assert np.linalg.norm(photos - view.camera.position, axis=1).min() >= APART - 1e-4
