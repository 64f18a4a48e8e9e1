"""The types Camera, View, Points and Scene (OpenCV axes: x right, y down, z forward)."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float32, Int32, Int64, UInt8
from msgspec import Meta

from sagesplat.core.geometry import NO_OFFSET, Position


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera; the first pixel's centre is at (0.5, 0.5)."""

    w2c: Float32[np.ndarray, "4 4"]  # world to camera, world units
    K: Float32[np.ndarray, "3 3"]  # intrinsics, pixels
    width: int
    height: int
    background: tuple[int, int, int] = (0, 0, 0)  # RGB; photos with alpha are composited over it
    exposure: Float32[np.ndarray, "3 4"] | None = None  # photo's colours = E[:, :3] @ rgb + E[:, 3]

    @property
    def neutral(self) -> "Camera":
        """The same camera without its photo's exposure, for pictures that stand beside no photo."""
        return replace(self, exposure=None)

    @property
    def position(self) -> Float32[np.ndarray, "3"]:
        """Camera centre in the world."""
        return -self.w2c[:3, :3].T @ self.w2c[:3, 3]

    @property
    def focal(self) -> float:
        """Focal length in pixels, the geometric mean of both axes'."""
        return float(np.sqrt(abs(float(self.K[0, 0]) * float(self.K[1, 1]))))

    @property
    def direction(self) -> Float32[np.ndarray, "3"]:
        """Unit viewing direction (camera z) in the world."""
        return self.w2c[2, :3]

    def resized(self, width: int, height: int) -> "Camera":
        """The same camera for an image of `width` x `height` pixels."""
        scale = np.array([width / self.width, height / self.height, 1.0], np.float32)
        return replace(self, K=(self.K * scale[:, None]).astype(np.float32), width=width, height=height)

    def within(self, side: int) -> "Camera":
        """The same camera for an image whose longer side is at most `side` pixels."""
        share = min(1.0, side / max(self.width, self.height))
        return self.resized(max(1, round(self.width * share)), max(1, round(self.height * share)))


Face = Literal["front", "right", "back", "left", "up", "down"]  # of the cube around a wide lens


@dataclass(frozen=True)
class Lens:
    """A COLMAP camera model with its parameters: `images.load_photo` undistorts photos by it."""

    model: str  # COLMAP's name, e.g. "OPENCV"
    params: tuple[float, ...]  # in COLMAP's order, pixels of width x height (the file may be smaller)
    width: int
    height: int
    face: Face | None = None  # the view shows this face of the cube around the lens; None: straight ahead


STEEPEST = 10.0  # magnitude of a coefficient of a vignetting
_Steepness = Annotated[float, Meta(ge=-STEEPEST, le=STEEPEST)]


@dataclass(frozen=True)
class Vignetting:
    """Share of the light that a lens lets through: exp(a s + b s^2) for s = tan^2(angle to its axis) / reach.

    Farther out than `reach` it stays what it is there.
    """

    coefficients: tuple[_Steepness, _Steepness]  # a, b
    reach: Annotated[float, Meta(gt=0, le=1e6)]  # tan^2

    @property
    def lost(self) -> float:
        """Share of the light that is lost at the reach."""
        return 1 - math.exp(sum(self.coefficients))


@dataclass(frozen=True, eq=False)
class View:
    """One posed photo."""

    name: str  # path below the image folder, as COLMAP lists it
    camera: Camera  # pinhole, at the size that training uses
    image_path: Path
    lens: Lens | None = None  # None: the file on disk needs no undistortion
    valid_path: Path | None = None  # an image of the photo's shape whose black pixels do not count
    vignetting: Vignetting | None = None  # of the photo, to be taken out of it

    @property
    def photo_name(self) -> str:
        """Name of the whole photo, where the view is one face of the cube around its lens."""
        if self.lens is None or self.lens.face is None:
            return self.name
        path = PurePosixPath(self.name)
        return path.with_name(path.stem.removesuffix(f"_{self.lens.face}") + path.suffix).as_posix()


@dataclass(frozen=True, eq=False)
class Points:
    """Structure-from-motion points and their tracks (T observations of points in views)."""

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
    calibrate_every: int = 0  # every n-th of the others is a calibration view; 0 = none
    test_names: frozenset[str] | None = None  # overrides test_every: test views that the data set lists
    calibration_names: frozenset[str] | None = None  # likewise overrides calibrate_every
    alpha: Literal["auto", "background", "ignore"] = "auto"  # what transparent pixels mean (`SceneConfig`)
    notes: tuple[str, ...] = ()  # what was decided while it was read, a line each
    offset: Position = NO_OFFSET  # that was subtracted from all positions of the capture, world units

    @cached_property
    def extent(self) -> float:
        """1.1 times the largest distance of a training camera from their mean (3DGS's scene extent)."""
        centres = np.stack([self.views[i].camera.position for i in self.train_ids])
        return float(1.1 * np.linalg.norm(centres - centres.mean(0), axis=1).max())

    @property
    def scale(self) -> float:
        """What positions are divided by: the extent, or 1 where all cameras are in one place."""
        return self.extent if self.extent > 0 else 1.0

    @property
    def test_ids(self) -> np.ndarray:
        """Rows of the test views, which training, fitting and calibration never use."""
        every = np.arange(len(self.views))
        if self.test_names is not None:
            return every[[view.name in self.test_names for view in self.views]]
        return every[every % self.test_every == 0] if self.test_every else every[:0]

    @property
    def calibration_ids(self) -> np.ndarray:
        """Rows of the calibration views: held out from training, used to calibrate the quality bounds."""
        rest = np.setdiff1d(np.arange(len(self.views)), self.test_ids)
        if self.calibration_names is not None:
            return rest[[self.views[i].name in self.calibration_names for i in rest]]
        return rest[self.calibrate_every // 2 :: self.calibrate_every] if self.calibrate_every else rest[:0]

    def split(self, row: int) -> str:
        """The split that a view is in: train, calibration or test."""
        if row in self.test_ids:
            return "test"
        return "calibration" if row in self.calibration_ids else "train"

    @property
    def train_ids(self) -> np.ndarray:
        """Rows of the training views."""
        held_out = np.concatenate([self.test_ids, self.calibration_ids])
        return np.setdiff1d(np.arange(len(self.views)), held_out)
