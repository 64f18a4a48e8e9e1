"""Pictures from strangers: named formats, limits before decoding, one line for whatever a decoder throws."""

import ast
import os
import struct
import sys
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFile

import sagesplat
from sagesplat.core.errors import SceneError
from sagesplat.core.extras import install
from sagesplat.io.pictures import open_picture
from sagesplat.scene._prepare import prepare_photos
from sagesplat.scene.images import as_rgb, load_photo, photo_size
from sagesplat.scene.scene import Camera, View

HEIC = Path(__file__).parent / "data" / "two_halves.heic"
NOISE = np.random.default_rng(0).integers(0, 256, (40, 60, 3)).astype(np.uint8)


def load(path: Path, width: int = 60, height: int = 40) -> np.ndarray:
    camera = Camera(np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32), width, height)
    return load_photo(View(path.name, camera, path))


def refused(read: Callable[[], object]) -> str:
    """The message of a SceneError of one line."""
    with pytest.raises(SceneError) as raised:
        read()
    assert str(raised.value).isprintable()
    return str(raised.value)


def chunk(kind: bytes, content: bytes = b"") -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width: int, height: int, *chunks: bytes, color: int = 0) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, color, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + b"".join(chunks) + chunk(b"IEND")


def jpeg_of(width: int, height: int, nbytes: int) -> bytes:
    """A grey JPEG's header, and bytes that are no scan."""
    frame = struct.pack(">BHBHHBBBB", 0xC0, 11, 8, height, width, 1, 1, 0x11, 0)
    scan = b"\xff\xda" + struct.pack(">HBBBBBB", 8, 1, 1, 0, 0, 63, 0)
    return b"\xff\xd8\xff" + frame + scan + bytes(nbytes)


def test_pictures_are_opened_in_one_place() -> None:
    """Every other `Image.open` would start Ghostscript for a stranger's PostScript."""
    source = Path(sagesplat.__file__).parent
    found = []
    for path in source.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and node.attr in ("open", "imread", "fromfile", "read_image"):
                owner = node.value.id if isinstance(node.value, ast.Name) else ""
                if owner in ("Image", "PIL", "plt", "mpl", "iio", "imageio", "cv2", "torchvision"):
                    found.append(path.relative_to(source).as_posix())
            if isinstance(node, ast.ImportFrom) and node.module in ("PIL.Image", "matplotlib.image"):
                found.append(path.relative_to(source).as_posix())
    assert found == ["io/pictures.py"]


EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 60 40\n%%EndComments\n{} loop\n%%EOF\n"


def test_postscript_starts_no_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran, gs = tmp_path / "ran", tmp_path / "bin" / "gs"
    gs.parent.mkdir()
    gs.write_text(f"#!/bin/sh\ntouch {ran}\n")
    gs.chmod(0o755)
    monkeypatch.setenv("PATH", f"{gs.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr("PIL.EpsImagePlugin.gs_binary", None)  # as in a fresh process
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.png").write_bytes(EPS)
    expected = r"not readable as a photo (its content is PostScript); convert it to JPEG or PNG"
    for read in (load, photo_size):
        assert refused(lambda read=read: read(photos / "a.png")) == f"{photos / 'a.png'}: {expected}"
    _, unreadable = prepare_photos(photos, tmp_path / "t", tmp_path / "t", lambda done, total: None)
    assert unreadable == {"a.png": "unreadable: its content is PostScript; convert it to JPEG or PNG"}
    assert not ran.exists()


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (b"DDS |" + bytes(200), "DDS"),
        (b"P6\n60 40 255\n" + NOISE.tobytes(), "PPM"),
        (b"\0\0\0\x18ftypmp42\0\0\0\0mp41isom", "video"),
        (b"<!DOCTYPE html>", "SVG, XML or HTML"),
    ],
)
def test_another_format_is_named(tmp_path: Path, content: bytes, name: str) -> None:
    (tmp_path / "a.jpg").write_bytes(content)
    assert refused(lambda: load(tmp_path / "a.jpg")).endswith(
        f"not readable as a photo (its content is {name}); convert it to JPEG or PNG"
    )


