"""Colour profiles (ICC) that pictures carry: their colours become those of sRGB."""

from collections import Counter
from collections.abc import Iterable
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from PIL import Image

from sagesplat.core.errors import short
from sagesplat.core.names import repaired
from sagesplat.io.pictures import PictureError, open_picture

_LARGEST = 2**23  # bytes; those of printers have three million
_SAME = 2  # levels of 255 by which colours of sRGB's own profiles differ
_FITTING = {"L": ("1", "L", "LA"), "CMYK": ("CMYK",)}  # modes of pictures; for RGB all
_SPACES = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}  # of profiles: the mode of pictures


class Profile(NamedTuple):
    """What a colour profile is good for."""

    kind: Literal["srgb", "other", "damaged"]  # srgb: nothing is to be converted
    name: str  # for people
    mode: str = ""  # of pictures that it is for


def in_srgb(image: Image.Image) -> Image.Image:
    """The picture, decoded, with colours in sRGB; itself where they are, and where its profile is damaged.

    Modes with a profile become RGB or RGBA. 16 bits are left alone.
    """
    content = image.info.get("icc_profile")
    if not content or not _converts(profile := profile_of(content), image):
        return image
    alpha = image.convert("RGBA").getchannel("A") if image.has_transparency_data else None
    plain = image if image.mode == profile.mode else image.convert(profile.mode)
    converted = _transformed(plain, content, profile.mode)
    if alpha is not None:
        converted.putalpha(alpha)
    return converted


def _converts(profile: Profile, image: Image.Image) -> bool:
    """Whether colours change: not in pictures of another kind than the profile's, nor in 16 bits of grey."""
    plain = not image.mode.startswith("I") and image.mode != "F"
    return plain and profile.kind == "other" and image.mode in _FITTING.get(profile.mode, (image.mode,))


@lru_cache(maxsize=64)
def profile_of(content: bytes) -> Profile:
    """What a profile is, by its content."""
    from PIL import ImageCms  # loads a library that photos without profiles do not need

    if len(content) > _LARGEST:
        return Profile("damaged", f"{len(content):,} bytes")
    try:
        opened = ImageCms.ImageCmsProfile(BytesIO(content))
        header: Any = opened.profile  # whose type Pillow declares too narrowly
        name = short(repaired((header.profile_description or "").strip(), "without a name"))
        mode = _SPACES.get(header.xcolor_space.strip(), "")
        if not mode:
            return Profile("damaged", name)
        steps = np.linspace(0, 255, 9).round().astype(np.uint8)
        grid = np.stack(np.meshgrid(*[steps] * {"L": 1, "RGB": 3, "CMYK": 4}[mode], indexing="ij"), -1)
        grid = grid.reshape(-1, 1, grid.shape[-1])
        before = Image.fromarray(grid[..., 0] if mode == "L" else grid, mode=None if mode == "L" else mode)
        after = _transformed(before, content, mode)
    except (OSError, ValueError, TypeError, ImageCms.PyCMSError) as error:
        return Profile("damaged", short(str(error).strip() or type(error).__name__))
    change = np.asarray(before.convert("RGB")).astype(int) - np.asarray(after)
    same = mode != "CMYK" and (name.lower().startswith("srgb") or np.abs(change).max() <= _SAME)
    return Profile("srgb" if same else "other", name, mode)


def _transformed(image: Image.Image, content: bytes, mode: str) -> Image.Image:
    """The picture in sRGB; its own transform, since those of LittleCMS are not for several threads."""
    from PIL import ImageCms

    transform = ImageCms.buildTransform(
        ImageCms.ImageCmsProfile(BytesIO(content)), ImageCms.createProfile("sRGB"), mode, "RGB"
    )
    converted = ImageCms.applyTransform(image, transform)
    if converted is None:
        raise ValueError("not converted")
    converted.info.pop("icc_profile", None)
    return converted


def describe_profiles(paths: Iterable[Path]) -> list[str]:
    """What is done about the colour profiles of photos, in words; nothing about those in sRGB."""
    names, unfit, damaged = Counter[str](), Counter[str](), list[Path]()
    for path in paths:
        try:
            with open_picture(path, decodes=False) as image:
                content = image.info.get("icc_profile")
                profile = profile_of(content) if content else None
                converts = profile is not None and _converts(profile, image)
        except PictureError:
            continue  # whoever reads it says why
        if profile is not None and profile.kind == "other":
            (names if converts else unfit)[profile.name] += 1
        if profile is not None and profile.kind == "damaged":
            damaged.append(path)
    lines = [f"photos converted from {name} to sRGB: {count}" for name, count in names.items()]
    lines += [f"photos that the profile {name} is not for, read without it: {n}" for name, n in unfit.items()]
    if damaged:
        lines.append(
            f"photos with a damaged colour profile, read as sRGB: {len(damaged)}, first {damaged[0]}"
        )
    return lines
