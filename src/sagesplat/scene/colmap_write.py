"""Writes COLMAP models in binary: of the demo capture, and of the viewpoints of adopted splats.

Format: https://colmap.github.io/format.html, without rigs and frames, which COLMAP before 3.12
cannot read.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial.transform import Rotation

from sagesplat.io.files import atomic_path
from sagesplat.scene.undistort import CAMERA_MODELS


@dataclass(frozen=True, eq=False)
class ModelCamera:
    """A camera of a model (a line of cameras.txt)."""

    id: int
    model: str  # COLMAP's name, e.g. "PINHOLE"
    width: int
    height: int
    params: tuple[float, ...]  # in COLMAP's order, pixels


@dataclass(frozen=True, eq=False)
class ModelImage:
    """A posed image of a model and its M keypoints (two lines of images.txt)."""

    id: int
    name: str  # path below the image folder
    camera_id: int
    w2c: Float[np.ndarray, "4 4"]  # world to camera
    uv: Float[np.ndarray, "M 2"]  # pixels, the first pixel's centre is at (0.5, 0.5)
    point_rows: Int[np.ndarray, " M"]  # rows of the model's xyz; -1: not triangulated


def write_model(
    folder: Path,
    cameras: Sequence[ModelCamera],
    images: Sequence[ModelImage],
    xyz: Float[np.ndarray, "P 3"],
    rgb: UInt8[np.ndarray, "P 3"],
    error: Float[np.ndarray, " P"],
) -> None:
    """Write cameras.bin, images.bin and points3D.bin into `folder`, usually sparse/0.

    `error` is each point's mean reprojection error in pixels. Row r of `xyz` gets the point id r + 1;
    the tracks of points3D are those of the images' `point_rows`.
    """
    xyz = np.asarray(xyz, float)
    with atomic_path(folder / "cameras.bin") as path, path.open("wb") as file:
        file.write(struct.pack("<Q", len(cameras)))
        for c in cameras:
            file.write(struct.pack("<IiQQ", c.id, CAMERA_MODELS[c.model].id, c.width, c.height))
            file.write(np.array(c.params, "<f8").tobytes())
    with atomic_path(folder / "images.bin") as path, path.open("wb") as file:
        file.write(struct.pack("<Q", len(images)))
        for i in images:
            file.write(struct.pack("<I7dI", i.id, *_pose(i), i.camera_id) + i.name.encode() + b"\0")
            observed = np.empty(len(i.uv), [("uv", "<f8", 2), ("point", "<i8")])
            observed["uv"] = i.uv
            observed["point"] = np.where(i.point_rows >= 0, i.point_rows + 1, -1)
            file.write(struct.pack("<Q", len(observed)) + observed.tobytes())
    with atomic_path(folder / "points3D.bin") as path, path.open("wb") as file:
        file.write(struct.pack("<Q", len(xyz)))
        for row, track in enumerate(_tracks(images, len(xyz))):
            file.write(struct.pack("<Q3d3Bd", row + 1, *xyz[row], *rgb[row], error[row]))
            file.write(struct.pack("<Q", len(track)) + track.astype("<u4").tobytes())


def _tracks(images: Sequence[ModelImage], num_points: int) -> list[np.ndarray]:
    """For each point its observations [L, 2]: image id, and row of the image's uv."""
    rows = np.concatenate([i.point_rows for i in images])
    ids = np.concatenate([np.full(len(i.point_rows), i.id) for i in images])
    index = np.concatenate([np.arange(len(i.point_rows)) for i in images])
    seen = np.flatnonzero(rows >= 0)
    seen = seen[np.argsort(rows[seen], kind="stable")]
    pairs = np.stack([ids[seen], index[seen]], axis=1)
    return np.split(pairs, np.searchsorted(rows[seen], np.arange(1, num_points)))[:num_points]


def _pose(image: ModelImage) -> list[float]:
    """The image's pose as qw qx qy qz tx ty tz, world to camera."""
    quat = Rotation.from_matrix(image.w2c[:3, :3]).as_quat(canonical=True, scalar_first=True)
    return [*quat.tolist(), *np.asarray(image.w2c[:3, 3], float).tolist()]
