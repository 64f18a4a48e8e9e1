"""The colours that photos show of the same points of structure from motion."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene

_DARK, _BRIGHT = 10.0, 245.0  # of 255; values beyond tell nothing of the light
_PLENTY = 400  # observations of a photo, on average, that are used


@dataclass(frozen=True, eq=False)
class TrackColours:
    """T observations of points, each point in two photos or more."""

    points: Int64[np.ndarray, " T"]  # numbered from 0 on
    views: Int64[np.ndarray, " T"]  # places in the rows that were asked for
    uv: Float64[np.ndarray, "T 2"]  # px
    colours: Float64[np.ndarray, "T 3"]  # RGB in [0, 1], mean of 3 x 3 pixels


def track_colours(scene: Scene, photos: Photos | Sequence[np.ndarray], rows: Sequence[int]) -> TrackColours:
    """What some photos (rows of `scene.views`) show of points that are neither dark nor saturated there."""
    tracks = scene.points
    place = np.full(len(scene.views), -1)
    place[list(rows)] = np.arange(len(rows))
    mine = _some(tracks.track_points, np.flatnonzero(place[tracks.track_views] >= 0), len(rows))
    views = place[tracks.track_views[mine]]
    order = np.argsort(views, kind="stable")
    mine, views = mine[order], views[order]
    u, v = np.floor(tracks.track_uv[mine]).astype(np.int64).T
    mean, ends = np.zeros((len(mine), 3)), np.searchsorted(views, np.arange(len(rows) + 1))
    for row, begin, end in zip(rows, ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        if begin < end:
            mean[begin:end] = _around(photos[row], u[begin:end], v[begin:end])
    fine = np.flatnonzero(((mean > _DARK) & (mean < _BRIGHT)).all(1))
    _, points, seen = np.unique(tracks.track_points[mine[fine]], return_inverse=True, return_counts=True)
    fine, points = fine[seen[points] > 1], points[seen[points] > 1]
    _, points = np.unique(points, return_inverse=True)
    return TrackColours(points, views[fine], tracks.track_uv[mine[fine]].astype(np.float64), mean[fine] / 255)


def _some(
    track_points: Int64[np.ndarray, " T"], candidates: Int64[np.ndarray, " C"], photos: int
) -> Int64[np.ndarray, " S"]:
    """Observations of points that have two or more: of every n-th such point where there are plenty."""
    points = track_points[candidates]
    every = max(1, len(candidates) // (_PLENTY * max(1, photos)))
    shared = np.bincount(points) > 1
    chosen = shared & (np.cumsum(shared) % every == 0)
    return candidates[chosen[points]]


def _around(
    photo: UInt8[np.ndarray, "H W 3"], u: Int64[np.ndarray, " T"], v: Int64[np.ndarray, " T"]
) -> Float64[np.ndarray, "T 3"]:
    """Means of 3 x 3 pixels, of 255; 0 where they are not all in the photo."""
    height, width = photo.shape[:2]
    found = np.zeros((len(u), 3))
    inside = np.flatnonzero((u >= 1) & (v >= 1) & (u < width - 1) & (v < height - 1))
    u, v, sums = u[inside], v[inside], np.zeros((len(inside), 3))
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            sums += photo[v + i, u + j]
    found[inside] = sums / 9
    return found
