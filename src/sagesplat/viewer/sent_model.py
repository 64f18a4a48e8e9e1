"""Viewpoint models as promises-*.json holds them, and as a viewer evaluates them (`web/src/core/quality.ts`).

Fidelity is read as the models of cells that were calibrated (`read_fidelity`), SSIM as one model a label
(`read_model`), whose weights are solved for from the values at the model's views:

    (C + NUGGET I) weights = values,        C_ij = c(x_i, x_j), the kernel of `adapt.process`
    mean_k = curve_k(d) + offset_k + sum_i c(x, x_i) weights_ik

Numbers are whole steps of a unit (`viewer.promises`), in documents that are unpacked (`viewer.numbers`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sagesplat.adapt.cell_models import FACTOR_STEP, STEP, CellModel, FidelityModel
from sagesplat.adapt.eq3 import SsimModel
from sagesplat.adapt.process import inputs_of, matern32, weights_from
from sagesplat.adapt.viewpoint import Calibration, Prediction, away_from, means_at, monotone
from sagesplat.viewer.frames import FLIP
from sagesplat.viewer.quality import curve_of

AXES = np.array([*FLIP, *FLIP, 1.0, 1.0])  # signs of the shared inputs in the bundle's axes
CORRECTION_STEP = 5e-3
STEPS_PER_UNIT = round(1 / STEP)
NEIGHBOUR_EXPONENT = 16  # of the kernel weights in `corrected`: only close views count
HALF_WEIGHT = 1e-3  # weight at which a correction counts by half
_Lengths = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class SentModel:
    """The model of SSIM against photos of a label as a whole, as a viewer evaluates it."""

    levels: tuple[int, ...]
    curves: tuple[SsimModel, ...]
    offsets: Float[np.ndarray, " K"]
    extent: float
    median_log_distance: float
    screens: tuple[float, float]
    inputs: Float[np.ndarray, "n 9"]
    lengths: _Lengths
    photos: Float[np.ndarray, "6 P"]
    weights: Float[np.ndarray, "n K"]
    corrections: Float[np.ndarray, " n"]
    calibration: Calibration

    def predict(
        self,
        distance: Float[np.ndarray, " V"],
        position: Float[np.ndarray, "V 3"],
        direction: Float[np.ndarray, "V 3"],
        screen: Float[np.ndarray, " V"] | None = None,
    ) -> Prediction:
        """Like `ViewModel.predict`."""
        screen = None if screen is None else np.clip(screen, *self.screens)
        x = inputs_of(distance, position, direction, self.extent, self.median_log_distance, screen)
        near = matern32(x, self.inputs, self.lengths)
        mean = monotone(means_at(self.curves, distance) + self.offsets + near @ self.weights)
        support = near.max(1)
        away = away_from(x, self.photos, support)
        return Prediction(mean, self.calibration.bound(mean, support, away), support, away)

    def corrected(
        self,
        distance: Float[np.ndarray, " V"],
        position: Float[np.ndarray, "V 3"],
        direction: Float[np.ndarray, "V 3"],
    ) -> Float[np.ndarray, " V"]:
        """Distances by points, corrected by their errors in the model's views nearby.

        d exp(sum_i a_i^16 c_i / (sum_i a_i^16 + 0.001)), where a_i is the model's kernel of place alone.
        """
        here = np.column_stack([position / self.extent, direction])
        weights = matern32(here, self.inputs[:, :6], self.lengths[:2]) ** NEIGHBOUR_EXPONENT
        return distance * np.exp(weights @ self.corrections / (weights.sum(1) + HALF_WEIGHT))


def read_model(document: dict[str, Any], label_id: int) -> SentModel:
    """The model of a label in a document of SSIM against photos."""
    (entry,) = (entry for entry in document["labels"] if entry["id"] == label_id)
    return model_of_entry(entry, _steps(document["views"]), _steps(document["photos"]).T, document)


def model_of_entry(
    entry: dict[str, Any],
    shared: Int[np.ndarray, "U 8"],
    photos: Int[np.ndarray, "6 P"],
    document: dict[str, Any],
) -> SentModel:
    """The model of an entry; `shared`, `photos`: the views and photos that the labels share, in steps."""
    (whole,) = entry["cells"]
    views, screens = shared / STEPS_PER_UNIT * AXES, document["screens"]
    inputs = _inputs(whole, views)
    return SentModel(
        levels=tuple(whole["levels"]),
        curves=tuple(curve_of(curve) for curve in whole["curves"]),
        offsets=np.array(whole["offsets"]) / STEPS_PER_UNIT,
        extent=document["extent"],
        median_log_distance=whole["medianLogDistance"],
        screens=(screens[0], screens[1]),
        inputs=inputs,
        lengths=_lengths(entry),
        photos=(photos.T / STEPS_PER_UNIT * AXES[:6]).T,
        weights=_weights(whole, inputs, entry["lengths"]),
        corrections=np.array(whole["corrections"]) * CORRECTION_STEP,
        calibration=calibration_of(entry),
    )


def read_fidelity(document: dict[str, Any]) -> dict[int, FidelityModel]:
    """The models of a document of fidelity by label id, all with as many levels.

    What lies above the last level of a cell is that level.
    """
    views = _steps(document["views"]) / STEPS_PER_UNIT * AXES
    photos = (_steps(document["photos"]) / STEPS_PER_UNIT * AXES[:6]).T
    most = max(len(cell["ladder"]) for entry in document["labels"] for cell in entry["cells"])
    low, high = document["screens"]
    return {
        entry["id"]: FidelityModel(
            label_id=entry["id"],
            extent=document["extent"],
            focal=document["focal"],
            screens=(low, high),
            views=views,
            lengths=_lengths(entry),
            photos=photos,
            cells=tuple(_cell(cell, views, document["levels"], most) for cell in entry["cells"]),
            rmse=0.0,
            calibration=calibration_of(entry),
        )
        for entry in document["labels"]
    }


def _cell(cell: dict[str, Any], views: Float[np.ndarray, "U 8"], last: int, most: int) -> CellModel:
    """The model of a cell with `most` levels; `last`: of the ladder."""
    columns = np.minimum(np.arange(most), len(cell["ladder"]) - 1)
    inputs, factors = _inputs(cell, views), np.array(cell["factors"], int)
    return CellModel(
        cell=cell["id"],
        offsets=np.array(cell["offsets"])[columns] / STEPS_PER_UNIT,
        places=(np.array(cell["ladder"])[columns] - 0.5) / last,
        rows=np.array(cell["rows"], int),
        log_distances=inputs[:, -1],
        median_log_distance=cell["medianLogDistance"],
        values=np.array(cell["terms"], int),
        factors=np.where(factors < 0, -1.0, factors * FACTOR_STEP),
    )


def calibration_of(entry: dict[str, Any]) -> Calibration:
    """The calibration of a label's entry."""
    targets, thresholds, slopes = (
        np.array(entry[name], np.float64) / STEPS_PER_UNIT for name in ("targets", "thresholds", "slopes")
    )
    return Calibration(
        entry["status"], entry["confidence"], 0, targets, thresholds, slopes, entry["leastSupport"]
    )


def _inputs(cell: dict[str, Any], views: Float[np.ndarray, "U 8"]) -> Float[np.ndarray, "n 9"]:
    """The inputs of a cell's views."""
    logs = np.array(cell["logDistances"]) * cell["logUnit"]
    return np.column_stack([views[np.array(cell["rows"], int)], logs])


def _weights(
    cell: dict[str, Any], inputs: Float[np.ndarray, "n 9"], lengths: Sequence[float]
) -> Float[np.ndarray, "n K"]:
    return weights_from(inputs, np.cumsum(cell["values"], 0).T * cell["units"], lengths)


def _lengths(entry: dict[str, Any]) -> _Lengths:
    position, direction, screen, distance = entry["lengths"]
    return position, direction, screen, distance


def _steps(columns: Sequence[Sequence[int]]) -> Int[np.ndarray, "U D"]:
    return np.array(columns, int).T
