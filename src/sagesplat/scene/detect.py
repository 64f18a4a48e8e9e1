"""The formats of captures, and which of them is at a path."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sagesplat.core.errors import SceneError
from sagesplat.scene import scans, stored
from sagesplat.scene.colmap import load_colmap
from sagesplat.scene.find_model import MODEL_FILES, USUAL, model_folders
from sagesplat.scene.find_photos import NOT_PHOTOS, folders_of, holds_photos
from sagesplat.scene.nerfstudio import load_blender, load_transforms
from sagesplat.scene.scene import Scene

VIDEOS = frozenset(
    {".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".mpg", ".mpeg", ".3gp"}
)
_RUN = "scene.json", "provenance"  # are in every run folder


@dataclass(frozen=True)
class CaptureFormat:
    """How captures of one format, photos with poses, are recognised and loaded."""

    files: tuple[str, ...]  # in the capture's folder: one of them is there
    load: Callable[..., Scene]  # (path, downscale=, test_every=, images=, fisheye=) -> the scene
    suffix: str | None = None  # of other files that stand for a capture
    holds: Callable[[Path], object] = lambda folder: False  # or this finds something in a folder that is one


CAPTURES = {
    "colmap": CaptureFormat(tuple(f"{place}/{name}" for place in USUAL for name in MODEL_FILES), load_colmap),
    "transforms": CaptureFormat(("transforms.json",), load_transforms, suffix=".json"),
    "blender": CaptureFormat(("transforms_train.json",), load_blender),
    "polycam": CaptureFormat((), scans.load_polycam, holds=scans.polycam_cameras),
    "record3d": CaptureFormat((), scans.load_record3d, holds=scans.is_record3d),
    "metashape": CaptureFormat((), scans.load_metashape, suffix=".xml", holds=scans.metashape_file),
}


def detect(path: Path) -> str:
    """The kind of capture at a path: see `locate`. SceneError if there is none."""
    return locate(path)[0]


def locate(path: Path) -> tuple[str, Path]:
    """The kind of capture at a path, the first of these that matches, and where it is.

    - a name in `CAPTURES`: one of its files is in the folder, or the path is of one, or has its suffix;
    - transforms, blender: in the only folder below that has such a file, as archives are unpacked;
    - colmap: a model is in the folder, or anywhere below it (`find_model`);
    - stored: an .npz file, such as the capture of one block (`scene.stored`);
    - photos: photos in images/, input/, the folder itself, or folders in it;
    - video: the path of a video file.

    Raises SceneError if none matches.
    """
    if os.path.isfile(path):  # Path's own methods fail for names that no disk can hold
        return _of_file(path), path
    if not os.path.isdir(path):
        raise SceneError(f"{path}: no such file or folder; give a capture's folder or a video")
    if all((path / name).exists() for name in _RUN):  # its label images are no photos
        raise SceneError(f"{path}: a run folder; give the capture it was made of, or `sagesplat view {path}`")
    if kind := _of_folder(path):
        return kind, path
    below = folders_of(path)
    for folders in (below, [each for folder in below for each in folders_of(folder)]):
        inside = [(kind, each) for each in folders if (kind := _of_folder(each)) not in (None, "colmap")]
        if len(inside) == 1:  # nerfstudio keeps COLMAP's model beside its file, in colmap/
            return inside[0]
    if model_folders(path):
        return "colmap", path
    photos = [each for each in below if not each.name.lower().startswith(NOT_PHOTOS)]
    if any(holds_photos(folder) for folder in (path, *photos)):
        return "photos", path
    looked_for = ", ".join(name for capture in CAPTURES.values() for name in capture.files)
    raise SceneError(
        f"{path}: no capture (looked for {looked_for}, other places of cameras.txt, folders of Polycam and "
        "Record3D, cameras of Metashape, and photos in images/, input/ and the folder); give a folder that "
        "has one of them, or a video file"
    )


def _of_folder(path: Path) -> str | None:
    for kind, capture in CAPTURES.items():
        if any((path / name).is_file() for name in capture.files) or capture.holds(path):
            return kind
    return None


def _of_file(path: Path) -> str:
    suffix = path.suffix.lower()
    named = [kind for kind, capture in CAPTURES.items() if path.name in capture.files]
    named += [kind for kind, capture in CAPTURES.items() if capture.suffix == suffix]
    if named:
        return named[0]
    if suffix == stored.SUFFIX:
        return "stored"
    if suffix in VIDEOS:
        return "video"
    raise SceneError(
        f"{path}: neither a transforms .json, an .xml of Metashape nor a video; give one of these, or a "
        f"folder (unpack archives); `sagesplat adopt {path} RUN` is for splats"
    )
