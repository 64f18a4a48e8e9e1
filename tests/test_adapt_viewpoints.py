"""Drawn viewpoints: independent draws by a declared rule, and files that come from anybody."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import orbit
from scipy.spatial.transform import Rotation

from sagesplat.adapt.viewpoints import (
    SETS,
    Rule,
    capture_cameras,
    draw,
    read_cameras,
    read_viewpoints,
    write_viewpoints,
)
from sagesplat.core.errors import DataError, RunError
from sagesplat.scene.scene import Camera, Points, Scene, View

NONE = np.empty(0, np.int64)


def scene(cameras: list[Camera], xyz: np.ndarray | None = None) -> Scene:
    xyz = np.zeros((0, 3), np.float32) if xyz is None else xyz.astype(np.float32)
    points = Points(xyz, xyz.astype(np.uint8), NONE, NONE.astype(np.int32), np.empty((0, 2), np.float32))
    views = tuple(View(f"{i:03}", camera, Path()) for i, camera in enumerate(cameras))
    return Scene("s", Path(), views, points, test_every=4, calibrate_every=3)


SCENE = scene(orbit(24))


def poses(cameras) -> np.ndarray:
    return np.stack([camera.w2c for camera in cameras])


def test_draws_depend_on_their_own_number_only():
    base = capture_cameras(SCENE)
    few = draw(SCENE, base, Rule(3), {"fit": 5, "bias": 2, "calibration": 4})
    many = draw(SCENE, base, Rule(3), {"fit": 9, "bias": 3, "calibration": 4})
    for name in SETS:
        wanted = poses(few.cameras)[few.rows(name)]
        assert (poses(many.cameras)[many.rows(name)][: len(wanted)] == wanted).all()
    other = draw(SCENE, base, Rule(4), {"fit": 5, "bias": 2, "calibration": 4})
    assert not np.isclose(poses(other.cameras), poses(few.cameras)).all((1, 2)).any()
    assert len(np.unique(poses(many.cameras).reshape(-1, 16), axis=0)) == 16  # no set repeats another's


def test_viewpoints_lie_between_neighbours_and_close_to_them():
    base = capture_cameras(SCENE)
    rule = Rule(neighbours=2, shift=0.02, turn=0.03, places=(1, 0, 0))
    drawn = draw(SCENE, base, rule, {"fit": 200})
    positions = np.stack([camera.position for camera in base])
    # on an arc each camera's two neighbours are the ones beside it
    order = np.argsort(positions[:, 0])
    a, b = positions[order[:-1]], positions[order[1:]]
    for camera in drawn.cameras:
        assert np.abs(camera.w2c[:3, :3] @ camera.w2c[:3, :3].T - np.eye(3)).max() < 1e-5
        along = np.clip(((camera.position - a) * (b - a)).sum(1) / ((b - a) ** 2).sum(1), 0, 1)[:, None]
        nearest = np.abs(camera.position - (a + along * (b - a))).max(1).min()
        assert nearest <= 3 * rule.shift * SCENE.extent  # ends have their neighbours on one side
        turned = [Rotation.from_matrix(camera.w2c[:3, :3] @ c.w2c[:3, :3].T).magnitude() for c in base]
        assert min(turned) < 0.08 + np.sqrt(3) * rule.turn
    still = draw(SCENE, base, Rule(neighbours=0, shift=0, turn=0, places=(1, 0, 0)), {"fit": 30})
    near = np.abs(poses(still.cameras)[:, None] - poses(base)).max((2, 3)).min(1)
    assert near.max() < 1e-6


def test_no_viewpoint_inside_of_something():
    cameras = orbit(12)
    wall = np.array([camera.position for camera in cameras[3:5]]).mean(0) + np.random.default_rng(0).normal(
        0, 1e-3, (50, 3)
    )
    blocked = scene(cameras, np.concatenate([wall, [[0, 0, 4]]]))
    drawn = draw(blocked, capture_cameras(blocked), Rule(shift=0.001, places=(0.5, 0.5, 0)), {"fit": 200})
    away = np.array([np.linalg.norm(wall - camera.position, axis=1).min() for camera in drawn.cameras])
    own = np.array([np.linalg.norm(wall - camera.position, axis=1).min() for camera in cameras])
    assert away.min() > 0.49 * min(own.min(), np.quantile(own, 0.1))


def test_test_photos_are_not_drawn_from():
    base = capture_cameras(SCENE)
    assert len(base) == len(SCENE.views) - len(SCENE.test_ids)
    tests = poses([SCENE.views[row].camera for row in SCENE.test_ids])
    assert not (poses(base)[:, None] == tests).all((2, 3)).any()


def test_all_cameras_in_one_place_and_a_single_one():
    one = [SCENE.views[1].camera] * 3
    drawn = draw(scene([*one, one[0]]), one, Rule(), {"fit": 4})
    assert np.isfinite(poses(drawn.cameras)).all()
    assert len(draw(SCENE, one[:1], Rule(), {"fit": 2}).cameras) == 2


@pytest.mark.parametrize(
    ("rule", "says"),
    [
        (Rule(screens=(2.0, 0.5)), r"^--sample\.screens 2 0\.5: from the smaller to the larger: 0\.5 2$"),
        (Rule(screens=(0.0, 1.0)), r"--sample\.screens 0\.0 1\.0 is impossible"),
        (Rule(screens=(1.0, 1e6)), r"--sample\.screens 1\.0 1000000\.0 is impossible"),
        (Rule(places=(0, 0, 0)), r"^--sample\.places 0 0 0: no viewpoints anywhere"),
        (Rule(places=(0.5, -0.1, 0)), r"--sample\.places 0\.5 -0\.1 0 is impossible"),
    ],
)
def test_screens_and_places_that_cannot_be(rule, says):
    with pytest.raises(RunError, match=says):
        draw(SCENE, capture_cameras(SCENE), rule, {"fit": 1})


def test_pictures_that_are_too_large_are_one_line_and_its_cure_works():
    photo = replace(SCENE.views[1].camera, width=4000, height=3000)
    with pytest.raises(RunError, match=r"screens 0\.5 50: pictures of 30,000 mega.*; end at 4\.72 or below$"):
        draw(SCENE, [photo], Rule(screens=(0.5, 50.0)), {"fit": 1})
    assert len(draw(SCENE, [photo], Rule(screens=(0.5, 4.72)), {"fit": 3}).cameras) == 3


def test_screens_are_log_uniform_and_keep_the_field_of_view_or_the_area():
    cameras = orbit(12)
    drawn = draw(scene(cameras), cameras, Rule(screens=(0.5, 2.0), fov=1.0), {"fit": 400}).cameras
    s = np.array([camera.focal for camera in drawn]) / cameras[0].focal
    assert (s >= 0.5 - 1e-6).all()
    assert (s <= 2 + 1e-6).all()
    np.testing.assert_allclose(np.quantile(np.log2(s), [0.1, 0.5, 0.9]), [-0.8, 0, 0.8], atol=0.12)
    size = np.array([(camera.width, camera.height) for camera in drawn])
    own = np.array([cameras[0].width, cameras[0].height])
    kept = np.abs(size - s[:, None] * own).max(1) <= 0.5 + 1e-4
    assert 0.4 < kept.mean() < 0.65
    np.testing.assert_allclose(size.prod(1), s**2 * own.prod(), rtol=0.12)
    assert (size[:, 0] < size[:, 1]).mean() > 0.15  # portrait
    for camera, same in zip(drawn, kept, strict=True):
        if not same:
            np.testing.assert_allclose(camera.K[:2, 2], [camera.width / 2, camera.height / 2])


def test_lenses_are_from_the_photos_to_the_widest():
    cameras = orbit(12)
    own = np.array([cameras[0].width, cameras[0].height])
    drawn = draw(scene(cameras), cameras, Rule(screens=(0.5, 2.0), fov=90.0), {"fit": 400}).cameras
    s = np.array([camera.focal for camera in drawn]) / cameras[0].focal
    size = np.array([(camera.width, camera.height) for camera in drawn])
    shaped = np.abs(size - s[:, None] * own).max(1) > 0.5 + 1e-4
    assert 0.35 < shaped.mean() < 0.6
    shorter, same_area = size.min(1) / s, np.sqrt(own.prod() * size.min(1) / size.max(1))
    assert (shorter[shaped] > 0.97 * same_area[shaped]).all()
    assert shorter.max() < 1.03 * 2 * cameras[0].focal  # 90 degrees
    assert (shorter[shaped] > 1.3 * same_area[shaped]).mean() > 0.3
    assert size.prod(1).max() < 12.2 * own.prod()  # three times a photo's on the sharpest screen


def test_places_are_on_the_path_among_the_cameras_and_behind_them():
    cameras = orbit(24)
    points = np.random.default_rng(0).normal([0, 0, 4], 0.3, (400, 3))
    where = scene(cameras, points)
    base = capture_cameras(where)
    positions = np.stack([camera.position for camera in base])

    def drawn(*places: Any) -> list[Camera]:
        return list(draw(where, base, Rule(places=places), {"fit": 100}).cameras)

    up = poses(base)[:, 1, :3].mean(0)
    low, high = positions.min(0), positions.max(0)
    grown = 0.1 * (high - low) + 0.11 * where.extent
    for camera in drawn(0, 1, 0):
        assert ((camera.position > low - grown) & (camera.position < high + grown)).all()
        assert abs(camera.w2c[0, :3] @ up) < 1e-5  # no roll
        middle = np.median(points, 0) - camera.position
        assert camera.direction @ middle / np.linalg.norm(middle) > 0.9
    for camera in drawn(0, 0, 1):
        same = int(np.abs(poses(base)[:, :3, :3] - camera.w2c[:3, :3]).max((1, 2)).argmin())
        depth = (points - positions[same]) @ base[same].direction
        moved = positions[same] - camera.position
        assert np.linalg.norm(moved) <= np.median(depth[depth > 0]) + 1e-4
        np.testing.assert_allclose(moved, (moved @ base[same].direction) * base[same].direction, atol=1e-4)
    mixed = poses(draw(where, base, Rule(places=(0.4, 0.4, 0.2)), {"fit": 200}).cameras)
    turned = np.abs(mixed[:, None, :3, :3] - poses(base)[None, :, :3, :3]).max((2, 3)).min(1)
    assert 0.1 < (turned < 1e-6).mean() < 0.3  # those that step back have a camera's own rotation


def test_files_come_back(tmp_path):
    base = capture_cameras(SCENE)
    base_focal = np.median([camera.focal for camera in base])
    drawn = draw(SCENE, base, Rule(7, 2, 0.1, 0.2, (0.3, 1.5)), {"fit": 3, "calibration": 2})
    write_viewpoints(tmp_path / "v.json", drawn)
    back = read_viewpoints(tmp_path / "v.json")
    assert (back.rule, back.sets, back.source) == (drawn.rule, drawn.sets, "capture")
    assert back.focal == drawn.focal == pytest.approx(base_focal)
    assert (poses(back.cameras) == poses(drawn.cameras)).all()
    assert [c.K.tolist() for c in back.cameras] == [c.K.tolist() for c in drawn.cameras]
    assert (poses(read_cameras(tmp_path / "v.json", SCENE.views[0].camera)) == poses(drawn.cameras)).all()


@pytest.mark.parametrize(
    "change",
    [
        {"format": "other"},
        {"viewpoints": [{"set": "fit", "w2c": [[1, 2], [3, 4]], "K": [[1]], "width": 4, "height": 4}]},
        {"width": 10**6, "height": 10**6},
        {"K": np.zeros((3, 3)).tolist()},
    ],
)
def test_damaged_files_are_one_line(tmp_path, change):
    write_viewpoints(tmp_path / "v.json", draw(SCENE, capture_cameras(SCENE), Rule(), {"fit": 1}))
    document = json.loads((tmp_path / "v.json").read_text())
    (document if change.keys() <= document.keys() else document["viewpoints"][0]).update(change)
    (tmp_path / "v.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match=r"not a file of viewpoints .*run `sagesplat sample` again"):
        read_viewpoints(tmp_path / "v.json")


def test_own_cameras_from_the_frames_of_a_transforms_file(tmp_path):
    like = replace(SCENE.views[0].camera, width=30, height=20)
    c2w = np.linalg.inv(SCENE.views[5].camera.w2c.astype(np.float64)) * [1, -1, -1, 1]
    (tmp_path / "path.json").write_text(json.dumps({"frames": [{"transform_matrix": c2w.tolist()}]}))
    (camera,) = read_cameras(tmp_path / "path.json", like)
    np.testing.assert_allclose(camera.w2c, SCENE.views[5].camera.w2c, atol=1e-6)
    assert (camera.width, camera.height) == (30, 20)


@pytest.mark.parametrize("text", ["{", '{"frames": []}', '{"frames": [{}]}'])
def test_lists_of_cameras_that_are_none(tmp_path, text):
    (tmp_path / "path.json").write_text(text)
    with pytest.raises((DataError, RunError), match=r"give a viewpoints\.json, or a transforms\.json"):
        read_cameras(tmp_path / "path.json", SCENE.views[0].camera)
