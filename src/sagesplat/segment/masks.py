"""Label images and the taxonomy that names their ids."""

import colorsys
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Int16, Integer
from PIL import Image

from sagesplat.core.errors import LabelError, short
from sagesplat.core.names import LENGTH, RULE, checked, collision_key
from sagesplat.io.files import atomic_path, read_json, write_json
from sagesplat.io.pictures import FREE_PIXELS, PictureError, open_picture
from sagesplat.io.typed import convert_as, refused
from sagesplat.scene.raw_photos import raw_photos
from sagesplat.scene.scene import Scene, View
from sagesplat.segment import coco
from sagesplat.segment.fit import fit

UNLABELLED = -1  # pixels, points and Gaussians without a category
UNLABELLED_NAME = "unlabelled"
UNLABELLED_COLOR = (128, 128, 128)
MAX_LABEL_ID = np.iinfo(np.int16).max
_UNKNOWN = -2  # never leaves this file
_BLOCK = len("@4095")  # what a per-block category adds to the name of its category
VOID_8, VOID_16 = 255, 65535  # what unlabelled pixels hold in 8- and 16-bit files, unless stated otherwise


@dataclass(frozen=True)
class Taxonomy:
    """The categories of a scene: names by id, COCO panoptic's where there is a mapping.

    Example:
        >>> from sagesplat import Taxonomy
        >>> names = Taxonomy({3: "car", 184: "tree-merged"})
        >>> names.name(184), names.name(-1), len(names.color(3))
        ('tree-merged', 'unlabelled', 3)
    """

    names: dict[int, str]  # category id -> name, ids in rising order

    def name(self, label_id: int) -> str:
        """A category's name; 'unlabelled' for -1."""
        return UNLABELLED_NAME if label_id == UNLABELLED else self.names[label_id]

    def color(self, label_id: int) -> tuple[int, int, int]:
        """A category's RGB colour: COCO's own where id and name are COCO's, else one made from the name."""
        name = self.name(label_id)
        if label_id == UNLABELLED:
            return UNLABELLED_COLOR
        if coco.NAMES.get(label_id) == name:
            return coco.COLORS[label_id]
        seed = zlib.crc32(name.encode())
        hue, saturation, value = seed % 997 / 997, 0.45 + seed % 5 * 0.1, 0.7 + seed % 3 * 0.1
        r, g, b = (round(255 * c) for c in colorsys.hsv_to_rgb(hue, saturation, value))
        return r, g, b

    def __or__(self, other: "Taxonomy") -> "Taxonomy":
        """The categories of both; an id that both have is named as the other names it."""
        return Taxonomy(dict(sorted((self.names | other.names).items())))

    def write(self, path: Path) -> None:
        """Write labels.json."""
        write_json(path, {"labels": {str(label_id): name for label_id, name in self.names.items()}})

    @classmethod
    def read(cls, path: Path) -> "Taxonomy":
        """Read labels.json; LabelError where it is missing or its content cannot be used."""
        return _read_labels(path, LENGTH + _BLOCK)[0]


class Masks:
    """The label images of a normalised folder (what `import_masks` or `segment_views` wrote), read lazily.

    Images are kept until `cache_bytes` are full; the rest is read anew each time, since the stages visit all
    views in turn.
    """

    def __init__(self, folder: Path, taxonomy: Taxonomy, cache_bytes: int = 2**28):
        self.folder, self.taxonomy, self.cache_bytes = folder, taxonomy, cache_bytes
        self._cache: dict[str, Int16[np.ndarray, "H W"]] = {}
        self._used = 0

    def __getitem__(self, view: View) -> Int16[np.ndarray, "H W"]:
        """A view's category ids at the size of its camera, -1 = unlabelled; shared, so not to be changed."""
        label_ids = self._cache.get(view.name)
        if label_ids is None:
            label_ids = read_mask(mask_path(self.folder, view), self.taxonomy, _pixels(view))
            if self._used + label_ids.nbytes <= self.cache_bytes:
                self._cache[view.name] = label_ids
                self._used += label_ids.nbytes
        (h, w), camera = label_ids.shape, view.camera
        if (h, w) != (camera.height, camera.width):
            raise LabelError(
                f"{mask_path(self.folder, view)}: {w} x {h} pixels where the scene has {camera.width} x "
                f"{camera.height}; make the masks again at this size"
            )
        return label_ids


