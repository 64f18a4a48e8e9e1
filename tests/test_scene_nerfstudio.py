"""transforms.json of nerfstudio and Blender, listed splits, white backgrounds, and what kind a folder is."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_scene_colmap import poses

from sagesplat.core.errors import SceneError
from sagesplat.core.geometry import project, to_camera
from sagesplat.scene import nerfstudio
from sagesplat.scene.colmap import load_colmap
from sagesplat.scene.colmap_write import ModelCamera, ModelImage, write_model
from sagesplat.scene.detect import detect
from sagesplat.scene.images import load_photo, photo_size
from sagesplat.scene.nerfstudio import load_blender, load_transforms
from sagesplat.scene.points import random_points
from sagesplat.scene.scene import Camera, Lens, Points, Scene, View
from sagesplat.scene.undistort import distort

INTRINSICS = {"fl_x": 35.0, "fl_y": 36.0, "cx": 21.5, "cy": 13.25, "w": 40, "h": 30}
# What nerfstudio does to COLMAP's world: x and y change places, z turns round.
APPLIED = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1.0]])


@pytest.fixture(autouse=True, scope="module")
def few_points():
    """A hundred thousand random points for every scene here would take half a minute."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nerfstudio, "random_points", partial(random_points, count=300))
        yield


def opengl(w2c: np.ndarray) -> list[list[float]]:
    """Camera to world in OpenGL axes, as the files have it."""
    return (np.linalg.inv(w2c) @ np.diag([1, -1, -1, 1])).tolist()


def save_photo(path: Path, size: tuple[int, int] = (40, 30), *, seed: int = 0, channels: int = 3) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    noise = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], channels))
    Image.fromarray(noise.astype(np.uint8)).save(path)


def capture(folder: Path, *, views: int = 5, shared: dict | None = None, own: dict | None = None) -> dict:
    """A nerfstudio folder without points; frames are not in the order of their names. Returns the content."""
    frames = []
    for i, w2c in enumerate(poses(views)):
        name = f"images/frame_{views - i:05d}.png"
        save_photo(folder / name, seed=i)
        frames.append({"file_path": f"./{name}", "transform_matrix": opengl(w2c), **(own or {})})
    content = {"camera_model": "OPENCV", **(INTRINSICS if shared is None else shared), "frames": frames}
    write(folder, content)
    return content


def write(folder: Path, content: Any, name: str = "transforms.json") -> None:
    (folder / name).write_text(json.dumps(content))


def test_poses_names_and_intrinsics(tmp_path):
    capture(tmp_path)
    scene = load_transforms(tmp_path, test_every=2)
    assert [v.name for v in scene.views] == [f"frame_{i:05d}.png" for i in range(1, 6)]
    assert scene.test_ids.tolist() == [0, 2, 4]
    assert (scene.name, scene.path) == (tmp_path.name, tmp_path)
    for view, w2c in zip(scene.views, reversed(poses(5)), strict=True):
        np.testing.assert_allclose(view.camera.w2c, w2c, atol=1e-6)
        assert view.camera.K.tolist() == [[35, 0, 21.5], [0, 36, 13.25], [0, 0, 1]]
        assert (view.camera.width, view.camera.height, view.lens) == (40, 30, None)
        assert view.camera.w2c.dtype == view.camera.K.dtype == np.float32
    assert len(scene.points.xyz) == 300
    assert scene.extent > 0


