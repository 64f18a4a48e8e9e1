"""promises-*.json: the viewpoint models of all categories for one quality, small enough to be sent.

A mean over the viewpoint is written as its values at the model's views, not as weights. Weights cancel each
other and need many digits; a value that is rounded moves the mean by about as much. A reader solves for them
(`viewer.sent_model`). An offset holds what does not depend on the viewpoint: the mean of fidelity, and what
views differ by that training never saw. Numbers are whole steps of a unit. The shared views, and the photos,
are in the order of a path from each to the nearest one left, and lists over them hold differences to the one
before: most are small. Values hold differences to the level below as well.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import lstsq
from scipy.spatial.distance import cdist

from sagesplat.adapt.process import matern32
from sagesplat.adapt.viewpoint import Calibration, Prediction, QualityKind, ViewModel, where
from sagesplat.scene.scene import Camera
from sagesplat.viewer.quality import curve_entry, significant
from sagesplat.viewer.sent_model import (
    AXES,
    CORRECTION_STEP,
    STEP,
    STEPS_PER_UNIT,
    covariance,
    inputs_of_entry,
    model_of_entry,
)

MAX_ROUNDING_CHANGE = 5e-4  # of a mean, in any of the model's views and halfway to the next one; or
RELATIVE_ROUNDING = 1e-2  # this part of what is missing to 1, if that is more
MOST_VIEWS = 1024  # of a model; of more every second, third, ... is sent: a browser solves for the weights
# units of log distances and of values, the coarsest first
_UNITS = ((1e-2, 1e-3), (5e-3, 7e-4), (5e-3, 5e-4), (2e-3, 5e-4), (1e-3, 3e-4), (5e-4, 1e-4), (1e-5, 1e-5))


@dataclass(frozen=True, eq=False)
class Seen:
    """A category in V viewpoints."""

    shares: Float[np.ndarray, " V"]  # of the image's pixels; 0: too few to count
    distance: Float[np.ndarray, " V"]  # d_min, world units; NaN: unknown
    corrections: Float[np.ndarray, " V"] | None = None  # log of d_min over the distance by boxes; None: 0


def promises_document(
    quality: QualityKind, models: Mapping[int, ViewModel], cameras: Sequence[Camera], seen: Mapping[int, Seen]
) -> dict[str, Any]:
    """The document of at least one model. `cameras`: the V viewpoints that `seen` is about."""
    some = next(iter(models.values()))
    at = where(cameras, some.focal)
    views = some.inputs_at(np.ones(len(cameras)), *at)[:, :7]
    rows = {label: _nearest(model.inputs[:, :7], views) for label, model in models.items()}
    used = np.unique(np.concatenate(list(rows.values())))
    used = used[_path(views[used])]
    place = np.zeros(len(views), int)
    place[used] = np.arange(len(used))
    shared = np.round(views[used] * AXES / STEP).astype(int)
    photos = some.photos.T[_path(some.photos.T)]
    photos = np.round(photos * AXES[:6] / STEP).astype(int).T
    return {
        "quality": quality,
        "extent": some.extent,
        "focal": significant(some.focal),
        "screens": significant(some.screens),
        "views": [_differences(column) for column in shared.T],
        "photos": [_differences(column) for column in photos],
        "labels": [
            _entry(model, place[rows[label]], rows[label], used, shared, photos, seen.get(label))
            for label, model in models.items()
        ],
    }


def _entry(
    model: ViewModel,
    places: Int[np.ndarray, " n"],
    rows: Int[np.ndarray, " n"],
    used: Int[np.ndarray, " U"],
    shared: Int[np.ndarray, "U 7"],
    photos: Int[np.ndarray, "6 P"],
    seen: Seen | None,
) -> dict[str, Any]:
    """The entry of a model; `places`: its views among the shared ones, `rows`: among the cameras."""
    flat = model.quality == "fidelity"  # its curves are constants
    offsets = model.heldout_variance * model.heldout_inputs @ model.weights
    offsets += np.array([curve.median if flat else 0.0 for curve in model.curves])
    order = np.argsort(places, kind="stable")
    sent = order[_sent_views(len(order))]
    ordered = {name: getattr(model, name)[order] for name in ("inputs", "heldout_inputs", "weights")}
    shares = np.zeros(len(used)) if seen is None else seen.shares[used]
    corrections = (
        seen.corrections[rows[sent]] if seen and seen.corrections is not None else np.zeros(len(sent))
    )
    entry = {
        "id": model.label_id,
        "levels": list(model.levels),
        "status": model.status,
        "confidence": model.confidence,
        "leastSupport": math.ceil(model.calibration.least_support / STEP) / STEPS_PER_UNIT,
        "medianLogDistance": significant(model.median_log_distance),
        "lengths": significant(model.lengths),
        "curves": [] if flat else [curve_entry(curve) for curve in model.curves],
        "offsets": offsets.round(6).tolist(),
        "views": _differences(places[sent]),
        "shares": _differences(np.round(shares / STEP)),
        "corrections": _differences(np.round(np.nan_to_num(corrections) / CORRECTION_STEP)),
    }
    return _rounded(entry, replace(model, **ordered), shared, photos)


def _rounded(
    entry: dict[str, Any],
    model: ViewModel,
    shared: Int[np.ndarray, "U 7"],
    photos: Int[np.ndarray, "6 P"],
) -> dict[str, Any]:
    """The entry with log distances, values and thresholds, in the coarsest units that are allowed."""
    own = model.inputs
    at = np.concatenate([own, (own + own[_neighbours(own)]) / 2])
    # a curve may jump exactly at the distance of a view: a little beyond it
    place = at[:, :3] * model.extent, at[:, 3:6], np.exp(at[:, 6])
    viewpoints = np.exp(at[:, 7]) * (1 + 1e-9), *place
    before = model.predict(*viewpoints)
    coarser = allowed_change(before.mean.mean(0)) / MAX_ROUNDING_CHANGE
    sent, change = entry, math.inf
    for log_unit, unit in _UNITS if len(own) <= MOST_VIEWS else _UNITS[:1]:
        sent = _with_values(entry, model, shared, log_unit, significant(unit * coarser, 4))
        after = model_of_entry(sent, shared, photos, model.extent, model.screens).predict(*viewpoints)
        change = _relative_change(before, after, model.calibration.slopes)
        if change <= 1:
            break
    return {**sent, **_thresholds(model.calibration, change)}


def _with_values(
    entry: dict[str, Any],
    model: ViewModel,
    shared: Int[np.ndarray, "U 7"],
    log_unit: float,
    units: Sequence[float],
) -> dict[str, Any]:
    """The entry with log distances and values, by which it predicts what the model does."""
    own = model.inputs
    logs = _differences(np.round(own[_sent_views(len(own)), 7] / log_unit))
    sent = {
        **entry,
        "logDistances": {"unit": log_unit, "steps": logs},
        "targets": [],
        "thresholds": [],
        "slopes": [],
    }
    inputs = inputs_of_entry(sent, shared)
    expected = matern32(own, own, model.lengths) @ model.weights
    found = lstsq(matern32(own, inputs, model.lengths), expected, cond=1e-9, lapack_driver="gelsy")
    assert found is not None  # as its stub has it
    values = covariance(inputs, model.lengths) @ found[0]
    sent["values"] = {"units": units, "steps": _differences(np.round((values / units).T))}
    return sent


def _relative_change(before: Prediction, after: Prediction, slopes: Float[np.ndarray, " G"]) -> float:
    """The largest change of what bounds come from, over what is allowed."""
    steepest = np.abs(slopes).max(initial=0.0)
    change = np.abs(after.mean - before.mean) + steepest * np.abs(after.away - before.away)[:, None]
    return float((change / allowed_change(before.mean)).max())


def allowed_change(mean: np.ndarray) -> np.ndarray:
    """What rounding may change means by."""
    return np.maximum(MAX_ROUNDING_CHANGE, RELATIVE_ROUNDING * (1 - mean))


def _thresholds(calibration: Calibration, change: float) -> dict[str, list[int]]:
    """Targets, thresholds and slopes in whole steps; thresholds go up as means change, so no bound rises.

    `change`: the largest change of a mean, over what is allowed.
    """
    thresholds = calibration.thresholds
    targets = np.floor(calibration.targets / STEP + 1e-6).astype(int)
    raised = np.ceil((thresholds + change * allowed_change(thresholds)) / STEP - 1e-6).astype(int)
    slopes = np.ceil(calibration.slopes / STEP - 1e-6).astype(int)
    if len(targets) and thresholds[-1] >= 1:  # the full model keeps every target: that is not raised
        raised[-1], slopes[-1] = STEPS_PER_UNIT, 0
    return {"targets": targets.tolist(), "thresholds": raised.tolist(), "slopes": slopes.tolist()}


def _differences(whole: np.ndarray) -> list[Any]:
    """Differences along each axis, of whole numbers; the first ones are kept."""
    for axis in range(whole.ndim):
        whole = np.diff(whole, axis=axis, prepend=0)
    return whole.astype(int).tolist()


def _sent_views(views: int) -> slice:
    """Which of a number of views are sent."""
    return slice(None, None, math.ceil(views / MOST_VIEWS))


def _nearest(a: Float[np.ndarray, "A D"], b: Float[np.ndarray, "B D"]) -> Int[np.ndarray, " A"]:
    return cdist(a, b, "sqeuclidean").argmin(1)


def _neighbours(points: Float[np.ndarray, "n D"]) -> Int[np.ndarray, " n"]:
    """The nearest other point of each; itself if it is alone."""
    apart = cdist(points, points, "sqeuclidean")
    np.fill_diagonal(apart, np.inf)
    return apart.argmin(1)


def _path(points: Float[np.ndarray, "n D"]) -> Int[np.ndarray, " n"]:
    """An order of points, each followed by the nearest one left."""
    path, left = [*range(min(len(points), 1))], np.arange(1, len(points))
    while len(left):
        apart = ((points[left] - points[path[-1]]) ** 2).sum(1)
        path.append(int(left[apart.argmin()]))
        left = np.delete(left, apart.argmin())
    return np.array(path, int)