def mask_path(folder: Path, view: View) -> Path:
    """Where a normalised folder keeps the label image of a view."""
    return _png_path(folder, view.name)


def _png_path(folder: Path, photo: str) -> Path:
    name = PurePosixPath(photo)
    if name.is_absolute() or ".." in name.parts:
        raise LabelError(f"{photo}: a photo outside the image folder; move it there and rename it")
    return folder / name.with_suffix(".png")


def prepare_folder(folder: Path, views: Sequence[View]) -> list[Path]:
    """The paths of the views' label images in a folder that is about to be filled.

    Removes its labels.json, which is written last and says that the folder is complete.
    """
    paths = [mask_path(folder, view) for view in views]
    taken: dict[str, str] = {}
    for view, path in zip(views, paths, strict=True):
        key = collision_key(path.as_posix())
        if key in taken:
            raise LabelError(
                f"{view.name}: {taken[key]} has the same name but for the suffix or capitals; rename one"
            )
        taken[key] = view.name
    (folder / "labels.json").unlink(missing_ok=True)
    return paths


def read_mask(path: Path, taxonomy: Taxonomy, free: int = FREE_PIXELS) -> Int16[np.ndarray, "H W"]:
    """A normalised label image; LabelError where it is missing, damaged or holds ids without a name.

    Label images with more than `free` pixels are refused where their files are too small for photos of that
    size. Memory: up to 20 bytes per pixel.
    """
    ids = {VOID_8: UNLABELLED, VOID_16: UNLABELLED} | {i: i for i in taxonomy.names}
    return _translate(_read_png(path, free), ids, path, "make the masks again")


def _pixels(view: View) -> int:
    """Number of pixels that any label image of a view may have: four times its photo's, at least."""
    return max(FREE_PIXELS, 4 * view.camera.width * view.camera.height)


def write_mask(path: Path, label_ids: Int16[np.ndarray, "H W"], taxonomy: Taxonomy) -> None:
    """Write a label image: 8 bits with 255 = unlabelled if all ids allow it, else 16 bits with 65535.

    The taxonomy decides and not the image, so that a folder is of one kind and 255 has one meaning.
    """
    small = max(taxonomy.names, default=0) < VOID_8
    dtype, void = (np.uint8, VOID_8) if small else (np.uint16, VOID_16)
    pixels = np.where(label_ids == UNLABELLED, void, label_ids).astype(dtype)
    with atomic_path(path, sync=False) as temporary:  # of many: the stage syncs them together
        Image.fromarray(pixels).save(temporary, format="PNG")


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
    if not source.is_dir():
        raise LabelError(f"{source}: no such folder; name the one with the label images")
    taxonomy, find = _source(source)
    found = {view.name: find(view.name) for view in scene.views}
    missing = [name for name, file in found.items() if file is None]
    if len(missing) == len(scene.views):
        raise LabelError(
            f"{source}: no label image for any view; name them like the photos "
            f"({PurePosixPath(missing[0]).with_suffix('.png')}, ...)"
        )
    occurring, raw = set[int](), raw_photos(scene.path)
    for view, path in zip(scene.views, prepare_folder(target, scene.views), strict=True):
        label_ids = np.full((view.camera.height, view.camera.width), UNLABELLED, np.int16)
        if (file := found[view.name]) is not None:
            label_ids = fit(file.read(_pixels(view)), view, raw.get(view.name), file.path)
        write_mask(path, label_ids, taxonomy)
        occurring.update(np.unique(label_ids).tolist())
    write_labels(target, taxonomy, occurring)
    return missing


