"""Bounding boxes of a category, and its distance from a camera by them: the viewer has no points.

Splitting: outliers are removed, that is, points whose 8th nearest neighbour is more than FAR times the median
of that distance away. The rest is halved at the median of its longest axis, recursively, into at most MOST
parts of equal counts. A part's box extends from the 5th to the 95th percentile of its points on each axis.

Distance, from a camera's position and the half spaces of its frustum: each box is sampled at 27 points, at
1/6, 1/2 and 5/6 of each axis. The distance is the 5th percentile (numpy's, linear) over the samples of all
boxes that lie in all half spaces. If there are none, but boxes touch the frustum, it is the distance of the
nearest centre of those boxes. Else it is NaN: out of sight. A box touches the frustum if in each half space
its deepest corner is inside.

Models know distances in photos, and in pictures of the same area and other shapes. A window may be higher or
wider than any of them and show what lies at one's feet. So samples count inside the frustum of their lens
(`widest_lens`) at the same pose; where that has none, inside the window's.
"""

import math

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

MOST = 32  # boxes of a category, a power of two
PERCENTILE = 5.0  # of distances, as in adapt.observe
TRIM = (5.0, 95.0)  # percentiles of the points at a box's faces
FAR = 5.0  # times the median distance of the NEIGHBOURS-th neighbour: outliers are beyond
NEIGHBOURS = 8
FEW = 20  # points; outliers of fewer are kept
_AT = np.array([1 / 6, 1 / 2, 5 / 6])
_GRID = np.stack(np.meshgrid(_AT, _AT, _AT, indexing="ij"), -1).reshape(-1, 3)


def split_boxes(points: Float[np.ndarray, "N 3"], most: int = MOST) -> Float[np.ndarray, "B 6"]:
    """At most `most` boxes (smallest x y z, largest x y z) around N points, with about equal counts."""
    if not len(points):
        return np.zeros((0, 6))
    parts = _halved(_without_outliers(np.asarray(points, np.float64)), most)
    return np.stack([np.percentile(part, TRIM, axis=0).ravel() for part in parts])


def frustum(
    position: ArrayLike, quaternion: ArrayLike, fov_y: float, aspect: float
) -> Float[np.ndarray, "5 4"]:
    """Half spaces (nx, ny, nz, d) of a view frustum, n x + d >= 0 inside: left, right, bottom, top, front.

    `quaternion`: x y z w, camera to world, for a camera that looks along -z with y up. `fov_y`: radians.
    `aspect`: width over height. The near plane is at the camera; there is no far plane.
    """
    high = math.tan(fov_y / 2)
    wide = high * aspect
    normals = np.array([[1, 0, -wide], [-1, 0, -wide], [0, 1, -high], [0, -1, -high], [0, 0, -1]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    world = normals @ _rotation(quaternion).T
    return np.column_stack([world, -world @ np.asarray(position, np.float64)])


def photo_frustum(
    position: ArrayLike, quaternion: ArrayLike, fov_y: float, aspect: float, lens: tuple[float, float]
) -> Float[np.ndarray, "5 4"]:
    """`frustum`, but no wider and no higher than `lens` (`adapt.observe.widest_lens`)."""
    high = math.tan(fov_y / 2)
    wide, high = min(high * aspect, lens[0]), min(high, lens[1])
    return frustum(position, quaternion, 2 * math.atan(high), wide / high)


def touching(boxes: Float[np.ndarray, "B 6"], planes: Float[np.ndarray, "P 4"]) -> Bool[np.ndarray, " B"]:
    """Which boxes touch the frustum of the half spaces; all do if there are no half spaces."""
    normals, offsets = planes[:, None, :3], planes[:, None, 3]
    deepest = np.where(normals >= 0, boxes[None, :, 3:], boxes[None, :, :3])
    return ((deepest * normals).sum(-1) + offsets >= 0).all(0)


def distance(
    boxes: Float[np.ndarray, "B 6"],
    position: ArrayLike,
    planes: Float[np.ndarray, "P 4"],
    photo: Float[np.ndarray, "P 4"] | None = None,
) -> float:
    """Distance of the visible boxes (see the module's docstring), world units; NaN: out of sight.

    `planes`: half spaces of the window's frustum. `photo`: those of the photos' lens, within them; None: the
    window is that of a photo.
    """
    near, position = boxes[touching(boxes, planes)], np.asarray(position, np.float64)
    if not len(near):
        return math.nan
    low, size = near[:, None, :3], near[:, None, 3:] - near[:, None, :3]
    samples = (low + _GRID * size).reshape(-1, 3)
    inside = np.zeros(len(samples), bool)
    for lens in (planes,) if photo is None else (photo, planes):
        if not inside.any():
            inside = (samples @ lens[:, :3].T + lens[:, 3] >= 0).all(1)
    if not inside.any():
        centres = (near[:, :3] + near[:, 3:]) / 2
        return float(np.linalg.norm(centres - position, axis=1).min())
    return float(np.percentile(np.linalg.norm(samples[inside] - position, axis=1), PERCENTILE))


def _without_outliers(points: np.ndarray) -> np.ndarray:
    if len(points) < FEW:
        return points
    spacing = np.asarray(KDTree(points).query(points, k=NEIGHBOURS + 1)[0])[:, -1]
    return points[spacing <= FAR * np.median(spacing)]


def _halved(points: np.ndarray, most: int) -> list[np.ndarray]:
    if most < 2 or len(points) < 2:
        return [points]
    order = np.argsort(points[:, np.ptp(points, axis=0).argmax()], kind="stable")
    half = (len(points) + 1) // 2
    return [part for rows in (order[:half], order[half:]) for part in _halved(points[rows], most // 2)]


def _rotation(quaternion: ArrayLike) -> np.ndarray:
    """Rotation matrix [3, 3] of a quaternion x y z w of any length."""
    x, y, z, w = np.asarray(quaternion, np.float64) / np.linalg.norm(np.asarray(quaternion))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
