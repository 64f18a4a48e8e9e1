"""What scanner apps and Metashape export: poses and intrinsics as they were, depths read past, refusals."""

import json
import unicodedata
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from sagesplat.core.errors import SceneError
from sagesplat.scene import describe, load_scene, nerfstudio
from sagesplat.scene.detect import detect
from sagesplat.scene.points import random_points
from sagesplat.scene.scene import Scene
from sagesplat.scene.undistort import distort

SIZE = (40, 30)
POSES = [
    np.block([
        [Rotation.from_euler("xyz", [0.1, angle, 0.2]).as_matrix(), np.array([[0.05], [-0.1], [4 + angle]])],
        [np.eye(4)[3:]],
    ])
    for angle in np.linspace(-0.4, 0.4, 5)
]  # fmt: skip
OPENGL = np.diag([1.0, -1, -1, 1])


@pytest.fixture(autouse=True, scope="module")
def few_points():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nerfstudio, "random_points", partial(random_points, count=300))
        yield


def _photo(path: Path, size: tuple[int, int] = SIZE) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (90, 120, 60)).save(path)


def _same(scene: Scene, poses: list[np.ndarray] = POSES) -> None:
    for view, w2c in zip(scene.views, poses, strict=True):
        np.testing.assert_allclose(view.camera.w2c, w2c, atol=2e-6)


def _polycam(folder: Path, cameras: str = "cameras", images: str = "images") -> None:
    for number, w2c in enumerate(POSES):
        c2w = np.linalg.inv(w2c) @ OPENGL
        content = {f"t_{row}{column}": c2w[row, column] for row in range(3) for column in range(4)}
        content |= {"fx": 35, "fy": 36, "cx": 21, "cy": 14, "width": 80, "height": 60, "blur_score": 3.5}
        path = folder / "keyframes" / cameras / f"{1000 + number}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content))
        _photo(folder / "keyframes" / images / f"{1000 + number}.jpg")


def test_polycam(tmp_path):
    _polycam(tmp_path)
    for name in ("depth", "confidence"):
        _photo(tmp_path / "keyframes" / name / "1000.png", (4, 3))
    (tmp_path / "keyframes" / "images" / "1004.jpg").unlink()
    assert detect(tmp_path) == "polycam"
    scene = load_scene(tmp_path)
    _same(scene, POSES[:4])
    assert scene.name == tmp_path.name
    assert scene.path == tmp_path
    assert [view.name for view in scene.views] == [f"{1000 + i}.jpg" for i in range(4)]
    np.testing.assert_allclose(
        scene.views[0].camera.K, [[17.5, 0, 10.5], [0, 18, 7], [0, 0, 1]]
    )  # at half size
    assert scene.notes[:4] == (
        "poses: cameras/ of Polycam",
        "2 depth images are not used",
        "4 of 4 photos have poses",
        "1 of 5 posed photos are gone and left out, first '1004'",
    )
    assert ("read", scene.notes[0]) in describe(scene)


def test_corrected_poses_of_polycam_are_preferred(tmp_path):
    _polycam(tmp_path)
    _polycam(tmp_path, "corrected_cameras", "corrected_images")
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.views] == [f"{1000 + i}.jpg" for i in range(5)]
    assert scene.views[0].image_path.parent.name == "corrected_images"
    assert scene.notes[:2] == ("poses: corrected_cameras/ of Polycam", "5 of 5 photos have poses")
    assert load_scene(tmp_path / "keyframes").notes == scene.notes
    (tmp_path / "keyframes" / "corrected_cameras" / "1002.json").write_text('{"fx": 1}')
    with pytest.raises(SceneError, match=r"1002\.json: not a camera of Polycam .*export the raw data again"):
        load_scene(tmp_path)


def _record3d(folder: Path, **more: Any) -> None:
    poses = []
    for number, w2c in enumerate(POSES):
        c2w = np.linalg.inv(w2c) @ OPENGL
        poses.append([*Rotation.from_matrix(c2w[:3, :3]).as_quat().tolist(), *c2w[:3, 3].tolist()])
        _photo(folder / "rgbd" / f"{number}.jpg")
        (folder / "rgbd" / f"{number}.depth").write_bytes(b"lzfse")
    content = {"w": 40, "h": 30, "K": [35, 0, 0, 0, 36, 0, 21, 14, 1], "poses": poses, "fps": 60, **more}
    (folder / "metadata.json").write_text(json.dumps(content))