def test_heic_without_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.heic").write_bytes(HEIC.read_bytes())
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    assert refused(lambda: load(tmp_path / "a.heic")).endswith(
        f"(HEIC needs an extra); {install('sagesplat[heic]')}"
    )
    _, unreadable = prepare_photos(tmp_path, tmp_path / "t", tmp_path / "t", lambda done, total: None)
    assert unreadable == {"a.heic": f"unreadable: HEIC needs an extra; {install('sagesplat[heic]')}"}


def test_a_pipe_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.png")
    assert "(no regular file)" in refused(lambda: photo_size(tmp_path / "a.png"))


def test_bombs_are_refused_before_they_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def decode(image: ImageFile.ImageFile) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr(ImageFile.ImageFile, "load", decode)
    (tmp_path / "a.png").write_bytes(png(13344, 13344, chunk(b"IDAT", bytes(165_000))))
    assert "13344 x 13344 pixels, more than fit into 165,057 bytes" in refused(
        lambda: load(tmp_path / "a.png")
    )
    (tmp_path / "b.jpg").write_bytes(jpeg_of(30000, 30000, 100))
    assert "30000 x 30000 pixels, more than 268 million); make it smaller" in refused(
        lambda: load(tmp_path / "b.jpg")
    )


def test_phones_take_200_megapixels(tmp_path: Path) -> None:
    """As dark as a photo can be; Pillow by itself refuses it."""
    width, height = 16320, 12240
    (tmp_path / "a.jpg").write_bytes(jpeg_of(width, height, width * height // 64))
    assert photo_size(tmp_path / "a.jpg") == (width, height)
    assert Image.MAX_IMAGE_PIXELS == 1024**3 // 4 // 3


def test_a_huge_jpeg_is_decoded_at_reduced_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sagesplat.scene.images._HUGE", 10**6)
    y, x = np.mgrid[:1200, :1600]
    ramp = np.stack([x / 7, y / 5, (x + y) / 12], -1).astype(np.uint8)
    Image.fromarray(ramp).save(tmp_path / "a.jpg", quality=95)
    expected = ramp.reshape(60, 20, 80, 20, 3).mean(axis=(1, 3))
    assert np.abs(load(tmp_path / "a.jpg", 80, 60) - expected).max() < 3


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        struct.error("unpack requires\na buffer"),
        SyntaxError("broken PNG file"),
        OSError(5, "Input/output error"),
        Image.DecompressionBombError("\x1b[31m"),
        Image.DecompressionBombWarning("large"),
    ],
)
def test_whatever_a_decoder_throws_is_one_line(tmp_path, monkeypatch, error):
    Image.fromarray(NOISE).save(tmp_path / "a.png")

    def fail(image: ImageFile.ImageFile) -> None:
        raise error

    monkeypatch.setattr(ImageFile.ImageFile, "load", fail)
    assert "not readable as a photo" in refused(lambda: load(tmp_path / "a.png"))


def test_warnings_of_pillow_stay_inside(tmp_path: Path) -> None:
    Image.fromarray(NOISE).save(tmp_path / "a.png")
    with open_picture(tmp_path / "a.png"):
        warnings.warn("Corrupt EXIF data", stacklevel=1)


