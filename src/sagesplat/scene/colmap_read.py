"""Reads COLMAP models, text and binary, of any COLMAP version.

Format: https://colmap.github.io/format.html. Models since 3.12 also have rigs and frames. They are ignored,
since images still hold their own poses.
"""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64, UInt8
from scipy.spatial.transform import Rotation

from sagesplat.core.errors import SceneError, short
from sagesplat.io.files import decoded
from sagesplat.scene.colmap_write import ModelCamera, ModelImage
from sagesplat.scene.undistort import CAMERA_MODELS

MODEL_NAMES = {model.id: name for name, model in CAMERA_MODELS.items()}
MAX_SIDE = 10**6  # pixels
_SUFFIXES = (".bin", ".txt")
# The fixed-length part of a record in each binary file.
CAMERA = np.dtype([("id", "<u4"), ("model", "<i4"), ("width", "<u8"), ("height", "<u8")])
IMAGE = np.dtype([("id", "<u4"), ("pose", "<f8", 7), ("camera", "<u4")])
OBSERVATION = np.dtype([("uv", "<f8", 2), ("point", "<i8")])
POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8")])


class ModelPoints(NamedTuple):
    """points3D without its tracks: the images hold the same observations."""

    ids: Int64[np.ndarray, " P"]  # sorted
    xyz: Float64[np.ndarray, "P 3"]
    rgb: UInt8[np.ndarray, "P 3"]


def read_names(folder: Path) -> list[str]:
    """The photos of the model in `folder`, as it names them. SceneError for missing or damaged files."""

    def text(path: Path, lines: list[str]) -> list[str]:
        return [image.name for image in _text_images(path, lines)]

    return _read(folder, "images", _binary_names, text)


def read_model(folder: Path) -> tuple[dict[int, ModelCamera], list[ModelImage], ModelPoints | None]:
    """Cameras by id, posed images and points of the model in `folder`; binary files are preferred to text.

    None for points where there is no points3D.bin or .txt, as other tools leave it out. SceneError for
    missing or damaged files. All numbers are finite, but not checked further. Memory stays within a small
    multiple of the file sizes: the counts in the files are not trusted.
    """
    cameras = _read(folder, "cameras", _binary_cameras, _text_cameras)
    listed = _read(folder, "images", _binary_images, _text_images)
    points = None
    if any(model_file(folder, f"points3D{suffix}") for suffix in _SUFFIXES):
        points = _read(folder, "points3D", _binary_points, _text_points)
    ids = np.zeros(0, np.int64) if points is None else points.ids

    def rows(of: np.ndarray) -> np.ndarray:
        if not len(ids):
            return np.full(len(of), -1)
        at = np.minimum(np.searchsorted(ids, of), len(ids) - 1)
        return np.where(ids[at] == of, at, -1)

    return cameras, [replace(i, point_rows=rows(i.point_rows)) for i in listed], points


def model_file(folder: Path, name: str) -> Path | None:
    """The file of a name in the folder of a model, whatever its case; None where it is not there."""
    if (file := folder / name).is_file():
        return file
    try:
        others = sorted(entry.path for entry in os.scandir(folder) if entry.name.lower() == name.lower())
    except OSError:
        return None
    return next((Path(other) for other in others if os.path.isfile(other)), None)


def _read(folder: Path, part: str, binary: Callable, text: Callable) -> Any:
    path = next((file for s in _SUFFIXES if (file := model_file(folder, part + s))), folder / f"{part}.txt")
    try:
        content = path.read_bytes()
        if path.suffix == ".bin":
            data = _Bytes(content)
            value = binary(path, data)
            if data.at != len(data.data):
                raise ValueError(f"{len(data.data) - data.at} bytes more than expected")
            return value
        lines = decoded(content, "surrogateescape").replace("\r", "\n").split("\n")  # paths may be no UTF-8
        return text(path, [line.strip() for line in lines])
    except FileNotFoundError:
        raise SceneError(f"{path}: no such file; copy the whole model (cameras, images, points3D)") from None
    except (OSError, ValueError, IndexError, OverflowError) as error:
        raise SceneError(
            f"{path}: damaged or incomplete ({short(error)}); copy or export the model again"
        ) from None


