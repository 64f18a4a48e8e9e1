"""Camera models against their definitions, and undistorted images against the scene they show."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation
from test_scene_colmap import capture, project

from sagesplat.core.errors import SceneError
from sagesplat.scene import describe, load_scene
from sagesplat.scene.colmap import load_colmap
from sagesplat.scene.colmap_write import ModelCamera
from sagesplat.scene.images import load_photo
from sagesplat.scene.loading import views_of
from sagesplat.scene.scene import Camera, Lens, View
from sagesplat.scene.stored import read_scene, write_scene
from sagesplat.scene.undistort import CAMERA_MODELS, SPHERE, distort, pinhole, seen, shown_share, undistort
from sagesplat.segment.valid import write_valid

WIDTH, HEIGHT = 64, 48
COEFFICIENTS = {
    "SIMPLE_RADIAL": (-0.08,),
    "RADIAL": (0.06, 0.02),
    "OPENCV": (-0.1, 0.02, 2e-3, -3e-3),
    "FULL_OPENCV": (0.05, 0.01, 1e-3, 2e-3, 0.002, -0.03, 0.01, 0.001),
    "OPENCV_FISHEYE": (0.02, -0.01, 0.002, 0.001),
    "SIMPLE_RADIAL_FISHEYE": (0.03,),
    "RADIAL_FISHEYE": (-0.02, 0.005),
    "FOV": (0.8,),
    "THIN_PRISM_FISHEYE": (0.01, 0.005, 2e-3, -1e-3, 0.001, 0.0005, 3e-3, -2e-3),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *(0.01, 0.005, 0.001, 0.0005, -0.002, 0.001),
        *(2e-3, -1e-3, 3e-3, -2e-3, 1e-3, 2e-3),
    ),
    "SIMPLE_DIVISION": (-0.08,),
    "DIVISION": (0.05,),
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "EUCM": (0.55, 1.1),
}


def lens_of(model: str, coefficients: tuple[float, ...] | None = None) -> Lens:
    focal = (45.0,) * CAMERA_MODELS[model].num_focal
    return Lens(model, (*focal, 33.0, 22.0, *(coefficients or COEFFICIENTS[model])), WIDTH, HEIGHT)


def camera_of(lens: Lens, width: int = WIDTH, height: int = HEIGHT) -> Camera:
    K = pinhole(lens).astype(np.float32)
    return Camera(np.eye(4, dtype=np.float32), K, lens.width, lens.height).resized(width, height)


def unit(lens: Lens, x: float, y: float) -> tuple[float, float]:
    """The distorted point on the plane z = 1."""
    u, v = distort(lens, np.array([x, y]))
    return (u - 33) / 45, (v - 22) / 45


# Expected values worked out from the definitions one by one, at x = 0.3, y = -0.2: r^2 = 0.13.
@pytest.mark.parametrize(
    ("model", "coefficients", "expected"),
    [
        ("SIMPLE_RADIAL", (0.1,), (0.3 * 1.013, -0.2 * 1.013)),
        ("RADIAL", (0.1, 0.01), (0.3 * 1.013169, -0.2 * 1.013169)),
        ("OPENCV", (0.1, 0.01, 1e-3, -2e-3), (0.3 * 1.013169 - 0.00074, -0.2 * 1.013169 + 0.00045)),
        ("FULL_OPENCV", (0, 0, 0, 0, 0, 0.1, 0, 0), (0.3 / 1.013, -0.2 / 1.013)),
        ("FULL_OPENCV", (0, 0, 0, 0, 1, 0, 0, -1), (0.3 * 1.002197 / 0.997803, -0.2 * 1.002197 / 0.997803)),
        ("OPENCV_FISHEYE", (0, 0, 0, 0), (0.3 * 0.959761502, -0.2 * 0.959761502)),
        ("THIN_PRISM_FISHEYE", (0, 0, 0, 0, 0, 0, 1, 0), (0.407676929, -0.191952300)),
        ("THIN_PRISM_FISHEYE", (0, 0, 0, 0, 0, 0, 0, 1), (0.287928451, -0.072203822)),
        ("FOV", (0.8,), (0.3 * 1.025946805, -0.2 * 1.025946805)),
        ("DIVISION", (-0.1,), (0.3 * 0.987321977, -0.2 * 0.987321977)),
        ("FISHEYE", (), (0.3 * 0.959761502, -0.2 * 0.959761502)),
        ("EUCM", (0.5, 1.0), (0.3 / 1.031507291, -0.2 / 1.031507291)),
    ],
)
def test_models_follow_their_definition(model, coefficients, expected):
    assert unit(lens_of(model, coefficients), 0.3, -0.2) == pytest.approx(expected, abs=2e-6)


def test_models_agree_where_they_are_the_same():
    for same in (
        [("SIMPLE_RADIAL", (0.1,)), ("RADIAL", (0.1, 0)), ("OPENCV", (0.1, 0, 0, 0))],
        [("OPENCV", (0.1, 0.2, 0.01, -0.02)), ("FULL_OPENCV", (0.1, 0.2, 0.01, -0.02, 0, 0, 0, 0))],
        [
            ("SIMPLE_RADIAL_FISHEYE", (0.1,)),
            ("RADIAL_FISHEYE", (0.1, 0)),
            ("OPENCV_FISHEYE", (0.1, 0, 0, 0)),
            ("THIN_PRISM_FISHEYE", (0.1, 0, 0, 0, 0, 0, 0, 0)),
        ],
        [("OPENCV_FISHEYE", (0.1, 0.2, 0.3, 0.4)), ("THIN_PRISM_FISHEYE", (0.1, 0.2, 0, 0, 0.3, 0.4, 0, 0))],
    ):
        points = [unit(lens_of(*lens), 0.5, -0.7) for lens in same]
        for point in points[1:]:
            assert point == pytest.approx(points[0], rel=1e-12)


@given(st.floats(0, 3))
def test_fov_is_the_inverse_of_its_published_undistortion(r):
    omega = 1.1
    distorted = unit(lens_of("FOV", (omega,)), r, 0)[0]
    assert np.tan(distorted * omega) / (2 * np.tan(omega / 2)) == pytest.approx(r, rel=1e-9, abs=1e-9)


def border(camera: Camera) -> np.ndarray:
    """Rays of all pixels on the image's border."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    edge = (u < 1) | (v < 1) | (u > camera.width - 1) | (v > camera.height - 1)
    return (np.stack([u[edge], v[edge]], -1) - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]


