"""COLMAP workspaces: what is read back, what is refused, and the real scenes."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from colmap_text import write_text_model
from PIL import Image
from scipy.spatial.transform import Rotation

from sagesplat.core.errors import SceneError
from sagesplat.scene import describe, load_scene
from sagesplat.scene.colmap import load_colmap
from sagesplat.scene.colmap_read import read_model
from sagesplat.scene.colmap_write import ModelCamera, ModelImage, write_model
from sagesplat.scene.scene import Lens
from sagesplat.scene.undistort import distort

SHARED = Path(__file__).resolve().parents[2] / "shared"
PINHOLE = ModelCamera(7, "PINHOLE", 40, 30, (35.0, 36.0, 21.5, 13.25))


def poses(count: int) -> list[np.ndarray]:
    """Cameras on an arc, all looking at points near the origin."""
    w2c = []
    for angle in np.linspace(-0.4, 0.4, count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("xyz", [0.1, angle, 0.2]).as_matrix()
        pose[:3, 3] = [0.05, -0.1, 4 + angle]
        w2c.append(pose)
    return w2c


def capture(
    folder: Path, cameras: list[ModelCamera], *, views: int = 5, sparse: str = "sparse/0", text: bool = False
) -> np.ndarray:
    """A workspace with exact observations; view i has camera i modulo their number. Returns the points."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-0.8, 0.8, (20, 3))
    rgb = rng.integers(0, 256, (20, 3)).astype(np.uint8)
    images = []
    for i, w2c in enumerate(poses(views)):
        camera = cameras[i % len(cameras)]
        lens = Lens(camera.model, camera.params, camera.width, camera.height)
        local = xyz @ w2c[:3, :3].T + w2c[:3, 3]
        uv = distort(lens, local[:, :2] / local[:, 2:])
        rows = np.where(np.arange(20) % 5 == i % 5, -1, np.arange(20))  # a fifth belongs to no point
        name = f"part {i % 2}/{views - i:02d}.png"
        images.append(ModelImage(100 - i, name, camera.id, w2c, uv, rows))
        photo = folder / "images" / name
        photo.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 256, (camera.height, camera.width, 3)).astype(np.uint8)).save(photo)
    write = write_text_model if text else write_model
    write(folder / sparse, cameras, images, xyz, rgb, np.full(20, 0.25))
    return xyz


def project(scene) -> np.ndarray:
    """Reprojection error of each observation in pixels."""
    points, error = scene.points, []
    for row, view in enumerate(scene.views):
        seen = points.track_views == row
        local = points.xyz[points.track_points[seen]] @ view.camera.w2c[:3, :3].T + view.camera.w2c[:3, 3]
        uvw = local @ view.camera.K.T
        error.append(np.linalg.norm(uvw[:, :2] / uvw[:, 2:] - points.track_uv[seen], axis=1))
    return np.concatenate(error)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("sparse", ["sparse/0", "sparse"])
def test_reads_back_what_was_written(tmp_path, text, sparse):
    other = ModelCamera(2, "SIMPLE_PINHOLE", 32, 32, (30.0, 15.0, 17.0))
    xyz = capture(tmp_path, [PINHOLE, other], sparse=sparse, text=text)
    scene = load_colmap(tmp_path, test_every=2)
    assert [v.name for v in scene.views] == sorted(v.name for v in scene.views)
    assert scene.name == tmp_path.name
    assert scene.test_ids.tolist() == [0, 2, 4]
    np.testing.assert_allclose(scene.points.xyz, xyz, atol=1e-6)
    assert len(scene.points.track_points) == 5 * 16
    assert scene.points.track_points.dtype == np.int64
    assert scene.points.track_views.dtype == np.int32
    assert project(scene).max() < 1e-4
    by_name = {v.name: v for v in scene.views}
    np.testing.assert_allclose(by_name["part 0/05.png"].camera.w2c, poses(5)[0], atol=1e-6)
    assert by_name["part 0/05.png"].camera.K[0].tolist() == [35, 0, 21.5]
    assert by_name["part 1/04.png"].camera.K.tolist() == [[30, 0, 15], [0, 30, 17], [0, 0, 1]]
    assert (by_name["part 1/04.png"].camera.width, by_name["part 1/04.png"].camera.height) == (32, 32)


def test_an_image_without_observations(tmp_path):
    capture(tmp_path, [PINHOLE], text=True)
    path = tmp_path / "sparse/0/images.txt"
    lines = path.read_text().split("\n")
    lines[3] = ""  # the second line of the first image
    path.write_text("\n".join(lines))
    assert len(load_colmap(tmp_path).points.track_points) == 4 * 16


@pytest.mark.parametrize("shipped", [True, False])
def test_downscale_keeps_the_exact_ratio(tmp_path, shipped):
    capture(tmp_path, [PINHOLE])
    if shipped:
        for photo in (tmp_path / "images").glob("**/*.png"):
            small = tmp_path / "images_4" / photo.relative_to(tmp_path / "images")
            small.parent.mkdir(parents=True, exist_ok=True)
            Image.open(photo).resize((10, 7)).save(small)  # 30 / 4 rounded down
    scene = load_colmap(tmp_path, downscale=4)
    camera = scene.views[0].camera
    height = 7 if shipped else 8
    assert (camera.width, camera.height) == (10, height)
    expected = [[35 / 4, 0, 21.5 / 4], [0, 36 * height / 30, 13.25 * height / 30], [0, 0, 1]]
    np.testing.assert_allclose(camera.K, expected, rtol=1e-6)
    assert scene.views[0].image_path.parts[-3] == ("images_4" if shipped else "images")
    assert project(scene).max() < 1e-4


