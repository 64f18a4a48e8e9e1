"""Poses from photos: rendered photos of a textured corner come back as the cameras that saw them."""

import importlib.util
import json
import os
import signal
import sqlite3
import subprocess
import sys
import types
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation
from test_scene_points import looking

from sagesplat.core.errors import BackendUnavailable, SceneError
from sagesplat.core.names import check_photo, collision_key
from sagesplat.scene import load_scene, photos
from sagesplat.scene._prepare import prepare_photos
from sagesplat.scene.images import load_photo
from sagesplat.scene.photos import PosesConfig, reconstruct
from sagesplat.segment.mask_files import import_masks

with pytest.MonkeyPatch.context() as patch:  # its own functions, without COLMAP
    patch.setitem(sys.modules, "pycolmap", types.ModuleType("pycolmap"))
    from sagesplat.scene import _sfm

WIDTH, HEIGHT, FOCAL = 240, 180, 210.0
VIEWS = 6
CONFIG = PosesConfig(model="SIMPLE_RADIAL")
needs_pycolmap = pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="needs pycolmap (the extra `poses`)"
)


@lru_cache
def texture(seed: int, size: int = 512) -> np.ndarray:
    """Noise of several scales, RGB."""
    rng = np.random.default_rng(seed)
    layers = [gaussian_filter(rng.normal(size=(size, size, 3)), (s, s, 0)) * s for s in (2, 5, 12)]
    return np.clip(128 + 110 * np.sum(layers, axis=0), 0, 255)


def poses() -> list[np.ndarray]:
    """An arc of cameras before the corner, at changing heights."""
    return [
        looking(
            np.array([3 * np.sin(a), -0.9 + 0.25 * (-1) ** i, -3 * np.cos(a)]),
            np.array([0.0, 0.1, 0.3]),
            up=(0, -1, 0),
        )
        for i, a in enumerate(np.linspace(-0.45, 0.45, VIEWS))
    ]