def test_the_image_of_the_world_is_the_same_as_colmaps(tmp_path):
    """nerfstudio's conversion of a COLMAP model (world changed, ply changed with it) and the model itself."""
    rng = np.random.default_rng(0)
    xyz, rgb = rng.uniform(-0.8, 0.8, (20, 3)), rng.integers(0, 256, (20, 3)).astype(np.uint8)
    frames, images = [], []
    for i, w2c in enumerate(poses(4)):
        name = f"{i}.png"
        save_photo(tmp_path / "images" / name, seed=i)
        c2w = APPLIED @ np.array(opengl(w2c))
        frames.append({"file_path": f"images/{name}", "transform_matrix": c2w.tolist()})
        images.append(ModelImage(i + 1, name, 1, w2c, np.zeros((1, 2)), np.array([0])))
    camera = ModelCamera(1, "PINHOLE", 40, 30, (35.0, 36.0, 21.5, 13.25))
    write_model(tmp_path / "sparse/0", [camera], images, xyz, rgb, np.zeros(20))
    moved = xyz @ APPLIED[:3, :3].T
    rows = [f"{x:.9f} {y:.9f} {z:.9f} {r} {g} {b}" for (x, y, z), (r, g, b) in zip(moved, rgb, strict=True)]
    head = "ply\nformat ascii 1.0\nelement vertex 20\nproperty float x\nproperty float y\nproperty float z\n"
    head += "".join(f"property uint8 {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    (tmp_path / "sparse_pc.ply").write_text(head + "\n".join(rows) + "\n")
    applied = APPLIED[:3].tolist()
    write(
        tmp_path,
        {**INTRINSICS, "applied_transform": applied, "ply_file_path": "sparse_pc.ply", "frames": frames},
    )
    ours, theirs = load_transforms(tmp_path), load_colmap(tmp_path)
    np.testing.assert_array_equal(ours.points.rgb, theirs.points.rgb)
    for a, b in zip(ours.views, theirs.views, strict=True):
        assert a.name == b.name
        here, there = (to_camera(s.points.xyz, v.camera.w2c) for s, v in ((ours, a), (theirs, b)))
        np.testing.assert_allclose(here, there, atol=1e-5)
        np.testing.assert_array_equal(a.camera.K, b.camera.K)
    assert ours.extent == pytest.approx(theirs.extent, rel=1e-5)


LENSES = {
    "OPENCV": ({"k1": 0.05, "k2": 0.01, "p1": 1e-3, "p2": -1e-3}, "OPENCV", (0.05, 0.01, 1e-3, -1e-3)),
    "OPENCV_FISHEYE": (
        {"k1": 0.05, "k2": 0.01, "k3": 1e-3, "k4": -1e-3},
        "OPENCV_FISHEYE",
        (0.05, 0.01, 1e-3, -1e-3),
    ),
    "PINHOLE": ({}, None, ()),
    "SIMPLE_RADIAL": ({"k1": 0.02}, "OPENCV", (0.02, 0, 0, 0)),
    "OPENCV with k3": (
        {"camera_model": "OPENCV", "k1": 0.05, "k3": 0.02},
        "FULL_OPENCV",
        (0.05, 0, 0, 0, 0.02, 0, 0, 0),
    ),
    "instant-ngp's fisheye": ({"camera_model": None, "is_fisheye": True}, "OPENCV_FISHEYE", (0, 0, 0, 0)),
}


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("model", LENSES)
def test_distortion_becomes_a_lens(tmp_path, model, own):
    given, name, coefficients = LENSES[model]
    all_of = {"camera_model": model, **INTRINSICS, **given}
    capture(tmp_path, shared={} if own else all_of, own=all_of if own else {})
    view = load_transforms(tmp_path).views[0]
    if name is None:
        assert view.lens is None
        return
    assert view.lens is not None
    assert view.lens.model == name
    assert view.lens.params == (35, 36, 21.5, 13.25, *coefficients)
    assert (view.lens.width, view.lens.height) == (40, 30)
    assert load_photo(view).shape == (30, 40, 3)
    corner = (np.array([0.5, 0.5]) - view.camera.K[:2, 2]) / view.camera.K[[0, 1], [0, 1]]
    assert (distort(view.lens, corner) > 0).all()  # the pinhole's border has pixels of the photo


def test_angle_of_view_and_defaults(tmp_path):
    capture(tmp_path, shared={"camera_angle_x": 2 * np.arctan(0.4)})
    camera = load_transforms(tmp_path).views[0].camera
    np.testing.assert_allclose(camera.K, [[50, 0, 20], [0, 50, 15], [0, 0, 1]], rtol=1e-6)
    capture(tmp_path, shared={"camera_angle_x": 2 * np.arctan(0.4), "camera_angle_y": 2 * np.arctan(0.25)})
    assert load_transforms(tmp_path).views[0].camera.K[1, 1] == 60
    capture(tmp_path, shared={"fl_x": 44})
    assert load_transforms(tmp_path).views[0].camera.K[[0, 1], [0, 1]].tolist() == [44, 44]


def test_frames_of_their_own_size(tmp_path):
    content = capture(tmp_path)
    save_photo(tmp_path / "images/frame_00002.png", (64, 16))
    content["frames"][3] |= {"w": 64, "h": 16, "fl_x": 50, "cx": 32, "cy": 8}
    write(tmp_path, content)
    cameras = [v.camera for v in load_transforms(tmp_path).views]
    assert [(c.width, c.height) for c in cameras[:3]] == [(40, 30), (64, 16), (40, 30)]
    assert cameras[1].K.tolist() == [[50, 0, 32], [0, 36, 8], [0, 0, 1]]


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("shipped", [True, False])
def test_downscale(tmp_path, shipped, stated):
    shared = dict(INTRINSICS)
    if not stated:
        del shared["w"], shared["h"]
    capture(tmp_path, shared=shared)
    if shipped:
        for photo in (tmp_path / "images").iterdir():
            save_photo(tmp_path / "images_4" / photo.name, (10, 7))  # 30 / 4 rounded down
    view = load_transforms(tmp_path, downscale=4).views[0]
    height = 7 if shipped else 8
    assert (view.camera.width, view.camera.height) == (10, height)
    expected = [[35 / 4, 0, 21.5 / 4], [0, 36 * height / 30, 13.25 * height / 30], [0, 0, 1]]
    np.testing.assert_allclose(view.camera.K, expected, rtol=1e-6)
    assert view.name == "frame_00001.png"
    assert view.image_path.parent.name == ("images_4" if shipped else "images")
    assert load_photo(view).shape == (height, 10, 3)


@pytest.mark.parametrize("cut", [int, round])
def test_mipnerf360_layout(tmp_path, cut):
    """images, images_2, images_4, images_8, sparse/0 and poses_bounds.npy; sizes that N does not divide."""
    camera = ModelCamera(1, "PINHOLE", 83, 55, (70.0, 70.0, 41.5, 27.5))
    xyz = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    images = []
    for i, w2c in enumerate(poses(5)):
        local = xyz @ w2c[:3, :3].T + w2c[:3, 3]
        uv = 70 * local[:, :2] / local[:, 2:] + [41.5, 27.5]
        images.append(ModelImage(i + 1, f"DSC{i}.png", 1, w2c, uv, np.arange(20)))
        for n in (1, 2, 4, 8):
            name = tmp_path / ("images" if n == 1 else f"images_{n}") / f"DSC{i}.png"
            save_photo(name, (cut(83 / n), cut(55 / n)))
    write_model(tmp_path / "sparse/0", [camera], images, xyz, np.zeros((20, 3), np.uint8), np.zeros(20))
    np.save(tmp_path / "poses_bounds.npy", np.zeros((5, 17)))
    assert detect(tmp_path) == "colmap"
    for n in (1, 2, 4, 8):
        scene = load_colmap(tmp_path, downscale=n)
        view = scene.views[0]
        width, height = photo_size(view.image_path)
        assert view.image_path.parent.name == ("images" if n == 1 else f"images_{n}")
        assert (view.camera.width, view.camera.height) == (width, height)
        np.testing.assert_allclose(view.camera.K[:2, 2], [width / 2, height / 2], rtol=1e-6)
        uv, _ = project(scene.points.xyz, view.camera.w2c, view.camera.K)
        seen = scene.points.track_views == 0
        rows = scene.points.track_points[seen]
        np.testing.assert_allclose(uv[rows], scene.points.track_uv[seen], atol=1e-3)


def test_listed_split(tmp_path):
    content = capture(tmp_path, views=8)
    paths = [frame["file_path"] for frame in content["frames"]]  # names fall
    content |= {"train_filenames": paths[:5], "val_filenames": paths[5:7], "test_filenames": paths[6:]}
    write(tmp_path, content)
    scene = load_transforms(tmp_path)
    assert [v.name[-5] for v in scene.views] == list("1245678")  # 3 is for validation only
    assert scene.test_ids.tolist() == [0, 1]
    assert scene.train_ids.tolist() == [2, 3, 4, 5, 6]
    assert load_transforms(tmp_path, test_every=0).train_ids.tolist() == list(range(8))
    for listed, tests in (
        ({"val_filenames": paths[:2]}, [6, 7]),
        ({"val_filenames": paths[:2], "test_filenames": []}, [6, 7]),
        ({"train_filenames": [p.removeprefix("./") for p in paths[:4]]}, [0, 1, 2, 3]),
    ):
        plain = {key: value for key, value in content.items() if not key.endswith("_filenames")}
        write(tmp_path, plain | listed)
        assert load_transforms(tmp_path).test_ids.tolist() == tests


def blender(folder: Path, *, channels: int = 4, tests: str | None = "test") -> None:
    counts = {"train": 6, "val": 3} | ({tests: 4} if tests else {})
    for part, count in counts.items():
        frames = []
        for i, w2c in enumerate(poses(count)):
            save_photo(folder / part / f"r_{i}.png", (20, 20), seed=i, channels=channels)
            frames.append({"file_path": f"./{part}/r_{i}", "rotation": 0.01, "transform_matrix": opengl(w2c)})
        write(folder, {"camera_angle_x": 0.6911112, "frames": frames}, f"transforms_{part}.json")


def test_blender(tmp_path):
    blender(tmp_path)
    scene = load_blender(tmp_path)
    assert [v.name for v in scene.views] == [f"test/r_{i}.png" for i in range(4)] + [
        f"train/r_{i}.png" for i in range(6)
    ]
    assert scene.test_ids.tolist() == [0, 1, 2, 3]
    assert scene.train_ids.tolist() == list(range(4, 10))
    np.testing.assert_allclose(scene.views[4].camera.w2c, poses(6)[0], atol=1e-6)
    focal = 10 / np.tan(0.6911112 / 2)
    np.testing.assert_allclose(
        scene.views[0].camera.K, [[focal, 0, 10], [0, focal, 10], [0, 0, 1]], rtol=1e-6
    )
    assert np.abs(scene.points.xyz).max() <= 1.3
    assert len(scene.points.xyz) == 300
    assert {v.camera.background for v in scene.views} == {(255, 255, 255)}
    with Image.open(scene.views[0].image_path) as file:
        rgba = np.asarray(file).astype(float)
    over = rgba[..., :3] * rgba[..., 3:] / 255 + 255 - rgba[..., 3:]
    assert np.abs(load_photo(scene.views[0]) - over).max() <= 1
    small = load_blender(tmp_path, downscale=2).views[0]
    assert (small.camera.width, small.camera.K[0, 2]) == (10, 5)
    assert small.camera.resized(5, 5).background == (255, 255, 255)
    np.testing.assert_allclose(load_photo(small), over.reshape(10, 2, 10, 2, 3).mean((1, 3)), atol=1.5)


def test_blender_with_other_splits(tmp_path):
    blender(tmp_path)
    scene = load_blender(tmp_path / "transforms_train.json", test_every=0)
    assert len(scene.train_ids) == 10
    (tmp_path / "transforms_test.json").unlink()
    scene = load_blender(tmp_path)
    assert [scene.views[row].name for row in scene.test_ids] == [f"val/r_{i}.png" for i in range(3)]
    (tmp_path / "transforms_val.json").unlink()
    assert load_blender(tmp_path, test_every=3).test_ids.tolist() == [0, 3]


def test_explicit_split_of_a_scene():
    camera = Camera(np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32), 4, 4)
    views = tuple(View(f"{i}", camera, Path()) for i in range(10))
    none = np.zeros(0, np.int64)
    empty = np.zeros((0, 3), np.float32)
    points = Points(empty, empty.astype(np.uint8), none, none.astype(np.int32), empty[:, :2])
    scene = Scene("s", Path(), views, points, test_every=5, calibrate_every=4)
    assert scene.test_ids.tolist() == [0, 5]
    listed = replace(scene, test_names=frozenset({"1", "2", "9", "gone"}))
    assert listed.test_ids.tolist() == [1, 2, 9]
    assert listed.calibration_ids.tolist() == [4, 8]
    assert listed.train_ids.tolist() == [0, 3, 5, 6, 7]
    assert [listed.split(row) for row in (0, 1, 4)] == ["train", "test", "calibration"]
    assert replace(scene, test_names=frozenset()).test_ids.tolist() == []


