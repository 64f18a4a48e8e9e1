"""What a camera wrote into a photo about its exposure."""

import math
from pathlib import Path
from typing import Any

from PIL import Image

from sagesplat.io.pictures import PictureError, open_picture

DETAILS = 0x8769  # tag of EXIF's own directory
_TIME, _APERTURE, _ISO = 0x829A, 0x829D, 0x8827
_MOST_EV = 40.0  # from moonlight to the sun's disc is less
_LARGEST = 2**20  # bytes of EXIF


def exposure_of(path: Path) -> float | None:
    """How bright a photo shows a given light, in EV (log2 of time x ISO / f-number^2); None: it does not say.

    Tags that are missing, zero, or no numbers are None too, and so is a file that is no photo.
    """
    try:
        with open_picture(path, decodes=False) as image:
            tags = exif_of(image).get_ifd(DETAILS)
            time, aperture, iso = (_number(tags.get(tag)) for tag in (_TIME, _APERTURE, _ISO))
    except PictureError:
        return None
    if not (time > 0 and iso > 0):
        return None
    value = math.log2(time) + math.log2(iso) - 2 * math.log2(aperture if aperture > 0 else 1.0)
    return value if abs(value) <= _MOST_EV else None


def exif_of(image: Image.Image) -> Image.Exif:
    """The photo's EXIF; empty if it is damaged, or larger than photos have it."""
    if len(image.info.get("exif") or b"") > _LARGEST:
        return Image.Exif()
    try:
        exif = image.getexif()
        exif.get_ifd(DETAILS)
        return exif
    except Exception:  # Pillow raises errors of many kinds here too
        return Image.Exif()


def _number(value: Any) -> float:
    """A tag's number, the first where there are several; 0 for anything else."""
    if isinstance(value, tuple | list):
        value = value[0] if value else 0
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return 0.0
    return number if math.isfinite(number) else 0.0
