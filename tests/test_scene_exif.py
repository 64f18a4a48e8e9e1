"""EXIF's exposure: as cameras write it, and as others do."""

from fractions import Fraction

import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from sagesplat.scene.exif import exposure_of

TIME, APERTURE, ISO = 0x829A, 0x829D, 0x8827


def photo(path, tags) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    Image.new("RGB", (8, 8)).save(path, exif=exif)


def test_twice_the_time_is_one_ev(tmp_path):
    for name, time in (("a", Fraction(1, 100)), ("b", Fraction(1, 50))):
        photo(tmp_path / f"{name}.jpg", {TIME: IFDRational(time), APERTURE: IFDRational(28, 10), ISO: 200})
    a, b = (exposure_of(tmp_path / f"{name}.jpg") for name in "ab")
    assert a is not None
    assert b == pytest.approx(a + 1)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {TIME: "fast", APERTURE: "open", ISO: "high"},
        {TIME: IFDRational(1, 0), ISO: 100},
        {TIME: IFDRational(1, 60)},
    ],
)
def test_what_says_nothing(tmp_path, tags):
    photo(tmp_path / "a.tiff", tags)
    assert exposure_of(tmp_path / "a.tiff") is None


def test_smaller_apertures_and_lower_iso_are_darker(tmp_path):
    photo(tmp_path / "a.jpg", {TIME: IFDRational(1, 100), APERTURE: IFDRational(2), ISO: 200})
    photo(tmp_path / "b.jpg", {TIME: IFDRational(1, 100), APERTURE: IFDRational(4), ISO: 100})
    a, b = (exposure_of(tmp_path / f"{name}.jpg") for name in "ab")
    assert a is not None
    assert b == pytest.approx(a - 3)


def test_what_is_no_photo(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff\xe1nothing")
    assert exposure_of(tmp_path / "a.jpg") is None
    assert exposure_of(tmp_path / "gone.jpg") is None
