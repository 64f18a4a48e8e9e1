"""Masks that came with photos, under the names that trainers and photogrammetry give them.

Folders beside the photos, or beside those of one camera: masks_valid/, masks/, mask/, segmentation/, .mask/
(RealityScan). Names, of x.jpg: x.png, x.jpg.png (COLMAP), x.jpg.mask.png (RealityScan, Brush), x.mask.png,
x_mask.png (Metashape), and mask_x.png; or other pictures. Those with the word "mask" may also lie among the
photos. Edges may be soft. Black pixels do not count, as in nerfstudio, COLMAP, RealityScan, Metashape, Brush
and LichtFeld Studio. In masks_inverted/, and dynamic_mask_x.png of instant-ngp, it is the white ones.

Label images may lie in masks/ and mask/, too: with a labels.json, or of other values than two.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath, PurePosixPath

import numpy as np
from jaxtyping import Bool

from sagesplat.core.names import collision_key
from sagesplat.io.pictures import FREE_PIXELS, PHOTO_FORMATS, PictureError, open_picture
from sagesplat.scene.images import read_black
from sagesplat.scene.scene import Scene

VALID_FOLDER = "masks_valid"  # what is in it is never taken for label images
INVERTED_FOLDER = "masks_inverted"
FOLDERS = (VALID_FOLDER, "masks", "mask", "segmentation", ".mask", INVERTED_FOLDER)
_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
_LOOKED_AT = 8  # images that tell masks from label images
_BETWEEN = 0.02  # share of pixels that edges of masks may have between black and white
_SOFT, _SOFT_VALUES = 0.2, 16  # the same of soft masks, whose edges have at least so many values
_NEAR = 32  # grey values from black and white that lossy compression makes


@dataclass(frozen=True)
class GivenMask:
    """The mask of a photo: where it is, and whether its white pixels are those that do not count."""

    path: Path
    inverted: bool

    def read(self, pixels: int) -> Bool[np.ndarray, "h w"]:
        """Which pixels count, at the file's own size; `pixels`: of the photo. Raises SceneError."""
        return read_black(self.path, pixels) ^ self.inverted


class GivenMasks:
    """The masks in the folders of a capture; those that hold label images are left alone."""

    def __init__(self, bases: Sequence[Path], photos: Path, more: Path | None = None):
        """`bases`: folders that may hold mask folders; `photos`: of the photos; `more`: a folder of masks."""
        places = [more] if more is not None else []
        places += [folder for base in dict.fromkeys(bases) for folder in mask_folders(base)]
        inside = [folder for folder in mask_folders_below(photos) if folder not in places]
        self.folders = [folder for folder in (*places, *inside) if holds_masks(folder)]
        self._indices = [
            (folder, _key(folder.parent.relative_to(photos)) if folder in inside else "", _index(folder))
            for folder in self.folders
        ]
        self._among = _index(photos) if photos.is_dir() else {}

    def __bool__(self) -> bool:
        return bool(self.places)

    @property
    def places(self) -> list[Path]:
        """The folders, and the files among the photos that may be masks by their names."""
        named = [path for name, path in self._among.items() if "mask" in PurePosixPath(name).name]
        return [*self.folders, *(path for path in named if not any(map(path.is_relative_to, self.folders)))]

    def of(self, photo: str) -> GivenMask | None:
        """The mask of a photo, by its name below the folder of the photos."""
        key = _key(PurePosixPath(photo))
        names = list(_names(key))
        for folder, above, index in self._indices:
            inverted = folder.name.lower() == INVERTED_FOLDER
            for name, turned in _names(_below(key, above)) if above else names:
                if name in index:
                    return GivenMask(index[name], inverted ^ turned)
        for name, turned in names:
            named = "mask" in PurePosixPath(name).name and key != name
            if named and name in self._among and _is_two_valued(self._among[name]):
                return GivenMask(self._among[name], turned)
        return None


def masks_of(scene: Scene, folder: Path | None = None) -> GivenMasks:
    """The masks that lie beside the photos of a scene, or in `folder`."""
    view = scene.views[0]
    photos = view.image_path.parents[view.photo_name.count("/")]
    return GivenMasks([scene.path, photos.parent], photos, folder)