POSE = np.array(opengl(poses(5)[2]))
WRONG = [  # changed keys of the file, changed keys of one frame, and what is said of them
    ({"frames": []}, {}, "not a transforms file"),
    ({}, {"file_path": "images/\x1b[31m.png"}, r"file_path .*: it holds a control .*, U\+001B; rename"),
    ({}, {"file_path": "images/frame_00001.png"}, "the frames name 'frame_00001.png' twice"),
    ({}, {"transform_matrix": (POSE * np.nan).tolist()}, "transform_matrix: numbers that are not finite"),
    ({}, {"transform_matrix": (POSE @ np.diag([2, 2, 3, 1])).tolist()}, r"no rotation \(axes 2, 2, 3 long\)"),
    ({}, {"transform_matrix": (POSE @ np.diag([1, 1, -1, 1])).tolist()}, "is a reflection"),
    ({}, {"transform_matrix": POSE.T.tolist()}, "last row .* transposed"),
    ({"fl_x": None, "fl_y": None}, {}, "neither fl_x nor camera_angle_x"),
    ({}, {"fl_x": -3}, "focal length .* is out of range"),
    ({}, {"w": 0}, "size 0 x 30 is out of range"),
    ({}, {"camera_model": "VR180_L"}, "camera_model 'VR180_L' is not one of OPENCV"),
    ({}, {"k4": 0.1}, "OPENCV has no k4"),
    ({}, {"k1": -30.0}, "no pinhole view fits into a OPENCV camera"),
    ({}, {"w": 30, "h": 40}, "40 x 30 pixels, but its camera has another aspect ratio, 30 x 40"),
    ({"ply_file_path": "../a.ply"}, {}, "a.ply: no such file; add it, or remove ply_file_path"),
    ({"val_filenames": ["x.png"]}, {}, "1 of 1 names in val_filenames are of no frame, first 'x.png'"),
]


