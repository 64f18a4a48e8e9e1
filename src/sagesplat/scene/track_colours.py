"""The colours that photos show of the same points of structure from motion."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

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
    tracks, no = scene.points, np.zeros(0, np.int64)
    points, views, places, colours = [no], [no], [np.zeros((0, 2))], [np.zeros((0, 3))]
    order = np.argsort(tracks.track_views, kind="stable")
    ends = np.searchsorted(tracks.track_views[order], [(row, row + 1) for row in rows]).reshape(-1, 2)
    for number, (row, (begin, end)) in enumerate(zip(rows, ends.tolist(), strict=True)):
        if begin == end:
            continue
        mine, photo = order[begin:end], photos[row]
        u, v = np.floor(tracks.track_uv[mine]).astype(np.int64).T
        inside = (u >= 1) & (v >= 1) & (u < photo.shape[1] - 1) & (v < photo.shape[0] - 1)
        mine, u, v = mine[inside], u[inside], v[inside]
        around = [photo[v + i, u + j].astype(np.float64) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        mean = np.mean(around, 0) if len(mine) else np.zeros((0, 3))
        fine = ((mean > _DARK) & (mean < _BRIGHT)).all(1)
        points.append(tracks.track_points[mine[fine]])
        views.append(np.full(int(fine.sum()), number))
        places.append(tracks.track_uv[mine[fine]].astype(np.float64))
        colours.append(mean[fine] / 255)
    _, point, seen = np.unique(np.concatenate(points), return_inverse=True, return_counts=True)
    every = max(1, len(point) // (_PLENTY * max(1, len(rows))))
    shared = (seen[point] > 1) & (point % every == 0) if len(point) else np.zeros(0, bool)
    _, of = np.unique(point[shared], return_inverse=True)
    return TrackColours(
        of, np.concatenate(views)[shared], np.concatenate(places)[shared], np.concatenate(colours)[shared]
    )