@pytest.mark.parametrize("model", COEFFICIENTS)
def test_pinhole_is_the_widest_view_without_blank_pixels(model):
    lens = lens_of(model)
    camera = camera_of(lens)
    uv = distort(lens, border(camera))
    margin = np.minimum(uv, np.array([WIDTH, HEIGHT]) - uv)
    assert margin.min() > 0.49  # a whole source pixel under every pixel of the border
    K = pinhole(lens)
    assert K[:2, 2].tolist() == [33, 22]
    assert margin.min() < 0.51 or K[0, 0] == pytest.approx(45 * 0.5)


def test_folding_and_absurd_lenses():
    # k = -0.5 folds back at r = 0.8165: the pinhole view has to end before.
    lens = Lens("SIMPLE_RADIAL", (30.0, 33.0, 22.0, -0.5), WIDTH, HEIGHT)
    K = pinhole(lens)
    assert np.hypot(32.5, 25.5) / K[0, 0] < 0.8165 * 1.01
    with pytest.raises(ValueError, match="no pinhole view fits"):
        pinhole(lens_of("RADIAL", (900.0, -3e4)))


def colour(rays: np.ndarray) -> np.ndarray:
    """A smooth picture of the world, by the direction of the ray: [..., 3] in 0 to 255."""
    x, y = rays[..., 0], rays[..., 1]
    return 127.5 + 100 * np.stack([np.sin(2 * x), np.cos(2 * y), np.sin(x + 2 * y)], -1)


