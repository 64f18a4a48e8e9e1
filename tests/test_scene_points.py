"""Points to start from: PLY files of every kind, and random ones where the cameras look."""

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from sagesplat.core.errors import SceneError
from sagesplat.core.geometry import project
from sagesplat.scene.points import FAR, GREY, focus, random_points, read_points
from sagesplat.scene.scene import Camera, View

XYZ = np.array([[0.5, -1, 2], [3, 4, -5.25], [0, 0, 1e-3]], np.float32)
RGB = np.array([[255, 0, 7], [1, 2, 3], [200, 100, 50]], np.uint8)


def header(form: str, *properties: str, count: int = 3, after: str = "") -> bytes:
    lines = ["ply", f"format {form} 1.0", "comment made here", f"element vertex {count}"]
    lines += [f"property {p}" for p in properties]
    return "\n".join([*lines, *([after] if after else []), "end_header", ""]).encode()


AXES = ("float x", "float y", "float z")
COLOURS = ("uchar red", "uchar green", "uchar blue")


def ascii_ply(path: Path) -> Path:
    rows = [" ".join(map(str, [*p.tolist(), *c.tolist()])) for p, c in zip(XYZ, RGB, strict=True)]
    path.write_bytes(header("ascii", *AXES, *COLOURS) + "\n".join(rows).encode())
    return path


def test_ascii_as_nerfstudio_writes_it(tmp_path):
    points = read_points(ascii_ply(tmp_path / "sparse_pc.ply"))
    np.testing.assert_array_equal(points.xyz, XYZ)
    np.testing.assert_array_equal(points.rgb, RGB)
    assert (points.xyz.dtype, points.rgb.dtype) == (np.float32, np.uint8)
    assert (points.track_points.shape, points.track_views.shape, points.track_uv.shape) == (
        (0,),
        (0,),
        (0, 2),
    )
    assert (points.track_points.dtype, points.track_views.dtype) == (np.int64, np.int32)


