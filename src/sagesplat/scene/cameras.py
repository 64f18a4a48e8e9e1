"""Cameras from a file or a capture: cameras.json of 3DGS, viewpoints.json, transforms.json, COLMAP."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sagesplat.core.errors import DataError, short
from sagesplat.core.names import repaired
from sagesplat.io.files import read_json
from sagesplat.scene import load_scene
from sagesplat.scene.loading import MAX_SIDE
from sagesplat.scene.nerfstudio import LARGEST, MAX_SHEAR, frame_cameras
from sagesplat.scene.scene import Camera, View

VIEWPOINTS = "sagesplat-viewpoints"  # the format of viewpoints.json
MOST_PIXELS = 2**28  # of a camera's image
_CURE = (
    "give a cameras.json of 3DGS, a viewpoints.json, a transforms.json with the intrinsics of its frames, or "
    "a capture (COLMAP, nerfstudio)"
)


@dataclass(frozen=True, eq=False)
class NamedCamera:
    """A camera of a file, and its photo where there is one."""

    name: str  # for people: printable, not necessarily unique
    camera: Camera
    photo: View | None = None  # `scene.images` reads it


def read_camera_file(path: Path) -> list[NamedCamera]:
    """The cameras of a file or a capture, in its order.

    Args:
        path: cameras.json as 3DGS writes it (camera to world, OpenCV axes), viewpoints.json of a run,
            transforms.json, or a folder with a COLMAP workspace, nerfstudio's transforms or such a
            cameras.json. A transforms.json without its photos is read for its poses and intrinsics.

    Returns:
        At least one camera; those of captures with their photos.

    Raises:
        DataError: Where there are no cameras, or one cannot be used.
        SceneError, RunError: Where a capture or a file cannot be read.
    """
    if path.is_dir() and (path / "cameras.json").is_file():
        path = path / "cameras.json"
    if path.is_dir() or path.suffix != ".json":
        return _of_capture(path)
    document = read_json(path, _CURE)
    try:
        if isinstance(document, list):
            found = [_of_3dgs(entry, number) for number, entry in enumerate(document)]
        elif isinstance(document, dict) and document.get("format") == VIEWPOINTS:
            entries = enumerate(document["viewpoints"])
            found = [NamedCamera(f"{number:03}", camera_of_entry(entry)) for number, entry in entries]
        else:
            return _of_transforms(path)
        if not found:
            raise ValueError("no cameras")
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise DataError(f"{path}: no list of cameras ({short(repr(error))}); {_CURE}") from None
    return found


def _of_capture(path: Path) -> list[NamedCamera]:
    return [NamedCamera(repaired(v.name), v.camera, v) for v in load_scene(path, test_every=0).views]


def _of_transforms(path: Path) -> list[NamedCamera]:
    """Of a transforms.json: with its photos if they are there."""
    cameras, complete = frame_cameras(path)
    if complete:
        return _of_capture(path)
    for _, camera in cameras:
        _check_size(camera.width, camera.height)
    return [NamedCamera(repaired(name), camera) for name, camera in cameras]


def _of_3dgs(entry: dict[str, Any], number: int) -> NamedCamera:
    """An entry of 3DGS's cameras.json; the principal point is the middle. As `camera_of_entry`."""
    c2w, position = _numbers(entry["rotation"], 3, 3), _numbers(entry["position"], 3)
    fx, fy = float(_numbers(entry["fx"])), float(_numbers(entry["fy"]))
    width, height = entry["width"], entry["height"]
    _check_size(width, height)
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = c2w.T, -c2w.T @ position
    K = np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])
    name = entry.get("img_name")
    name = repaired(name) if isinstance(name, str) and name else f"{number:03}"
    return NamedCamera(name, _camera(w2c, K, width, height))


def camera_of_entry(entry: dict[str, Any]) -> Camera:
    """The camera of an entry of viewpoints.json. Raises ValueError, TypeError or KeyError."""
    w2c, K = _numbers(entry["w2c"], 4, 4), _numbers(entry["K"], 3, 3)
    width, height = entry["width"], entry["height"]
    _check_size(width, height)
    red, green, blue = (int(value) for value in entry["background"])
    return _camera(w2c, K, width, height, (red, green, blue))


def _numbers(value: Any, *shape: int) -> np.ndarray:
    array = np.array(value, np.float64)
    if array.shape != shape:
        raise ValueError(f"{short(value)} has to be {' x '.join(map(str, shape)) or 'one number'}")
    if not (np.abs(array) <= LARGEST).all():
        raise ValueError(f"values that are not finite or above {LARGEST:g}")
    return array


def _check_size(width: Any, height: Any) -> None:
    whole = all(isinstance(side, int) and 0 < side <= MAX_SIDE for side in (width, height))
    if not whole or width * height > MOST_PIXELS:
        raise ValueError(f"size {short(width)} x {short(height)} is out of range")


def _camera(
    w2c: np.ndarray, K: np.ndarray, width: int, height: int, background: tuple[int, int, int] = (0, 0, 0)
) -> Camera:
    axes = w2c[:3, :3]
    if np.abs(axes @ axes.T - np.eye(3)).max() > MAX_SHEAR or np.linalg.det(axes) < 0:
        raise ValueError("it is no rotation")
    if min(K[0, 0], K[1, 1]) <= 0:
        raise ValueError("it has no focal length")
    return Camera(w2c.astype(np.float32), K.astype(np.float32), width, height, background)
