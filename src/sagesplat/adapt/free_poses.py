"""Poses that a splat can be looked at from, as `free_viewpoints` says: around an object, inside of a place.

All is in the units of `free_space.Cloud`. Each class gives poses (world to camera) in the order of a
low-discrepancy sequence, without end or until a place is searched through.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64
from scipy.special import ndtri

from sagesplat.adapt.free_space import Cloud, Space, sphere
from sagesplat.adapt.upright import Upright
from sagesplat.core.geometry import weighted_quantile

RAYS = sphere(128)
CLEAR = 0.1  # units; nothing is closer to where one stands, but for a twentieth of all directions
_LEVEL = 0.35  # sine of the elevation up to which a direction counts as level

_FRAMED = 0.98  # of an object is within its radius, and in the frame
_BACKGROUND = 8.0  # units; what is farther is no part of an object
_MOST = 200_000  # Gaussians of an object that its size is measured by
_PARTS = 2000  # of an object, that frames are fitted to
_DISTANCES = (0.6, 2.0)  # times the one at which the object fits
_ELEVATIONS = (-20.0, 70.0)  # degrees
_OVER_FLOOR = 5.0  # lowest elevation over a floor, degrees

_REACH = 1.25  # units around the centre in which one stands
_EYES = (0.12, 0.5)  # height over the floor, units
_HORIZON, _GROUND = 0.6, 0.75  # of level directions, and of those below, show something
_TILT = (-10.0, 12.0)  # mean and standard deviation of the elevation of a view in a place, degrees
_STEEPEST = 40.0  # degrees
_AZIMUTHS = 24
_SHARPEST = 0.4  # of where one can stand has finer Gaussians in sight than a viewpoint may have
_BLUR = 0.7  # a view may be this much blurrier than that, logarithm
_PROBES = 1000  # points that this is measured at
_BATCH = 512
_MOST_BATCHES = 60


def sequence(seed: int, start: int, count: int) -> Float64[np.ndarray, "count 6"]:
    """A part of a low-discrepancy sequence in the unit cube, shifted by the seed.

    The first column are multiples of the golden ratio, the others van der Corput's sequences of primes.
    """
    numbers = np.arange(start + 1, start + count + 1)
    columns = [numbers * (np.sqrt(5) - 1) / 2, *(_van_der_corput(numbers, base) for base in (2, 3, 5, 7, 11))]
    return (np.stack(columns, axis=1) + np.random.default_rng(seed).random(len(columns))) % 1


def _van_der_corput(numbers: np.ndarray, base: int) -> np.ndarray:
    """The numbers' digits, mirrored at the point."""
    found, place, left = np.zeros(len(numbers)), 1.0, numbers.copy()
    while left.any():
        place /= base
        left, digits = np.divmod(left, base)
        found += digits * place
    return found


