"""Cameras from a file or a capture: cameras.json of 3DGS, viewpoints.json, transforms.json, COLMAP."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from jaxtyping import Float64
from msgspec import Meta

from sagesplat.core.geometry import NO_OFFSET, Position, offset_of
from sagesplat.core.names import repaired
from sagesplat.io.files import read_json
from sagesplat.io.typed import convert_as, refused
from sagesplat.scene import load_scene
from sagesplat.scene.loading import MAX_SIDE
from sagesplat.scene.nerfstudio import LARGEST, MAX_SHEAR, frame_cameras
from sagesplat.scene.scene import Camera, View

Viewpoints = Literal["sagesplat-viewpoints"]  # the format of viewpoints.json
(VIEWPOINTS,) = get_args(Viewpoints)
MOST_PIXELS = 2**28  # of a camera's image
Side = Annotated[int, Meta(ge=1, le=MAX_SIDE)]  # pixels
_Byte = Annotated[int, Meta(ge=0, le=255)]
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
    offset: Position = NO_OFFSET  # that was subtracted from its position in the file; of all in it the same


def read_camera_file(path: Path, images: Path | None = None) -> list[NamedCamera]:
    """The cameras of a file or a capture, in its order.

    Args:
        path: cameras.json as 3DGS writes it (camera to world, OpenCV axes), viewpoints.json of a run,
            transforms.json, or a folder with a COLMAP workspace, nerfstudio's transforms or such a
            cameras.json. A transforms.json without its photos is read for its poses and intrinsics.
        images: folder of a capture's photos; None: found beside the poses.

    Returns:
        At least one camera; those of captures with their photos.

    Raises:
        DataError: Where there are no cameras, or one cannot be used.
        SceneError, RunError: Where a capture or a file cannot be read.
    """
    if path.is_dir() and (path / "cameras.json").is_file():
        path = path / "cameras.json"
    if path.is_dir() or path.suffix != ".json":
        return _of_capture(path, images)
    document = read_json(path, _CURE)
    if isinstance(document, dict) and document.get("format") != VIEWPOINTS:
        return _of_transforms(path, images)
    with refused(path, "a list of cameras", _CURE):
        if isinstance(document, list):
            entries = convert_as(document, list[_Of3dgs])
            offset = offset_of(np.array([entry.position for entry in entries]).reshape(-1, 3))
            found = [_of_3dgs(entry, number, offset) for number, entry in enumerate(entries)]
        else:
            made = convert_as(document, ViewpointsFile)
            found = [
                NamedCamera(f"{number:03}", entry.camera(), offset=made.offset)
                for number, entry in enumerate(made.viewpoints)
            ]
        if not found:
            raise ValueError("no cameras")
    return found


def _of_capture(path: Path, images: Path | None) -> list[NamedCamera]:
    scene = load_scene(path, test_every=0, images=images)
    return [NamedCamera(repaired(view.name), view.camera, view, scene.offset) for view in scene.views]


def _of_transforms(path: Path, images: Path | None) -> list[NamedCamera]:
    """Of a transforms.json: with its photos if they are there."""
    cameras, complete, offset = frame_cameras(path)
    if complete or images is not None:
        return _of_capture(path, images)
    return [NamedCamera(repaired(name), _within_limits(camera), offset=offset) for name, camera in cameras]


@dataclass(frozen=True, eq=False)
class _Of3dgs:
    """An entry of 3DGS's cameras.json; the principal point is the middle, where other tools name none."""

    rotation: Float64[np.ndarray, "3 3"]
    position: Float64[np.ndarray, " 3"]
    fx: float
    fy: float
    width: Side
    height: Side
    img_name: Any = None
    cx: float | None = None
    cy: float | None = None


@dataclass(frozen=True, eq=False)
class CameraEntry:
    """A camera of viewpoints.json."""

    w2c: Float64[np.ndarray, "4 4"]
    K: Float64[np.ndarray, "3 3"]
    width: Side
    height: Side
    background: tuple[_Byte, _Byte, _Byte]
    set: str = ""

    def camera(self) -> Camera:
        """The camera; ValueError where it cannot be used."""
        return _camera(self.w2c, self.K, self.width, self.height, self.background)


@dataclass(frozen=True, eq=False)
class ViewpointsFile:
    """The cameras of viewpoints.json."""

    format: Viewpoints
    viewpoints: list[CameraEntry]
    offset: Position = NO_OFFSET  # `Scene.offset`


def _of_3dgs(entry: _Of3dgs, number: int, offset: Position) -> NamedCamera:
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = entry.rotation.T, -entry.rotation.T @ (entry.position - np.array(offset))
    cx = entry.width / 2 if entry.cx is None else entry.cx
    cy = entry.height / 2 if entry.cy is None else entry.cy
    K = np.array([[entry.fx, 0, cx], [0, entry.fy, cy], [0, 0, 1]])
    given = entry.img_name
    name = repaired(given) if isinstance(given, str) and given else f"{number:03}"
    return NamedCamera(name, _camera(w2c, K, entry.width, entry.height), offset=offset)


def _within_limits(camera: Camera) -> Camera:
    if max(camera.width, camera.height) > MAX_SIDE or camera.width * camera.height > MOST_PIXELS:
        raise ValueError(f"size {camera.width} x {camera.height} is out of range")
    return camera


def _camera(
    w2c: np.ndarray, K: np.ndarray, width: int, height: int, background: tuple[int, int, int] = (0, 0, 0)
) -> Camera:
    if not (np.abs([*w2c.flat, *K.flat]) <= LARGEST).all():
        raise ValueError(f"values that are not finite or above {LARGEST:g}")
    axes = w2c[:3, :3]
    if np.abs(axes @ axes.T - np.eye(3)).max() > MAX_SHEAR or np.linalg.det(axes) < 0:
        raise ValueError("it is no rotation")
    if min(K[0, 0], K[1, 1]) <= 0:
        raise ValueError("it has no focal length")
    return _within_limits(Camera(w2c.astype(np.float32), K.astype(np.float32), width, height, background))
