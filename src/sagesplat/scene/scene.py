"""Cameras, views, points and the scene they make (OpenCV axes: x right, y down, z forward)."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32, Int64, UInt8


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera; the first pixel's centre is at (0.5, 0.5)."""

    w2c: Float32[np.ndarray, "4 4"]  # world to camera, world units
    K: Float32[np.ndarray, "3 3"]  # intrinsics, pixels
    width: int
    height: int
    background: tuple[int, int, int] = (0, 0, 0)  # RGB behind the scene: alpha of photos goes over it

    @property
    def position(self) -> Float32[np.ndarray, "3"]:
        """Camera centre in the world."""
        return -self.w2c[:3, :3].T @ self.w2c[:3, 3]

    @property
    def direction(self) -> Float32[np.ndarray, "3"]:
        """Unit viewing direction (camera z) in the world."""
        return self.w2c[2, :3]

    def resized(self, width: int, height: int) -> "Camera":
        """The same view on an image of `width` x `height` pixels."""
        scale = np.array([width / self.width, height / self.height, 1.0], np.float32)
        return replace(self, K=(self.K * scale[:, None]).astype(np.float32), width=width, height=height)


@dataclass(frozen=True, eq=False)
class Lens:
    """A COLMAP camera that is not a pinhole: what `images.load_photo` undistorts from."""

    model: str  # COLMAP's name, e.g. "OPENCV"
    params: tuple[float, ...]  # in COLMAP's order, pixels of width x height (the file may be smaller)
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class View:
    """One posed photo."""

    name: str  # path below the image folder, as COLMAP lists it
    camera: Camera  # pinhole, at the size that training uses
    image_path: Path
    lens: Lens | None = None  # set where the file on disk has to be undistorted


@dataclass(frozen=True, eq=False)
class Points:
    """Structure-from-motion points and the observations (tracks) behind them."""

    xyz: Float32[np.ndarray, "P 3"]  # world
    rgb: UInt8[np.ndarray, "P 3"]
    track_points: Int64[np.ndarray, " T"]  # row in xyz
    track_views: Int32[np.ndarray, " T"]  # row in Scene.views
    track_uv: Float32[np.ndarray, "T 2"]  # pixels of View.camera (undistorted, resized)


@dataclass(frozen=True, eq=False)
class Scene:
    """A capture: views ordered by name, points, and the split into training and test views."""

    name: str
    path: Path
    views: tuple[View, ...]
    points: Points
    test_every: int = 8  # every n-th view by name is a test view; 0 = none
    calibrate_every: int = 0  # every n-th of the others calibrates promises; 0 = none
    test_names: frozenset[str] | None = None  # test views that the dataset lists, instead of test_every
    calibration_names: frozenset[str] | None = None  # likewise, instead of calibrate_every

    @cached_property
    def extent(self) -> float:
        """1.1 times the largest distance of a training camera from their mean (3DGS's scene extent)."""
        centres = np.stack([self.views[i].camera.position for i in self.train_ids])
        return float(1.1 * np.linalg.norm(centres - centres.mean(0), axis=1).max())

    @property
    def test_ids(self) -> np.ndarray:
        """Rows of `views` that training, fitting and calibration never see."""
        every = np.arange(len(self.views))
        if self.test_names is not None:
            return every[[view.name in self.test_names for view in self.views]]
        return every[every % self.test_every == 0] if self.test_every else every[:0]

    @property
    def calibration_ids(self) -> np.ndarray:
        """Rows of `views` that tell what a promise is worth where no photo was trained on."""
        rest = np.setdiff1d(np.arange(len(self.views)), self.test_ids)
        if self.calibration_names is not None:
            return rest[[self.views[i].name in self.calibration_names for i in rest]]
        return rest[self.calibrate_every // 2 :: self.calibrate_every] if self.calibrate_every else rest[:0]

    def split(self, row: int) -> str:
        """What a view is for: train, calibration or test."""
        of_others = "calibration" if row in self.calibration_ids else "train"
        return "test" if row in self.test_ids else of_others

    @property
    def train_ids(self) -> np.ndarray:
        """Rows of `views` that training may use."""
        kept = np.concatenate([self.test_ids, self.calibration_ids])
        return np.setdiff1d(np.arange(len(self.views)), kept)
