"""promises-*.json: the viewpoint models of all categories for one quality, small enough to be sent.

Fidelity has a model for each cell, in whole steps already as it was fitted and calibrated
(`adapt.cell_models`). SSIM against photos has one model for each category, rounded here: thresholds go up by
as much as that changes means.

A process is written as its values at the model's views, not as weights. Weights cancel each other and need
many digits; a value that is rounded moves the mean by about as much. A reader solves for them
(`viewer.sent_model`). An offset holds what does not depend on the viewpoint: the mean of fidelity, and what
views differ by that training never saw. Numbers are whole steps of a unit. The shared views, and the photos,
are in the order of a path from each to the nearest one left, so that differences to the one before are small
(`viewer.numbers`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.distance import cdist

from sagesplat.adapt.cell_models import FACTOR_STEP, LOG_STEP, STEP, CellModel, FidelityModel
from sagesplat.adapt.process import values_at
from sagesplat.adapt.viewpoint import Calibration, Prediction, QualityKind, ViewModel, where
from sagesplat.scene.scene import Camera
from sagesplat.viewer.quality import curve_entry, significant
from sagesplat.viewer.sent_model import (
    AXES,
    CORRECTION_STEP,
    STEPS_PER_UNIT,
    model_of_entry,
)

MAX_ROUNDING_CHANGE = 5e-4  # of a mean, in any of the model's views and halfway to the next one; or
RELATIVE_ROUNDING = 1e-2  # this part of what is missing to 1, if that is more
MOST_VIEWS = 1024  # of a model; of more every second, third, ... is sent: a browser solves for the weights
# units of a label's log distances and values, the coarsest first
_UNITS = ((1e-2, 1e-3), (5e-3, 7e-4), (5e-3, 5e-4), (2e-3, 5e-4), (1e-3, 3e-4), (5e-4, 1e-4), (1e-5, 1e-5))


@dataclass(frozen=True, eq=False)
class Seen:
    """A category in V photos."""

    shares: Float[np.ndarray, " V"]  # of the image's pixels; 0: too few to count
    distance: Float[np.ndarray, " V"]  # d_min, world units; NaN: unknown
    corrections: Float[np.ndarray, " V"] | None = None  # log of d_min over the distance by points; None: 0


def ssim_document(
    models: Mapping[int, ViewModel], cameras: Sequence[Camera], seen: Mapping[int, Seen]
) -> dict[str, Any]:
    """The document of SSIM against photos, of at least one model. `cameras`: the V photos of `seen`."""
    some = next(iter(models.values()))
    views = some.inputs_at(np.ones(len(cameras)), *where(cameras, some.focal))[:, :-1]
    rows = {label: _nearest(model.inputs[:, :-1], views) for label, model in models.items()}
    used = np.unique(np.concatenate(list(rows.values())))
    used = used[_path(views[used])]
    place = np.zeros(len(views), int)
    place[used] = np.arange(len(used))
    head, shared, photos = _head("ssim", some, views[used])
    entries = [
        _entry(model, place[rows[label]], rows[label], used, shared, photos, head, seen.get(label))
        for label, model in models.items()
    ]
    return {**head, "labels": entries}


def _head(
    quality: QualityKind, some: ViewModel | FidelityModel, views: Float[np.ndarray, "U 8"]
) -> tuple[dict[str, Any], Int[np.ndarray, "U 8"], Int[np.ndarray, "6 P"]]:
    """What all labels share, and the views and photos of it in whole steps."""
    shared = np.round(views * AXES / STEP).astype(int)
    photos = some.photos.T[_path(some.photos.T)]
    photos = np.round(photos * AXES[:6] / STEP).astype(int).T
    head = {
        "quality": quality,
        "extent": some.extent,
        "focal": significant(some.focal),
        "screens": significant(some.screens),
        "views": shared.T.tolist(),
        "photos": photos.tolist(),
    }
    return head, shared, photos


def fidelity_document(
    models: Mapping[int, FidelityModel],
    files: Mapping[int, Sequence[int]],
    last: int,
    cameras: Sequence[Camera],
) -> dict[str, Any]:
    """The document of fidelity, of at least one model.

    Args:
        models: By label id, with the ladder's levels; their views are the same.
        files: By cell id, the levels of its files; at least one each.
        last: The last of the nested levels.
        cameras: At least one viewpoint: the widest lens that was tried.
    """
    some = next(iter(models.values()))
    order = _path(some.views)
    head, _, _ = _head("fidelity", some, some.views[order])
    widest = max(min(camera.width, camera.height) / camera.focal for camera in cameras)
    entries = [
        {
            "id": label,
            "status": model.status,
            "confidence": model.confidence,
            "leastSupport": math.ceil(model.calibration.least_support / STEP) / STEPS_PER_UNIT,
            "lengths": significant(model.lengths),
            **_thresholds(model.calibration, 0.0),
            "cells": [
                _cell(cell, levels_of_files(files[cell.cell], last), order)
                for cell in model.cells
                if cell.cell in files
            ],
        }
        for label, model in models.items()
    ]
    fov = math.floor(math.degrees(2 * math.atan(widest / 2)) + 0.5)
    return {**head, "fov": fov, "levels": len(some.levels), "labels": entries}


def _cell(cell: CellModel, columns: Int[np.ndarray, " k"], order: Int[np.ndarray, " V"]) -> dict[str, Any]:
    """The entry of a cell; `order`: of the views when they are sent."""
    place = np.argsort(order)[cell.rows]
    by_place = np.argsort(place)
    logs = np.round(cell.log_distances[by_place] / LOG_STEP)
    factors = np.where(cell.factors < 0, -1, np.round(cell.factors / FACTOR_STEP))
    return {
        "id": cell.cell,
        "ladder": (columns + 1).tolist(),
        "medianLogDistance": cell.median_log_distance,
        "offsets": _whole(cell.offsets[columns] / STEP),
        "rows": place[by_place].tolist(),
        "logUnit": LOG_STEP,
        "logDistances": _whole(logs),
        "terms": cell.values[:, by_place].tolist(),
        "factors": _whole(factors[order]),
    }


def levels_of_files(files: Sequence[int], last: int) -> Int[np.ndarray, " k"]:
    """Columns of a model of all levels, for the levels of a cell's files; of equal levels the last one.

    A level that adds nothing has no file. `last`: the last of the nested levels.
    """
    return np.array([*files[1:], last + 1], int) - 2


def of_cells(
    models: Mapping[int, FidelityModel], files: Mapping[int, Sequence[int]], last: int
) -> dict[int, FidelityModel]:
    """The models with levels 1, 2, ... by the files of each cell; above a cell's last level is that level."""
    most = max(map(len, files.values()))

    def numbered(cell: CellModel) -> CellModel:
        columns = levels_of_files(files[cell.cell], last)
        columns = columns[np.minimum(np.arange(most), len(columns) - 1)]
        return replace(cell, offsets=cell.offsets[columns], places=cell.places[columns])

    kept = {
        label: tuple(numbered(cell) for cell in model.cells if cell.cell in files)
        for label, model in models.items()
    }
    return {label: replace(models[label], cells=some) for label, some in kept.items() if some}


