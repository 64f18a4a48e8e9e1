"""Quality in a bundle's manifest, and Eq. 3 by level, as rounded plain data."""

import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sagesplat.adapt.cell_models import FidelityModel, expect, promised
from sagesplat.adapt.cells import Cells
from sagesplat.adapt.eq3 import Eq3, SsimModel
from sagesplat.adapt.viewpoint import ViewModel
from sagesplat.scene.scene import Camera

MAX_CURVE_CHANGE = 1e-4  # largest change of a curve by rounding, SSIM


def levels_of(files: Collection[Sequence[int]], last: int) -> list[int]:
    """The nested level that all cells of a label show at least, with each cell's first 1, 2, ... files.

    `files`: for each cell the levels of its files: a level that adds nothing has none. `last`: the last of
    the nested levels.
    """
    shown = [[*(after - 1 for after in own[1:]), last] for own in files]
    return [min(own[min(k, len(own) - 1)] for own in shown) for k in range(max(map(len, shown)))]


def of_levels(model: ViewModel, levels: Sequence[int]) -> ViewModel:
    """The model with levels renumbered 1, 2, ... (`levels_of`), each as promised of the last one below it."""
    columns, curves = [], []
    for number, level in enumerate(levels, 1):
        if known := [column for column, own in enumerate(model.levels) if own <= level]:
            columns.append(known[-1])
            curves.append(replace(model.curves[known[-1]], level=number))
    return replace(model, curves=tuple(curves), weights=model.weights[:, columns])


def fidelity_entries(
    models: Mapping[int, FidelityModel], cells: Cells, cameras: Sequence[Camera], counts: Mapping[int, int]
) -> dict[int, dict[str, Any]]:
    """By label id `quality_entry` of fidelity: all cells at one level, from the viewpoints that show any.

    `counts`: levels by cell id; `models` have as many as the largest of these, and an entry as many as the
    largest of its label's cells.
    """
    levels, own = max(counts.values()), dict[int, int]()
    for cell, label in cells.label_of.items():
        own[label] = max(own.get(label, 0), counts[cell])
    expected, found = expect(models, cells, cameras, levels), {}
    composed = [expected.of_composition(np.full(expected.share.shape, k + 1)) for k in range(levels)]
    mean = np.stack(composed, 2)
    bound = np.stack([promised(models, expected, one) for one in composed], 2)
    for column, label in enumerate(expected.labels.tolist()):
        if label in models:
            shown = ~np.isnan(mean[:, column, 0])
            seen = mean[shown, column] if shown.any() else np.zeros((1, levels))
            kept = bound[shown, column] if shown.any() else np.full((1, levels), np.nan)
            last = own[label]
            found[label] = _entry(models[label], range(1, last + 1), seen[:, :last], kept[:, :last])
    return found


def quality_entry(model: ViewModel) -> dict[str, Any]:
    """What a label's manifest entry says of one quality: by level, what holds whatever the viewpoint.

    The mean is that over the model's views. The bound is below that of as many views as the confidence says;
    null: no promise.
    """
    own = model.inputs
    predicted = model.predict(np.exp(own[:, -1]), own[:, :3] * model.extent, own[:, 3:6], np.exp(own[:, 6]))
    return _entry(model, model.levels, predicted.mean, predicted.bound)


def _entry(
    model: ViewModel | FidelityModel, levels: Sequence[int], mean: np.ndarray, bound: np.ndarray
) -> dict[str, Any]:
    low = np.quantile(bound, 1 - model.confidence, axis=0, method="lower")
    return {
        "levels": list(levels),
        "status": model.status,
        "confidence": model.confidence,
        "mean": mean.mean(0).round(3).tolist(),
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
