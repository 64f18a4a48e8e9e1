"""Where the cells of nested levels are, and how a viewpoint sees them: a viewer has no Gaussians to ask.

A cell is described by at most 16 points, each of which stands for an area: of the Gaussians around it the sum
of the two longer axes' product times the opacity. From a viewpoint, with h_i the least signed height of a
point over the planes of the frustum:

    in_i     = clamp(1/2 + h_i / (2 radius), 0, 1)       radius: within it are 90 % of the Gaussians;
                                                         larger where known views show the cell from farther
    apparent = f_x f_y / (width height) * sum_i area_i in_i / distance_i^2
    distance = the weighted 25th percentile of distance_i, by area_i in_i

`apparent` is about the share of the picture's pixels if nothing hid the cell. A viewer computes the same
(`web/src/core/distance.ts`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.special import expit

from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import Gaussians
from sagesplat.io.files import atomic_path
from sagesplat.io.npz import Npz
from sagesplat.scene.scene import Camera
from sagesplat.train.cells import k_means

POINTS = 16  # of a cell
STEPS = 255  # of positions within the bounds, and of areas
PERCENTILE = 0.25  # of a cell's distances
LABEL_PERCENTILE = 0.05  # of those of a category as a whole
_AROUND = 0.9  # share of a cell's Gaussians within its radius around the points
_IN_SIGHT = 1e-3  # of the picture's pixels: a cell that covers them is in sight, with
_AT_LEAST = 0.05  # of the area of its closest point at least
_SAMPLE = 2000  # Gaussians of a cell that its points are found from


@dataclass(frozen=True, eq=False)
class Cells:
    """The cells of a ladder; the ids are those of its sizes."""

    ids: Int[np.ndarray, " C"]  # ascending
    labels: Int[np.ndarray, " C"]  # label id of each
    bounds: Float[np.ndarray, "C 6"]  # of the points: smallest x y z, largest x y z; world units
    grid: UInt8[np.ndarray, "C P 4"]  # position within the bounds and area of each point, in STEPS
    area: Float[np.ndarray, " C"]  # of all points, world units squared
    radius: Float[np.ndarray, " C"]  # world units

    @property
    def label_of(self) -> dict[int, int]:
        """Label id by cell id."""
        return dict(zip(self.ids.tolist(), self.labels.tolist(), strict=True))

    def select(self, rows: Int[np.ndarray, " n"] | Sequence[int]) -> "Cells":
        """Some of them, by their rows."""
        return Cells(**{name: array[rows] for name, array in vars(self).items()})

    def points(self) -> Float[np.ndarray, "C P 3"]:
        """The points' positions."""
        low, high = self.bounds[:, None, :3], self.bounds[:, None, 3:]
        return low + self.grid[..., :3] / STEPS * (high - low)

    def areas(self) -> Float[np.ndarray, "C P"]:
        """The points' areas."""
        share = self.grid[..., 3].astype(np.float64)
        return self.area[:, None] * share / np.maximum(share.sum(1, keepdims=True), 1)


@dataclass(frozen=True, eq=False)
class Sight:
    """C cells from V viewpoints."""

    apparent: Float[np.ndarray, "V C"]  # share of the picture's pixels if nothing hid them; 0: out of sight
    distance: Float[np.ndarray, "V C"]  # world units; NaN: out of sight


def describe_cells(g: Gaussians, labels: dict[int, int]) -> Cells:
    """The cells of Gaussians whose label ids are cell ids; `labels`: the label id of each."""
    means, ids = g.means.numpy().astype(np.float64), np.array(sorted(labels))
    axes = np.sort(np.exp(g.log_scales.numpy().astype(np.float64)), 1)[:, 1:]
    areas = axes.prod(1) * expit(g.logit_opacities.numpy().astype(np.float64))
    rows = [np.flatnonzero(g.label_ids.numpy() == cell) for cell in ids]
    found = [_described(means[own], areas[own]) for own in rows]
    columns = [np.stack(column) for column in zip(*found, strict=True)]
    return Cells(ids, np.array([labels[cell] for cell in ids.tolist()]), *columns)