@pytest.mark.parametrize("own", [False, True])
def test_record3d(tmp_path, own):
    _record3d(
        tmp_path, **({"perFrameIntrinsicCoeffs": [[30 + i, 31, 20, 15] for i in range(5)]} if own else {})
    )
    assert detect(tmp_path) == "record3d"
    scene = load_scene(tmp_path)
    _same(scene)
    K = scene.views[2].camera.K
    assert K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == ([32, 31, 20, 15] if own else [35, 36, 21, 14])
    assert scene.notes[:3] == (
        "poses: metadata.json of Record3D",
        "5 depth images are not used",
        "5 of 5 photos have poses",
    )
    (tmp_path / "metadata.json").rename(tmp_path / "metadata")  # as in an .r3d
    _same(load_scene(tmp_path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": [1, 2]}, "not metadata of Record3D"),
        ({"poses": [[0, 0, 0, 0, 1, 2, 3]]}, "a pose without a rotation"),
        ({"poses": [[0, 0, 0, 1, 1, 2]]}, "not metadata of Record3D"),
        ({"perFrameIntrinsicCoeffs": [[1, 2, 3, 4]]}, "intrinsics of 1 frames for 5 poses"),
        ({"poses": []}, "no camera; export it again"),
    ],
)
def test_metadata_that_cannot_be_used(tmp_path, change, message):
    _record3d(tmp_path, **change)
    with pytest.raises(SceneError, match=f"metadata.json: .*{message}"):
        load_scene(tmp_path)


LENS = {
    "f": 35.0,
    "cx": 1.0,
    "cy": -1.0,
    "k1": 0.05,
    "k2": -0.02,
    "k3": 0.01,
    "p1": 0.004,
    "p2": -0.003,
    "b1": 0.5,
}


def _metashape(
    folder: Path, lens: dict[str, float] = LENS, kind: str = "frame", *, scale: float = 1.0, suffix: str = ""
) -> None:
    """Cameras in a chunk of its own axes, in one of which the world is `scale` times as large."""
    turn, shift = Rotation.from_euler("xyz", [0.3, -0.2, 0.5]).as_matrix(), np.array([3.0, -2.0, 7.0])
    cameras = ""
    for number, w2c in enumerate(POSES):
        c2w = np.linalg.inv(w2c)
        c2w[:3, :3], c2w[:3, 3] = turn.T @ c2w[:3, :3], turn.T @ (c2w[:3, 3] - shift) / scale
        text = " ".join(map(repr, c2w.ravel().tolist()))
        cameras += f'<camera id="{number}" sensor_id="0" component_id="0" label="IMG_{number}{suffix}">'
        cameras += f"<transform>{text}</transform></camera>"
        _photo(folder / "images" / f"IMG_{number}.JPG")
    cameras += (
        '<group id="0" label="more"><camera id="9" sensor_id="0" label="IMG_9"/></group>'  # not aligned
    )
    values = "".join(f"<{name}>{value}</{name}>" for name, value in lens.items())
    calibration = f'<calibration type="{kind}" class="adjusted"><resolution width="40" height="30"/>{values}'
    (folder / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1">'
        f'<sensors><sensor id="0" label="a" type="{kind}"><resolution width="40" height="30"/>'
        f'{calibration}</calibration></sensor></sensors><components><component id="0"><transform>'
        f"<rotation>{' '.join(map(repr, turn.ravel().tolist()))}</rotation>"
        f"<translation>{' '.join(map(repr, shift.tolist()))}</translation><scale>{scale}</scale>"
        f"</transform></component></components><cameras>{cameras}</cameras></chunk></document>"
    )


def _seen(lens: dict[str, float], rays: np.ndarray, *, fisheye: bool) -> np.ndarray:
    """Pixels by the formulas of Metashape's manual."""
    x, y = rays.T
    if fisheye:
        r0 = np.hypot(x, y)
        x, y = x * np.arctan(r0) / r0, y * np.arctan(r0) / r0
    r2 = x * x + y * y
    p1, p2 = lens.get("p1", 0), lens.get("p2", 0)
    radial = 1 + sum(lens.get(f"k{i}", 0) * r2**i for i in (1, 2, 3, 4))
    u = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    v = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    f = lens["f"]
    return np.stack([20 + lens["cx"] + u * (f + lens.get("b1", 0)), 15 + lens["cy"] + v * f], 1)


