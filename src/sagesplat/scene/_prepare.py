"""Converts photos for COLMAP: upright, 8-bit RGB, as JPEG or PNG, under safe file names."""

import hashlib
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image, ImageOps

from sagesplat.core.names import cleaned, clipped, collision_key
from sagesplat.io.colour_profile import profile_of
from sagesplat.io.files import atomic_path, link
from sagesplat.io.pictures import PictureError, open_picture
from sagesplat.scene.exif import DETAILS, exif_of
from sagesplat.scene.find_photos import PHOTOS
from sagesplat.scene.given_masks import holds_masks, is_mask_among, mask_folders_below
from sagesplat.scene.images import as_rgb

_LONGEST, _ROOM = 250, 30  # bytes of a name, and what is left of them for suffixes
_ORIENTATION, _MAKER, _MODEL, _FOCAL, _FOCAL_35 = 0x0112, 0x010F, 0x0110, 0x920A, 0xA405


@dataclass(frozen=True)
class PreparedPhoto:
    """A photo as COLMAP reads it."""

    name: str  # path below the source
    prepared: str  # file in sfm/photos
    final: str  # path below images/
    camera: tuple[Any, ...]  # size, maker, model, focal lengths; photos with equal values share a camera
    state: tuple[int, int]  # size in bytes and modification time (ns) of the source
    orientation: int  # of the source's pixels, by EXIF: 1 ... 8
    path: str  # below the source, as the file is named

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the upright photo."""
        return self.camera[0], self.camera[1]


def prepare_photos(
    source: Path, target: Path, skipped: Path, on_photo: Callable[[int, int], None]
) -> tuple[list[PreparedPhoto], dict[str, str]]:
    """Convert the photos below `source` to upright 8-bit RGB in `target`.

    Returns the converted photos, and for each unreadable one (name -> reason). Photos below the folder
    `skipped` are ignored. A photo that needs no change is hard-linked. One that was converted before is kept.
    Other files in `target` are removed.
    """
    paths = _list(source, skipped)
    target.mkdir(parents=True, exist_ok=True)
    photos: list[PreparedPhoto] = []
    unreadable: dict[str, str] = {}
    taken: set[str] = set()
    for i, path in enumerate(paths):
        on_photo(i, len(paths))
        below = path.relative_to(source).as_posix()
        name = _clean(below)
        key = hashlib.sha256(os.fsencode(path.relative_to(source))).hexdigest()[:16]
        try:
            prepared, camera, state, turned = _prepare_photo(path, target, key)
        except PictureError as error:
            unreadable[name] = f"unreadable: {error.reason}; {error.cure or 'replace or remove it'}"
        else:
            final = _free(name, prepared.suffix, taken)
            photos.append(PreparedPhoto(name, prepared.name, final, camera, state, turned, below))
    on_photo(len(paths), len(paths))
    for old in {p.name for p in target.iterdir()} - {photo.prepared for photo in photos}:
        (target / old).unlink()
    return photos, unreadable


def _list(source: Path, skipped: Path) -> list[Path]:
    """Photos below a folder, without hidden ones and masks, sorted by name with numbers by value."""
    skipped = skipped.resolve()
    masks = [
        folder
        for folder in mask_folders_below(source)
        if (folder / "labels.json").exists() or holds_masks(folder)
    ]
    outside = not source.resolve().is_relative_to(skipped)
    photos = []
    for path in source.rglob("*"):
        hidden = any(part.startswith(".") for part in path.relative_to(source).parts)
        hidden |= any(path.is_relative_to(folder) for folder in masks)
        if path.suffix.lower() not in PHOTOS or hidden or not path.is_file():
            continue
        if not (outside and path.resolve().is_relative_to(skipped)):
            photos.append(path)
    names: dict[Path, set[str]] = {}
    for path in photos:
        names.setdefault(path.parent, set()).add(path.name.lower())
    photos = [path for path in photos if not is_mask_among(path, frozenset(names[path.parent]))]
    return sorted(photos, key=_by_number)


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts photo_2 before photo_10."""
    parts = re.split(r"([0-9]+)", path.as_posix())
    return [(int(part), "") if i % 2 else (-1, part) for i, part in enumerate(parts)]


def _clean(name: str) -> str:
    """The path as COLMAP, JSON and `check_photo` take it: without control characters and invalid Unicode.

    A long name is cut, and told from others by a hash, so that something can be added to it.
    """
    *folders, file = cleaned(name).split("/")
    stem, dot, suffix = file.rpartition(".")
    if len(stem.encode()) > _LONGEST - _ROOM:
        digest = hashlib.sha256(os.fsencode(name)).hexdigest()[:8]
        file = f"{clipped(stem, _LONGEST - 2 * _ROOM)}_{digest}{dot}{suffix}"
    return "/".join([*(clipped(folder, _LONGEST) for folder in folders), file])