def _described(
    means: Float[np.ndarray, "n 3"], areas: Float[np.ndarray, " n"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Bounds, grid, area and radius of one cell."""
    rng, total = np.random.default_rng(0), max(areas.sum(dtype=float), 1e-300)
    some, weight = np.arange(len(means)), areas
    if len(means) > _SAMPLE:
        some = rng.choice(len(means), _SAMPLE, p=areas / total if areas.any() else None)
        weight = np.full(_SAMPLE, total / _SAMPLE)
    points, nearest = means[some], np.arange(len(some))
    if len(some) > POINTS:  # equal places are no two centres
        points, nearest = np.unique(means[some], axis=0, return_inverse=True)
    if len(points) > POINTS:
        points, nearest = k_means(means[some], POINTS)
    mine = np.bincount(nearest, weight, len(points))
    radius = np.quantile(np.linalg.norm(means[some] - points[nearest], axis=1), _AROUND)
    kept = points[mine > 0] if (mine > 0).any() else points
    low, high = kept.min(0), kept.max(0)
    grid = np.zeros((POINTS, 4), np.uint8)
    inside = (np.clip(points, low, high) - low) / np.where(high > low, high - low, 1)
    grid[: len(points), :3] = np.round(inside * STEPS)
    grid[: len(points), 3] = np.ceil(mine / max(float(mine.max()), 1e-300) * STEPS)
    return np.concatenate([low, high]), grid, np.array(total), np.array(radius)


def look(cells: Cells, cameras: Sequence[Camera]) -> Sight:
    """How V cameras see the cells (formulas: the module's text)."""
    shape = len(cameras), len(cells.ids)
    apparent, distance = np.zeros(shape), np.full(shape, np.nan)
    for row, (camera, (away, weight)) in enumerate(zip(cameras, _seen(cells, cameras), strict=True)):
        solid, K = (weight / away**2).sum(1), camera.K.astype(np.float64)
        apparent[row] = solid * K[0, 0] * K[1, 1] / (camera.width * camera.height)
        distance[row] = _percentile(away, weight, PERCENTILE)
    return Sight(apparent, distance)


def reaching(cells: Cells, cameras: Sequence[Camera], shares: Float[np.ndarray, "V C"]) -> Cells:
    """The cells with larger radii where their Gaussians reach farther from the points than most of them are.

    `shares`: of the picture's pixels that each covers from V cameras. From where it covers a thousandth it is
    in sight: a cell that seems out of sight is drawn at its lowest level, which would spill over others.
    """
    radius, solid = cells.radius.copy(), cells.grid[..., 3] > 0
    for (_, height), share in zip(_heights(cells, cameras), shares, strict=True):
        outside = -np.where(solid, height, -np.inf).max(1)
        seen = (share >= _IN_SIGHT) & solid.any(1)  # without an area it is in sight from nowhere
        radius = np.maximum(radius, np.where(seen, outside / (1 - 2 * _AT_LEAST), 0))
    return replace(cells, radius=radius)


def label_distances(cells: Cells, cameras: Sequence[Camera]) -> Float[np.ndarray, "V L"]:
    """Distance of each label as a whole: a low percentile over the points of its cells; NaN: out of sight."""
    labels = np.unique(cells.labels)
    found = np.full((len(cameras), len(labels)), np.nan)
    for row, (away, weight) in enumerate(_seen(cells, cameras)):
        for column, label in enumerate(labels):
            mine = cells.labels == label
            found[row, column] = _percentile(
                away[mine].reshape(1, -1), weight[mine].reshape(1, -1), LABEL_PERCENTILE
            )[0]
    return found


def _seen(cells: Cells, cameras: Sequence[Camera]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For each camera the points' distances and their areas in sight, both [C, P]."""
    areas, radius = cells.areas(), np.maximum(cells.radius, 1e-9)[:, None]
    for away, height in _heights(cells, cameras):
        yield away, areas * np.clip(0.5 + height / (2 * radius), 0, 1)


def _heights(cells: Cells, cameras: Sequence[Camera]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For each camera the points' distances and least heights over the planes of its frustum, [C, P]."""
    points = cells.points()
    for camera in cameras:
        R, t = camera.w2c[:3, :3].astype(np.float64), camera.w2c[:3, 3].astype(np.float64)
        x, y, z = np.moveaxis(points @ R.T + t, -1, 0)
        K, size = camera.K.astype(np.float64), (camera.width, camera.height)
        height = z  # over the plane at the camera
        for along, axis in ((x, 0), (y, 1)):
            low = -K[axis, 2] / K[axis, axis]
            high = (size[axis] - K[axis, 2]) / K[axis, axis]
            height = np.minimum(height, (along - low * z) / np.hypot(1, low))
            height = np.minimum(height, (high * z - along) / np.hypot(1, high))
        yield np.maximum(np.sqrt(x**2 + y**2 + z**2), 1e-9), height


def _percentile(
    away: Float[np.ndarray, "C P"], weight: Float[np.ndarray, "C P"], part: float
) -> Float[np.ndarray, " C"]:
    """The first distance up to which there is this part of the weights; NaN without any."""
    order = np.argsort(away, 1, kind="stable")
    running: np.ndarray = np.cumsum(np.take_along_axis(weight, order, 1), 1)
    first = (running >= part * running[:, -1:]).argmax(1)
    near = np.take_along_axis(away, order, 1)[np.arange(len(order)), first]
    return np.where(running[:, -1] > 0, near, np.nan)


def write_cells(path: Path, cells: Cells) -> None:
    """cells.npz."""
    with atomic_path(path) as temporary:
        np.savez(temporary, allow_pickle=False, **vars(cells))


def read_cells(path: Path) -> Cells:
    """What `write_cells` wrote; DataError where the content cannot be used."""
    cure = f"{'delete it and ' if path.exists() else ''}run `sagesplat nest` again"
    try:
        with Npz(path) as file:
            arrays: dict[str, Any] = {field.name: file[field.name] for field in fields(Cells)}
        C = len(arrays["ids"])
        shapes = {"labels": (C,), "bounds": (C, 6), "grid": (C, POINTS, 4), "area": (C,), "radius": (C,)}
        if arrays["ids"].ndim != 1 or any(arrays[name].shape != shape for name, shape in shapes.items()):
            raise ValueError("arrays of unequal length")
        if (np.diff(arrays["ids"]) <= 0).any() or arrays["grid"].dtype != np.uint8:
            raise ValueError("ids or points out of range")
        whole = {name: arrays[name].astype(np.int64) for name in ("ids", "labels")}
        real = {name: arrays[name].astype(np.float64) for name in ("bounds", "area", "radius")}
        if not all(np.isfinite(value).all() for value in real.values()) or (real["area"] < 0).any():
            raise ValueError("numbers out of range")
    except (OSError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path}: not a file of cells ({short(repr(error))}); {cure}") from None
    return Cells(**(arrays | whole | real))