@pytest.mark.parametrize("suffix", ["avif", "heic"])
def test_damaged_pictures(tmp_path: Path, suffix: str) -> None:
    """As `tests/fuzz` damages all others: a picture, or one line with its path."""
    path = tmp_path / f"a.{suffix}"
    if suffix == "heic":
        pytest.importorskip("pi_heif")
        path.write_bytes(HEIC.read_bytes())
    else:
        Image.fromarray(NOISE).save(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    messages = []
    for i in range(60):
        damaged = bytearray(whole)
        damaged[rng.integers(min(len(whole), 400) if i % 3 else len(whole))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged[: rng.integers(len(whole))] if i % 3 == 2 else damaged)
        try:
            load(path)
        except SceneError as error:
            messages.append(str(error))
    assert len(messages) > 10
    assert all(m.startswith(f"{path}: not readable as a photo (") and m.isprintable() for m in messages)


SEGMENT = struct.pack(">BBH", 0xFF, 0xE5, 2)
EXIF = struct.pack(">BBH", 0xFF, 0xE1, 9) + b"Exif\0\0x"


@pytest.mark.parametrize(
    ("inserted", "complaint"),
    [
        (SEGMENT * 5000, "too many segments"),
        (EXIF * 20, "segments are damaged"),
        (bytes(5000), "segments are damaged"),
        (b"\xff" * 5000, "segments are damaged"),
        (SEGMENT * 300 + EXIF + bytes(40), ""),
    ],
    ids=["segments", "exif", "zeros", "fill", "fine"],
)
def test_metadata_of_a_jpeg(tmp_path: Path, inserted: bytes, complaint: str) -> None:
    Image.fromarray(NOISE).save(tmp_path / "a.jpg")
    whole = (tmp_path / "a.jpg").read_bytes()
    expected = load(tmp_path / "a.jpg")
    at = whole.index(b"\xff\xdb")  # between two segments
    (tmp_path / "a.jpg").write_bytes(whole[:at] + inserted + whole[at:])
    if complaint:
        assert complaint in refused(lambda: load(tmp_path / "a.jpg"))
    else:
        np.testing.assert_array_equal(load(tmp_path / "a.jpg"), expected)


def test_scans_of_a_jpeg(tmp_path: Path) -> None:
    Image.fromarray(NOISE).save(tmp_path / "a.jpg", progressive=True)
    whole = (tmp_path / "a.jpg").read_bytes()
    assert load(tmp_path / "a.jpg").shape == NOISE.shape
    at = whole.rindex(b"\xff\xda")
    (tmp_path / "a.jpg").write_bytes(whole[:at] + whole[at:-2] * 200 + whole[-2:])
    assert "a JPEG of too many scans" in refused(lambda: load(tmp_path / "a.jpg"))


def test_chunks_of_a_png(tmp_path: Path) -> None:
    pixels = chunk(b"IDAT", zlib.compress(bytes(41 * 60)))
    text = [chunk(b"zTXt", b"k%d\0\0" % i + zlib.compress(bytes(900_000))) for i in range(100)]
    many = chunk(b"teSt") * 5000
    for content in (png(60, 40, *text, pixels), png(60, 40, many, pixels), png(60, 40, pixels, *text)):
        (tmp_path / "a.png").write_bytes(content)
        assert "its metadata has too many chunks" in refused(lambda: load(tmp_path / "a.png"))


def tiff(*tags: tuple[int, int, int, bytes]) -> bytes:
    """A TIFF of 10 x 10 grey pixels, with more tags: number, type, count, content."""
    data, rows = bytes(100), [(256, 4, 1, 10), (257, 4, 1, 10), (258, 3, 1, 8), (259, 3, 1, 1)]
    rows += [(262, 3, 1, 1), (273, 4, 1, 8), (277, 3, 1, 1), (278, 4, 1, 10), (279, 4, 1, 100)]
    for tag, kind, count, content in tags:
        rows.append((tag, kind, count, 8 + len(data)))
        data += content
    entries = b"".join(struct.pack("<HHII", *row) for row in sorted(rows))
    return (
        b"II*\0" + struct.pack("<I", 8 + len(data)) + data + struct.pack("<H", len(rows)) + entries + bytes(4)
    )


@pytest.mark.parametrize(
    ("tags", "complaint"),
    [
        ([], ""),
        ([(282, 5, 1, struct.pack("<II", 72, 1))], ""),
        ([(282, 5, 2000, bytes(16000))], "too many numbers"),
        ([(34665, 4, 1, b"")], ""),  # EXIF of nothing
        ([(40000 + i, 3, 1, b"") for i in range(5000)], "too many tags"),
    ],
)
def test_tags_of_a_tiff(tmp_path: Path, tags: list[tuple[int, int, int, bytes]], complaint: str) -> None:
    (tmp_path / "a.tif").write_bytes(tiff(*tags))
    if complaint:
        assert complaint in refused(lambda: load(tmp_path / "a.tif"))
    else:
        assert (load(tmp_path / "a.tif", 10, 10) == 0).all()


def plainly(image: Image.Image, background: tuple[int, int, int]) -> Image.Image:
    """`as_rgb` of the whole image at once."""
    if image.mode.startswith("I") or image.mode == "F":
        values = np.asarray(image, np.float64)
        scale = 257 if image.mode.startswith("I") and values.max() > 255 else 1
        return Image.fromarray((values / scale).round().clip(0, 255).astype(np.uint8)).convert("RGB")
    if image.has_transparency_data:
        image = image.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", image.size, (*background, 255)), image).convert("RGB")
    return image.convert("RGB")


DEEP = (np.random.default_rng(2).random((40, 60)) * 65535).astype(np.uint16)
ALPHA = Image.fromarray(np.dstack([NOISE, NOISE[..., :1]]))
KINDS = {
    **{mode: Image.fromarray(NOISE).convert(mode) for mode in ("RGB", "L", "1", "P", "CMYK")},
    **{mode: ALPHA.convert(mode) for mode in ("RGBA", "LA")},
    "I;16": Image.fromarray(DEEP),
    "dark I;16": Image.fromarray(DEEP // 257),
    "I": Image.fromarray(DEEP.astype(np.int32) * 300),
    "F": Image.fromarray(DEEP.astype(np.float32) / 200),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_pixels_stay_bit_for_bit(tmp_path, monkeypatch, kind, suffix):
    if (kind in ("CMYK", "I", "F") and suffix == "png") or (kind == "P" and suffix == "tif"):
        pytest.skip("not in this format")
    path = tmp_path / f"a.{suffix}"
    image = KINDS[kind].copy()
    if kind == "P":
        image.info["transparency"] = 3
    image.save(path)
    with Image.open(path) as image:
        expected = np.asarray(plainly(image, (255, 9, 99)))
    monkeypatch.setattr("sagesplat.scene.images._STRIP", 7 * 60)  # rows
    with open_picture(path) as image:
        np.testing.assert_array_equal(np.asarray(as_rgb(image, (255, 9, 99))), expected)


def test_not_a_number_is_black(tmp_path: Path) -> None:
    values = np.array([[np.nan, np.inf, -np.inf, 7]], np.float32)
    Image.fromarray(values).save(tmp_path / "a.tif")
    assert load(tmp_path / "a.tif", 4, 1)[0, :, 0].tolist() == [0, 255, 0, 7]


def test_only_jpeg_and_png_reach_colmap_as_they_are(tmp_path: Path) -> None:
    """A name lies: COLMAP would choose its decoder by it."""
    photos = tmp_path / "photos"
    photos.mkdir()
    Image.fromarray(NOISE).save(photos / "a.jpg", format="TIFF")
    Image.fromarray(NOISE).save(photos / "b.jpg", format="PNG")
    Image.fromarray(NOISE).save(photos / "c.png", format="WEBP")
    found, _ = prepare_photos(photos, tmp_path / "t", tmp_path / "t", lambda done, total: None)
    kinds = {}
    for photo in found:
        with Image.open(tmp_path / "t" / photo.prepared) as image:
            kinds[photo.name] = image.format, Path(photo.prepared).suffix
    assert kinds == {"a.jpg": ("PNG", ".png"), "b.jpg": ("PNG", ".png"), "c.png": ("JPEG", ".jpg")}


def test_a_prepared_photo_from_elsewhere_is_made_again(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    Image.fromarray(NOISE).convert("L").save(photos / "a.png")
    (first,), _ = prepare_photos(photos, tmp_path / "t", tmp_path / "t", lambda done, total: None)
    prepared = tmp_path / "t" / first.prepared
    expected, mtime = prepared.read_bytes(), prepared.stat().st_mtime_ns
    prepared.write_bytes(png(9, 9))
    os.utime(prepared, ns=(mtime, mtime))
    prepare_photos(photos, tmp_path / "t", tmp_path / "t", lambda done, total: None)
    assert prepared.read_bytes() == expected
