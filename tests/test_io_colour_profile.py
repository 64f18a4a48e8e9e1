"""Colour profiles of photos: converted to sRGB, and left alone where there is nothing to convert."""

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms

from sagesplat.io.colour_profile import describe_profiles, in_srgb, profile_of
from sagesplat.scene.images import as_rgb

# Chromaticities of red, green, blue and white.
P3 = ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060), (0.3127, 0.3290))
ADOBE = ((0.640, 0.330), (0.210, 0.710), (0.150, 0.060), (0.3127, 0.3290))
PROPHOTO = ((0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001), (0.3457, 0.3585))
SRGB = ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060), (0.3127, 0.3290))
D50 = np.array([0.9642, 1.0, 0.8249])
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def _xyz(xy: tuple[float, float]) -> np.ndarray:
    return np.array([xy[0] / xy[1], 1.0, (1 - xy[0] - xy[1]) / xy[1]])


def to_d50(primaries) -> np.ndarray:
    """The matrix from linear RGB to XYZ of D50, as profiles have it."""
    colours = np.stack([_xyz(xy) for xy in primaries[:3]], 1)
    white = _xyz(primaries[3])
    matrix = colours * np.linalg.solve(colours, white)
    cone = np.diag((BRADFORD @ D50) / (BRADFORD @ white))
    return np.linalg.inv(BRADFORD) @ cone @ BRADFORD @ matrix


def _fixed(value: float) -> bytes:
    return struct.pack(">i", round(value * 65536))


def profile(primaries, gamma: float, name: str = "test", *, grey: bool = False) -> bytes:
    """A profile of matrix and gamma (ICC.1:2001-04, version 2)."""
    curve = b"curv" + bytes(4) + struct.pack(">IH", 1, round(gamma * 256)) + bytes(2)
    text = name.encode() + b"\0"
    described = b"desc" + bytes(4) + struct.pack(">I", len(text)) + text + bytes(4 + 4 + 2 + 1 + 67)
    white = b"XYZ " + bytes(4) + b"".join(map(_fixed, D50))
    tags = [(b"desc", described), (b"wtpt", white), (b"cprt", b"text" + bytes(4) + b"none\0")]
    if grey:
        tags += [(b"kTRC", curve)]
    else:
        matrix = to_d50(primaries)
        tags += [(f"{c}XYZ".encode(), b"XYZ " + bytes(4) + b"".join(map(_fixed, matrix[:, i])))
                 for i, c in enumerate("rgb")]  # fmt: skip
        tags += [(f"{c}TRC".encode(), curve) for c in "rgb"]
    at, table, body = 132 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for key, content in tags:
        content += bytes(-len(content) % 4)
        table += key + struct.pack(">II", at + len(body), len(content))
        body += content
    head = struct.pack(">I4sI4s4s4s", at + len(body), b"lcms", 0x02400000, b"mntr",
                       b"GRAY" if grey else b"RGB ", b"XYZ ")  # fmt: skip
    head += struct.pack(">6H", 2026, 1, 1, 0, 0, 0) + b"acsp" + bytes(28) + b"".join(map(_fixed, D50))
    return head.ljust(128, b"\0") + table + body


def expected(rgb: np.ndarray, primaries, gamma: float) -> np.ndarray:
    """Colours in sRGB, by the definitions."""
    linear = (rgb / 255) ** gamma @ (np.linalg.inv(to_d50(SRGB)) @ to_d50(primaries)).T
    linear = linear.clip(0, 1)
    return 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(40, 200, (12, 16, 3), np.uint8)


@pytest.mark.parametrize(("primaries", "gamma"), [(P3, 2.2), (ADOBE, 2.19921875), (PROPHOTO, 1.8)])
@pytest.mark.parametrize("suffix", ["png", "tif", "jpg"])
def test_wide_colours_become_srgb(tmp_path, primaries, gamma, suffix):
    rgb = _picture() if suffix != "jpg" else np.full((16, 16, 3), (180, 90, 60), np.uint8)
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(rgb).save(path, icc_profile=profile(primaries, gamma, "Wide"), quality=100)
    with Image.open(path) as image:
        stored = np.asarray(image)
    with Image.open(path) as image:
        found = np.asarray(as_rgb(image, (0, 0, 0))).astype(float)
    assert np.abs(found - expected(stored, primaries, gamma)).max() < 2.5
    assert np.abs(found - stored).max() > 5
    assert describe_profiles([path, path]) == ["photos converted from Wide to sRGB: 2"]


def test_srgb_stays_as_it_is(tmp_path):
    rgb = _picture()
    made = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for content in (made, b""):
        Image.fromarray(rgb).save(tmp_path / "a.png", icc_profile=content)
        with Image.open(tmp_path / "a.png") as image:
            assert as_rgb(image, (0, 0, 0)) is image
            assert np.array_equal(np.asarray(image), rgb)
    assert describe_profiles([tmp_path / "a.png"]) == []
    assert profile_of(made).kind == "srgb"


def test_grey_and_transparent_pictures(tmp_path):
    content = profile(P3, 1.0, "linear", grey=True)
    grey = Image.fromarray(np.full((4, 4), 55, np.uint8))
    grey.info["icc_profile"] = content
    assert np.asarray(as_rgb(grey, (0, 0, 0)))[0, 0].tolist() == [pytest.approx(128, abs=2)] * 3
    coloured = Image.fromarray(_picture())
    coloured.info["icc_profile"] = content  # not of this picture
    assert in_srgb(coloured) is coloured
    coloured.save(tmp_path / "a.png", icc_profile=content)
    assert describe_profiles([tmp_path / "a.png"]) == [
        "photos that the profile linear is not for, read without it: 1"
    ]
    pixels = np.dstack([_picture(), np.full((12, 16), 255, np.uint8)])
    pixels[:6, :, 3] = 0
    clear = Image.fromarray(pixels)
    clear.info["icc_profile"] = profile(P3, 2.2)
    found = np.asarray(as_rgb(clear, (9, 8, 7)))
    assert (found[:6] == (9, 8, 7)).all()
    assert np.abs(found[6:] - expected(pixels[6:, :, :3], P3, 2.2)).max() < 2.5


@pytest.mark.parametrize("content", [b"no profile", profile(P3, 2.2)[:200], bytes(4000), b"\0" * (2**23 + 1)])
def test_a_damaged_profile_is_said(tmp_path, content):
    rgb = _picture()
    image = Image.fromarray(rgb)
    image.info["icc_profile"] = content
    assert np.array_equal(np.asarray(as_rgb(image, (0, 0, 0))), rgb)
    if len(content) < 2**20:
        path = tmp_path / "a.png"
        image.save(path)
        assert describe_profiles([path, Path("missing.png")]) == [
            f"photos with a damaged colour profile, read as sRGB: 1, first {path}"
        ]