def write_labels(folder: Path, taxonomy: Taxonomy, occurring: set[int]) -> None:
    """Write the labels.json of a finished folder of masks, with only the categories that occur in it."""
    names = {label_id: name for label_id, name in taxonomy.names.items() if label_id in occurring}
    if not names:
        raise LabelError(f"{folder}: every pixel is unlabelled; there is no category to work with")
    Taxonomy(names).write(folder / "labels.json")


@dataclass(frozen=True, eq=False)
class _File:
    """A label image of the user's."""

    path: Path
    ids: dict[int, int]  # value in the file -> category id or UNLABELLED
    segments: bool  # RGB-coded segment ids instead of category ids
    cure: str  # what helps where the file holds other values

    def read(self, free: int) -> Int16[np.ndarray, "h w"]:
        """Category ids at the file's own size; `free` as in `read_mask`."""
        return _translate(_read_png(self.path, free, self.segments), self.ids, self.path, self.cure)


_Find = Callable[[str], _File | None]  # by the name of a photo


def label_images_of(folder: Path) -> tuple[Taxonomy, Callable[[str], Int16[np.ndarray, "h w"] | None]]:
    """The categories of a folder as `import_masks` takes it, and what reads an image by its photo's name.

    None for a photo without one. LabelError as of `import_masks`.
    """
    if not folder.is_dir():
        raise LabelError(f"{folder}: no such folder; name the one with the label images")
    taxonomy, find = _source(folder)

    def read(name: str) -> Int16[np.ndarray, "h w"] | None:
        file = find(name)
        return None if file is None else file.read(4 * FREE_PIXELS)

    return taxonomy, read


def _source(folder: Path) -> tuple[Taxonomy, _Find]:
    return _id_source(folder) if (folder / "labels.json").exists() else _panoptic_source(folder)


def _id_source(folder: Path) -> tuple[Taxonomy, _Find]:
    """Images of ids with a labels.json."""
    taxonomy, unlabelled = _read_labels(folder / "labels.json")
    voids = (VOID_8, VOID_16) if unlabelled is None else (unlabelled,)
    ids = dict.fromkeys(voids, UNLABELLED) | {i: i for i in taxonomy.names}
    cure = 'name them in labels.json (or say there which value is "unlabelled")'

    def find(name: str) -> _File | None:
        paths = (folder / f"{name}.png", _png_path(folder, name))
        path = next((p for p in paths if p.exists()), None)
        return None if path is None else _File(path, ids, False, cure)

    return taxonomy, find


def _panoptic_source(folder: Path) -> tuple[Taxonomy, _Find]:
    """COCO panoptic PNGs with the JSON of their segments."""
    panoptic = coco.read_panoptic(folder)
    if panoptic is None:
        raise LabelError(
            f"{folder}: no labels.json; write one like "
            '{"unlabelled": 255, "labels": {"184": "tree-merged"}}'
        )
    taxonomy = taxonomy_of(panoptic.names, folder)

    def find(name: str) -> _File | None:
        key = str(PurePosixPath(name).with_suffix(""))
        path = panoptic.pngs.get(key)
        if path is None or not path.exists():
            return None
        ids = {0: UNLABELLED} | panoptic.segments[key]
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
        return path, _read_png(path, 4 * FREE_PIXELS, segments=True)

    return read


@dataclass(frozen=True)
class _Labels:
    """Of a labels.json; names are checked by `taxonomy_of`."""

    labels: dict[int, Any]
    unlabelled: int | None = None