@pytest.mark.parametrize(("shared", "own", "message"), WRONG)
def test_errors_are_one_line_that_begins_with_the_path(tmp_path, shared, own, message):
    content = capture(tmp_path)
    content["frames"][2] |= own
    write(tmp_path, content | shared)
    with pytest.raises(SceneError, match=message) as raised:
        load_transforms(tmp_path)
    assert str(raised.value).startswith(str(tmp_path))


def test_detect(tmp_path):
    capture(tmp_path / "a", views=1)
    blender(tmp_path / "b")
    (tmp_path / "c/sparse/0").mkdir(parents=True)
    (tmp_path / "c/sparse/0/cameras.txt").touch()
    shutil.copy(tmp_path / "a/transforms.json", tmp_path / "c")  # a COLMAP model knows more
    (tmp_path / "d/sparse").mkdir(parents=True)
    (tmp_path / "d/sparse/cameras.bin").touch()
    save_photo(tmp_path / "e/1.PNG")
    save_photo(tmp_path / "f/images/1.jpg")
    (tmp_path / "walk.MP4").touch()
    expected = {
        "a": "transforms",
        "a/transforms.json": "transforms",
        "b": "blender",
        "b/transforms_train.json": "blender",
        "c": "colmap",
        "d": "colmap",
        "e": "photos",
        "f": "photos",
        "walk.MP4": "video",
    }
    assert {name: detect(tmp_path / name) for name in expected} == expected


