"""Finds the COLMAP models of a capture, and the photos of each, wherever other tools put them."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sagesplat.core.errors import SceneError, short
from sagesplat.scene.colmap_read import model_file, read_names
from sagesplat.scene.find_photos import (
    NOT_PHOTOS,
    PHOTO_FOLDERS,
    Found,
    PhotoFolder,
    folders_of,
    holds_photos,
)

MODEL_FILES = ("cameras.bin", "cameras.txt")
USUAL = ("sparse/0", "sparse")  # where models are, below a capture
_DEEPEST = 4  # folders below the capture, such as house/colmap/sparse/0
_ABOVE = 3  # folders above a model that was given, in which its photos are looked for
_MANY = 64  # models; COLMAP leaves one for each part of the photos that it cannot connect


@dataclass(frozen=True)
class FoundModel:
    """A COLMAP model, and the photos that are there for it."""

    folder: Path
    photos: Found


def model_folders(path: Path) -> list[Path]:
    """Folders with a COLMAP model: those below a path, the usual ones first, and the path itself."""
    found = [folder for name in (*USUAL, "") if _holds_model(folder := path / name)]
    for folder in _walk(path, 0):
        if len(found) >= _MANY:
            break
        if folder not in found and _holds_model(folder):
            found.append(folder)
    # `distorted/` of 3DGS's convert.py is of the same photos before they were undistorted
    final = [folder for folder in found if "distorted" not in folder.relative_to(path).parts]
    return final or found


def find_model(path: Path, images: Path | None = None) -> tuple[FoundModel, list[str]]:
    """The model below `path` that most photos are there for, and lines on what was chosen.

    Args:
        path: folder of the capture, or of a model.
        images: folder of the photos; None: looked for beside the model, and above it.

    Raises:
        SceneError: If there is no model; if the usual one, or every one, is damaged.
    """
    if not path.is_dir():
        raise SceneError(f"{path}: no such folder; give the folder that holds images/ and sparse/")
    folders = model_folders(path)
    if not folders:
        raise SceneError(
            f"{path}: no COLMAP model (looked for {' and '.join(MODEL_FILES)} in it and below it); "
            "run COLMAP on the photos first, or give the folder that holds them"
        )
    found: list[FoundModel] = []
    damaged: list[Path] = []
    for folder in folders:
        try:
            names = read_names(folder)
        except SceneError:
            if folder == folders[0] or len(damaged) == len(folders) - 1:
                raise  # another one would be taken without need
            damaged.append(folder)
        else:
            found.append(FoundModel(folder, _photos(path, folder, names, images)))
    best = max(found, key=lambda one: len(one.photos.files))  # the first of several
    others = {one.folder: f"{len(one.photos.files)} photos" for one in found if one is not best}
    others |= dict.fromkeys(damaged, "damaged")
    return best, _describe(path, best, others)


def _describe(path: Path, best: FoundModel, others: dict[Path, str]) -> list[str]:
    def named(folder: Path) -> str:
        below = folder.relative_to(path).as_posix()
        return "the folder itself" if below == "." else short(below)

    if not others:
        usual = best.folder.relative_to(path).as_posix() in USUAL
        return [] if usual else [f"poses: those of {named(best.folder)}"]
    rest = [f"{named(folder)} ({what})" for folder, what in others.items()]
    more = f" and {len(rest) - 3} more" if len(rest) > 3 else ""
    return [
        f"poses: those of {named(best.folder)}, which of {len(others) + 1} models has the most photos; left "
        f"aside: {', '.join(rest[:3])}{more}; to take another one, give its folder"
    ]


def _holds_model(folder: Path) -> bool:
    return any(model_file(folder, name) for name in (*MODEL_FILES, "images.bin"))  # if in part


def _walk(folder: Path, depth: int) -> Iterator[Path]:
    """Folders below, nearer ones first, that are not full of pictures."""
    below = [
        each for each in folders_of(folder) if not each.name.lower().startswith((*PHOTO_FOLDERS, "mask"))
    ]
    if (folder / "poses.json").is_file():
        below = [each for each in below if each.name != "sfm"]  # intermediate results of ours
    yield from below
    if depth + 1 < _DEEPEST:
        for each in below:
            yield from _walk(each, depth + 1)


def _photos(path: Path, folder: Path, names: list[str], images: Path | None) -> Found:
    """The photos of a model: in the first usual folder that has half of them, else in that which has most."""
    if images is not None:
        return PhotoFolder(images).find(names)
    best = PhotoFolder(path / PHOTO_FOLDERS[0]).find(names)
    for places in _places(path, folder):
        for place in places:
            found = PhotoFolder(place).find(names)
            best = max(best, found, key=lambda one: len(one.files))
            if place.name in PHOTO_FOLDERS and 2 * len(found.files) >= len(names) > 0:
                return found
        if 2 * len(best.files) >= len(names):
            break
    return best


def _places(path: Path, folder: Path) -> Iterator[list[Path]]:
    """Folders that may hold the photos of a model: the usual ones, any others, those of smaller copies."""
    levels = len(folder.relative_to(path).parts)
    above = [folder, *folder.parents][: levels + 1]
    outside = list(Path(os.path.abspath(path)).parents)[: max(0, _ABOVE - levels)]
    above += [each for each in outside if any((each / name).is_dir() for name in PHOTO_FOLDERS)]
    names = PHOTO_FOLDERS[::-1] if "distorted" in folder.parts else PHOTO_FOLDERS
    yield [each / name for each in above for name in names if (each / name).is_dir()]
    below = [(each, folders_of(each)) for each in above]
    photos = [
        [one for one in inside if not one.name.lower().startswith(NOT_PHOTOS) and holds_photos(one)]
        for _, inside in below
    ]
    yield [place for each, inside in zip(above, photos, strict=True) for place in (*inside, each)]
    yield [one for _, inside in below for one in inside if one.name.lower().startswith("images_")]