def _entry(
    model: ViewModel,
    places: Int[np.ndarray, " n"],
    rows: Int[np.ndarray, " n"],
    used: Int[np.ndarray, " U"],
    shared: Int[np.ndarray, "U 8"],
    photos: Int[np.ndarray, "6 P"],
    head: dict[str, Any],
    seen: Seen | None,
) -> dict[str, Any]:
    """The entry of a model; `places`: its views among the shared ones, `rows`: among the cameras."""
    offsets = model.heldout_variance * model.heldout_inputs @ model.weights
    order = np.argsort(places, kind="stable")
    sent = order[_sent_views(len(order))]
    ordered = {name: getattr(model, name)[order] for name in ("inputs", "heldout_inputs", "weights")}
    shares = np.zeros(len(used)) if seen is None else seen.shares[used]
    corrections = (
        seen.corrections[rows[sent]] if seen and seen.corrections is not None else np.zeros(len(sent))
    )
    entry = {
        "id": model.label_id,
        "status": model.status,
        "confidence": model.confidence,
        "leastSupport": math.ceil(model.calibration.least_support / STEP) / STEPS_PER_UNIT,
        "lengths": significant(model.lengths),
        "targets": [],
        "thresholds": [],
        "slopes": [],
    }
    whole = {
        "id": -1,
        "levels": list(model.levels),
        "medianLogDistance": significant(model.median_log_distance),
        "curves": [curve_entry(curve) for curve in model.curves],
        "offsets": _whole(offsets / STEP),
        "rows": places[sent].tolist(),
        "shares": _whole(shares / STEP),
        "corrections": _whole(np.nan_to_num(corrections) / CORRECTION_STEP),
    }
    return _rounded(entry, whole, replace(model, **ordered), shared, photos, head)


def _rounded(
    entry: dict[str, Any],
    whole: dict[str, Any],
    model: ViewModel,
    shared: Int[np.ndarray, "U 8"],
    photos: Int[np.ndarray, "6 P"],
    head: dict[str, Any],
) -> dict[str, Any]:
    """The entry with log distances, values and thresholds, in the coarsest units that are allowed."""
    own = model.inputs
    at = np.concatenate([own, (own + own[_neighbours(own)]) / 2])
    # a curve may jump exactly at the distance of a view: a little beyond it
    place = at[:, :3] * model.extent, at[:, 3:6], np.exp(at[:, 6])
    viewpoints = np.exp(at[:, -1]) * (1 + 1e-9), *place
    before = model.predict(*viewpoints)
    coarser = allowed_change(before.mean.mean(0)) / MAX_ROUNDING_CHANGE
    sent, change = entry, math.inf
    for log_unit, unit in _UNITS if len(own) <= MOST_VIEWS else _UNITS[:1]:
        valued = _with_values(whole, model, shared, log_unit, significant(unit * coarser, 4))
        sent = {**entry, "cells": [valued]}
        after = model_of_entry(sent, shared, photos, head).predict(*viewpoints)
        change = _relative_change(before, after, model.calibration.slopes)
        if change <= 1:
            break
    return {**sent, **_thresholds(model.calibration, change)}


def _with_values(
    whole: dict[str, Any],
    model: ViewModel,
    shared: Int[np.ndarray, "U 8"],
    log_unit: float,
    units: Sequence[float],
) -> dict[str, Any]:
    """The model's entry with log distances and values, by which it predicts what the model does."""
    own, some = model.inputs, _sent_views(len(model.inputs))
    logs = np.round(own[some, -1] / log_unit)
    views = shared[whole["rows"]] / STEPS_PER_UNIT * AXES
    inputs = np.column_stack([views, logs * log_unit])
    values = values_at(inputs, own, model.weights, model.lengths)
    return {
        **whole,
        "logUnit": log_unit,
        "logDistances": _whole(logs),
        "units": units,
        "values": np.diff(np.round(values / units).astype(int), prepend=0).T.tolist(),
    }


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


def _whole(numbers: np.ndarray) -> list[Any]:
    return np.round(numbers).astype(int).tolist()


def _sent_views(views: int) -> slice:
    """Which of a number of views are sent."""
    return slice(None, None, max(1, math.ceil(views / MOST_VIEWS)))


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