def rays_of_photo(lens: Lens, width: int, height: int) -> np.ndarray:
    """The ray of each pixel of the distorted photo, [H, W, 2], by fixed-point iteration."""
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    target = np.stack([u * lens.width / width, v * lens.height / height], -1)
    rays = (target - [33, 22]) / 45
    for _ in range(60):
        rays = rays + (target - distort(lens, rays)) / 45
    assert np.abs(distort(lens, rays) - target).max() < 1e-6
    return rays


@pytest.mark.parametrize("times", [1, 3])
@pytest.mark.parametrize("model", COEFFICIENTS)
def test_undistorted_photo_shows_the_scene_through_a_pinhole(model, times, tmp_path):
    lens = lens_of(model)
    rays = rays_of_photo(lens, times * WIDTH, times * HEIGHT)
    Image.fromarray(colour(rays).round().astype(np.uint8)).save(tmp_path / "photo.png")
    camera = camera_of(lens)
    photo = load_photo(View("photo.png", camera, tmp_path / "photo.png", lens))
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    seen = (np.stack([u, v], -1) - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    difference = np.abs(photo - colour(seen))
    assert photo.dtype == np.uint8
    assert difference.max() < 1.6  # rounding twice, and a bilinear patch of a curved picture


def test_label_images_keep_their_ids_and_may_have_another_size():
    lens = lens_of("OPENCV_FISHEYE")
    rays = rays_of_photo(lens, 2 * WIDTH, 2 * HEIGHT)
    labels = np.where(rays[..., 0] < 0.1, 3, 300).astype(np.uint16)
    camera = camera_of(lens, 32, 24)
    flat = undistort(labels, lens, camera, order=0)
    assert flat.shape == (24, 32)
    assert flat.dtype == np.uint16
    x = (np.arange(32) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    clear = np.abs(x - 0.1) > 1 / camera.K[0, 0]
    assert (flat == np.where(x < 0.1, 3, 300))[:, clear].all()
    assert undistort(labels, None, camera, order=0) is labels


@pytest.mark.parametrize("model", COEFFICIENTS)
@pytest.mark.parametrize("downscale", [1, 2])
def test_tracks_move_along_with_the_lens(model, downscale, tmp_path):
    lens = lens_of(model)
    capture(tmp_path, [ModelCamera(1, model, WIDTH, HEIGHT, lens.params)])
    scene = load_colmap(tmp_path, downscale=downscale)
    assert scene.views[0].lens is not None
    assert project(scene).max() < 1e-4
    assert len(scene.points.track_points) > 60
    assert dict(describe(scene))["distortion"].startswith(model)


def test_tracks_keep_the_residual_of_their_keypoint(tmp_path):
    lens = lens_of("OPENCV")
    capture(tmp_path, [ModelCamera(1, "OPENCV", WIDTH, HEIGHT, lens.params)], text=True)
    path = tmp_path / "sparse/0/images.txt"
    lines = path.read_text().split("\n")
    values = np.array(lines[3].split(), float).reshape(-1, 3) + np.array([0.25, 0, 0])
    lines[3] = " ".join(f"{u} {v} {int(p)}" for u, v, p in values)
    path.write_text("\n".join(lines))
    error = project(load_colmap(tmp_path))
    assert np.sort(error)[-16:] == pytest.approx(0.25, abs=1e-4)


def test_absurd_calibration_is_an_error_with_the_path(tmp_path):
    params = (45.0, 33.0, 22.0, 0.1)
    capture(tmp_path, [ModelCamera(1, "SIMPLE_RADIAL", WIDTH, HEIGHT, params)], text=True)
    path = tmp_path / "sparse/0/cameras.txt"
    path.write_text(path.read_text().replace(" 0.1\n", " 1e9\n"))
    with pytest.raises(SceneError, match=r"sparse/0: camera 1: no pinhole view fits"):
        load_colmap(tmp_path)


@pytest.mark.parametrize("model", [*COEFFICIENTS, "EQUIRECTANGULAR"])
def test_models_are_those_of_colmap(model):
    pycolmap = pytest.importorskip("pycolmap")
    if not hasattr(pycolmap.CameraModelId, model):
        pytest.skip(f"pycolmap {pycolmap.__version__} has no {model}")
    lens = SPHERE_LENS if model == SPHERE else lens_of(model)
    camera = pycolmap.Camera(model=model, width=lens.width, height=lens.height, params=list(lens.params))
    rays = np.random.default_rng(0).uniform(-1, 1, (200, 3)) + np.array([0, 0, 2])
    expected = camera.img_from_cam(rays)
    np.testing.assert_allclose(distort(lens, rays[:, :2] / rays[:, 2:]), expected, atol=1e-9)
    assert CAMERA_MODELS[model].id == int(getattr(pycolmap.CameraModelId, model))
    assert CAMERA_MODELS[model].num_params == len(camera.params)


SPHERE_LENS = Lens(SPHERE, (256.0, 128.0), 256, 128)
FISHEYE_LENS = Lens("OPENCV_FISHEYE", (40.0, 40.0, 64.0, 64.0, 0.01, 0.0, 0.0, 0.0), 128, 128)


def colour_around(directions: np.ndarray) -> np.ndarray:
    """A smooth picture of the world in all directions, [..., 3] in 0 to 255."""
    x, y, z = np.moveaxis(directions / np.linalg.norm(directions, axis=-1, keepdims=True), -1, 0)
    return 127.5 + 100 * np.stack([np.sin(2 * x + z), np.cos(2 * y), np.sin(z - y)], -1)


def wide_photo(lens: Lens) -> np.ndarray:
    """What the lens sees, with black where it sees nothing."""
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    if lens.model == SPHERE:
        lon, lat = (u / lens.width - 0.5) * 2 * np.pi, (v / lens.height - 0.5) * np.pi
        return colour_around(
            np.stack([np.cos(lat) * np.sin(lon), np.sin(lat), np.cos(lat) * np.cos(lon)], -1)
        )
    x, y = (u - 64) / 40, (v - 64) / 40
    r = np.hypot(x, y)
    angle = r
    for _ in range(30):
        angle = r / (1 + 0.01 * angle**2)
    shown = colour_around(np.stack([x / r * np.sin(angle), y / r * np.sin(angle), np.cos(angle)], -1))
    return np.where((r < 1.6)[..., None], shown, 0)  # a circle in the square


@pytest.mark.parametrize("lens", [SPHERE_LENS, FISHEYE_LENS], ids=["sphere", "fisheye"])
def test_faces_of_a_cube_show_the_scene(lens, tmp_path):
    Image.fromarray(wide_photo(lens).round().astype(np.uint8)).save(tmp_path / "a.png")
    turn = Rotation.from_euler("xyz", [0.2, 0.5, -0.3]).as_matrix()
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = turn, [1, 2, 3]
    views = views_of("cam/a.png", tmp_path / "a.png", w2c, lens, 1, "faces")
    faces = ["front", "right", "back", "left", "up", "down"]
    expected = faces if lens.model == SPHERE else [face for face in faces if face != "back"]
    assert [view.name for view in views] == [f"cam/a_{face}.png" for face in expected]
    assert {view.photo_name for view in views} == {"cam/a.png"}
    for view in views:
        camera = view.camera
        assert camera.width == camera.height == round(2 * (256 / (2 * np.pi) if lens.model == SPHERE else 40))
        np.testing.assert_allclose(camera.position, -turn.T @ [1, 2, 3], atol=1e-5)
        assert camera.K[0].tolist() == [camera.width / 2, 0, camera.width / 2]  # 90 degrees
        u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = np.stack([u, v, 0 * u + 1], -1)
        rays[..., :2] = (rays[..., :2] - camera.K[:2, 2]) / camera.K[0, 0]
        world = rays @ camera.w2c[:3, :3]
        assert view.lens is not None
        shown = seen(view.lens, camera.K, camera.width, camera.height)
        difference = np.abs(load_photo(view) - colour_around(world @ turn.T))[shown]
        assert np.quantile(difference, 0.99) < 2.5
        assert shown.all() == (lens.model == SPHERE or "front" in view.name)
        angle = np.arccos((world @ turn.T)[..., 2] / np.linalg.norm(world, axis=-1))
        if lens.model != SPHERE:
            assert shown[angle < 1.53].all()
            assert not shown[angle > 1.57].any()


def test_a_narrow_lens_stays_one_view(tmp_path):
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "a.png")
    for lens in (
        lens_of("OPENCV"),
        lens_of("SIMPLE_RADIAL"),
        Lens("PINHOLE", (45.0, 45.0, 33.0, 22.0), 64, 48),
    ):
        views = views_of("a.png", tmp_path / "a.png", np.eye(4), lens, 1, "faces")
        assert [view.name for view in views] == ["a.png"]


def test_what_a_wide_fisheye_loses_is_said(tmp_path):
    assert shown_share(lens_of("OPENCV_FISHEYE")) > 0.8
    assert shown_share(FISHEYE_LENS) == pytest.approx(0.45, abs=0.1)
    capture(tmp_path, [ModelCamera(1, "OPENCV_FISHEYE", 128, 128, FISHEYE_LENS.params)])
    scene = load_scene(tmp_path)
    (note,) = [note for note in scene.notes if "OPENCV_FISHEYE" in note]
    assert re.fullmatch(
        r"OPENCV_FISHEYE: the views show 14\d x 14\d degrees, [456]\d% of the photo is cropped; "
        r"--fisheye faces keeps it", note,
    )  # fmt: skip
    faces = load_scene(tmp_path, fisheye="faces", test_every=0)
    assert len(faces.views) == 25
    assert "5 photos by OPENCV_FISHEYE are shown as 25 faces of cubes" in faces.notes
    assert project(faces).max() < 1e-3
    assert (faces.points.track_views < 25).all()


def test_panoramas_become_faces_with_tracks_and_masks(tmp_path):
    capture(tmp_path, [ModelCamera(1, "EQUIRECTANGULAR", 64, 32, (64.0, 32.0))])
    scene = load_scene(tmp_path, test_every=0, downscale=2)
    assert len(scene.views) == 30
    assert "5 photos by EQUIRECTANGULAR are shown as 30 faces of cubes" in scene.notes
    assert project(scene).max() < 1e-3
    assert len(scene.points.track_points) == 5 * 16  # every point is in one face
    assert scene.views[0].camera.width == 10  # 64 / pi, halved
    write_scene(tmp_path / "scene.npz", scene)
    assert read_scene(tmp_path / "scene.npz").views[7].lens == scene.views[7].lens


def test_pixels_beyond_a_fisheye_do_not_count(tmp_path):
    capture(tmp_path, [ModelCamera(1, "OPENCV_FISHEYE", 128, 128, FISHEYE_LENS.params)])
    scene = load_scene(tmp_path, fisheye="faces")
    shares = write_valid(scene, tmp_path / "valid")
    by_face = {v.lens.face: share for v, share in zip(scene.views, shares, strict=True) if v.lens}
    assert by_face["front"] == 0
    assert 0.3 < by_face["left"] < 0.6


def test_masks_of_panoramas_are_those_of_their_faces(tmp_path):
    capture(tmp_path, [ModelCamera(1, "EQUIRECTANGULAR", 64, 32, (64.0, 32.0))])
    mask = np.zeros((32, 64), np.uint8)
    mask[:, :32] = 255  # what is on the left of the photo counts
    for photo in (tmp_path / "images").rglob("*.png"):
        path = tmp_path / "masks_valid" / photo.relative_to(tmp_path / "images")
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(path)
    scene = load_scene(tmp_path)
    shares = write_valid(scene, tmp_path / "valid")
    by_face = {v.lens.face: share for v, share in zip(scene.views, shares, strict=True) if v.lens}
    assert (by_face["left"], by_face["right"]) == (0, 1)
    assert by_face["front"] == pytest.approx(0.5, abs=0.05)