def test_detect_says_what_it_looked_for(tmp_path):
    (tmp_path / "a.png").mkdir()  # a folder is no photo
    with pytest.raises(
        SceneError, match=r"no capture \(looked for .*cameras.bin.*transforms.json.*photos in"
    ):
        detect(tmp_path)


def test_opaque_photos_keep_the_black_background(tmp_path):
    blender(tmp_path, channels=3)
    assert {v.camera.background for v in load_blender(tmp_path).views} == {(0, 0, 0)}


def renamed(change) -> Callable[[dict], None]:
    """All file_paths written in another way."""

    def apply(content: dict) -> None:
        for frame in content["frames"]:
            frame["file_path"] = change(frame["file_path"].removeprefix("./"))

    return apply


@pytest.mark.parametrize(
    "change",
    [
        lambda name: name.replace("/", "\\"),
        lambda name: "D:\\captures\\house\\" + name.replace("/", "\\"),
        lambda name: f"/home/you/house/{name}",
        lambda name: f"../house/{name}",
        lambda name: name.upper(),
        lambda name: name.removesuffix(".png"),
        lambda name: name.replace(".png", ".jpg"),
        lambda name: name.removeprefix("images/"),
    ],
)
def test_frames_find_their_photos_however_they_are_written(tmp_path, change):
    folder = tmp_path / "house"
    content = capture(folder)
    shutil.copytree(folder / "images", folder / "images_2")
    for path in (folder / "images_2").iterdir():
        save_photo(path, (20, 15))
    plain = load_transforms(folder)
    renamed(change)(content)
    write(folder, content | {"train_filenames": [frame["file_path"] for frame in content["frames"][1:]]})
    scene = load_transforms(folder)
    assert [(v.name, v.image_path) for v in scene.views] == [(v.name, v.image_path) for v in plain.views]
    assert scene.test_names == {"frame_00005.png"}
    assert any(note.startswith("5 of 5 photos are written differently") for note in scene.notes)
    assert {v.image_path.parent.name for v in load_transforms(folder, downscale=2).views} == {"images_2"}


