"""Masks for structure from motion: no features where photos show what does not belong to the scene."""

import hashlib
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from PIL import Image

from sagesplat.core.errors import SceneError
from sagesplat.io.files import atomic_path
from sagesplat.scene._prepare import PreparedPhoto
from sagesplat.scene.given_masks import VALID_FOLDER, GivenMasks, mask_of_photo
from sagesplat.scene.images import cut_out, has_alpha, load_alpha
from sagesplat.scene.raw_photos import same_aspect, upright

Pixels = Bool[np.ndarray, "H W"]
OfPhoto = Callable[[str], Pixels | None]  # name of a photo -> its pixels that count, at any resolution


def write_feature_masks(
    photos: Sequence[PreparedPhoto], source: Path, target: Path, capture: Path, alpha: str, ignored: OfPhoto
) -> dict[str, str]:
    """Write the masks of photos that have some, as COLMAP reads them.

    Those that come with the photos (`given_masks` below `source`, alpha) go to `masks_valid/` of the capture
    too, whose photos have lost them.

    Args:
        photos: As COLMAP reads them.
        source: Folder of the photos as they were taken.
        target: Folder to write: NAME.png for the prepared photo NAME.
        capture: Folder of the capture that will be made.
        alpha: `SceneConfig.alpha`.
        ignored: What label images say of a photo, by its final name; None: nothing.

    Returns:
        SHA-256 of each mask by the name of the prepared photo. SceneError for masks that cannot be used.
    """
    for folder in (target, capture / VALID_FOLDER):
        shutil.rmtree(folder, ignore_errors=True)
    transparent = [photo for photo in photos if has_alpha(source / photo.path)]
    cut = bool(transparent) and cut_out([source / photo.path for photo in transparent])
    opaque_only = set(transparent) if alpha == "ignore" or (alpha == "auto" and not cut) else set()
    masks: dict[str, str] = {}
    given_masks = GivenMasks([source, source / "images"], source)
    for photo in photos:
        found = mask_of_photo(given_masks, photo.path)
        given = [None if found is None else found.read(photo.size[0] * photo.size[1])]
        if photo in opaque_only:
            given.append(upright(load_alpha(source / photo.path) == 255, photo.orientation))
        if (valid := _all_of(photo, given)) is not None:
            _write(capture / VALID_FOLDER / Path(photo.final).with_suffix(".png"), valid)
        valid = _all_of(photo, [valid, ignored(photo.final)])
        if valid is not None:
            _write(target / f"{photo.prepared}.png", valid)
            masks[photo.prepared] = hashlib.sha256(np.packbits(valid).tobytes()).hexdigest()
    for photo in photos if masks else ():  # COLMAP leaves photos out that have none
        if photo.prepared not in masks:
            _write(target / f"{photo.prepared}.png", np.ones(photo.size[::-1], bool))
    return masks


def _upright(mask: Bool[np.ndarray, "h w"], photo: PreparedPhoto) -> Pixels:
    """A mask of a photo at its size, looked at as the photo is."""
    width, height = photo.size
    fits, fits_turned = (same_aspect(mask.shape[::-1], size) for size in ((width, height), (height, width)))
    if photo.orientation >= 5 and fits_turned and not fits:
        mask, fits = upright(mask, photo.orientation), True
    if not fits:
        h, w = mask.shape
        raise SceneError(
            f"{photo.path}: a mask or label image of {w} x {h} pixels, but the photo has {width} x {height}; "
            "they show the whole photo, at any resolution"
        )
    return np.asarray(Image.fromarray(mask).resize((width, height), Image.Resampling.NEAREST))


def _all_of(photo: PreparedPhoto, masks: Sequence[Pixels | None]) -> Pixels | None:
    """What counts in all of some masks, at the size of the photo; None where there is none."""
    given = [_upright(mask, photo) for mask in masks if mask is not None]
    return np.logical_and.reduce(given) if given else None


def _write(path: Path, valid: Pixels) -> None:
    with atomic_path(path, sync=False) as temporary:
        Image.fromarray(np.where(valid, np.uint8(255), np.uint8(0))).save(temporary, format="PNG")
