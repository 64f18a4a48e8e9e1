"""Where there is room in a splat, and what is seen from there: an optical-depth grid that rays march through.

Space is contracted as in mip-NeRF 360 (eq. 10): the unit ball as it is, all the rest in a shell around it. So
one grid holds the middle of a scene in detail and its farthest background, whatever the file's unit is.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64
from numba import prange
from scipy.spatial.transform import Rotation

from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import weighted_quantile
from sagesplat.kernels.jit import njit

SIDE = 112  # cells along an axis of the contracted cube, which is 4 units wide
CELL = 4.0 / SIDE
_FAR = 60.0  # units; a ray that gets so far has left the scene
_OPAQUE = 0.7  # optical depth that ends a ray: half of the light
_SAMPLES = 1_500_000  # points that stand for the Gaussians' bodies
_LARGEST_SHARE = 0.5  # steradians of the centre's view that one Gaussian is sampled for
_LOGS = (-60.0, 40.0)  # limits of a log scale, so that nothing overflows


@dataclass(frozen=True, eq=False)
class Cloud:
    """The Gaussians as bodies, in units of the scene: half of them are within 1 unit of its centre, 0."""

    centre: Float64[np.ndarray, "3"]  # world
    unit: float  # world units
    means: Float64[np.ndarray, "N 3"]
    axes: Float64[np.ndarray, "N 3 3"]  # rotations: unit axes are columns
    radii: Float64[np.ndarray, "N 3"]  # standard deviation along each axis
    opacity: Float64[np.ndarray, " N"]

    def __len__(self) -> int:
        return len(self.means)

    def select(self, rows: Int64[np.ndarray, " n"]) -> "Cloud":
        """Some of the bodies."""
        means, axes, radii = self.means[rows], self.axes[rows], self.radii[rows]
        return Cloud(self.centre, self.unit, means, axes, radii, self.opacity[rows])

    @cached_property
    def breadths(self) -> Float64[np.ndarray, "N 3"]:
        """The radii of each, ascending."""
        return np.sort(self.radii, axis=1)

    @cached_property
    def normals(self) -> Float64[np.ndarray, "N 3"]:
        """The direction in which each is thinnest."""
        return np.take_along_axis(self.axes, self.radii.argmin(1)[:, None, None], 2)[..., 0]

    @cached_property
    def area(self) -> Float64[np.ndarray, " N"]:
        """Opacity times the cross-section seen along the normal, square units."""
        return 2 * np.pi * self.opacity * self.breadths[:, 1] * self.breadths[:, 2]

    def world(self, points: Float[np.ndarray, "P 3"]) -> Float64[np.ndarray, "P 3"]:
        """Points of the scene's units in the world's."""
        return points * self.unit + self.centre


def cloud_of(g: Gaussians) -> Cloud:
    """The bodies of at least one Gaussian.

    Centre and unit are weighted by opacity alone: Gaussians are many where photos had detail, while a few
    huge ones stand for the sky.
    """
    means = g.means.detach().cpu().numpy().astype(np.float64)
    opacity = torch.sigmoid(g.logit_opacities.detach().double()).cpu().numpy()
    radii = np.exp(np.clip(g.log_scales.detach().cpu().numpy().astype(np.float64), *_LOGS))
    quats = g.quats.detach().cpu().numpy().astype(np.float64)
    weight = opacity + 1e-12
    centre = np.array([weighted_quantile(column, weight, 0.5) for column in means.T])
    reach = np.linalg.norm(means - centre, axis=1) + radii.max(1)
    unit = max(weighted_quantile(reach, weight, 0.5), 1e-30)
    axes = Rotation.from_quat(quats / np.abs(quats).max(1, keepdims=True), scalar_first=True).as_matrix()
    return Cloud(centre, unit, (means - centre) / unit, axes, radii / unit, opacity)


def in_units(g: Gaussians, cloud: Cloud) -> Gaussians:
    """The same Gaussians in the cloud's units: the rasteriser's near plane is a fixed distance."""
    scales = g.log_scales.detach() - float(np.log(cloud.unit))
    return replace(g, means=torch.from_numpy(cloud.means.astype(np.float32)), log_scales=scales.float())


@dataclass(frozen=True, eq=False)
class Space:
    """Optical depth of the cells of the contracted cube."""

    depth: Float32[np.ndarray, " cells"]  # of crossing a cell
    log_size: Float32[np.ndarray, " cells"]  # of the Gaussians in it, mean of the logarithm, units

    def look(
        self, points: Float64[np.ndarray, "P 3"], directions: Float64[np.ndarray, "D 3"]
    ) -> tuple[Float64[np.ndarray, "P D"], Float64[np.ndarray, "P D"]]:
        """Distance of what each ray meets (inf: nothing), and the log of its Gaussians' size; units."""
        distance, log_size = np.empty((2, len(points), len(directions)))
        _march(self.depth, self.log_size, points, directions, distance, log_size)
        return distance, log_size


