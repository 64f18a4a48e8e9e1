"""A viewpoint model as promises-*.json holds it, and as a viewer evaluates it (`web/src/core/quality.ts`).

The mean's weights are solved for, from the values at the model's views:

    (C + NUGGET I) weights = values,        C_ij = c(x_i, x_j), the kernel of `adapt.process`
    mean_k = curve_k(d) + offset_k + sum_i c(x, x_i) weights_ik

Numbers are whole steps of a unit, lists over views hold differences to the view before (`viewer.promises`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve

from sagesplat.adapt.eq3 import SsimModel
from sagesplat.adapt.process import inputs_of, matern32
from sagesplat.adapt.viewpoint import Calibration, Prediction, means_at, monotone
from sagesplat.viewer.frames import FLIP
from sagesplat.viewer.quality import curve_of

NUGGET = 1e-3  # added to the kernel's diagonal: far below what a mean is uncertain by
STEP = 1e-4  # of positions over the extent, directions, shares, targets and thresholds
CORRECTION_STEP = 5e-3
STEPS_PER_UNIT = round(1 / STEP)
NEIGHBOUR_EXPONENT = 16  # of the kernel weights in `corrected`: only close views count
HALF_WEIGHT = 1e-3  # weight at which a correction counts by half


@dataclass(frozen=True, eq=False)
class SentModel:
    """A model as a viewer evaluates it."""

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
        return distance * np.exp(weights @ self.corrections / (weights.sum(1) + HALF_WEIGHT))


def read_model(document: dict[str, Any], label_id: int) -> SentModel:
    """The model of a label in a document."""
    (entry,) = (entry for entry in document["labels"] if entry["id"] == label_id)
    shared = np.cumsum(document["views"], 1).T
    return model_of_entry(entry, shared, document["extent"])


def model_of_entry(entry: dict[str, Any], shared: Int[np.ndarray, "U 6"], extent: float) -> SentModel:
    """The model of an entry; `shared`: the views that the labels share, in steps."""
    inputs = inputs_of_entry(entry, shared)
    x, y, z = entry["lengths"]
    values = np.cumsum(np.cumsum(entry["values"]["steps"], 0), 1).T * entry["values"]["units"]
    weights = cho_solve(cho_factor(covariance(inputs, (x, y, z))), values)
    targets, thresholds = (
        np.array(entry[name], np.float64) / STEPS_PER_UNIT for name in ("targets", "thresholds")
    )
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


def inputs_of_entry(entry: dict[str, Any], shared: Int[np.ndarray, "U 6"]) -> Float[np.ndarray, "n 7"]:
    """Scaled position, direction and log distance of an entry's views."""
    own = shared[np.cumsum(entry["views"])] / STEPS_PER_UNIT * np.tile(FLIP, 2)
    logs = np.cumsum(entry["logDistances"]["steps"]) * entry["logDistances"]["unit"]
    return np.column_stack([own, logs])


def covariance(inputs: Float[np.ndarray, "n 7"], lengths: Sequence[float]) -> Float[np.ndarray, "n n"]:
    """The kernel between all views, with the nugget."""
    return matern32(inputs, inputs, lengths) + NUGGET * np.eye(len(inputs))