def test_frames_whose_photo_is_gone_are_left_out(tmp_path):
    content = capture(tmp_path)
    write(tmp_path, content | {"test_filenames": [frame["file_path"] for frame in content["frames"][:2]]})
    (tmp_path / "images/frame_00005.png").unlink()
    scene = load_transforms(tmp_path)
    assert [view.name for view in scene.views] == [f"frame_{i:05d}.png" for i in range(1, 5)]
    assert scene.test_names == {"frame_00004.png"}
    assert "1 of 5 posed photos are gone and left out, first './images/frame_00005.png'" in scene.notes
    for i in (1, 2):
        (tmp_path / f"images/frame_0000{i}.png").unlink()
    with pytest.raises(SceneError, match=r"3 of the 5 photos of transforms\.json are missing, .* --images"):
        load_transforms(tmp_path)


def test_the_scale_of_a_camera_is_left_out(tmp_path):
    content = capture(tmp_path)
    for frame in content["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([2, 2, 2, 1])).tolist()
    write(tmp_path, content)
    scene = load_transforms(tmp_path)
    for view, w2c in zip(scene.views, reversed(poses(5)), strict=True):
        np.testing.assert_allclose(view.camera.w2c, w2c, atol=1e-6)
    assert "the axes of the poses are 2 long; their scale is left out" in scene.notes


def test_panoramas_and_lenses_by_other_names(tmp_path):
    content = capture(tmp_path, own={"camera_model": "EQUIRECTANGULAR", "w": 40, "h": 20, "fl_x": 20})
    for photo in (tmp_path / "images").iterdir():
        save_photo(photo, (40, 20))
    scene = load_transforms(tmp_path, test_every=0)
    assert len(scene.views) == 30
    assert scene.views[0].lens == Lens("EQUIRECTANGULAR", (40.0, 20.0), 40, 20, face="back")
    aria = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06]
    lenses = {
        "PERSPECTIVE": ({"k1": 0.1}, "OPENCV", (0.1, 0, 0, 0)),
        "FISHEYE": ({"k1": 0.1}, "OPENCV_FISHEYE", (0.1, 0, 0, 0)),
        "OPENCV": ({"k1": 0.1, "k4": 1e-12}, "OPENCV", (0.1, 0, 0, 0)),
        "FISHEYE624": ({"distortion_params": aria}, "RAD_TAN_THIN_PRISM_FISHEYE", tuple(aria)),
    }
    for name, (given, model, coefficients) in lenses.items():
        for frame in content["frames"]:
            frame |= {"camera_model": name, "w": 40, "h": 20, "fl_x": 20, "fl_y": 20, **given}
        write(tmp_path, content)
        lens = load_transforms(tmp_path).views[0].lens
        assert lens is not None
        assert (lens.model, lens.params[4:]) == (model, coefficients)
        for frame in content["frames"]:
            for key in given:
                del frame[key]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_transforms_of_windows_tools(tmp_path, encoding):
    content = capture(tmp_path)
    (tmp_path / "transforms.json").write_text(json.dumps(content), encoding=encoding)
    assert len(load_transforms(tmp_path).views) == 5


def test_masks_among_photos_are_not_counted_as_photos(tmp_path):
    capture(tmp_path)
    for photo in list((tmp_path / "images").iterdir()):
        Image.new("L", (40, 30), 255).save(photo.with_name(f"{photo.stem}_mask.png"))
    assert "5 of 5 photos have poses" in load_transforms(tmp_path).notes


def test_points_at_the_end_of_a_path_of_another_machine(tmp_path):
    content = capture(tmp_path)
    head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float X\nproperty float Y\nproperty float Z\n"
    (tmp_path / "sparse_pc.ply").write_text(head + "end_header\n1 2 3\n")
    write(tmp_path, content | {"ply_file_path": "C:\\house\\sparse_pc.ply"})
    assert load_transforms(tmp_path).points.xyz.tolist() == [[1, 2, 3]]
