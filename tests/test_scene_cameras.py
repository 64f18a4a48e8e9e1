"""Cameras of others: files of 3DGS, viewpoints, transforms and captures, and what is wrong with them."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import orbit, random_gaussians, write_capture

from sagesplat.adapt.viewpoints import Rule, Viewpoints, write_viewpoints
from sagesplat.core.errors import SageError
from sagesplat.scene.cameras import NamedCamera, read_camera_file

CAMERAS = orbit(4)


def entry(number: int) -> dict:
    """A camera as 3DGS writes it."""
    camera = CAMERAS[number]
    return {
        "id": number,
        "img_name": f"a/{number}.png",
        "width": camera.width,
        "height": camera.height,
        "position": camera.position.tolist(),
        "rotation": camera.w2c[:3, :3].T.tolist(),
        "fx": 40.0,
        "fy": 41.0,
    }


def transforms(**more) -> dict:
    poses = [np.linalg.inv(c.w2c.astype(np.float64)) @ np.diag([1, -1, -1, 1]) for c in CAMERAS]
    frames = [{"file_path": f"images/{i}", "transform_matrix": p.tolist()} for i, p in enumerate(poses)]
    return {"w": 48, "h": 32, "fl_x": 40.0, "cx": 25.0, "cy": 14.0, "frames": frames} | more


def put(folder: Path, document: object, name: str = "cameras.json") -> Path:
    (folder / name).write_text(json.dumps(document))
    return folder / name


def assert_as_drawn(found: list[NamedCamera]) -> None:
    for one, camera in zip(found, CAMERAS, strict=True):
        np.testing.assert_allclose(one.camera.w2c, camera.w2c, atol=1e-5)
        assert (one.camera.width, one.camera.height) == (48, 32)


def test_cameras_of_3dgs(tmp_path):
    path = put(tmp_path, [entry(i) for i in range(4)])
    found = read_camera_file(path)
    assert_as_drawn(found)
    assert [one.name for one in found] == ["a/0.png", "a/1.png", "a/2.png", "a/3.png"]
    assert found[0].camera.K.tolist() == [[40, 0, 24], [0, 41, 16], [0, 0, 1]]
    assert found[0].photo is None
    assert_as_drawn(read_camera_file(tmp_path))  # the folder of a model
    put(tmp_path, [entry(i) | {"cx": 20.5, "cy": 17.0} for i in range(4)])
    assert read_camera_file(path)[0].camera.K.tolist() == [[40, 0, 20.5], [0, 41, 17], [0, 0, 1]]


def test_viewpoints_of_a_run(tmp_path):
    write_viewpoints(tmp_path / "v.json", Viewpoints(Rule(), "capture", 50.0, tuple(CAMERAS), ("fit",) * 4))
    found = read_camera_file(tmp_path / "v.json")
    assert_as_drawn(found)
    assert found[1].camera.K.tolist() == CAMERAS[1].K.tolist()


def test_transforms_without_their_photos(tmp_path):
    found = read_camera_file(put(tmp_path, transforms(), "transforms.json"))
    assert_as_drawn(found)
    assert found[3].name == "images/3"
    assert found[3].camera.K.tolist() == [[40, 0, 25], [0, 40, 14], [0, 0, 1]]
    bent = read_camera_file(put(tmp_path, transforms(k1=0.1), "transforms.json"))
    assert bent[0].camera.K[0, 0] != 40  # of the pinhole that stands for the lens


def test_a_capture_with_its_photos(tmp_path):
    scene = write_capture(tmp_path / "capture", random_gaussians(20), views=4)
    found = read_camera_file(tmp_path / "capture")
    assert_as_drawn(found)
    assert [one.photo.name for one in found if one.photo] == [view.name for view in scene.views]


def without(key: str) -> dict:
    return {name: value for name, value in entry(0).items() if name != key}


@pytest.mark.parametrize(
    "document",
    [
        [],
        {"frames": [{}]},
        {"format": "sagesplat-viewpoints"},
        transforms(w=10**7),
        [without("position")],
        [entry(0) | {"rotation": (-np.eye(3)).tolist()}],
        [entry(0) | {"position": [1e300, 0, 0]}],
        [entry(0) | {"fx": -3}],
        [entry(0) | {"width": 1.5}],
        [entry(0), entry(1) | {"fx": 0}],
    ],
)
def test_what_is_no_list_of_cameras_is_one_line(tmp_path, document):
    path = put(tmp_path, document)
    with pytest.raises(SageError) as error:
        read_camera_file(path)
    assert str(error.value).startswith(str(tmp_path))
    assert "; " in str(error.value)


def test_names_are_fit_to_be_shown(tmp_path):
    found = read_camera_file(
        put(tmp_path, [entry(0) | {"img_name": "a\x1b[2J\n"}, entry(1) | {"img_name": 3}])
    )
    assert [one.name for one in found] == ["a_[2J_", "001"]
