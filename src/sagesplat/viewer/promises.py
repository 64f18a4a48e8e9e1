"""promises-*.json: the viewpoint models of all categories for one quality, small enough to be sent.

A mean over the viewpoint is written as its values at the model's views, not as weights. Weights cancel each
other and need many digits; a value that is rounded moves the mean by about as much. A reader solves for them:

    (C + NUGGET I) weights = values,        C_ij = c(x_i, x_j), the kernel of `adapt.process`
    mean_k = curve_k(d) + offset_k + sum_i c(x, x_i) weights_ik

and goes on as in `adapt.viewpoint`. An offset holds what does not depend on the viewpoint: the mean of
fidelity, and what views differ by that training never saw. Numbers are whole steps of a unit. The shared
views are in the order of a path from each to the nearest one left, and lists over views hold differences to
the view before: most are small. Values hold differences to the level below as well.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve, lstsq
from scipy.spatial.distance import cdist

from sagesplat.adapt.eq3 import SsimModel
from sagesplat.adapt.process import inputs_of, matern32
from sagesplat.adapt.viewpoint import Calibration, Prediction, QualityKind, ViewModel, means_at, monotone
from sagesplat.scene.scene import Camera
from sagesplat.viewer.frames import FLIP
from sagesplat.viewer.quality import curve_entry, curve_of, significant

VERSION = 2
# largest change of a mean by rounding, in any of the model's views and halfway to the next one: this much, or
MAX_ROUNDING_CHANGE = 5e-4
RELATIVE_ROUNDING = 1e-2  # this part of what is missing to 1, if that is more
NUGGET = 1e-3  # added to the kernel's diagonal: far below what a mean is uncertain by
STEP = 1e-4  # of positions over the extent, directions, shares, targets and thresholds
CORRECTION_STEP = 5e-3
MOST_VIEWS = 1024  # of a model; of more every second, third, ... is sent: a browser solves for the weights
NEIGHBOUR_EXPONENT = 16  # exponent of the kernel weights in `corrected`: only close views count
_ENOUGH = 1e-3  # weight at which a correction counts by half
_WHOLE = round(1 / STEP)
# units of log distances and of values, the coarsest first
_UNITS = ((1e-2, 1e-3), (5e-3, 7e-4), (5e-3, 5e-4), (2e-3, 5e-4), (1e-3, 3e-4), (5e-4, 1e-4), (1e-5, 1e-5))


@dataclass(frozen=True, eq=False)
class Seen:
    """A category in V viewpoints."""

    shares: Float[np.ndarray, " V"]  # of the image's pixels; 0: too few to count
    distance: Float[np.ndarray, " V"]  # d_min, world units; NaN: unknown
    corrections: Float[np.ndarray, " V"] | None = None  # log of d_min over the distance by boxes; None: 0


@dataclass(frozen=True, eq=False)
class SentModel:
    """A model as a viewer evaluates it (`web/src/core/quality.ts`)."""

    levels: tuple[int, ...]
    curves: tuple[SsimModel, ...]  # empty: 0
    offsets: Float[np.ndarray, " K"]
    extent: float
    median_log_distance: float
    inputs: Float[np.ndarray, "n 7"]
    lengths: tuple[float, float, float]
    weights: Float[np.ndarray, "n K"]
    corrections: Float[np.ndarray, " n"]
    calibration: Calibration

    def predict(
        self,
        distance: Float[np.ndarray, " V"],
        position: Float[np.ndarray, "V 3"],
        direction: Float[np.ndarray, "V 3"],
    ) -> Prediction:
        """Like `ViewModel.predict`."""
        x = inputs_of(distance, position, direction, self.extent, self.median_log_distance)
        near = matern32(x, self.inputs, self.lengths)
        curves = means_at(self.curves, distance) if self.curves else 0.0
        mean = monotone(curves + self.offsets + near @ self.weights)
        support = near.max(1)
        return Prediction(mean, self.calibration.bound(mean, support), support)

    def corrected(
        self,
        distance: Float[np.ndarray, " V"],
        position: Float[np.ndarray, "V 3"],
        direction: Float[np.ndarray, "V 3"],
    ) -> Float[np.ndarray, " V"]:
        """Distances by boxes, corrected by their errors in the model's views nearby.

        d exp(sum_i a_i^16 c_i / (sum_i a_i^16 + 0.001)), where a_i is the model's kernel without the distance
        input. In leave-one-out tests on `garden` and `dinosaur` this halves the error of the bounds.
        """
        here = np.column_stack([position / self.extent, direction, np.zeros(len(position))])
        known = np.column_stack([self.inputs[:, :6], np.zeros(len(self.inputs))])
        weights = matern32(here, known, self.lengths) ** NEIGHBOUR_EXPONENT
        return distance * np.exp(weights @ self.corrections / (weights.sum(1) + _ENOUGH))


def promises_document(
    quality: QualityKind,
    models: Mapping[int, ViewModel],
    cameras: Sequence[Camera],
    seen: Mapping[int, Seen],
) -> dict[str, Any]:
    """The document of at least one model. `cameras`: the V viewpoints that `seen` is about."""
    extent = next(iter(models.values())).extent
    position = np.stack([camera.position for camera in cameras]).astype(np.float64)
    direction = np.stack([camera.direction for camera in cameras]).astype(np.float64)
    views = np.column_stack([position / extent, direction])
    rows = {label: _nearest(model.inputs[:, :6], views) for label, model in models.items()}
    used = np.unique(np.concatenate(list(rows.values())))
    used = used[_path(views[used])]
    place = np.zeros(len(views), int)
    place[used] = np.arange(len(used))
    shared = np.round(views[used] * np.tile(FLIP, 2) / STEP).astype(int)
    return {
        "version": VERSION,
        "quality": quality,
        "extent": extent,
        "views": [_differences(column) for column in shared.T],
        "labels": [
            _entry(model, place[rows[label]], rows[label], used, shared, seen.get(label))
            for label, model in models.items()
        ],
    }


def read_model(document: dict[str, Any], label_id: int) -> SentModel:
    """The model of a label in a document."""
    (entry,) = (entry for entry in document["labels"] if entry["id"] == label_id)
    shared = np.cumsum(document["views"], 1).T
    return _model_of(entry, shared, document["extent"])


def _entry(
    model: ViewModel,
    places: Int[np.ndarray, " n"],
    rows: Int[np.ndarray, " n"],
    used: Int[np.ndarray, " U"],
    shared: Int[np.ndarray, "U 6"],
    seen: Seen | None,
) -> dict[str, Any]:
    """The entry of a model; `places`: its views among the shared ones, `rows`: among the cameras."""
    flat = model.quality == "fidelity"  # its curves are constants
    offsets = model.heldout_variance * model.heldout_inputs @ model.weights
    offsets += np.array([curve.median if flat else 0.0 for curve in model.curves])
    order = np.argsort(places, kind="stable")
    sent = order[_every(len(order))]
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
        "leastSupport": math.ceil(model.calibration.least_support / STEP) / _WHOLE,
        "discount": math.ceil(model.calibration.discount / STEP) / _WHOLE,
        "medianLogDistance": significant(model.median_log_distance),
        "lengths": significant(model.lengths),
        "curves": [] if flat else [curve_entry(curve) for curve in model.curves],
        "offsets": offsets.round(6).tolist(),
        "views": _differences(places[sent]),
        "shares": _differences(np.round(shares / STEP)),
        "corrections": _differences(np.round(np.nan_to_num(corrections) / CORRECTION_STEP)),
    }
    return _rounded(entry, replace(model, **ordered), shared)


def _rounded(entry: dict[str, Any], model: ViewModel, shared: Int[np.ndarray, "U 6"]) -> dict[str, Any]:
    """The entry with log distances, values and thresholds, in the coarsest units that are allowed."""
    own = model.inputs
    at = np.concatenate([own, (own + own[_neighbours(own)]) / 2])
    # a curve may jump exactly at the distance of a view: a little beyond it
    inputs = np.exp(at[:, 6]) * (1 + 1e-9), at[:, :3] * model.extent, at[:, 3:6]
    before = model.predict(*inputs)
    coarser = allowed(before.mean.mean(0)) / MAX_ROUNDING_CHANGE
    sent, moved = entry, math.inf
    for log_unit, unit in _UNITS if len(own) <= MOST_VIEWS else _UNITS[:1]:
        sent = _with_values(entry, model, shared, log_unit, significant(unit * coarser, 4))
        after = _model_of(sent, shared, model.extent).predict(*inputs)
        moved = _moved(before, after, model.calibration.discount)
        if moved <= 1:
            break
    return {**sent, **_thresholds(model.calibration, moved)}


def _with_values(
    entry: dict[str, Any],
    model: ViewModel,
    shared: Int[np.ndarray, "U 6"],
    log_unit: float,
    units: Sequence[float],
) -> dict[str, Any]:
    """The entry with log distances and values, by which it predicts what the model does."""
    own = model.inputs
    logs = _differences(np.round(own[_every(len(own)), 6] / log_unit))
    sent = {**entry, "logDistances": {"unit": log_unit, "steps": logs}, "targets": [], "thresholds": []}
    inputs = _inputs(sent, shared)
    expected = matern32(own, own, model.lengths) @ model.weights
    found = lstsq(matern32(own, inputs, model.lengths), expected, cond=1e-9, lapack_driver="gelsy")
    assert found is not None  # as its stub has it
    values = _covariance(inputs, model.lengths) @ found[0]
    sent["values"] = {"units": units, "steps": _differences(np.round((values / units).T))}
    return sent


def _moved(before: Prediction, after: Prediction, discount: float) -> float:
    """The largest change of what bounds come from, over what is allowed."""
    change = after.mean - before.mean + discount * (after.support - before.support)[:, None]
    return float((np.abs(change) / allowed(before.mean)).max())


def allowed(mean: np.ndarray) -> np.ndarray:
    """What rounding may change means by."""
    return np.maximum(MAX_ROUNDING_CHANGE, RELATIVE_ROUNDING * (1 - mean))


def _thresholds(calibration: Calibration, moved: float) -> dict[str, list[int]]:
    """Targets and thresholds in whole steps; thresholds go up by what means moved, so no bound is raised.

    `moved`: the largest change of a mean, over what is allowed.
    """
    targets, thresholds = calibration.targets, calibration.thresholds
    full = len(targets) > 0 and thresholds[-1] >= 1  # the full model keeps every target: that is not raised
    just_below = 1 - 1.5 * STEP - moved * MAX_ROUNDING_CHANGE
    if full:  # targets that only the full model keeps must not lend theirs to means below
        target = np.interp(just_below, thresholds, targets)
        low = thresholds < just_below
        targets, thresholds = [*targets[low], target, 1.0], np.array([*thresholds[low], just_below, 1.0])
    targets = np.floor(np.array(targets) / STEP + 1e-6).astype(int)
    raised = thresholds + moved * allowed(thresholds)
    raised = np.ceil(raised / STEP - 1e-6).astype(int)
    rising = np.maximum.accumulate(raised - np.arange(len(raised))) + np.arange(len(raised))
    kept = (rising < _WHOLE) & (np.diff(targets, prepend=-2 * _WHOLE) > 0)
    if full:
        rising[-1], kept[-1] = _WHOLE, True
    return {"targets": targets[kept].tolist(), "thresholds": rising[kept].tolist()}


def _model_of(entry: dict[str, Any], shared: Int[np.ndarray, "U 6"], extent: float) -> SentModel:
    inputs = _inputs(entry, shared)
    x, y, z = entry["lengths"]
    values = np.cumsum(np.cumsum(entry["values"]["steps"], 0), 1).T * entry["values"]["units"]
    weights = cho_solve(cho_factor(_covariance(inputs, (x, y, z))), values)
    targets, thresholds = (np.array(entry[name], np.float64) / _WHOLE for name in ("targets", "thresholds"))
    calibration = Calibration(
        entry["status"], entry["confidence"], 0, targets, thresholds, entry["leastSupport"], entry["discount"]
    )
    return SentModel(
        levels=tuple(entry["levels"]),
        curves=tuple(curve_of(curve) for curve in entry["curves"]),
        offsets=np.array(entry["offsets"], np.float64),
        extent=extent,
        median_log_distance=entry["medianLogDistance"],
        inputs=inputs,
        lengths=(x, y, z),
        weights=weights,
        corrections=np.cumsum(entry["corrections"]) * CORRECTION_STEP,
        calibration=calibration,
    )


def _inputs(entry: dict[str, Any], shared: Int[np.ndarray, "U 6"]) -> Float[np.ndarray, "n 7"]:
    own = shared[np.cumsum(entry["views"])] / _WHOLE * np.tile(FLIP, 2)
    logs = np.cumsum(entry["logDistances"]["steps"]) * entry["logDistances"]["unit"]
    return np.column_stack([own, logs])


def _covariance(inputs: Float[np.ndarray, "n 7"], lengths: Sequence[float]) -> Float[np.ndarray, "n n"]:
    return matern32(inputs, inputs, lengths) + NUGGET * np.eye(len(inputs))


def _differences(whole: np.ndarray) -> list[Any]:
    """Differences along each axis, of whole numbers; the first ones are kept."""
    for axis in range(whole.ndim):
        whole = np.diff(whole, axis=axis, prepend=0)
    return whole.astype(int).tolist()


def _every(views: int) -> slice:
    """Which of so many views are sent."""
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
    path, left = [0], np.arange(1, len(points))
    while len(left):
        apart = ((points[left] - points[path[-1]]) ** 2).sum(1)
        path.append(int(left[apart.argmin()]))
        left = np.delete(left, apart.argmin())
    return np.array(path)