def _free(name: str, suffix: str, taken: set[str]) -> str:
    """The name with `suffix` and a stem that is not in `taken`: label images are named by stems."""
    stem, _, old = name.rpartition(".")
    fits = old.lower() in (("png",) if suffix == ".png" else ("jpg", "jpeg"))
    if collision_key(stem) in taken:
        stem = f"{stem}_{old.lower()}"
    while collision_key(stem) in taken:
        stem += "_"
    taken.add(collision_key(stem))
    return f"{stem}.{old}" if fits else stem + suffix


def _prepare_photo(path: Path, folder: Path, key: str) -> tuple[Path, tuple[Any, ...], tuple[int, int], int]:
    """Write one photo as upright 8-bit RGB, or hard-link it if it is one. Raises PictureError.

    Returns the file, the camera key, the source's size and time, and its orientation.
    """
    changed = None
    with open_picture(path) as image:
        stat, exif = path.stat(), exif_of(image)
        target = folder / (key + (".png" if image.format in ("PNG", "TIFF", "BMP") else ".jpg"))
        camera = _camera(image.size, exif)
        done = _is_prepared(target, camera[:2], stat.st_mtime_ns)
        if not done:
            changed = _changed(path, image, exif)
    if changed is not None:
        with atomic_path(target) as temporary:
            _save(changed, exif, temporary)
            os.utime(temporary, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    elif not done:
        link(path.resolve(), target)
    return target, camera, (stat.st_size, stat.st_mtime_ns), _orientation(exif)


def _is_prepared(target: Path, size: tuple[int, ...], mtime_ns: int) -> bool:
    """Whether a photo was prepared before: COLMAP opens what is there by itself, so it has to be a photo."""
    try:
        with open_picture(target, ("JPEG", "PNG"), decodes=False) as image:
            suffix = ".png" if image.format == "PNG" else ".jpg"
            return (image.size, suffix) == (size, target.suffix) and target.stat().st_mtime_ns == mtime_ns
    except PictureError:
        return False


def _changed(path: Path, image: Image.Image, exif: Image.Exif) -> Image.Image | None:
    """The photo as upright 8-bit RGB, or None if the file is that already; decodes it in both cases."""
    turned = _orientation(exif) > 1
    content = image.info.get("icc_profile")
    as_is = image.format in ("JPEG", "MPO", "PNG") and image.mode == "RGB" and not turned
    as_is = as_is and not (content and profile_of(content).kind == "other")
    if as_is and image.format == "PNG":
        with path.open("rb") as file:
            as_is = file.read(25)[24] == 8 and not image.has_transparency_data  # Pillow reads 16 bits as 8
    if as_is:
        image.draft("RGB", (image.width // 8, image.height // 8))  # finds damage at an eighth of the size
        image.load()
        return None
    return as_rgb(ImageOps.exif_transpose(image) if turned else image, (0, 0, 0))


def _save(image: Image.Image, exif: Image.Exif, path: Path) -> None:
    """Write a photo with the EXIF tags from which COLMAP derives the focal length."""
    kept, details = Image.Exif(), exif.get_ifd(DETAILS)
    kept.update({tag: exif[tag] for tag in (_MAKER, _MODEL) if tag in exif})
    kept.get_ifd(DETAILS).update({tag: details[tag] for tag in (_FOCAL, _FOCAL_35) if tag in details})
    try:
        content = kept.tobytes()
    except Exception:  # values that Pillow reads but cannot write
        content = b""
    lossy = path.suffix == ".jpg"
    image.info.clear()
    image.save(path, exif=content, quality=97 if lossy else -1, subsampling=0 if lossy else -1)


def _orientation(exif: Image.Exif) -> int:
    stored = exif.get(_ORIENTATION, 1)
    return int(stored) if stored in range(1, 9) else 1


def _camera(size: tuple[int, int], exif: Image.Exif) -> tuple[Any, ...]:
    """Key of photos with one camera and zoom: upright size, maker, model, focal lengths."""
    details = exif.get_ifd(DETAILS)
    focal = [details.get(tag, "") for tag in (_FOCAL, _FOCAL_35)]  # in mm, and 35 mm equivalent
    upright = size[::-1] if _orientation(exif) >= 5 else size
    return (*upright, *(str(value)[:200] for value in (exif.get(_MAKER, ""), exif.get(_MODEL, ""), *focal)))
