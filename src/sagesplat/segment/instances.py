"""Instances of single photos: 16-bit PNGs of numbers that mean nothing in another photo."""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Int16
from PIL import Image

from sagesplat.core.errors import LabelError
from sagesplat.io.files import atomic_path
from sagesplat.io.pictures import FREE_PIXELS
from sagesplat.scene.raw_photos import raw_photos
from sagesplat.scene.scene import Scene
from sagesplat.segment import coco
from sagesplat.segment.fit import fit
from sagesplat.segment.mask_files import panoptic_segments
from sagesplat.segment.masks import VOID_8, VOID_16, given_png, mask_path, read_png

NO_INSTANCE = -1
FOLDER = "instances"  # of a capture, beside its masks
EVERY, THINGS = "*", "things"  # in place of category names
_MOST = 4096  # instances of a photo
_LAST_THING = 90  # COCO's ids of stuff follow


def write_instances(path: Path, instances: Int16[np.ndarray, "H W"]) -> None:
    """Write the number of the instance at each pixel, -1 for none, as a 16-bit PNG (65535 = none)."""
    pixels = np.where(instances < 0, VOID_16, instances).astype(np.uint16)
    with atomic_path(path, sync=False) as temporary:  # of many: the stage syncs them together
        Image.fromarray(pixels).save(temporary, format="PNG")


def read_instances(path: Path, size: tuple[int, int] | None = None) -> Int16[np.ndarray, "H W"]:
    """The number of the instance at each pixel of a photo, from 0 on without gaps; -1 where there is none.

    LabelError for a file that is missing, damaged, of more than 4096 instances, or not of `size` (height and
    width) where that is given. Memory: up to 20 bytes per pixel.
    """
    free = FREE_PIXELS if size is None else max(FREE_PIXELS, 4 * size[0] * size[1])
    pixels = read_png(path, free, cure="find the instances again")
    if size is not None and pixels.shape != size:
        raise LabelError(
            f"{path}: {pixels.shape[1]} x {pixels.shape[0]} pixels where the photo has {size[1]} x "
            f"{size[0]}; find the instances again at this size"
        )
    return _renumbered(pixels, VOID_8 if pixels.dtype == np.uint8 else VOID_16, path)


def _renumbered(pixels: np.ndarray, void: int, path: Path) -> Int16[np.ndarray, "H W"]:
    """Numbers without gaps in place of any; -1 for `void`."""
    values, numbers = np.unique(pixels, return_inverse=True)
    kept = values != void
    if kept.sum() > _MOST:
        raise LabelError(f"{path}: {kept.sum():,} instances in one photo; at most {_MOST:,} are possible")
    table = np.where(kept, np.cumsum(kept) - 1, NO_INSTANCE).astype(np.int16)
    return table[numbers].reshape(pixels.shape)


def import_instances(scene: Scene, masks: Path, target: Path) -> int:
    """Import the instances that a capture has: how many photos have some.

    They are undistorted and resampled like the label images (`masks.import_masks`).

    Args:
        scene: The capture.
        masks: Folder of its label images. COCO panoptic PNGs are of instances already; else `instances/`
            beside it has PNGs named like the photos, each instance a number, 65535 (in 8 bits 255) where
            there is none.
        target: Folder to write.

    Raises:
        LabelError: If no photo has instances, or a file cannot be used.
    """
    folder = masks.parent / FOLDER
    segments = panoptic_segments(masks)
    raw, found = raw_photos(scene.path), 0
    for view in scene.views:
        path = given_png(folder, view.photo_name)
        if path is not None:
            instances = read_instances(path)
        elif segments is not None and (given := segments(view.photo_name)) is not None:
            path, instances = given[0], _renumbered(given[1], 0, given[0])
        else:
            continue
        write_instances(mask_path(target, view), fit(instances, view, raw.get(view.name), path))
        found += 1
    if not found:
        name = PurePosixPath(scene.views[0].name).with_suffix(".png")
        raise LabelError(
            f"{folder}: no instances of any photo; put PNGs there ({name}, ...: a number for each instance, "
            "65535 for none), or leave out --labels.instances"
        )
    return found


def wanted_ids(names: dict[int, str], wanted: Sequence[str]) -> list[int]:
    """Ids of the categories whose instances are wanted; "*" is all of them, "things" all but COCO's stuff.

    LabelError for a category that there is not.
    """
    unknown = [name for name in wanted if name not in (*names.values(), EVERY, THINGS)]
    if unknown:
        raise LabelError(
            f"--labels.instances: no category {unknown[0]!r}; there are {', '.join(sorted(names.values()))}"
        )
    return [
        label_id
        for label_id, name in sorted(names.items())
        if name in wanted or EVERY in wanted or (THINGS in wanted and is_thing(label_id, name))
    ]


def is_thing(label_id: int, name: str) -> bool:
    """Whether a category is countable: any but COCO's stuff, such as grass or sky."""
    return label_id <= _LAST_THING or coco.NAMES.get(label_id) != name