@pytest.mark.parametrize(("form", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_binary_of_both_orders_with_more_properties_and_faces(tmp_path, form, order):
    path = tmp_path / "a.ply"
    names = ("double x", "double y", "double z", "float nx", "short tag", *COLOURS, "uchar alpha")
    body = b"".join(
        struct.pack(f"{order}3dfh4B", *p.tolist(), 0.5, -7, *c.tolist(), 255)
        for p, c in zip(XYZ, RGB, strict=True)
    )
    faces = "element face 1\nproperty list uchar int vertex_indices"
    path.write_bytes(header(form, *names, after=faces) + body + b"\x03" + bytes(12))
    points = read_points(path)
    np.testing.assert_array_equal(points.xyz, XYZ)
    np.testing.assert_array_equal(points.rgb, RGB)


@pytest.mark.parametrize(
    ("kind", "code", "values"),
    [("float", "f", RGB / 255), ("ushort", "H", RGB.astype(int) * 257), ("int", "i", RGB.astype(int))],
)
def test_colours_of_other_types(tmp_path, kind, code, values):
    colours = [f"{kind} {name}" for name in ("red", "green", "blue")]
    path = tmp_path / "a.ply"
    rows = [struct.pack(f"<3f3{code}", *p.tolist(), *c.tolist()) for p, c in zip(XYZ, values, strict=True)]
    path.write_bytes(header("binary_little_endian", *AXES, *colours) + b"".join(rows))
    np.testing.assert_array_equal(read_points(path).rgb, RGB)
    rows = [" ".join(map(repr, [*p.tolist(), *c.tolist()])) for p, c in zip(XYZ, values, strict=True)]
    path.write_bytes(header("ascii", *AXES, *colours) + "\n".join(rows).encode())
    np.testing.assert_array_equal(read_points(path).rgb, RGB)


BAD = {
    "no such file; add it, or remove ply_file_path": None,
    "its header breaks at 'format zip 1.0'": header("zip", *AXES),
    "3 points announced, but the file ends": header("binary_little_endian", *AXES) + XYZ.tobytes()[:-1],
    "9{20} points announced": header("binary_big_endian", *AXES, count=int("9" * 20)) + bytes(99),
    "3 points of 3 values announced, but there are": header("ascii", *AXES) + b"0.5 0.5 0.5\n0.5 0.5 0.5\n",
    "not readable as a PLY file": header("ascii", *AXES) + b"0.5 0.5 0.5\n0.5 0.5 x.5\n0.5 0.5 0.5\n",
    "1 of 3 points are not finite": header("ascii", *AXES) + b"0 0 0\nnan 0 0\n1 1 1\n",
    "2 of 3 points are not finite": header("ascii", *(p.replace("float", "double") for p in AXES))
    + b"0 0 0\n1e300 0 0\ninf 1 1\n",
}


@pytest.mark.parametrize("message", BAD)
def test_bad_files_are_one_line(tmp_path, message):
    path, content = tmp_path / "a.ply", BAD[message]
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SceneError, match=message) as raised:
        read_points(path)
    assert str(raised.value).startswith(str(path))


def looking(position: np.ndarray, target: np.ndarray, up: tuple = (0, 0, 1)) -> np.ndarray:
    """World to camera, OpenCV axes."""
    z = target - position
    z = z / np.linalg.norm(z)
    x = np.cross(z, up)
    x = x / np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = R, -R @ position
    return w2c


def views_of(poses: list[np.ndarray], folder: Path, colour: tuple = (10, 200, 90)) -> list[View]:
    K = np.array([[40, 0, 20], [0, 40, 15], [0, 0, 1]], np.float32)
    path = folder / "a.png"
    Image.new("RGB", (40, 30), colour).save(path)
    return [View(f"{i}", Camera(w2c.astype(np.float32), K, 40, 30), path) for i, w2c in enumerate(poses)]


def ring(centre: np.ndarray, radius: float, count: int = 12) -> list[np.ndarray]:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    around = np.stack([np.cos(angles), np.sin(angles), 0.5 + 0 * angles], axis=1)
    return [looking(centre + radius * offset, centre) for offset in around]


@settings(max_examples=30)
@given(
    centre=st.tuples(*[st.floats(-20, 20)] * 3).map(np.array),
    radius=st.floats(0.1, 50),
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
)
def test_focus_is_what_the_cameras_look_at(centre, radius, turn, tmp_path_factory):
    world = np.eye(4)
    world[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    poses = [w2c @ world for w2c in ring(centre, radius)]
    views = views_of(poses, tmp_path_factory.getbasetemp())
    point, reach = focus(views)
    expected = world[:3, :3].T @ centre
    np.testing.assert_allclose(point, expected, atol=0.01 * radius + 1e-3)
    assert reach == pytest.approx(radius * np.hypot(1, 0.5), rel=0.02)


def test_focus_of_parallel_axes_is_before_the_cameras(tmp_path):
    poses = []
    for x in (-1.0, 0.0, 1.0):
        w2c = np.eye(4)
        w2c[0, 3] = -x
        poses.append(w2c)
    point, _ = focus(views_of(poses, tmp_path))
    np.testing.assert_allclose(point, [0, 0, 1], atol=1e-6)


def in_sight(xyz: np.ndarray, views: list[View]) -> np.ndarray:
    total = np.zeros(len(xyz), int)
    for view in views:
        uv, _ = project(xyz, view.camera.w2c, view.camera.K)
        total += ((uv >= 0) & (uv < [40, 30])).all(1)
    return total


def test_points_are_where_two_cameras_look(tmp_path):
    centre = np.array([5.0, -3, 2])
    views = views_of(ring(centre, 2), tmp_path)
    points = random_points(views, 2000)
    assert points.xyz.shape == (2000, 3)
    assert points.xyz.dtype == np.float32
    assert in_sight(points.xyz, views).min() >= 2
    radius = 2 * np.hypot(1, 0.5)
    nearest = np.min([np.linalg.norm(points.xyz - v.camera.position, axis=1) for v in views], axis=0)
    assert nearest.max() <= 2 * radius * FAR * 1.2  # a corner's ray is longer than its depth
    assert np.mean(nearest < 0.2 * radius) < 0.05  # hardly anything just before a lens
    around = np.linalg.norm(points.xyz - centre, axis=1) < radius
    assert 0.25 < around.mean() < 0.75
    assert (points.rgb == [10, 200, 90]).all()
    assert len(points.track_points) == 0


def outwards() -> list[np.ndarray]:
    """A room scan: cameras in the middle that look at the walls."""
    return [looking(0.1 * offset, 5 * offset) for offset in _directions(16)]


def sideways() -> list[np.ndarray]:
    """Facades: parallel axes, a row of cameras."""
    return [looking(np.array([x, 0, 0]), np.array([x, 9, 0])) for x in np.linspace(0, 3, 9)]


def panorama() -> list[np.ndarray]:
    """All from one point."""
    return [looking(np.zeros(3), offset) for offset in _directions(16)]


def _directions(count: int) -> np.ndarray:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)


@pytest.mark.parametrize("capture", [outwards, sideways, panorama])
def test_other_captures_get_points_too(tmp_path, capture):
    views = views_of(capture(), tmp_path)
    points = random_points(views, 500)
    assert len(points.xyz) == 500
    assert in_sight(points.xyz, views).min() >= 2


def test_colour_is_the_mean_of_the_photos_that_show_a_point(tmp_path):
    """Two cameras side by side, each with a red left half; points in the middle of both are mixed."""
    photo = np.zeros((30, 40, 3), np.uint8)
    photo[:, :20] = [255, 0, 0]
    views = views_of(sideways()[:3], tmp_path)
    Image.fromarray(photo).save(tmp_path / "a.png")
    points = random_points(views, 400)
    total, count = np.zeros(400), np.zeros(400)
    for view in views:
        uv, _ = project(points.xyz, view.camera.w2c, view.camera.K)
        inside = ((uv >= 0) & (uv < [40, 30])).all(1)
        total += inside & (uv[:, 0] < 20)
        count += inside
    np.testing.assert_allclose(points.rgb[:, 0], 255 * total / count, atol=0.51)
    assert (points.rgb[:, 1:] == 0).all()


def test_without_colours_grey(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(header("binary_little_endian", *AXES) + XYZ.tobytes())
    points = read_points(path)
    np.testing.assert_array_equal(points.xyz, XYZ)
    assert (points.rgb == GREY).all()


def test_photos_that_share_nothing_are_refused(tmp_path):
    apart = [looking(np.array([0, 0, 0.0]), np.array([x, 0, 0.0])) for x in (1, -1)]
    for poses in (apart, apart[:1]):
        with pytest.raises(SceneError, match="no two photos show the same part"):
            random_points(views_of(poses, tmp_path), 100)


def test_cube_of_blender(tmp_path):
    views = views_of(ring(np.zeros(3), 4), tmp_path)
    points = random_points(views, 5000, cube=1.3)
    assert np.abs(points.xyz).max() <= 1.3
    np.testing.assert_allclose(points.xyz.mean(0), 0, atol=0.05)
    np.testing.assert_allclose(points.xyz.std(0), 2.6 / np.sqrt(12), rtol=0.03)