class _Bytes:
    """A binary file and the read position; never allocates more than the file holds."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0

    def take(self, dtype: Any, count: int = 1) -> np.ndarray:
        size = np.dtype(dtype).itemsize * count
        self.skip(size)
        return np.frombuffer(self.data, dtype, count, self.at - size)

    def skip(self, size: int) -> None:
        if size > len(self.data) - self.at:
            raise ValueError(f"it ends within a record, byte {self.at}")
        self.at += size

    def count(self) -> int:
        self.skip(8)
        return int.from_bytes(self.data[self.at - 8 : self.at], "little")

    def name(self) -> str:
        start, end = self.at, self.data.index(b"\0", self.at)
        self.at = end + 1
        return self.data[start:end].decode("utf-8", "surrogateescape")


def _binary_cameras(path: Path, data: _Bytes) -> dict[int, ModelCamera]:
    cameras = {}
    for _ in range(data.count()):
        id, model, width, height = data.take(CAMERA)[0].tolist()
        name = MODEL_NAMES.get(model) or _unknown_model(path, f"number {model}")
        params = data.take("<f8", CAMERA_MODELS[name].num_params)
        cameras[id] = camera_of_model(id, name, width, height, params.tolist())
    return cameras


def _text_cameras(path: Path, lines: list[str]) -> dict[int, ModelCamera]:
    cameras = {}
    for line in _records(lines):
        id, model, *values = line.split()
        width, height, *params = map(float, values)  # tools other than COLMAP write sizes as 96.0, too
        if width % 1 or height % 1:
            raise ValueError(f"camera {id}: size {width} x {height} is not of whole pixels")
        name = model.upper() if model.upper() in CAMERA_MODELS else _unknown_model(path, model)
        cameras[int(id)] = camera_of_model(int(id), name, int(width), int(height), params)
    return cameras


def _unknown_model(path: Path, model: str) -> str:
    raise SceneError(
        f"{path}: camera model {short(model)} is unknown (known: {', '.join(CAMERA_MODELS)}); "
        "find the poses again with one of these"
    )


def camera_of_model(id: int, name: str, width: int, height: int, params: list[float]) -> ModelCamera:
    """A camera whose numbers are checked. KeyError for an unknown model, ValueError for other numbers."""
    model = CAMERA_MODELS[name]
    if len(params) != model.num_params or not np.isfinite(params).all():
        raise ValueError(f"camera {id}: {name} has {model.num_params} finite parameters, not {params[:13]}")
    if min(params[: model.num_focal or 2]) <= 0 or not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise ValueError(f"camera {id}: focal length {params[0]} or size {width} x {height} out of range")
    return ModelCamera(id, name, width, height, tuple(params))


def _binary_images(path: Path, data: _Bytes) -> list[ModelImage]:
    rows, poses = [], []
    for _ in range(data.count()):
        id, pose, camera_id = data.take(IMAGE)[0]
        name = data.name()
        observed = data.take(OBSERVATION, data.count())
        rows.append((int(id), name, int(camera_id), observed["uv"], observed["point"]))
        poses.append(pose)
    return _images(rows, poses)


def _binary_names(path: Path, data: _Bytes) -> list[str]:
    """The names alone: observations, which are most of the file, are passed over."""
    names = []
    for _ in range(data.count()):
        data.skip(IMAGE.itemsize)
        names.append(data.name())
        data.skip(OBSERVATION.itemsize * data.count())
    return names


def _text_images(path: Path, lines: list[str]) -> list[ModelImage]:
    """The images. COLMAP writes a line of observations after each, which files written by hand leave out."""
    rows: list[tuple] = []
    poses: list[np.ndarray] = []
    nothing = np.zeros((0, 2)), np.zeros(0, np.int64)
    for line in _records(lines):
        if rows and rows[-1][3] is nothing[0] and (observed := _observations(line)) is not None:
            rows[-1] = (*rows[-1][:3], observed[:, :2], observed[:, 2].astype(np.int64))
            continue
        id, *pose, camera_id, name = line.split(maxsplit=9)
        rows.append((int(id), name, int(camera_id), *nothing))
        poses.append(np.array(pose, float))
    return _images(rows, poses)


def _observations(line: str) -> np.ndarray | None:
    """The numbers of a line of observations [M, 3]; None for the line of an image, which has a name."""
    words = line.split()
    try:
        numbers = np.array(words, float).reshape(-1, 3)
    except ValueError:
        if len(words) < 10:
            raise
        return None
    # the name may be of numbers, too: then the four that turn the camera tell
    named = len(words) > 10 and abs(float(np.linalg.norm(numbers.ravel()[1:5])) - 1) < 1e-3
    return None if named else numbers


def _images(rows: list[tuple], poses: list[np.ndarray]) -> list[ModelImage]:
    """The images, with point ids still in `point_rows`; poses are qw qx qy qz tx ty tz, world to camera."""
    if not rows:
        return []
    pose = np.stack(poses)
    bad = ~np.isfinite(pose.astype(np.float32)).all(axis=1) | ~(np.linalg.norm(pose[:, :4], axis=1) > 1e-6)
    if bad.any():
        raise ValueError(f"photo {rows[int(np.argmax(bad))][1]!r} has a pose that is not finite")
    w2c = np.tile(np.eye(4), (len(rows), 1, 1))
    w2c[:, :3, :3] = Rotation.from_quat(pose[:, :4], scalar_first=True).as_matrix()
    w2c[:, :3, 3] = pose[:, 4:]
    return [
        ModelImage(id, name, camera, m, uv, ids)
        for (id, name, camera, uv, ids), m in zip(rows, w2c, strict=True)
    ]


def _binary_points(path: Path, data: _Bytes) -> ModelPoints:
    number, starts = data.count(), []
    for _ in range(number):  # tracks are skipped: the images hold them too
        starts.append(data.at)
        data.skip(POINT.itemsize)
        data.skip(8 * data.count())
    if not number:
        return _points(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))
    windows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data.data, np.uint8), POINT.itemsize)
    records: np.ndarray = windows[starts].view(POINT)[:, 0]
    return _points(records["id"].astype(np.int64), records["xyz"], records["rgb"])


def _text_points(path: Path, lines: list[str]) -> ModelPoints:
    rows = [line.split(maxsplit=7)[:7] for line in _records(lines)]  # whose error is of no use
    table = np.array(rows, float).reshape(-1, 7)
    return _points(table[:, 0].astype(np.int64), table[:, 1:4], table[:, 4:7])


def _points(ids: np.ndarray, xyz: np.ndarray, rgb: np.ndarray) -> ModelPoints:
    if not np.isfinite(xyz.astype(np.float32)).all():
        raise ValueError("points with coordinates that are not finite")
    order = np.argsort(ids)
    return ModelPoints(ids[order], xyz[order], rgb[order].astype(np.uint8))


def _records(lines: list[str]) -> list[str]:
    return [line for line in lines if line and not line.startswith("#")]
