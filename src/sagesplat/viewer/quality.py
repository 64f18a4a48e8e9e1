"""Quality entries of a bundle's documents: Eq. 3 by level, and viewpoint models, as rounded plain data."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.distance import cdist

from sagesplat.adapt.eq3 import Eq3, SsimModel
from sagesplat.adapt.viewpoint import ViewModel, matern32
from sagesplat.viewer.frames import FLIP

MOVES = 5e-4  # largest change of a bound by rounding, SSIM, in any of the scene's views
CURVE_MOVES = 1e-4  # largest change of a curve by rounding, SSIM
LIKE = 16  # exponent of the kernel weights in `corrected`: only close views count
_ENOUGH = 1e-3  # weight at which a correction counts by half
_WIRE = {  # keys in promises-*.json -> fields of `ViewModel`
    "usual": "median_log_distance", "unseen": "heldout_variance", "noise": "noise", "factor": "multiplier",
    "confidence": "confidence", "shift": "composition_bias", "mixing": "composition_std",
}  # fmt: skip


def of_files(model: ViewModel, files: Sequence[int], last: int) -> ViewModel:
    """The model with levels renumbered 1, 2, ... by the label's files; `files`: the levels of the files.

    A level that adds nothing has no file. Of levels with equal content the bound of the last one is kept, as
    in plans. `last`: the last of the nested levels.
    """
    known, columns, curves = list(model.levels), [], []
    for number, (first, after) in enumerate(pairwise([*files, last + 1]), 1):
        if same := [level for level in known if first <= level < after]:
            columns.append(known.index(same[-1]))
            curves.append(replace(model.curves[columns[-1]], level=number))
    return replace(
        model,
        curves=tuple(curves),
        weights=model.weights[:, columns],
        amplitudes=model.amplitudes[columns],
    )


def quality_entry(model: ViewModel) -> dict[str, Any]:
    """The manifest's quality entry of a label."""
    return {
        "status": model.status,
        "confidence": model.confidence,
        "margin": margins(model).round(4).tolist(),
        "curves": [curve_entry(curve) for curve in model.curves],
    }


def curve_entry(curve: SsimModel, exact: bool = False) -> dict[str, Any]:
    """Eq. 3 of a level, with the fewest digits that change it by at most CURVE_MOVES; all with `exact`.

    If both regimes are equal, only the far one is written, from distance 0 on.
    """
    near, far, beta = curve.params[:4], curve.params[4:8], curve.params.beta
    if far[1] == 0:
        far = (far[0], 0.0, 0.0, 1.0)  # a constant; the other parameters have no effect
    if curve.params[:4] == curve.params[4:8]:
        near, beta = (0.0, 0.0, 0.0, 1.0), 0.0
    entry = {
        "level": curve.level,
        "params": [*near, *far, beta],
        "range": list(curve.d_range),
        "median": curve.median,
        "rmse": curve.rmse,
    }
    if exact:
        return entry
    below = 10.0 ** decimals_of(beta, 6)  # rounds down: some views are exactly at beta, where far begins
    short: dict[str, Any] = {**entry, "median": round(curve.median, 4), "rmse": round(curve.rmse, 4)}
    away = np.array([*np.linspace(*curve.d_range, 200), curve.params.mu1, curve.params.mu2])  # with the cusps
    for digits in range(3, 16):
        params = [*significant(entry["params"][:8], digits), math.floor(beta * below) / below]
        short |= {"params": params, "range": significant(entry["range"], max(digits, 6))}
        if np.abs(curve_of(short, curve.label_id)(away) - curve(away)).max() <= CURVE_MOVES:
            break
    return short


def curve_of(entry: dict[str, Any], label_id: int = -1) -> SsimModel:
    """The model that `curve_entry` wrote."""
    low, high = entry["range"]
    return SsimModel(
        label_id, entry["level"], Eq3(*entry["params"]), (low, high), entry["median"], entry["rmse"], 0, ""
    )


def margins(model: ViewModel) -> Float[np.ndarray, " K"]:
    """By level, the offset from the curve to a lower bound that needs no viewpoint model.

    With it the curve is below the model's bound in a share of the model's views equal to its confidence. On
    held-out views of `garden` and `dinosaur` 96 % of the measurements are above it (for 0.95).
    """
    away = np.exp(model.inputs[:, 6])
    predicted = model.predict(away, model.inputs[:, :3] * model.extent, model.inputs[:, 3:6])
    difference = predicted.bound - np.stack([curve(away) for curve in model.curves], 1)
    return np.quantile(difference, 1 - model.confidence, axis=0, method="lower")