def test_observations_outside_the_view_are_left_out(tmp_path):
    small = ModelCamera(1, "PINHOLE", 8, 8, (35.0, 35.0, 4.0, 4.0))
    capture(tmp_path, [small])
    uv = load_colmap(tmp_path).points.track_uv
    assert 0 < len(uv) < 5 * 16
    assert ((uv >= 0) & (uv < 8)).all()


def breakages() -> dict:
    def shrink(folder):
        for photo in list((folder / "images").glob("**/*.png"))[:3]:
            Image.open(photo).transpose(Image.Transpose.ROTATE_90).save(photo)

    def put(name: str, at: int, content: bytes) -> Callable[[Path], object]:
        """Bytes written over a file of the model."""

        def change(folder: Path) -> None:
            path = folder / "sparse/0" / name
            data = bytearray(path.read_bytes())
            data[at : at + len(content)] = content
            path.write_bytes(data)

        return change

    nan = np.array(np.nan).tobytes()
    return {
        r"images: 3 of the 5 photos of the model are missing, first 'part 0/05.png'": lambda f: shutil.rmtree(
            f / "images/part 0"
        ),
        r"30 x 40 pixels, but its camera has another aspect ratio, 40 x 30": shrink,
        r"points3D.bin: damaged or incomplete \(it ends within a record": put("points3D.bin", 0, b"\xff" * 8),
        r"images.bin: damaged .*photo 'part 0/05.png' has a pose that is not finite": put(
            "images.bin", 12, nan
        ),
        r"no COLMAP model \(looked for cameras.bin": lambda f: shutil.rmtree(f / "sparse"),
    }


@pytest.mark.parametrize("message", breakages())
def test_errors_name_path_and_cure(tmp_path, message):
    folder = tmp_path / "scene"
    capture(folder, [PINHOLE])
    breakages()[message](folder)
    with pytest.raises(SceneError, match=message) as raised:
        load_colmap(folder)
    assert str(raised.value).startswith(str(folder))


@pytest.mark.parametrize(
    ("name", "views", "points", "error"), [("garden", 185, 42599, 0.43), ("dinosaur", 116, 17540, 0.5)]
)
def test_real_scenes(name, views, points, error):
    folder = SHARED / "scenes" / name
    if not folder.is_dir():
        pytest.skip("needs the real scenes beside the checkout")
    scene = load_scene(folder)
    assert (len(scene.views), len(scene.points.xyz)) == (views, points)
    assert project(scene).mean() < error
    rows = dict(describe(scene))
    assert rows["image size"] == "512 x 512"
    assert rows["masks"] == f"{views} label images in masks/"
    assert rows["distortion"] == "none"
    assert float(rows["reprojection error"].split()[0]) < 0.4
    assert rows["cameras"].split()[0] == {"garden": "1", "dinosaur": "116"}[name]


BAD_NAMES = {
    b"caf\xe9.png": r"photo 'caf\\udce9\.png': it is not UTF-8; rename the photo",
    b"\x1b[31m.png": r"U\+001B; rename the photo",
    b"a/../../../": "names nothing in the folder of the photos",
}


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("name", BAD_NAMES)
def test_photos_that_cannot_be_named_are_one_line(tmp_path, name, text):
    capture(tmp_path, [PINHOLE], text=text)
    model = tmp_path / "sparse" / "0" / ("images.txt" if text else "images.bin")
    content = model.read_bytes()
    assert content.count(b"part 1/02.png") == 1
    model.write_bytes(content.replace(b"part 1/02.png", name))
    with pytest.raises(SceneError, match=BAD_NAMES[name]) as raised:
        load_scene(tmp_path)
    assert str(raised.value).isprintable()


def test_binary_and_text_models_are_the_same(tmp_path):
    capture(tmp_path / "bin", [PINHOLE])
    capture(tmp_path / "txt", [PINHOLE], text=True)
    models = [read_model(tmp_path / kind / "sparse" / "0") for kind in ("bin", "txt")]
    (cameras, images, points), (cameras2, images2, points2) = models
    assert cameras[7].params == cameras2[7].params
    assert points
    assert points2
    assert all(np.array_equal(a, b) for a, b in zip(points, points2, strict=True))
    for a, b in zip(images, images2, strict=True):
        assert (a.id, a.name, a.camera_id) == (b.id, b.name, b.camera_id)
        assert all(np.array_equal(getattr(a, f), getattr(b, f)) for f in ("w2c", "uv", "point_rows"))


def test_rigs_and_frames_of_new_versions_are_left_alone(tmp_path):
    capture(tmp_path, [PINHOLE])
    for name in ("rigs.bin", "frames.bin"):
        (tmp_path / "sparse/0" / name).write_bytes(b"\xff" * 24)
    assert len(load_colmap(tmp_path).views) == 5


def test_too_few_views_and_bad_splits(tmp_path):
    capture(tmp_path, [PINHOLE], views=2)
    with pytest.raises(SceneError, match="2 posed photos, but it takes 3"):
        load_colmap(tmp_path)
    with pytest.raises(SceneError, match="test_every 1"):
        load_colmap(tmp_path, test_every=1)