def render(w2c: np.ndarray) -> Image.Image:
    """A floor and two walls that meet in a corner, by intersecting rays with planes."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    local = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], axis=-1)
    rays, centre = local @ w2c[:3, :3], -w2c[:3, :3].T @ w2c[:3, 3]
    depth, rgb = np.full(u.shape, np.inf), np.zeros((HEIGHT, WIDTH, 3))
    planes = (([0, 1, 0], 1.0), ([0.6, 0, 0.8], 1.2), ([-0.6, 0, 0.8], 1.2))
    for seed, (normal, offset) in enumerate(planes):
        n = np.array(normal, float)
        with np.errstate(divide="ignore"):
            t = (offset - centre @ n) / (rays @ n)
        nearer = (t > 0) & (t < depth)
        points = centre + t[nearer][:, None] * rays[nearer]
        first = np.array([1.0, 0, 0]) if seed == 0 else np.array([n[2], 0, -n[0]])
        second = np.cross(n, first)
        at = np.stack([points @ first, points @ second]) * 110 + 256
        paint = texture(seed)
        rgb[nearer] = np.stack(
            [map_coordinates(paint[..., c], at, order=1, mode="mirror") for c in range(3)], 1
        )
        depth[nearer] = t[nearer]
    return Image.fromarray(rgb.round().astype(np.uint8))


@pytest.fixture(scope="module")
def rendered() -> list[Image.Image]:
    return [render(w2c) for w2c in poses()]


@pytest.fixture
def folder(rendered: list[Image.Image], tmp_path: Path) -> Path:
    source = tmp_path / "photos"
    source.mkdir()
    for i, image in enumerate(rendered):
        image.save(source / f"view {i}.png")
    return source


@pytest.fixture(scope="module")
def solved(rendered: list[Image.Image], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, list]:
    """Photos, their finished workspace, and the progress that was reported."""
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("needs pycolmap (the extra `poses`)")
    base = tmp_path_factory.mktemp("solved")
    source, events = base / "my photos", []
    (source / "é 1").mkdir(parents=True)
    for i, image in enumerate(rendered[:-1]):
        image.save(source / "é 1" / f"view {i}.png")
    exif = Image.Exif()
    exif[0x0112] = 6
    turned = rendered[-1].transpose(Image.Transpose.ROTATE_90)
    turned.save(source / "é 1" / "view 1.jpg", quality=95, exif=exif)
    (source / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 no photo")
    Image.new("RGB", (WIDTH, HEIGHT), (90, 90, 90)).save(source / "blank.png")
    noise = np.random.default_rng(5).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    Image.fromarray(gaussian_filter(noise.astype(float), (1.5, 1.5, 0)).round().astype(np.uint8)).save(
        source / "elsewhere.png"
    )
    reconstruct(source, base / "out", CONFIG, lambda *event: events.append(event))
    return source, base / "out", events


def test_the_cameras_are_found(solved: tuple[Path, Path, list]) -> None:
    scene = load_scene(solved[1], test_every=0)
    expected = {f"é 1/view {i}.png": w2c for i, w2c in enumerate(poses()[:-1])}
    expected["é 1/view 1.jpg"] = poses()[-1]
    expected["é 1/view 1_png.png"] = expected.pop("é 1/view 1.png")
    assert {view.name for view in scene.views} == set(expected)
    assert all(view.lens is None for view in scene.views)  # pinholes
    truth = np.stack([-w[:3, :3].T @ w[:3, 3] for w in (expected[v.name] for v in scene.views)])
    found = np.stack([view.camera.position for view in scene.views]).astype(float)
    spread = [np.linalg.norm(x - x.mean(0)) for x in (truth, found)]
    turn = Rotation.align_vectors(truth - truth.mean(0), found - found.mean(0))[0]
    error = turn.apply(found - found.mean(0)) * spread[0] / spread[1] - (truth - truth.mean(0))
    assert np.linalg.norm(error, axis=1).max() < 0.02 * np.linalg.norm(truth - truth.mean(0), axis=1).max()
    focal = np.array([view.camera.K[0, 0] for view in scene.views])
    np.testing.assert_allclose(focal, FOCAL, rtol=0.03)
    # Gravity is +y, as in the scene that was rendered.
    assert turn.apply([0.0, 1.0, 0.0])[1] > np.cos(np.radians(2))
    assert len(scene.points.xyz) > 200
    assert len(scene.points.track_points) > 2 * len(scene.points.xyz)


def test_what_was_left_out_is_said(solved: tuple[Path, Path, list]) -> None:
    report = json.loads((solved[1] / "poses.json").read_text())
    reasons = report["unregistered"]
    assert set(reasons) == {"broken.jpg", "blank.png", "elsewhere.png"}
    assert reasons["broken.jpg"].startswith("unreadable: ")
    assert reasons["blank.png"] == "too few features"
    assert reasons["elsewhere.png"] == "no match with enough inliers"
    assert (report["num_photos"], report["num_registered"], report["complete"]) == (VIEWS + 2, VIEWS, True)
    assert report["renamed"] == {"é 1/view 1.png": "é 1/view 1_png.png"}
    assert report["resolved"] == {"matching": "exhaustive", "cameras": 1}
    assert 0 < report["reprojection_error"] < 1


def test_label_images_of_the_photos_land_on_their_pixels(solved, rendered, tmp_path):
    """As they were taken, one of them on its side: bright pixels of the photos are those labelled bright."""
    scene = load_scene(solved[1], test_every=0)
    (tmp_path / "labels.json").write_text('{"labels": {"0": "dark", "1": "bright"}}')
    names = [view.name for view in scene.views]
    for name in names:
        number = int(name.split()[2][0])
        stored = (
            rendered[-1].transpose(Image.Transpose.ROTATE_90) if name.endswith("jpg") else rendered[number]
        )
        label = (np.asarray(stored.convert("L")) > 128).astype(np.uint8)
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.fromarray(label).save((tmp_path / name).with_suffix(".png"))
    assert import_masks(scene, tmp_path, tmp_path / "out") == []
    for view in scene.views:
        bright = read(tmp_path / "out" / Path(view.name).with_suffix(".png"))
        grey = load_photo(view).mean(axis=2)
        clear = np.abs(grey - 128) > 25
        assert (bright[clear] == (grey[clear] > 128)).mean() > 0.97


def test_a_finished_workspace_is_kept(solved, monkeypatch):
    source, out, _ = solved
    before = (out / "poses.json").read_text()

    def never(*args: Any) -> None:
        raise AssertionError("nothing is left to do")

    monkeypatch.setattr(photos, "_run", never)
    again = reconstruct(source, out, replace(CONFIG, min_registered=0.2))
    assert (again.num_registered, again.workspace) == (VIEWS, out)
    assert (out / "poses.json").read_text() == before


class Ended(subprocess.Popen):
    """Whose context has nothing to wait for: after Ctrl-C it would for a quarter of a second only."""

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        value: BaseException | None,
        traceback: types.TracebackType | None,
    ) -> None:
        assert self.returncode is not None
        super().__exit__(exc_type, value, traceback)


@needs_pycolmap
def test_a_stopped_run_goes_on(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "Popen", Ended)
    out, config = tmp_path / "out", replace(CONFIG, max_size=200)

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "matches":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(folder, out, config, stop)
    assert not (out / "poses.json").exists()
    features: list[tuple[int, int]] = []

    def stop_later(stage: str, done: int, total: int) -> None:
        if stage == "features":
            features.append((done, total))
        if stage == "mapping":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(folder, out, config, stop_later)
    assert features == [(VIEWS, VIEWS)]  # all were there

    def stop_at_once(stage: str, done: int, total: int) -> None:
        if stage == "features":
            assert (done, total) == (0, VIEWS)  # other settings start again
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(folder, out, replace(config, max_size=2000), stop_at_once)


@needs_pycolmap
def test_too_few_poses_is_one_line_and_keeps_the_work(tmp_path: Path) -> None:
    source = tmp_path / "photos"
    source.mkdir()
    for i in range(3):
        noise = np.random.default_rng(i).integers(0, 256, (60, 80, 3)).astype(np.uint8)
        Image.fromarray(noise).save(source / f"{i}.png")
    with pytest.raises(SceneError, match=r"poses found for 0 of 3 photos \(0%.*overlap"):
        reconstruct(source, tmp_path / "out", CONFIG)
    report = json.loads((tmp_path / "out" / "poses.json").read_text())
    assert (report["complete"], len(report["unregistered"])) == (False, 3)
    assert (tmp_path / "out" / "sfm" / "database.db").is_file()
    assert not (tmp_path / "out" / "sparse").exists()


@needs_pycolmap
def test_no_features_where_pixels_do_not_count(folder: Path, tmp_path: Path) -> None:
    """By alpha, a mask of half the size, a mask of a photo that EXIF turns, and label images."""
    alpha, masked, turned, labelled = (folder / f"view {i}.png" for i in range(4))
    pixels = np.dstack([read(alpha), np.full((HEIGHT, WIDTH), 255, np.uint8)])
    pixels[:, : WIDTH // 2, 3] = 0
    Image.fromarray(pixels).save(alpha)
    (folder / "masks_valid").mkdir()
    half = Image.new("1", (WIDTH // 2, HEIGHT // 2))
    half.paste(1, (WIDTH // 4, 0, WIDTH // 2, HEIGHT // 2))
    half.save(folder / "masks_valid" / masked.name)
    exif = Image.Exif()
    exif[0x0112] = 6
    with Image.open(turned) as image:
        image.transpose(Image.Transpose.ROTATE_90).save(turned, exif=exif)
    stored = Image.new("L", (HEIGHT, WIDTH))
    stored.paste(200, (0, 0, HEIGHT, WIDTH // 2))  # of the stored pixels the upper half is the right one
    stored.save(folder / "masks_valid" / f"{turned.name}.png")
    right = np.arange(WIDTH)[None].repeat(HEIGHT, 0) >= WIDTH // 2

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "matches":
            raise KeyboardInterrupt

    def features(name: str) -> np.ndarray:
        work = tmp_path / "out" / "sfm"
        names = json.loads((work / "request.json").read_text())["names"]
        prepared = next(key for key, final in names.items() if final == name)
        with sqlite3.connect(work / "database.db") as database:
            (row,) = database.execute(
                "select rows, cols, data from keypoints natural join images where name = ?", (prepared,)
            ).fetchall()
        database.close()
        return np.frombuffer(row[2], np.float32).reshape(row[:2])

    def ignored(name: str) -> np.ndarray | None:
        return right if name == labelled.name else None

    with pytest.raises(KeyboardInterrupt):
        reconstruct(folder, tmp_path / "out", CONFIG, stop, ignored=ignored)
    assert features("view 4.png")[:, 0].min() < WIDTH / 4
    for path in (alpha, masked, turned, labelled):
        found = features(path.name)
        assert len(found) > 20, path
        assert found[:, 0].min() > WIDTH / 2 - 1, path
    kept = sorted(path.name for path in (tmp_path / "out" / "masks_valid").iterdir())
    assert kept == ["view 0.png", "view 1.png", "view 2.png"]  # label images are the stage's that follows
    Image.new("L", (50, 50)).save(folder / "masks_valid" / masked.name)
    with pytest.raises(SceneError, match=r"view 1\.png: a mask or label image of 50 x 50 pixels"):
        reconstruct(folder, tmp_path / "out", CONFIG, stop)


def test_focal_lengths_of_exif_reach_colmap(tmp_path: Path) -> None:
    """Through a plain JPEG, a turned one and a PNG with alpha: 35 mm on 36 mm wide film."""
    source, noise = (
        tmp_path / "photos",
        np.random.default_rng(0).integers(0, 256, (48, 72, 4)).astype(np.uint8),
    )
    source.mkdir()
    for name, orientation, mode in (("a.jpg", 1, "RGB"), ("b.jpg", 6, "RGB"), ("c.png", 1, "RGBA")):
        exif = Image.Exif()
        exif[0x0112] = orientation
        exif.get_ifd(0x8769)[0xA405] = 35
        Image.fromarray(noise).convert(mode).save(source / name, exif=exif)
    with pytest.raises(SceneError, match="0 of 3 photos"):
        reconstruct(source, tmp_path / "out", replace(CONFIG, camera="per-image"))
    with sqlite3.connect(tmp_path / "out" / "sfm" / "database.db") as database:
        rows = database.execute("select width, height, params, prior_focal_length from cameras").fetchall()
    database.close()
    assert sorted(row[:2] for row in rows) == [(48, 72), (72, 48), (72, 48)]
    assert all(row[3] for row in rows)
    np.testing.assert_allclose([np.frombuffer(row[2])[0] for row in rows], 70, rtol=0.05)


def prepared(source: Path, target: Path) -> tuple[dict[str, Path], dict[str, str]]:
    found, unreadable = prepare_photos(source, target, target.parent / "none", lambda done, total: None)
    return {photo.final: target / photo.prepared for photo in found}, unreadable


def read(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def test_photos_become_upright_8_bit_rgb(tmp_path: Path) -> None:
    source = tmp_path / "photos"
    (source / "sub").mkdir(parents=True)
    rgb = np.random.default_rng(0).integers(0, 256, (20, 30, 3)).astype(np.uint8)
    grey16 = rgb[..., 0].astype(np.uint16) * 257
    Image.fromarray(rgb).save(source / "as it is.jpg", quality=80)
    Image.fromarray(rgb).save(source / "plain.png")
    Image.fromarray(grey16).save(source / "grey16.png")
    Image.fromarray(rgb).convert("CMYK").save(source / "cmyk.jpg", quality=100)
    Image.fromarray(np.dstack([rgb, np.zeros_like(rgb[..., :1])])).save(source / "alpha.png")
    Image.fromarray(rgb).save(source / "sub" / "lossless.bmp")
    Image.fromarray(rgb).save(source / "sub" / "web.webp")
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(rgb).save(source / "turned.png", exif=exif)
    (source / ".hidden.jpg").write_bytes(b"")
    files, unreadable = prepared(source, tmp_path / "target")
    assert not unreadable
    assert set(files) == {
        *("as it is.jpg", "plain.png", "grey16.png", "cmyk.jpg", "alpha.png", "turned.png"),
        *("sub/lossless.png", "sub/web.jpg"),
    }
    for name in ("as it is.jpg", "plain.png"):
        assert files[name].samefile(source / name)  # no second generation
    pixels = {name: read(path) for name, path in files.items()}
    assert {p.dtype for p in pixels.values()} == {np.dtype(np.uint8)}
    assert {p.shape for name, p in pixels.items() if name != "turned.png"} == {(20, 30, 3)}
    np.testing.assert_array_equal(pixels["turned.png"], np.rot90(rgb, -1))
    np.testing.assert_array_equal(pixels["grey16.png"], np.repeat(rgb[..., :1], 3, axis=2))
    np.testing.assert_array_equal(pixels["sub/lossless.png"], rgb)
    assert pixels["alpha.png"].max() == 0
    with Image.open(files["turned.png"]) as image:
        assert image.getexif().get(0x0112, 1) == 1


def test_prepared_photos_are_kept_until_the_source_changes(tmp_path: Path) -> None:
    source = tmp_path / "photos"
    source.mkdir()
    for i in range(2):
        Image.new("L", (8, 8), 50 * i).save(source / f"{i}.png")
    first, _ = prepared(source, tmp_path / "target")
    inodes = {name: path.stat().st_ino for name, path in first.items()}
    Image.new("L", (8, 8), 200).save(source / "1.png")
    os.utime(source / "1.png", (1, 1))
    again, _ = prepared(source, tmp_path / "target")
    assert again["0.png"].stat().st_ino == inodes["0.png"]
    assert read(again["1.png"]).tolist()[0][0] == [200, 200, 200]
    (source / "0.png").unlink()
    last, _ = prepared(source, tmp_path / "target")
    assert [p.name for p in (tmp_path / "target").iterdir()] == [last["1.png"].name]


def test_numbers_order_photos_and_stems_stay_apart(tmp_path: Path) -> None:
    source = tmp_path / "photos"
    source.mkdir()
    for name in ("p10.png", "p9.png", "a.png", "A.tiff", "a.jpg"):
        Image.new("RGB", (8, 8)).save(source / name)
    files, _ = prepared(source, tmp_path / "target")
    stems = [name.rpartition(".")[0].casefold() for name in files]
    assert len(set(stems)) == 5
    assert list(files)[-2:] == ["p9.png", "p10.png"]


@pytest.mark.parametrize("mode", ["single", "per-folder"])
def test_one_camera_for_two_sizes_is_refused(tmp_path: Path, mode: Any) -> None:
    for i in range(4):
        Image.new("RGB", (30 + i // 2, 20)).save(tmp_path / f"{i}.png")
    found, _ = prepare_photos(tmp_path, tmp_path / "t", tmp_path / "t", lambda done, total: None)
    with pytest.raises(SceneError, match="30 x 20 and 31 x 20 pixels cannot share a camera"):
        photos._request(tmp_path, found, PosesConfig(camera=mode))


def turned_heic() -> bytes:
    """A HEIC as a phone held upright writes it: pixels as the sensor lies, and a turn of 90 degrees."""
    content = bytearray((Path(__file__).parent / "data" / "two_halves.heic").read_bytes())
    turn = b"\0\0\0\x09irot\x01"
    properties = content.index(b"\x05\x81\x02\x03\x05\x84")  # of the image: five; the new one is the sixth
    content[properties : properties + 6] = b"\x06\x81\x02\x03\x05\x84\x86"
    end = content.index(b"ipma") - 4
    content[end:end] = turn
    offset = content.index(b"\0\0\x01\xa1")  # of the pixels in the file
    sizes = [
        (content.index(box) - 4, more)
        for box, more in ((b"meta", 10), (b"iprp", 10), (b"ipco", 9), (b"ipma", 1))
    ]
    for at, more in [*sizes, (offset, 10)]:
        content[at : at + 4] = (int.from_bytes(content[at : at + 4], "big") + more).to_bytes(4, "big")
    return bytes(content)


def test_heic_photos_of_a_turned_phone_are_upright(tmp_path: Path) -> None:
    pytest.importorskip("pi_heif")
    (tmp_path / "a.heic").write_bytes(turned_heic())
    (photo,), unreadable = prepare_photos(tmp_path, tmp_path / "t", tmp_path / "t", lambda done, total: None)
    assert not unreadable
    assert photo.size == (48, 64)
    assert photo.orientation == 1  # the decoder has turned it; nothing else may turn it again
    image = np.asarray(Image.open(tmp_path / "t" / photo.prepared), int)
    assert np.abs(image[54, 10] - [200, 40, 40]).max() < 20
    assert np.abs(image[10, 10] - [40, 40, 200]).max() < 20


def test_portrait_and_landscape_of_a_phone_are_cameras_of_their_own(tmp_path: Path) -> None:
    """4:3, 16:9 and portrait, which EXIF turns: photos of one upright size share intrinsics."""
    exif = Image.Exif()
    exif[0x0110] = "Phone"
    for i, (size, orientation) in enumerate((((64, 48), 1), ((64, 36), 1), ((64, 48), 6), ((48, 64), 1)) * 2):
        exif[0x0112] = orientation
        Image.new("RGB", size).save(tmp_path / f"{i}.jpg", exif=exif)
    found, _ = prepare_photos(tmp_path, tmp_path / "t", tmp_path / "t", lambda done, total: None)
    assert [photo.size for photo in found[:4]] == [(64, 48), (64, 36), (48, 64), (48, 64)]
    groups = photos._request(tmp_path, found, PosesConfig())["cameras"]
    assert sorted(len(group) for group in groups) == [2, 2, 4]


def test_too_few_photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(photos.importlib.util, "find_spec", lambda name: name)
    source = tmp_path / "photos"
    source.mkdir()
    for i in range(3):
        (source / f"{i}.jpg").write_bytes(b"no photo")
    with pytest.raises(
        SceneError, match=r"it takes 3; 0\.jpg \(the first of 3\) is unreadable: .*; replace or"
    ):
        reconstruct(source, tmp_path / "out")


def test_nothing_of_the_users_is_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(photos.importlib.util, "find_spec", lambda name: name)
    (tmp_path / "images").mkdir()
    (tmp_path / "photos").mkdir()
    for source in (tmp_path, tmp_path / "images"):
        with pytest.raises(SceneError, match="lies where the poses would be written"):
            reconstruct(source, tmp_path)
    with pytest.raises(SceneError, match="already holds a capture; name an empty folder"):
        reconstruct(tmp_path / "photos", tmp_path)
    with pytest.raises(SceneError, match=r"gone: no such file or folder"):
        reconstruct(tmp_path / "gone", tmp_path / "out")
    (tmp_path / "file").write_text("")
    with pytest.raises(SceneError, match="file: is not a folder"):
        reconstruct(tmp_path / "photos", tmp_path / "file")


def test_without_pycolmap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(photos.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(BackendUnavailable, match=r"need pycolmap; .*pip install 'sagesplat\[poses\]'"):
        reconstruct(tmp_path, tmp_path / "out")


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("import os; os.kill(os.getpid(), 11)", r"COLMAP crashed \(SIGSEGV\); see .*log\.txt"),
        ("raise ValueError('bad luck')", r"COLMAP failed \(ValueError: bad luck\)"),
        ("", "COLMAP failed"),
    ],
)
def test_a_crash_of_the_child_is_one_line(tmp_path, monkeypatch, script, message):
    (tmp_path / "script.py").write_text(script)
    monkeypatch.setattr(photos, "_SCRIPT", tmp_path / "script.py")
    with pytest.raises(SceneError, match=message):
        photos._run(tmp_path, lambda stage, done, total: None)


def test_an_error_in_the_callback_ends_the_child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = """
import json, os, time
print(json.dumps({"stage": str(os.getpid()), "done": 0, "total": 1}), flush=True)
time.sleep(3600)
"""
    (tmp_path / "script.py").write_text(lines)
    monkeypatch.setattr(photos, "_SCRIPT", tmp_path / "script.py")
    pids: list[int] = []

    def interrupt(stage: str, done: int, total: int) -> None:
        pids.append(int(stage))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        photos._run(tmp_path, interrupt)
    with pytest.raises(ProcessLookupError):
        os.kill(pids[0], signal.SIG_DFL)


@needs_pycolmap
def test_the_child_ends_with_its_parent_and_imports_no_pillow(tmp_path: Path) -> None:
    code = """