def space_of(cloud: Cloud, seed: int) -> Space:
    """The grid of a cloud: points drawn in the Gaussians' bodies carry their areas."""
    rng = np.random.default_rng([seed, 1])
    near = np.maximum(1.0, np.linalg.norm(cloud.means, axis=1))
    seen = np.minimum(cloud.area / near**2, _LARGEST_SHARE) + 1e-12
    sums = np.cumsum(seen)
    rows = np.searchsorted(sums, (np.arange(_SAMPLES) + rng.random()) / _SAMPLES * sums[-1])
    counts = np.bincount(np.minimum(rows, len(cloud) - 1), minlength=len(cloud))
    counts = np.maximum(counts, 1)
    depth, size = np.zeros((2, SIDE**3))
    for rows in np.array_split(np.arange(len(cloud)), 1 + int(counts.sum()) // 500_000):
        rows = np.repeat(rows, counts[rows])
        inside = rng.standard_normal((len(rows), 3)).clip(-2, 2) * cloud.radii[rows]
        points = cloud.means[rows] + np.einsum("nij,nj->ni", cloud.axes[rows], inside)
        length = np.maximum(1.0, np.linalg.norm(points, axis=1))
        share = cloud.area[rows] / counts[rows] / (CELL * length) ** 2
        cells = np.ravel_multi_index(tuple(_cells(points, length).T), (SIDE,) * 3)
        depth += np.bincount(cells, share, SIDE**3)
        size += np.bincount(cells, share * np.log(cloud.breadths[rows, 1] + 1e-30), SIDE**3)
    return Space(depth.astype(np.float32), (size / np.maximum(depth, 1e-30)).astype(np.float32))


def _cells(points: np.ndarray, length: np.ndarray) -> np.ndarray:
    contracted = points * ((2 - 1 / length) / length)[:, None]
    return ((contracted + 2) / CELL).astype(np.int64).clip(0, SIDE - 1)


@njit(parallel=True, cache=True)
def _march(depth, log_size, points, directions, distance, sizes):
    for i in prange(len(points)):
        for j in range(len(directions)):
            distance[i, j], sizes[i, j] = np.inf, np.nan
            t, passed, last = 0.0, 0.0, -1
            while True:
                x = points[i, 0] + t * directions[j, 0]
                y = points[i, 1] + t * directions[j, 1]
                z = points[i, 2] + t * directions[j, 2]
                square, length, share = x * x + y * y + z * z, 1.0, 1.0
                if square > 1:
                    length = np.sqrt(square)
                    if length > _FAR:
                        break
                    share = (2 - 1 / length) / length
                a, b, c = (
                    int((x * share + 2) / CELL),
                    int((y * share + 2) / CELL),
                    int((z * share + 2) / CELL),
                )
                cell = (a * SIDE + b) * SIDE + c
                if cell != last:
                    last = cell
                    passed += depth[cell]
                    if passed > _OPAQUE:
                        distance[i, j], sizes[i, j] = max(t, 0.5 * CELL), log_size[cell]
                        break
                t += 0.7 * CELL * length


def sphere(count: int) -> Float64[np.ndarray, "count 3"]:
    """Unit vectors spread evenly (Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, np.pi * (1 + np.sqrt(5)) * i
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), z, np.sqrt(1 - z * z) * np.sin(turn)], axis=1)
