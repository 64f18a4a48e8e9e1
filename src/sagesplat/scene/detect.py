"""Detects the kind of capture at a path."""

import os
from pathlib import Path
from typing import Literal

from sagesplat.core.errors import SceneError
from sagesplat.scene import stored

Kind = Literal["colmap", "transforms", "blender", "stored", "photos", "video"]
# Their content decides how they are read (`io.pictures`).
PHOTOS = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".avif", ".heic", ".heif"})
VALID_FOLDER = "masks_valid"  # beside photos: masks named like them, black where pixels do not count
VIDEOS = frozenset(
    {".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".mpg", ".mpeg", ".3gp"}
)


def detect(path: Path) -> Kind:
    """The kind of capture at a path: the first of these that matches.

    - colmap: cameras.bin or .txt in sparse/0 or sparse;
    - transforms: transforms.json in the folder, or the path of any .json file;
    - blender: transforms_train.json in the folder, or its path;
    - stored: an .npz file, such as the capture of one block (`scene.stored`);
    - photos: photos in images/, or in the folder itself;
    - video: the path of a video file.

    Raises SceneError if none matches.
    """
    if os.path.isfile(path):  # Path's own methods fail for names that no disk can hold
        return _of_file(path)
    if not os.path.isdir(path):
        raise SceneError(f"{path}: no such file or folder; give a capture's folder or a video")
    models = (path / "sparse" / "0", path / "sparse")
    if any((model / name).is_file() for model in models for name in ("cameras.bin", "cameras.txt")):
        return "colmap"
    if (path / "transforms.json").is_file():
        return "transforms"
    if (path / "transforms_train.json").is_file():
        return "blender"
    if any(_holds_photos(folder) for folder in (path / "images", path)):
        return "photos"
    raise SceneError(
        f"{path}: no capture (looked for cameras.bin and cameras.txt in sparse/0 and sparse, "
        "transforms.json, transforms_train.json, and photos in images/ and the folder); "
        "give a folder that has one of them, or a video file"
    )


def _of_file(path: Path) -> Kind:
    suffix = path.suffix.lower()
    if suffix == ".json":
        return "blender" if path.name == "transforms_train.json" else "transforms"
    if suffix == stored.SUFFIX:
        return "stored"
    if suffix in VIDEOS:
        return "video"
    raise SceneError(f"{path}: neither a transforms .json nor a video; give a folder, or one of these files")


def _holds_photos(folder: Path) -> bool:
    if not folder.is_dir():
        return False
    return any(file.suffix.lower() in PHOTOS and file.is_file() for file in folder.iterdir())