import importlib.util, sys, threading
spec = importlib.util.spec_from_file_location("sfm", sys.argv[1])
sfm = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sfm)
print(sorted(name for name in sys.modules if name.partition(".")[0] in ("PIL", "sagesplat")), flush=True)
thread = threading.Thread(target=sfm._end_with_parent)
thread.start()
thread.join(3600)
"""
    command = [sys.executable, "-P", "-c", code, str(photos._SCRIPT)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        out, _ = child.communicate(timeout=600)  # closes standard input, as a killed parent does
    assert (out.strip(), child.returncode) == ("[]", 1)


@settings(max_examples=20)
@given(st.integers(1, 400))
def test_sequential_pairs(count: int) -> None:
    pairs = _sfm.sequential_pairs(count)
    assert len(set(pairs)) == len(pairs)
    assert all(0 <= i < j < count for i, j in pairs)
    assert len(pairs) <= count * (_sfm.OVERLAP + 9) + _sfm.KEYFRAMES**2 / 2
    listed = set(pairs)
    assert all((i, i + d) in listed for i in range(count) for d in (*range(1, 11), 16) if i + d < count)
    if count > 2:
        assert (0, count - 1) in listed  # the loop is closed


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.booleans())
def test_upright_finds_gravity(seed: int, facade: bool) -> None:
    rng = np.random.default_rng(seed)
    around = rng.normal(0, 0.1 if facade else 2, 12)
    level = Rotation.from_euler("YX", np.stack([around, rng.normal(0, 0.05, 12)], 1))  # pan, then tilt
    world = Rotation.from_rotvec(rng.normal(0, 1.5, 3))  # COLMAP's world is turned somehow
    w2c = (world * level).inv().as_matrix()
    turn = _sfm.upright(w2c)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) > 0
    down = turn @ world.apply([0.0, 1.0, 0.0])
    assert down[1] > np.cos(np.radians(12 if facade else 1e-3))


def test_awkward_names_of_photos_are_mended(tmp_path: Path) -> None:
    source = tmp_path / os.fsdecode(b"photos \xff [old]")
    source.mkdir()
    names = (
        b"caf\xe9.png",
        b"caf\xe8.png",
        b"\x1b[31m.png",
        b"x" * 251 + b".png",
        b"x" * 250 + b"y.png",
        b"A.png",
        b"a.PNG",
    )
    for name in (*names, "e\u0301.png".encode(), "\u00e9.png".encode()):
        Image.new("RGB", (8, 8)).save(source / os.fsdecode(name))
    photos, unreadable = prepare_photos(source, tmp_path / "work", tmp_path / "none", lambda *_: None)
    assert not unreadable
    finals = [photo.final for photo in photos]
    assert len(photos) == len({collision_key(name) for name in finals}) == 9
    for name in finals:
        check_photo(name)
        assert name.lower().endswith(".png")


@pytest.mark.parametrize(
    "damage", ["{", "[]", "{}", '{"complete": true}', '{"complete": true, "seconds": 3}']
)
def test_a_damaged_report_is_made_again(tmp_path: Path, damage: str) -> None:
    (tmp_path / "sfm").mkdir()
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "sfm" / "request.json").write_text(json.dumps({"a": 1, "threads": 2}))
    (tmp_path / "poses.json").write_text(damage)
    assert photos._resume(tmp_path, {"a": 1}) is None
    (tmp_path / "sfm" / "request.json").write_text(damage)
    assert photos._resume(tmp_path, {"a": 1}) is None


def test_many_photos_and_videos_are_matched_in_sequence(tmp_path: Path) -> None:
    Image.new("RGB", (30, 20)).save(tmp_path / "a.png")
    found, _ = prepare_photos(tmp_path, tmp_path / "t", tmp_path / "t", lambda done, total: None)
    assert photos._request(tmp_path, found * 100, PosesConfig())["matching"] == "exhaustive"
    assert photos._request(tmp_path, found * 101, PosesConfig())["matching"] == "sequential"
    assert photos._request(tmp_path / "a.png", found, PosesConfig())["matching"] == "sequential"
    chosen = PosesConfig(matching="exhaustive")
    assert photos._request(tmp_path / "a.png", found, chosen)["matching"] == "exhaustive"