def _key(path: PurePath) -> str:
    """A path whatever its case and form of Unicode; empty for that of a folder to itself."""
    return collision_key("/".join(path.parts))


def _below(photo: str, above: str) -> str:
    """The path of a photo below a folder, without the folder of the photos there; empty for another's."""
    below = photo.removeprefix(f"{above}/")
    return "" if below == photo else below.removeprefix("images/")


def _names(photo: str) -> Iterator[tuple[str, bool]]:
    """Keys that a photo's mask may have, by its own one, and whether they say that it is inverted."""
    path = PurePosixPath(photo)
    forms = ("{0}", "{1}", "{0}.mask", "{1}.mask", "{1}_mask", "{0}_mask", "mask_{1}", "dynamic_mask_{1}")
    for folder in dict.fromkeys((path.parent, PurePosixPath())):  # or all masks in one folder
        for form in forms:
            for suffix in _SUFFIXES:
                name = form.format(path.name, path.stem) + suffix
                yield (folder / name).as_posix(), form.startswith("dynamic")


def is_mask_among(path: Path, names: frozenset[str]) -> bool:
    """Whether a picture is the mask of another one: `names` are those in its folder, in lower case."""
    name, stem = path.name.lower(), path.stem.lower()
    for of in (stem.removesuffix(".mask"), stem.removesuffix("_mask"), stem.removeprefix("dynamic_mask_")):
        others = {of, *(of + suffix for suffix in _SUFFIXES)} - {name}
        if of != stem and others & names and _is_two_valued(path):
            return True
    return False


def _index(folder: Path) -> dict[str, Path]:
    """The pictures below a folder by the key of their path in it."""
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _SUFFIXES and path.is_file())
    return {_key(path.relative_to(folder)): path for path in files}


def mask_folders(base: Path) -> list[Path]:
    """The folders in one that are named for masks, in the order of `FOLDERS`."""
    if not base.is_dir():
        return []
    named = [path for path in base.iterdir() if path.name.lower() in FOLDERS and path.is_dir()]
    return sorted(named, key=lambda path: FOLDERS.index(path.name.lower()))


def mask_folders_below(folder: Path) -> list[Path]:
    """The folders that are named for masks, in a folder or below it: of photos by several cameras."""
    return sorted(path for path in folder.rglob("*") if path.name.lower() in FOLDERS and path.is_dir())


def holds_masks(folder: Path) -> bool:
    """Whether a folder's pictures are masks rather than label images: of two values, without labels.json."""
    if folder.name.lower() in (VALID_FOLDER, INVERTED_FOLDER, ".mask"):
        return folder.is_dir()
    if (folder / "labels.json").exists():
        return False
    files = list(_index(folder).values())
    some = files[:: len(files) // _LOOKED_AT + 1]
    return bool(some) and all(_is_two_valued(path) for path in some)


def _is_two_valued(path: Path) -> bool:
    """Whether a picture is black and white: 0 and the largest value, but for few pixels at edges."""
    try:
        with open_picture(path, PHOTO_FORMATS, free=4 * FREE_PIXELS) as image:
            lossy = image.format != "PNG"
            if image.mode in ("1", "I;16", "I"):
                values = np.asarray(image)
            else:
                rgb = np.asarray(image.convert("RGB")).astype(np.int16)
                if np.ptp(rgb, axis=2).max(initial=0) > (_NEAR if lossy else 0):
                    return False  # colours
                values = rgb[..., 1]
    except PictureError:
        return False  # whoever reads it says why
    most = int(values.max(initial=0))
    if not lossy and most not in (0, 1, 255, 65535):
        return False
    near = _NEAR if lossy else 0
    between = (values > near) & (values < (255 if lossy else most) - near)
    share = float(between.mean())
    return share <= _BETWEEN or (share <= _SOFT and len(np.unique(values[between])) >= _SOFT_VALUES)


def mask_of_photo(masks: GivenMasks, photo: str) -> GivenMask | None:
    """The mask of a photo of a folder that may have them in images/, or that is images/ itself."""
    inside = photo.removeprefix("images/")
    return masks.of(photo) or (masks.of(inside) if inside != photo else None)
