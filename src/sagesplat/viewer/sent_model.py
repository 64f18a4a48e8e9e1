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
from sagesplat.adapt.viewpoint import Calibration, Prediction, away_from, means_at, monotone
from sagesplat.viewer.frames import FLIP
from sagesplat.viewer.quality import curve_of

NUGGET = 1e-3  # added to the kernel's diagonal: far below what a mean is uncertain by
STEP = 1e-4  # of positions over the extent, directions, log screens, shares, targets, thresholds and slopes
AXES = np.array([*FLIP, *FLIP, 1.0])  # signs of position, direction and log screen in the bundle's axes
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
    screens: tuple[float, float]
    inputs: Float[np.ndarray, "n 8"]
    lengths: tuple[float, float, float, float]
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
        curves = means_at(self.curves, distance) if self.curves else 0.0
        mean = monotone(curves + self.offsets + near @ self.weights)
        support = near.max(1)
        away = away_from(x, self.photos, support)
        return Prediction(mean, self.calibration.bound(mean, support, away), support, away)

    def corrected(
        self,
        distance: Float[np.ndarray, " V"],
        position: Float[np.ndarray, "V 3"],
        direction: Float[np.ndarray, "V 3"],
    ) -> Float[np.ndarray, " V"]:
        """Distances by boxes, corrected by their errors in the model's views nearby.

        d exp(sum_i a_i^16 c_i / (sum_i a_i^16 + 0.001)), where a_i is the model's kernel of place alone. In
        leave-one-out tests on `garden` and `dinosaur` this halves the error of the bounds.
        """
        here = np.column_stack([position / self.extent, direction, np.zeros((len(position), 2))])
        known = np.column_stack([self.inputs[:, :6], np.zeros((len(self.inputs), 2))])
        weights = matern32(here, known, self.lengths) ** NEIGHBOUR_EXPONENT
        return distance * np.exp(weights @ self.corrections / (weights.sum(1) + HALF_WEIGHT))


def read_model(document: dict[str, Any], label_id: int) -> SentModel:
    """The model of a label in a document."""
    (entry,) = (entry for entry in document["labels"] if entry["id"] == label_id)
    shared, photos = np.cumsum(document["views"], 1).T, np.cumsum(document["photos"], 1, dtype=int)
    return model_of_entry(entry, shared, photos, document["extent"], document["screens"])


def model_of_entry(
    entry: dict[str, Any],
    shared: Int[np.ndarray, "U 7"],
    photos: Int[np.ndarray, "6 P"],
    extent: float,
    screens: Sequence[float],
) -> SentModel:
    """The model of an entry; `shared`, `photos`: the views and photos that the labels share, in steps."""
    inputs = inputs_of_entry(entry, shared)
    lengths = position, direction, screen, distance = entry["lengths"]
    values = np.cumsum(np.cumsum(entry["values"]["steps"], 0), 1).T * entry["values"]["units"]
    weights = cho_solve(cho_factor(covariance(inputs, lengths)), values)
    targets, thresholds, slopes = (
        np.array(entry[name], np.float64) / STEPS_PER_UNIT for name in ("targets", "thresholds", "slopes")
    )
    calibration = Calibration(
        entry["status"], entry["confidence"], 0, targets, thresholds, slopes, entry["leastSupport"]
    )
    return SentModel(
        levels=tuple(entry["levels"]),
        curves=tuple(curve_of(curve) for curve in entry["curves"]),
        offsets=np.array(entry["offsets"], np.float64),
        extent=extent,
        median_log_distance=entry["medianLogDistance"],
        screens=(screens[0], screens[1]),
        inputs=inputs,
        lengths=(position, direction, screen, distance),
        photos=(photos.T / STEPS_PER_UNIT * AXES[:6]).T,
        weights=weights,
        corrections=np.cumsum(entry["corrections"]) * CORRECTION_STEP,
        calibration=calibration,
    )


def inputs_of_entry(entry: dict[str, Any], shared: Int[np.ndarray, "U 7"]) -> Float[np.ndarray, "n 8"]:
    """Scaled position, direction, log screen and log distance of an entry's views."""
    own = shared[np.cumsum(entry["views"])] / STEPS_PER_UNIT * AXES
    logs = np.cumsum(entry["logDistances"]["steps"]) * entry["logDistances"]["unit"]
    return np.column_stack([own, logs])


def covariance(inputs: Float[np.ndarray, "n 8"], lengths: Sequence[float]) -> Float[np.ndarray, "n n"]:
    """The kernel between all views, with the nugget."""
    return matern32(inputs, inputs, lengths) + NUGGET * np.eye(len(inputs))
