"""Which way is up in a splat: the normal of its floor, or the convention of COLMAP's axes (-y)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from sagesplat.adapt.free_space import Cloud, sphere
from sagesplat.core.errors import RunError, short

AXES = dict(zip("xyz", np.eye(3), strict=True))
AXES |= {f"-{axis}": -row for axis, row in AXES.items()}
CONVENTION = "-y"
_WITHIN = 2.0  # units from the centre
_LARGEST = 0.04  # square units that one Gaussian counts for
_FLAT = 0.5  # thinnest over middle radius of what has a normal
_ALIGNED = 0.9  # cosine of a floor's normals with its own
_STEP = 0.03  # units; a floor is three of these thick
_LEAST_FLOOR = {"place": 0.06, "object": 0.15}  # of all area is in a floor; objects have flat backs
_MOST_BELOW = 0.15  # of all area lies below a floor
_MOST = 200_000  # Gaussians that floors are looked for among
_LOOKED_AT = 50_000  # Gaussians, for a first guess
_PREFERRED = 0.5  # a floor of the convention may be so much smaller than the best


@dataclass(frozen=True, eq=False)
class Upright:
    """The up direction, and why."""

    up: Float64[np.ndarray, "3"]  # unit vector, world
    floor: bool  # whether there is a floor, with next to nothing below it
    reason: str


@dataclass(frozen=True, eq=False)
class _Floor:
    normal: Float64[np.ndarray, "3"]  # area-weighted mean of its Gaussians' normals
    share: float  # of all area
    below: float  # share of all area that lies below


def upright(
    cloud: Cloud, kind: Literal["object", "place"], given: str | Float64[np.ndarray, "3"] = "auto"
) -> Upright:
    """The up direction of a cloud.

    A floor is a slab with much of the area, whose Gaussians are flat along it, and with next to nothing
    below. The largest one decides; one within 45 degrees of the convention may be half as large, since a wall
    looks the same.

    Args:
        cloud: The Gaussians' bodies.
        kind: What they show.
        given: "auto", one of AXES, or a vector of any length.

    Raises:
        RunError: For a direction that is none.
    """
    floors = _Floors(cloud)
    if isinstance(given, str) and given == "auto":
        return _found(floors, _LEAST_FLOOR[kind])
    if isinstance(given, str) and given not in AXES:
        raise RunError(f"--up {short(given)} is no direction; choose auto, {', '.join(AXES)}")
    up = AXES[given] if isinstance(given, str) else np.asarray(given, np.float64)
    length = float(np.linalg.norm(up)) if up.shape == (3,) else 0.0
    if not 0 < length < np.inf:
        raise RunError("up has to be a vector of three numbers that are not all zero; choose 0 -1 0, say")
    up = up / length
    return Upright(up, _is_floor(floors.along(up), _LEAST_FLOOR[kind]), f"up is {_named(up)}, as given")


def _found(floors: "_Floors", least: float) -> Upright:
    peak = floors.peak()
    along = [floors.converged(normal) for normal in (*AXES.values(), peak, -peak)]
    along = [floor for floor in along if _is_floor(floor, least)]
    if not along:
        return Upright(AXES[CONVENTION], False, f"up is {CONVENTION} (the convention; no floor stands out)")
    best = max(along, key=lambda floor: floor.share)
    typical = [floor for floor in along if floor.normal @ AXES[CONVENTION] > np.sqrt(0.5)]
    typical = [floor for floor in typical if floor.share > _PREFERRED * best.share]
    best = max(typical, key=lambda floor: floor.share, default=best)
    named = _named(best.normal)
    return Upright(best.normal, True, f"up is {named} (normal of a floor, {best.share:.0%} of the area)")


def _is_floor(floor: _Floor, least: float) -> bool:
    return floor.share > least and floor.below < _MOST_BELOW


def _named(up: np.ndarray) -> str:
    name, axis = max(AXES.items(), key=lambda item: item[1] @ up)
    if axis @ up > np.cos(np.radians(0.5)):
        return name
    tilt = np.degrees(np.arccos(axis @ up))
    return f"({', '.join(f'{value:.2f}' for value in up)}), {tilt:.0f} degrees from {name}"


class _Floors:
    """Looks for floors among the Gaussians around the centre."""

    def __init__(self, cloud: Cloud):
        near = np.flatnonzero(np.linalg.norm(cloud.means, axis=1) < _WITHIN)
        near = near[:: 1 + len(near) // _MOST]
        self.means, self.normals = cloud.means[near], cloud.normals[near]
        self.area = np.minimum(cloud.area[near], _LARGEST)
        self.flat = cloud.breadths[near, 0] < _FLAT * cloud.breadths[near, 1]
        self.total = float(self.area.sum()) or 1.0

    def peak(self) -> np.ndarray:
        """The direction that most flat Gaussians' normals are close to, of either sign."""
        some = slice(None, None, 1 + len(self.area) // _LOOKED_AT)
        area, normals, directions = (self.area * self.flat)[some], self.normals[some], sphere(600)
        found = [area @ (np.abs(normals @ direction) > 0.95) for direction in directions]
        return directions[int(np.argmax(found))]

    def converged(self, normal: np.ndarray) -> _Floor:
        """The floor along a direction, its own normal taken as the direction again."""
        floor = self.along(normal)
        for _ in range(3):
            floor = self.along(floor.normal)
        return floor

    def along(self, normal: np.ndarray) -> _Floor:
        """The slab along a direction that holds the most area of Gaussians that are flat in it."""
        height, cosine = self.means @ normal, self.normals @ normal
        aligned = self.flat & (np.abs(cosine) > _ALIGNED)
        edges = np.arange(-_WITHIN, _WITHIN + _STEP, _STEP)
        counts = np.histogram(height[aligned], edges, weights=self.area[aligned])[0]
        slabs = counts[:-2] + counts[1:-1] + counts[2:]
        at = int(slabs.argmax())
        low, high = edges[at], edges[at + 3]
        own = aligned & (height >= low) & (height < high)
        sums = (self.normals[own] * (self.area[own] * np.sign(cosine[own]))[:, None]).sum(0)
        length = float(np.linalg.norm(sums))
        below = float(self.area[height < low - 2 * _STEP].sum()) / self.total
        return _Floor(sums / length if length else normal, float(slabs[at]) / self.total, below)