def looking(position: np.ndarray, direction: np.ndarray, up: np.ndarray) -> Float64[np.ndarray, "4 4"]:
    """World-to-camera of a camera without roll."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(z, up)
    if np.linalg.norm(x) < 1e-6:
        x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    x /= np.linalg.norm(x)
    w2c = np.eye(4)
    w2c[:3, :3] = x, np.cross(z, x), z
    w2c[:3, 3] = -w2c[:3, :3] @ position
    return w2c


def level_axes(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two directions that are perpendicular to `up` and to each other."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    return first, np.cross(up, first)


class Orbits:
    """Poses around an object, in the scene's units."""

    def __init__(self, cloud: Cloud, upward: Upright, K: np.ndarray, size: tuple[int, int], seed: int):
        self.up, self.seed = upward.up, seed
        rows = np.flatnonzero(np.linalg.norm(cloud.means, axis=1) < _BACKGROUND)
        cloud = cloud.select(rows[:: 1 + len(rows) // _MOST])
        weight = np.minimum(cloud.area, weighted_quantile(cloud.area, cloud.area + 1e-30, 0.9)) + 1e-30
        axes = np.stack([*level_axes(self.up), self.up])
        along = cloud.means @ axes.T
        ends = [[weighted_quantile(column, weight, q) for q in (1 - _FRAMED, _FRAMED)] for column in along.T]
        self.centre = np.mean(ends, axis=1) @ axes
        reach = np.linalg.norm(cloud.means - self.centre, axis=1) + cloud.breadths[:, 1]
        self.radius = float(weighted_quantile(reach, weight, _FRAMED))
        rows = np.searchsorted(np.cumsum(weight), (np.arange(_PARTS) + 0.5) / _PARTS * weight.sum())
        rows = np.minimum(rows, len(cloud) - 1)
        inside = reach[rows] <= self.radius
        self.parts = (cloud.means[rows] - self.centre)[inside]
        self.thickness = cloud.breadths[rows, 1][inside]
        self.frame = 2 * K[[0, 1], [0, 1]] / size  # of a point's offset over its depth, 1 at the edge
        self.lowest = np.radians(_OVER_FLOOR if upward.floor else _ELEVATIONS[0])

    def poses(self) -> Iterator[np.ndarray]:
        """World to camera, [4, 4] each, without end."""
        first, second = level_axes(self.up)
        low, high = np.sin(self.lowest), np.sin(np.radians(_ELEVATIONS[1]))
        start = 0
        while True:
            for turn, rise, far, part, *_ in sequence(self.seed, start, _BATCH):
                sine, turn = low + (high - low) * rise, 2 * np.pi * turn
                level = np.cos(turn) * first + np.sin(turn) * second
                factor = _DISTANCES[0] * (_DISTANCES[1] / _DISTANCES[0]) ** far
                target = self.centre + max(0.1, 1 - factor) * self.parts[int(part * len(self.parts))]
                away = sine * self.up + np.sqrt(1 - sine**2) * level
                position = self.centre + factor * self._fitting(away) * away
                yield looking(position, target - position, self.up)
            start += _BATCH

    def _fitting(self, away: np.ndarray) -> float:
        """The distance from the centre at which most parts are in the frame, seen from a direction."""
        axes = looking(away, -away, self.up)[:3, :3]
        local = self.parts @ axes.T
        needed = ((np.abs(local[:, :2]) + self.thickness[:, None]) * self.frame).max(1) - local[:, 2]
        return max(float(np.quantile(needed, _FRAMED)), self.thickness.max(), 1e-6)


class Standing:
    """Poses in the free space of a place, in the scene's units."""

    centre, radius = np.zeros(3), 1.0

    def __init__(self, space: Space, upward: Upright, K: np.ndarray, size: tuple[int, int], seed: int):
        self.space, self.up, self.floor, self.seed = space, upward.up, upward.floor, seed
        self.cosine = np.cos(np.arctan(0.5 * max(size) / K[0, 0]))
        self.rise = RAYS @ self.up
        self.sharp = np.inf
        points = _REACH * (2 * sequence(seed, 0, _PROBES)[:, 1:4] - 1)
        blur, _, stands = self._facts(points)
        if stands.any():
            self.sharp = float(np.quantile(blur[stands], _SHARPEST))

    def poses(self) -> Iterator[np.ndarray]:
        """World to camera, [4, 4] each."""
        for batch in range(_MOST_BATCHES):
            drawn = sequence(self.seed, batch * _BATCH, _BATCH)
            points = _REACH * (2 * drawn[:, 1:4] - 1)
            blur, detail, stands = self._facts(points)
            for row in np.flatnonzero(stands & (blur <= self.sharp)):
                direction = self._direction(detail[row], *drawn[row, [0, 4]])
                if np.median(detail[row][RAYS @ direction > self.cosine]) > np.exp(-self.sharp - _BLUR):
                    yield looking(points[row], direction, self.up)

    def _facts(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Blur [P], detail [P, rays], and whether one can stand there [P]."""
        distance, log_size = self.space.look(points, RAYS)
        hits = np.isfinite(distance)
        with np.errstate(invalid="ignore"):
            log_angle = np.where(hits, log_size - np.log(distance), np.inf)  # of the Gaussians that are seen
        detail = np.where(hits, np.exp(-np.maximum(log_angle, -10)), 0)
        blur = np.full(len(points), np.inf)
        for row in np.flatnonzero(hits.any(1)):
            blur[row] = np.median(log_angle[row, hits[row]])
        below = self.rise < -_LEVEL
        stands = np.quantile(distance, 0.05, axis=1, method="nearest") > CLEAR
        stands &= hits[:, np.abs(self.rise) < _LEVEL].mean(1) > _HORIZON
        stands &= np.linalg.norm(points, axis=1) < _REACH
        if self.floor:
            drop = distance * -self.rise
            under = np.median(drop[:, self.rise < -0.8], axis=1)
            around = np.median(drop[:, below], axis=1)  # or one would stand on hedges
            stands &= (under > _EYES[0]) & (np.maximum(under, around) < _EYES[1])
            stands &= hits[:, below].mean(1) > _GROUND
        return blur, detail, stands

    def _direction(self, detail: np.ndarray, turn: float, rise: float) -> np.ndarray:
        """A direction of view: finer Gaussians make its azimuth likelier; its elevation is near the level."""
        first, second = level_axes(self.up)
        tilt = float(ndtri(np.clip(rise, 1e-6, 1 - 1e-6)))
        tilt = np.radians(np.clip(_TILT[0] + _TILT[1] * tilt, -_STEEPEST, _STEEPEST))
        angles = 2 * np.pi * (np.arange(_AZIMUTHS + 1) / _AZIMUTHS)
        level = np.cos(angles[:-1, None]) * first + np.sin(angles[:-1, None]) * second
        views = np.cos(tilt) * level + np.sin(tilt) * self.up
        capped = np.minimum(detail, np.quantile(detail, 0.98))
        weight = [capped[RAYS @ view > self.cosine].sum() for view in views]
        sums = np.cumsum([0.0, *np.add(weight, 1e-9)])
        angle = np.interp(turn * sums[-1], sums, angles)
        return np.cos(tilt) * (np.cos(angle) * first + np.sin(angle) * second) + np.sin(tilt) * self.up
