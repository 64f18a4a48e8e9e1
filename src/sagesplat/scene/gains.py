"""How exposure and white balance differ between photos, from the colours that they show of the same points.

sRGB's curve is v = 1.055 L^(1/2.4) - 0.055 but for the darkest colours. So light times a gain is, in stored
values, (v + 0.055) times gain^(1/2.4): what is fitted here is that factor, for each photo and channel.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy.sparse import csr_array
from scipy.sparse.linalg import LinearOperator, cg

from sagesplat.core.sh import bases
from sagesplat.scene.exif import exposure_of
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.scene.track_colours import track_colours
from sagesplat.scene.vignetting import CURVE, OFFSET

_ROUNDS = 10  # of iteratively reweighted least squares
_PRIOR = 0.3  # observations that say of every photo that it has no gain
_ENOUGH = 30  # observations of a photo, on average, at least
_RIDGE = 0.01  # of the harmonics fitted to log gains
_BY_DIRECTION = 0.5  # share of the variance of exposures: with more the direction tells most of it
_EXPLAINED = 0.08  # least share by which gains have to bring colours of the same point together
_LEAST_EV = 0.1  # range of exposures that is worth a transform
_LEAST_EXIF_EV = 0.3  # the same where nothing but EXIF tells it


def exposure_values(transforms: Float[np.ndarray, "V 3 4"]) -> Float[np.ndarray, " V"]:
    """How much brighter colour transforms make a middle grey, EV."""
    grey = transforms[:, :, :3].sum(2) * 0.5 + transforms[:, :, 3]
    return CURVE * np.log2(np.maximum(grey + OFFSET, 1e-3) / (0.5 + OFFSET)).mean(1)


@dataclass(frozen=True, eq=False)
class Gains:
    """Exposure and white balance of V photos relative to their mean."""

    gain: Float32[np.ndarray, "V 3"]  # of stored value + 0.055 in [0, 1]; mean 1 over the photos
    source: Literal["tracks", "EXIF", "nothing"]
    # of tracks only, cross-validated: the share by which the spread of a point's colours falls,
    # and the share of the variance of exposures that the viewing direction tells
    explained: float = 0.0
    by_direction: float = 0.0

    @property
    def ev(self) -> Float32[np.ndarray, " V"]:
        """Exposure of each photo relative to the mean, EV."""
        ev = CURVE * np.log2(self.gain).mean(1)
        return ev - ev.mean()

    @property
    def range_ev(self) -> float:
        """From the darkest to the brightest photo."""
        return float(np.ptp(self.ev))

    @property
    def differ(self) -> bool:
        """Whether the photos differ by more than noise and what depends on the viewing direction."""
        if self.source == "EXIF":
            return self.range_ev > _LEAST_EXIF_EV
        return self.vary and self.by_direction <= _BY_DIRECTION

    @property
    def follow_direction(self) -> bool:
        """Whether the photos differ, but the viewing direction tells most of it.

        Photos towards the sun are darker, all of them. The harmonics of the model explain that, for photos
        that nobody has seen too; transforms would only take it from the model.
        """
        return self.vary and self.by_direction > _BY_DIRECTION

    @property
    def vary(self) -> bool:
        """Whether tracks tell that the photos differ, whatever by."""
        return self.explained > _EXPLAINED and self.range_ev > _LEAST_EV

    def transforms(self) -> Float32[np.ndarray, "V 3 4"]:
        """The gains as affine transforms of colours, whose mean over the photos is the identity."""
        found = np.zeros((len(self.gain), 3, 4), np.float32)
        found[:, range(3), range(3)] = self.gain
        found[:, :, 3] = OFFSET * (self.gain - 1)
        return found


def photo_gains(scene: Scene, photos: Photos | Sequence[np.ndarray], rows: Sequence[int]) -> Gains:
    """Gains of some photos (rows of `scene.views`): from tracks, else from EXIF, else none."""
    tracks = track_colours(scene, photos, rows)
    points, views = tracks.points, tracks.views
    if len(points) >= _ENOUGH * len(rows):
        logs = np.log(tracks.colours + OFFSET)

        def fit(some: slice | np.ndarray) -> Float64[np.ndarray, "V 3"]:
            of_channel = (log_gains(points[some], views[some], log[some], len(rows)) for log in logs.T)
            return np.stack([*of_channel], 1)

        explained = cross_validated(points, logs, lambda a, b: logs[b] - fit(a)[views[b]])
        gains = fit(slice(None))
        forward = np.stack([scene.views[row].camera.w2c[2, :3] for row in rows]).astype(np.float64)
        return Gains(_relative(gains), "tracks", explained, _by_direction(gains.mean(1), forward))
    ev = [exposure_of(scene.views[row].image_path) for row in rows]
    if ev and all(value is not None for value in ev):
        found = np.array(ev, np.float64)[:, None].repeat(3, 1) * np.log(2) / CURVE
        return Gains(_relative(found), "EXIF")
    return Gains(np.ones((len(rows), 3), np.float32), "nothing")


def _by_direction(gains: Float64[np.ndarray, " V"], forward: Float64[np.ndarray, "V 3"]) -> float:
    """Share of the variance of log gains that harmonics of the direction tell, fitted to the other photos."""
    basis = np.stack(np.broadcast_arrays(*bases(*forward.T)), 1)
    fit = basis @ np.linalg.solve(basis.T @ basis + _RIDGE * np.eye(basis.shape[1]), basis.T)
    own = fit.diagonal()
    missed = (gains - fit @ gains) / np.maximum(1 - own, 1e-3)  # each by a fit that leaves it out
    return float(1 - missed.var() / max(gains.var(), 1e-12))


def _relative(logs: Float64[np.ndarray, "V 3"]) -> Float32[np.ndarray, "V 3"]:
    gain = np.exp(np.clip(logs - logs.mean(0), -3, 3))
    return (gain / gain.mean(0)).astype(np.float32)


def log_gains(
    points: Int64[np.ndarray, " T"],
    views: Int64[np.ndarray, " T"],
    logs: Float64[np.ndarray, " T"],
    count: int,
) -> Float64[np.ndarray, " V"]:
    """Minimise the robust sum of (log value - gain of the photo - colour of the point)^2; the gains.

    Geman-McClure weights; the points are eliminated, so that what is solved has a row for each photo.
    """
    num = int(points.max()) + 1
    order = np.argsort(points, kind="stable")
    points, views, logs = points[order], views[order], logs[order]
    begins = np.concatenate([[0], np.cumsum(np.bincount(points))])
    gain, weight = np.zeros(count), np.ones(len(logs))
    for _ in range(_ROUNDS):
        table = csr_array((weight, views, begins), shape=(num, count))
        per_point = np.maximum(np.bincount(points, weight), 1e-9)
        per_view = np.bincount(views, weight, count)
        point_sums, view_sums = np.bincount(points, weight * logs), np.bincount(views, weight * logs, count)

        def eliminated(x: np.ndarray, table=table, per_point=per_point, per_view=per_view) -> np.ndarray:
            return (per_view + _PRIOR) * x - table.T @ (table @ x / per_point)  # not multiplied out

        matrix = LinearOperator((count, count), eliminated, dtype=np.float64)  # type: ignore
        gain, _ = cg(matrix, view_sums - table.T @ (point_sums / per_point), x0=gain, rtol=1e-4)
        colour = (point_sums - table @ gain) / per_point
        errors = logs - gain[views] - colour[points]
        scale = 2 * 1.4826 * float(np.median(np.abs(errors))) + 1e-4
        weight = 1 / (1 + (errors / scale) ** 2) ** 2
    return gain


def cross_validated(
    points: Int64[np.ndarray, " T"],
    logs: Float64[np.ndarray, "T C"],
    left: Callable[[Bool[np.ndarray, " T"], Bool[np.ndarray, " T"]], np.ndarray],
) -> float:
    """Share by which a fit to half of the points brings together the colours of the others.

    `left`: what the fit to the first observations leaves of the logs of the second.
    """
    before, after = 0.0, 0.0
    for half in (0, 1):
        fitted, other = points % 2 == half, points % 2 != half
        before += spread(points[other], logs[other])
        after += spread(points[other], left(fitted, other))
    return 1 - after / max(before, 1e-12)


def spread(points: Int64[np.ndarray, " T"], logs: Float64[np.ndarray, "T C"]) -> float:
    """Median distance of a point's colours from their mean, over all observations."""
    seen = np.bincount(points)
    means = np.stack([np.bincount(points, channel) for channel in logs.T], 1) / np.maximum(seen, 1)[:, None]
    return float(np.median(np.abs(logs - means[points])))
