"""Label images and the taxonomy that names their ids."""

import colorsys
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Int16, Integer
from PIL import Image

from sagesplat.core.errors import LabelError, short
from sagesplat.core.names import RULE, checked, collision_key
from sagesplat.io.files import atomic_path, read_json, write_json
from sagesplat.io.pictures import FREE_PIXELS, PictureError, open_picture
from sagesplat.io.typed import convert_as, refused
from sagesplat.scene.scene import View
from sagesplat.segment import coco

UNLABELLED = -1  # pixels, points and Gaussians without a category
UNLABELLED_NAME = "unlabelled"
UNLABELLED_COLOR = (128, 128, 128)
MAX_LABEL_ID = np.iinfo(np.int16).max
_UNKNOWN = -2  # never leaves this file
CACHE_BYTES = 2**28  # of the images of a folder that are kept in memory
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
        return read_labels(path)[0]


class Masks:
    """The label images of a normalised folder (what `import_masks` or `segment_some` wrote), read lazily.

    Images are kept until `CACHE_BYTES` are full; the rest is read anew each time, since the stages visit all
    views in turn.
    """

    def __init__(self, folder: Path, taxonomy: Taxonomy):
        self.folder, self.taxonomy = folder, taxonomy
        self._cache: dict[str, Int16[np.ndarray, "H W"]] = {}
        self._used = 0

    def __getitem__(self, view: View) -> Int16[np.ndarray, "H W"]:
        """A view's category ids at the size of its camera, -1 = unlabelled; shared, so not to be changed."""
        label_ids = self._cache.get(view.name)
        if label_ids is None:
            label_ids = read_mask(mask_path(self.folder, view), self.taxonomy, num_pixels(view))
            if self._used + label_ids.nbytes <= CACHE_BYTES:
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
    return png_path(folder, view.name)


def png_path(folder: Path, photo: str) -> Path:
    """Where a folder keeps the label image of a photo; LabelError for a name outside of it."""
    name = PurePosixPath(photo)
    if name.is_absolute() or ".." in name.parts:
        raise LabelError(f"{photo}: a photo outside the image folder; move it there and rename it")
    return folder / name.with_suffix(".png")


def given_png(folder: Path, photo: str) -> Path | None:
    """The PNG that a folder of the user's has of a photo: x.jpg.png or x.png of x.jpg."""
    paths = (folder / f"{photo}.png", png_path(folder, photo))
    return next((path for path in paths if path.is_file()), None)


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
    return translated(read_png(path, free), ids, path, "make the masks again")


def num_pixels(view: View) -> int:
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


def write_labels(folder: Path, taxonomy: Taxonomy, occurring: set[int]) -> None:
    """Write the labels.json of a finished folder of masks, with only the categories that occur in it."""
    names = {label_id: name for label_id, name in taxonomy.names.items() if label_id in occurring}
    if not names:
        raise LabelError(f"{folder}: every pixel is unlabelled; there is no category to work with")
    Taxonomy(names).write(folder / "labels.json")


def taxonomy_of(names: dict[int, Any], path: Path) -> Taxonomy:
    """A taxonomy whose ids fit and whose names may be; they are distinct, as results are listed by name.

    `path`: the file that the names are from. LabelError for others.
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
            name = checked(name)
        except ValueError as error:
            raise LabelError(f"{named}, but {error}; rename it ({RULE})") from None
        if name in found or name == UNLABELLED_NAME:
            raise LabelError(
                f"{named}; give each id a name of its own "
                f'(unlabelled pixels: "{UNLABELLED_NAME}": {label_id} beside "labels")'
            )
        found[name] = label_id
    return Taxonomy({label_id: name for name, label_id in sorted(found.items(), key=lambda of: of[1])})


def read_png(
    path: Path, free: int, segments: bool = False, cure: str = "make the masks again"
) -> Integer[np.ndarray, "h w"]:
    """The ids in a PNG: grey values or palette indices, or R + 256 G + 65536 B with `segments`.

    `free` as in `read_mask`; `cure`: of a file that is not there.
    """
    modes = ("RGB", "RGBA") if segments else ("1", "L", "P", "I;16", "I")
    try:
        with open_picture(path, ("PNG",), free=free) as image:
            mode = image.mode
            pixels = np.asarray(image) if mode in modes else None
    except PictureError as error:
        if not path.exists():
            raise LabelError(f"{path}: no such file; {cure}") from None
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


@dataclass(frozen=True)
class _Labels:
    """Of a labels.json; names are checked by `taxonomy_of`."""

    labels: dict[int, Any]
    unlabelled: int | None = None


def read_labels(path: Path) -> tuple[Taxonomy, int | None]:
    """The taxonomy of a labels.json, and the value of unlabelled pixels if it is stated."""
    content = read_json(path, "it names the ids of the label images", LabelError)
    form = 'of the form {"unlabelled": 255, "labels": {"184": "tree-merged"}}'
    with refused(path, form, "rewrite it so", LabelError):
        made = convert_as(content, _Labels, strict=False)
    unlabelled, names = made.unlabelled, made.labels
    if unlabelled is not None and not 0 <= unlabelled <= VOID_16:
        raise LabelError(f'{path}: "unlabelled" is {short(unlabelled)}; give a pixel value, 0 ... {VOID_16}')
    if unlabelled in names:
        raise LabelError(f'{path}: {unlabelled} is "unlabelled" and has a name too; remove one of them')
    return taxonomy_of(names, path), unlabelled


def translated(
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
