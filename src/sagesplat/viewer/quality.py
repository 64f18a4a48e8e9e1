"""Quality in a bundle's manifest, and Eq. 3 by level, as rounded plain data."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from sagesplat.adapt.eq3 import Eq3, SsimModel
from sagesplat.adapt.viewpoint import ViewModel

MAX_CURVE_CHANGE = 1e-4  # largest change of a curve by rounding, SSIM


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
    return replace(model, curves=tuple(curves), weights=model.weights[:, columns])


def quality_entry(model: ViewModel) -> dict[str, Any]:
    """What a label's manifest entry says of one quality: by level, what holds whatever the viewpoint.

    The mean is that over the model's views. The bound is below that of as many views as the confidence says;
    null: no promise.
    """
    own = model.inputs
    predicted = model.predict(np.exp(own[:, 7]), own[:, :3] * model.extent, own[:, 3:6], np.exp(own[:, 6]))
    low = np.quantile(predicted.bound, 1 - model.confidence, axis=0, method="lower")
    return {
        "levels": list(model.levels),
        "status": model.status,
        "confidence": model.confidence,
        "mean": predicted.mean.mean(0).round(3).tolist(),
        "bound": None if np.isnan(low).any() else (np.floor(low * 1000) / 1000).tolist(),
    }


def curve_entry(curve: SsimModel) -> dict[str, Any]:
    """Eq. 3 of a level, with the fewest digits that change it by at most MAX_CURVE_CHANGE.

    If both regimes are equal, only the far one is written, from distance 0 on.
    """
    params, beta = tuple(curve.params), curve.params.beta
    near, far = params[:4], params[4:8]
    if far[1] == 0:
        far = (far[0], 0.0, 0.0, 1.0)  # a constant; the other parameters have no effect
    if params[:4] == params[4:8]:
        near, beta = (0.0, 0.0, 0.0, 1.0), 0.0
    entry = {
        "level": curve.level,
        "params": [*near, *far, beta],
        "range": list(curve.d_range),
        "median": curve.median,
    }
    below = 10.0 ** decimals_of(beta, 6)  # rounds down: some views are exactly at beta, where far begins
    short: dict[str, Any] = {**entry, "median": round(curve.median, 4)}
    cusps = curve.params.mu1, curve.params.mu2
    distance = np.array([*np.linspace(*curve.d_range, 200), *cusps])
    for digits in range(3, 16):
        params = [*significant(entry["params"][:8], digits), math.floor(beta * below) / below]
        short |= {"params": params, "range": significant(entry["range"], max(digits, 6))}
        if np.abs(curve_of(short, curve.label_id)(distance) - curve(distance)).max() <= MAX_CURVE_CHANGE:
            break
    return short


def curve_of(entry: dict[str, Any], label_id: int = -1) -> SsimModel:
    """The model that `curve_entry` wrote."""
    low, high = entry["range"]
    return SsimModel(
        label_id, entry["level"], Eq3(*entry["params"]), (low, high), entry["median"], math.nan, 0, "constant"
    )


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