@pytest.mark.parametrize("scale", [1.0, 12.5])
@pytest.mark.parametrize("suffix", ["", ".JPG"])
def test_metashape(tmp_path, scale, suffix):
    _metashape(tmp_path, scale=scale, suffix=suffix)
    assert detect(tmp_path) == detect(tmp_path / "cameras.xml") == "metashape"
    scene = load_scene(tmp_path)
    _same(scene)
    assert [view.name for view in scene.views] == [f"IMG_{i}.JPG" for i in range(5)]
    assert scene.notes[:2] == (
        "poses: cameras.xml of Metashape; 5 of 6 cameras have one",
        "5 of 5 photos have poses",
    )
    _same(load_scene(tmp_path / "cameras.xml"))


def test_photos_of_metashape_are_found_as_those_of_other_formats(tmp_path):
    """Beside smaller copies, in other folders, with accents in another form, in UTF-16."""
    capture, file = tmp_path / "capture", tmp_path / "capture" / "cameras.xml"
    capture.mkdir()
    _metashape(capture)
    labels = file.read_text().replace("IMG_", "Übersicht_").replace("UTF-8", "UTF-16")
    file.write_bytes(labels.encode("utf-16"))
    for photo in list(capture.rglob("*.JPG")):
        name = unicodedata.normalize("NFD", photo.name.replace("IMG_", "Übersicht_"))
        photo.rename(photo.with_name(name))
        _photo(capture / "images_2" / name, (20, 15))
    assert detect(capture) == "metashape"
    _same(load_scene(capture))
    (capture / "images").rename(tmp_path / "elsewhere")
    with pytest.raises(SceneError, match=r"5 of the 5 photos of cameras\.xml are missing.*--images"):
        load_scene(capture)
    _same(load_scene(capture, images=tmp_path / "elsewhere"))


@pytest.mark.parametrize("fisheye", [False, True])
def test_lenses_of_metashape(tmp_path, fisheye):
    lens = (
        {"f": 30.0, "cx": 1.0, "cy": -1.0, "k1": 0.05, "k2": -0.02, "k3": 0.01, "k4": 0.004}
        if fisheye
        else LENS
    )
    _metashape(tmp_path, lens, "fisheye" if fisheye else "frame")
    found = load_scene(tmp_path).views[0].lens
    assert found is not None
    rays = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    np.testing.assert_allclose(distort(found, rays), _seen(lens, rays, fisheye=fisheye), atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<k1>", "<b2>9</b2><k1>", "b2 moves a corner by .* px, and no camera model .* optimise"),
        ("<k1>", "<k4>5</k4><k1>", "k4 moves a corner by"),
        ("<f>35.0</f>", "", "without a focal length"),
        ("<f>35.0</f>", "<f>nan</f>", "a number that is not finite"),
        ("</document>", "", "no element found"),
        ("<document", "<!DOCTYPE a><document", "too large, or with entities"),
        ('sensor_id="0"', 'sensor_id="7"', "without a calibrated sensor"),
        ("</cameras></chunk>", "</cameras></chunk><chunk/>", "2 chunks; export one"),
    ],
)
def test_xml_that_cannot_be_used(tmp_path, old, new, message):
    _metashape(tmp_path)
    file = tmp_path / "cameras.xml"
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(SceneError, match=rf"cameras\.xml: .*{message}"):
        load_scene(tmp_path)


def test_cameras_in_geocentric_coordinates_are_moved(tmp_path):
    """Those of a georeferenced chunk, millions of metres from the origin."""
    _metashape(tmp_path)
    file = tmp_path / "cameras.xml"
    far = "<translation>4177123.5 855012.25 4728456.75</translation>"
    text = file.read_text()
    begin, end = text.index("<translation>"), text.index("</translation>") + len("</translation>")
    file.write_text(text[:begin] + far + text[end:])
    scene = load_scene(tmp_path)
    assert any(scene.offset)
    by = np.array(scene.offset) - [4177123.5 - 3, 855012.25 + 2, 4728456.75 - 7]
    centres = [view.camera.position + by for view in scene.views]
    np.testing.assert_allclose(centres, [np.linalg.inv(w2c)[:3, 3] for w2c in POSES], atol=1e-5)
