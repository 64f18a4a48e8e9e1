"""Label images of others: PNGs of ids, or COCO panoptic, imported as masks of the run."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Int16, Integer

from sagesplat.core.errors import LabelError
from sagesplat.io.pictures import FREE_PIXELS
from sagesplat.scene.raw_photos import raw_photos
from sagesplat.scene.scene import Scene
from sagesplat.segment import coco, masks
from sagesplat.segment.fit import fit


def import_masks(scene: Scene, source: Path, target: Path) -> list[str]:
    """Import label images: one per view at the size of its camera, with ids checked, and a labels.json.

    Images are undistorted like the photos and resampled to the nearest pixel. Where structure from motion
    undistorted the photos of the capture, that goes for label images of the photos as they were taken.

    Args:
        scene: The capture.
        source: Folder of PNGs named like the photos (x.png or x.jpg.png for x.jpg). Either 8- or 16-bit ids
            with a labels.json {"unlabelled": 255, "labels": {"184": "tree-merged"}}, where "unlabelled" may
            be absent (then 255, in 16 bits 65535); or COCO panoptic PNGs with their JSON.
        target: Folder to write.

    Returns:
        Names of the views without an image: they are unlabelled everywhere.

    Raises:
        LabelError: If the images cannot be used, or no view has one.
    """
    if source.resolve() == target.resolve():
        raise LabelError(f"{source}: these are the masks of the run itself; name the folder they came from")
    taxonomy, find = _source(source)
    found = {view.name: find(view.photo_name) for view in scene.views}
    missing = [name for name, file in found.items() if file is None]
    if len(missing) == len(scene.views):
        raise LabelError(
            f"{source}: no label image for any view; name them like the photos "
            f"({PurePosixPath(missing[0]).with_suffix('.png')}, ...)"
        )
    occurring, raw = set[int](), raw_photos(scene.path)
    for view, path in zip(scene.views, masks.prepare_folder(target, scene.views), strict=True):
        label_ids = np.full((view.camera.height, view.camera.width), masks.UNLABELLED, np.int16)
        if (file := found[view.name]) is not None:
            label_ids = fit(file.read(masks.num_pixels(view)), view, raw.get(view.name), file.path)
        masks.write_mask(path, label_ids, taxonomy)
        occurring.update(np.unique(label_ids).tolist())
    masks.write_labels(target, taxonomy, occurring)
    return missing


@dataclass(frozen=True, eq=False)
class _File:
    """A label image of the user's."""

    path: Path
    ids: dict[int, int]  # value in the file -> category id or UNLABELLED
    segments: bool  # RGB-coded segment ids instead of category ids
    cure: str  # what helps where the file holds other values

    def read(self, free: int) -> Int16[np.ndarray, "h w"]:
        """Category ids at the file's own size; `free` as in `read_mask`."""
        return masks.translated(
            masks.read_png(self.path, free, self.segments), self.ids, self.path, self.cure
        )


_Find = Callable[[str], _File | None]  # by the name of a photo


def label_images_of(folder: Path) -> tuple[masks.Taxonomy, Callable[[str], Int16[np.ndarray, "h w"] | None]]:
    """The categories of a folder as `import_masks` takes it, and what reads an image by its photo's name.

    None for a photo without one. LabelError as of `import_masks`.
    """
    taxonomy, find = _source(folder)

    def read(name: str) -> Int16[np.ndarray, "h w"] | None:
        file = find(name)
        return None if file is None else file.read(4 * FREE_PIXELS)

    return taxonomy, read


def _source(folder: Path) -> tuple[masks.Taxonomy, _Find]:
    if not folder.is_dir():
        raise LabelError(f"{folder}: no such folder; name the one with the label images")
    return _id_source(folder) if (folder / "labels.json").exists() else _panoptic_source(folder)


def _id_source(folder: Path) -> tuple[masks.Taxonomy, _Find]:
    """Images of ids with a labels.json."""
    taxonomy, unlabelled = masks.read_labels(folder / "labels.json")
    voids = (masks.VOID_8, masks.VOID_16) if unlabelled is None else (unlabelled,)
    ids = dict.fromkeys(voids, masks.UNLABELLED) | {i: i for i in taxonomy.names}
    cure = 'name them in labels.json (or say there which value is "unlabelled")'

    def find(name: str) -> _File | None:
        path = masks.given_png(folder, name)
        return None if path is None else _File(path, ids, False, cure)

    return taxonomy, find


def _panoptic_source(folder: Path) -> tuple[masks.Taxonomy, _Find]:
    """COCO panoptic PNGs with the JSON of their segments."""
    panoptic = coco.read_panoptic(folder)
    if panoptic is None:
        raise LabelError(
            f"{folder}: no labels.json, and not the two values of masks of what counts; write one like "
            '{"unlabelled": 255, "labels": {"184": "tree-merged"}}'
        )
    taxonomy = masks.taxonomy_of(panoptic.names, folder)

    def find(name: str) -> _File | None:
        key = str(PurePosixPath(name).with_suffix(""))
        path = panoptic.pngs.get(key)
        if path is None or not path.exists():
            return None
        ids = {0: masks.UNLABELLED} | panoptic.segments[key]
        return _File(path, ids, True, "they are no segments in the JSON; export image and JSON together")

    return taxonomy, find


def panoptic_segments(
    folder: Path,
) -> Callable[[str], tuple[Path, Integer[np.ndarray, "h w"]] | None] | None:
    """What reads the segments of a photo (its file, and their numbers; 0 = none) from COCO panoptic PNGs.

    None for a folder of other label images. LabelError as of `import_masks`.
    """
    if not folder.is_dir() or (folder / "labels.json").exists():
        return None
    panoptic = coco.read_panoptic(folder)
    if panoptic is None:
        return None

    def read(name: str) -> tuple[Path, Integer[np.ndarray, "h w"]] | None:
        path = panoptic.pngs.get(str(PurePosixPath(name).with_suffix("")))
        if path is None or not path.exists():
            return None
        return path, masks.read_png(path, 4 * FREE_PIXELS, segments=True)

    return read