def promise_entry(
    model: ViewModel,
    rows: Int[np.ndarray, " n"],
    shares: Float[np.ndarray, " V"],
    corrections: Float[np.ndarray, " V"],
    decimals: int | None = None,
) -> dict[str, Any]:
    """The entry of a model in promises-*.json, rounded to `decimals` (None: exact).

    `rows`: of the shared views, those that the model was fitted on. `shares`: pixel share in each view.
    `corrections`: in each view, the log of the true distance over the distance by boxes; NaN: unknown.
    """

    def short(values: Any, digits: int = 6) -> Any:
        return significant(values, digits) if decimals is not None else np.asarray(values).tolist()

    return {
        "id": model.label_id,
        "levels": list(model.levels),
        "usual": short(model.median_log_distance),
        "lengths": short(model.lengths),
        "unseen": short(model.heldout_variance),
        "noise": short(model.noise),
        "factor": short(model.multiplier),
        "confidence": model.confidence,
        "shift": short(model.composition_bias),
        "mixing": short(model.composition_std),
        "amplitudes": short(model.amplitudes),
        "views": rows.tolist(),
        "unseenViews": model.heldout_inputs.astype(int).tolist(),
        "logDistances": (
            model.inputs[:, 6] if decimals is None else model.inputs[:, 6].round(decimals)
        ).tolist(),
        "weights": (model.weights if decimals is None else model.weights.round(decimals)).tolist(),
        "shares": short(shares, 4),
        "corrections": [round(c, 3) for c in np.nan_to_num(corrections[rows]).tolist()],
    }


def model_of(
    entry: dict[str, Any], curves: Sequence[SsimModel], views: Float[np.ndarray, "V 6"], extent: float
) -> ViewModel:
    """The model that `promise_entry` wrote, with the label's curves; `views` in the bundle's axes."""
    mine = views[entry["views"]] * np.tile(FLIP, 2)
    x, y, z = entry["lengths"]
    return ViewModel(
        label_id=entry["id"],
        curves=tuple(curve for curve in curves if curve.level in entry["levels"]),
        extent=extent,
        inputs=np.column_stack([mine[:, :3] / extent, mine[:, 3:], entry["logDistances"]]),
        heldout_inputs=np.array(entry["unseenViews"], bool),
        lengths=(x, y, z),
        weights=np.array(entry["weights"]),
        amplitudes=np.array(entry["amplitudes"]),
        rmse=math.nan,
        status="",
        **{field: entry[name] for name, field in _WIRE.items()},
    )


def corrected(
    model: ViewModel,
    corrections: Float[np.ndarray, " n"],
    distance: Float[np.ndarray, " V"],
    position: Float[np.ndarray, "V 3"],
    direction: Float[np.ndarray, "V 3"],
) -> Float[np.ndarray, " V"]:
    """Distances by boxes, corrected by their errors in the model's views nearby.

    d exp(sum_i a_i^16 c_i / (sum_i a_i^16 + 0.001)), where a_i is the model's kernel without the distance
    input. In leave-one-out tests on `garden` and `dinosaur` this halves the error of the bounds.
    """
    here = np.column_stack([position / model.extent, direction, np.zeros(len(position))])
    known = np.column_stack([model.inputs[:, :6], np.zeros(model.num_views)])
    weights = matern32(here, known, model.lengths) ** LIKE
    return distance * np.exp(weights @ corrections / (weights.sum(1) + _ENOUGH))


def rounded_entry(
    model: ViewModel,
    rows: np.ndarray,
    shares: np.ndarray,
    corrections: np.ndarray,
    views: np.ndarray,
    at: tuple[np.ndarray, ...],
) -> dict[str, Any]:
    """The shortest entry of a model that changes no bound by more than MOVES at the viewpoints `at`."""
    curves = [curve_of(curve_entry(curve)) for curve in model.curves]
    bound = model.predict(*at).bound
    entry = {}
    for decimals in range(3, 9):
        entry = promise_entry(model, rows, shares, corrections, decimals)
        moved = model_of(entry, curves, views, model.extent).predict(*at).bound - bound
        if np.abs(moved).max() <= MOVES:
            break
    return entry


def rows_of(model: ViewModel, position: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Rows of the cameras that a model was fitted on."""
    cameras = np.column_stack([position / model.extent, direction])
    return cdist(model.inputs[:, :6], cameras, "sqeuclidean").argmin(1)


def significant(values: Any, digits: int = 6) -> Any:
    """A number, or nested lists of numbers, rounded to `digits` significant digits."""
    if isinstance(values, (int, np.integer)):
        return int(values)
    if isinstance(values, (list, tuple, np.ndarray)):
        return [significant(value, digits) for value in values]
    return float(f"{float(values):.{digits}g}")


def decimals_of(extent: float, digits: int) -> int:
    """Decimals that give a length `digits` significant digits relative to the scene's extent."""
    return digits - math.floor(math.log10(extent)) if extent > 0 else digits


def dumped(document: Any) -> bytes:
    """Compact JSON: no spaces, and integral floats without a decimal point."""
    return json.dumps(_integral(document), separators=(",", ":"), allow_nan=False).encode() + b"\n"


def _integral(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _integral(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_integral(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value