def _read_labels(path: Path, length: int = LENGTH) -> tuple[Taxonomy, int | None]:
    """The taxonomy of a labels.json, and the value of unlabelled pixels if it is stated.

    `length`: characters of a name, at most.
    """
    content = read_json(path, "it names the ids of the label images", LabelError)
    form = 'of the form {"unlabelled": 255, "labels": {"184": "tree-merged"}}'
    with refused(path, form, "rewrite it so", LabelError):
        made = convert_as(content, _Labels, strict=False)
    unlabelled, names = made.unlabelled, made.labels
    if unlabelled is not None and not 0 <= unlabelled <= VOID_16:
        raise LabelError(f'{path}: "unlabelled" is {short(unlabelled)}; give a pixel value, 0 ... {VOID_16}')
    if unlabelled in names:
        raise LabelError(f'{path}: {unlabelled} is "unlabelled" and has a name too; remove one of them')
    return taxonomy_of(names, path, length), unlabelled


def taxonomy_of(names: dict[int, Any], path: Path, length: int = LENGTH) -> Taxonomy:
    """A taxonomy whose ids fit and whose names may be; they are distinct, as results are listed by name.

    `path`: the file that the names are from; `length`: characters of a name, at most. LabelError for others.
    """
    wrong = [label_id for label_id in names if not 0 <= label_id <= MAX_LABEL_ID]
    if wrong:
        raise LabelError(
            f"{path}: label ids {short(wrong[:5])} are outside 0 ... {MAX_LABEL_ID}; renumber them"
        )
    if not names:
        raise LabelError(f"{path}: names no label; list the ids of the label images")
    found: dict[str, int] = {}
    for label_id, name in names.items():
        named = f"{path}: label {label_id} is named {short(repr(name))}"
        try:
            name = checked(name, length)
        except ValueError as error:
            raise LabelError(f"{named}, but {error}; rename it ({RULE})") from None
        if name in found or name == UNLABELLED_NAME:
            raise LabelError(
                f"{named}; give each id a name of its own "
                f'(unlabelled pixels: "{UNLABELLED_NAME}": {label_id} beside "labels")'
            )
        found[name] = label_id
    return Taxonomy({label_id: name for name, label_id in sorted(found.items(), key=lambda of: of[1])})


def _read_png(path: Path, free: int, segments: bool = False) -> Integer[np.ndarray, "h w"]:
    """The ids in a PNG: grey values or palette indices, or R + 256 G + 65536 B with `segments`."""
    modes = ("RGB", "RGBA") if segments else ("1", "L", "P", "I;16", "I")
    try:
        with open_picture(path, ("PNG",), free=free) as image:
            mode = image.mode
            pixels = np.asarray(image) if mode in modes else None
    except PictureError as error:
        if not path.exists():
            raise LabelError(f"{path}: no such file; make the masks again") from None
        cure = error.cure or "export it again"
        raise LabelError(f"{path}: not a readable PNG ({error.reason}); {cure}") from None
    if pixels is None:
        wanted = "an RGB image of segments" if segments else "one channel of 8- or 16-bit ids"
        raise LabelError(f"{path}: a PNG of mode {mode} where {wanted} is needed; convert it")
    if not segments:
        return pixels.astype(np.uint8) if mode == "1" else pixels
    ids = pixels[..., 2].astype(np.int32)
    for channel in (1, 0):
        ids *= 256
        ids += pixels[..., channel]
    return ids


def _translate(
    raw: Integer[np.ndarray, "h w"], ids: dict[int, int], path: Path, cure: str
) -> Int16[np.ndarray, "h w"]:
    """Replace each value by what `ids` says; LabelError for values that it does not know."""
    small = raw.dtype.itemsize <= 2
    size = max(ids) + 2  # the last entry is for all larger values
    table = np.full(max(size, np.iinfo(raw.dtype).max + 1) if small else size, _UNKNOWN, np.int16)
    table[list(ids)] = list(ids.values())
    label_ids = table[raw if small else np.minimum(raw, len(table) - 1)]
    unknown = raw[label_ids == _UNKNOWN]
    if len(unknown):
        unknown = np.unique(unknown[:10_000])  # of a large image some will do
        listed = ", ".join(map(str, unknown[:5])) + (", ..." if len(unknown) > 5 else "")
        raise LabelError(f"{path}: unknown ids {listed}; {cure}")
    return label_ids
