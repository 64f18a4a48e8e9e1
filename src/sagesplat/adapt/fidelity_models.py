"""Models of fidelity over the viewpoint, with thresholds that keep a target at a confidence.

Three sets of drawn viewpoints are used, each for one thing:

1. "fit": a Gaussian process per category learns the expected fidelity of each level, all categories at the
   same level. Each viewpoint predicted without itself gives preliminary thresholds.
2. "bias": compositions planned by the thresholds for a range of nominal targets are measured, and the
   thresholds corrected so that they allow for neighbours at other levels (`remove_composition_bias`). Where a
   category misses a target at any level of its own, as its neighbours spill over it, all categories are held
   at the nominal target that keeps it (`hold_all_categories`).
3. "calibration": split conformal prediction says which nominal target to ask for, so that each target is kept
   at the confidence, category by category (`adapt.calibrate`). Neighbours' levels move with that, so it is
   done twice.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from sagesplat.adapt.calibrate import (
    AT_A_PHOTO,
    conformal_quantile,
    critical_margins,
    critical_nominals,
    fewest_views,
)
from sagesplat.adapt.fidelity import SampledFidelity
from sagesplat.adapt.process import fit_process, inputs_of, matern32
from sagesplat.adapt.viewpoint import (
    PHOTO_LENGTHS,
    Calibration,
    Status,
    ViewModel,
    away_from,
    constant_curve,
    monotone,
    where,
)
from sagesplat.scene.scene import Camera

# Targets that compositions are planned for.
NOMINAL = np.array([0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.98, 0.99])
# Targets that are calibrated; those between them are interpolated.
TARGETS = np.unique(
    np.concatenate(
        [np.arange(0.4, 0.9, 0.025), np.arange(0.9, 0.97, 0.01), [0.97, 0.975, 0.98, 0.985, 0.99]]
    ).round(4)
)
NOTHING_HELD = np.zeros(len(TARGETS), bool)
_ABOVE = 1e-9  # a threshold lies above its critical value
_MARGINS = (-1.0, 10.0)  # limits of preliminary ones
MOST_PHOTOS = 256  # by which it is known how far a place is from the photos
_NOISE_SIGMAS = 3.0  # standard deviations of a share of views that are no more than chance


def fit_fidelity(
    sampled: SampledFidelity,
    cameras: Sequence[Camera],
    extent: float,
    confidence: float,
    focal: float,
    screens: tuple[float, float],
    photos: Sequence[Camera],
) -> dict[int, ViewModel]:
    """Fit the expected fidelity of each category over the viewpoint, with preliminary thresholds.

    Args:
        sampled: Measured at V viewpoints that are used for nothing else.
        cameras: The V viewpoints.
        extent: Of the scene, world units.
        confidence: Of the preliminary thresholds.
        focal: Of the photos, pixels.
        screens: Of the viewpoints (`ViewModel`).
        photos: At least one camera; margins grow away from them.

    Returns:
        Models by label id; a category that is shown in no viewpoint has none. They are not calibrated yet.
    """
    position, direction, screen = where(cameras, focal)
    places = photo_places(photos, extent)
    shown, models = sampled.shown(), {}
    for column, label in enumerate(sampled.labels):
        rows = np.flatnonzero(shown[:, column])
        if not len(rows):
            continue
        values = sampled.fidelity[rows, column].astype(np.float64)
        distance = sampled.distance[rows, column].astype(np.float64)
        known = np.log(distance[distance > 0])
        median = float(np.median(known)) if len(known) else 0.0
        inside = np.clip(screen[rows], *screens)
        x = inputs_of(distance, position[rows], direction[rows], extent, median, inside)
        models[label] = _fit(label, x, values, extent, median, confidence, focal, screens, places)
    return models


def _fit(
    label: int,
    x: Float[np.ndarray, "n 8"],
    values: Float[np.ndarray, "n K"],
    extent: float,
    median: float,
    confidence: float,
    focal: float,
    screens: tuple[float, float],
    photos: Float[np.ndarray, "6 P"],
) -> ViewModel:
    heldout = np.zeros(len(x), bool)
    mean = values.mean(0)
    # a last level that is the full model is known, and no part of the process (unless it is the only one)
    known = bool((values[:, -1] == 1).all())
    learnt = slice(0, max(len(mean) - known, 1))
    process = fit_process(x, heldout, (values - mean)[:, learnt])
    weights = np.zeros(values.shape)
    weights[:, learnt] = process.weights
    left_out = values.copy()
    left_out[:, learnt] = mean[learnt] + process.left_out
    left_out = monotone(left_out)
    rmse = np.sqrt(((left_out - values) ** 2).mean(0))
    near = matern32(x, x, process.lengths)
    np.fill_diagonal(near, 0)
    least = float(near.max(1).min())  # each by the others
    scale = AT_A_PHOTO + away_from(x, photos, near.max(1))
    margins = np.clip(
        [
            np.quantile(critical_margins(left_out, values, target, scale), confidence, method="higher")
            for target in TARGETS
        ],
        *_MARGINS,
    )
    return ViewModel(
        label_id=label,
        quality="fidelity",
        curves=tuple(
            constant_curve(label, k, float(m), float(e), len(x))
            for k, m, e in zip(range(1, len(mean) + 1), mean, rmse, strict=True)
        ),
        extent=extent,
        median_log_distance=median,
        focal=focal,
        screens=screens,
        inputs=x,
        heldout_inputs=heldout,
        lengths=process.lengths,
        heldout_variance=0.0,
        photos=photos,
        weights=weights,
        rmse=float(rmse.mean()),
        calibration=_calibration(
            TARGETS + AT_A_PHOTO * margins, margins, "uncalibrated", confidence, 0, least
        ),
    )


def photo_places(photos: Sequence[Camera], extent: float) -> Float[np.ndarray, "6 P"]:
    """`ViewModel.photos` of cameras: at most `MOST_PHOTOS`, each the furthest from those before it."""
    position, direction, _ = where(photos, 1.0)
    places = np.column_stack([position / extent, direction])
    chosen, away = [0], np.full(len(places), np.inf)
    while len(chosen) < min(MOST_PHOTOS, len(places)):
        away = np.minimum(away, 1 - matern32(places, places[chosen[-1:]], PHOTO_LENGTHS)[:, 0])
        chosen.append(int(away.argmax()))
    return places[np.unique(chosen)].T


def _calibration(
    thresholds: Float[np.ndarray, " G"],
    slopes: Float[np.ndarray, " G"],
    status: Status,
    confidence: float,
    views: int,
    least: float,
) -> Calibration:
    """A calibration from the thresholds of TARGETS; the full model (mean 1) keeps all targets."""
    targets, thresholds = np.append(TARGETS, 1.0), np.append(np.clip(thresholds + _ABOVE, -1, 1), 1.0)
    return Calibration(status, confidence, views, targets, thresholds, np.append(slopes, 0.0), least)


def plan_nominal(
    models: Mapping[int, ViewModel],
    labels: Sequence[int],
    levels: int,
    distance: Float[np.ndarray, "V L"],
    cameras: Sequence[Camera],
    nominal: Float[np.ndarray, " J"],
) -> Int[np.ndarray, "V J L"]:
    """The lowest level (1 to `levels`) whose bound reaches each nominal target; the last without a bound."""
    planned = np.full((len(cameras), len(nominal), len(labels)), levels)
    for column, label in enumerate(labels):
        if label in models:
            bound = _bounds(models[label], distance[:, column], cameras)
            reached = bound[:, None, :] >= nominal[:, None]
            planned[..., column] = np.where(reached.any(2), reached.argmax(2) + 1, levels)
    return planned


@dataclass(frozen=True, eq=False)
class Trial:
    """Compositions planned for NOMINAL at viewpoints of one set, and what they measured."""

    labels: Sequence[int]  # of the columns, ascending
    cameras: Sequence[Camera]
    distance: Float32[np.ndarray, "V L"]  # d_min, world units
    shown: Bool[np.ndarray, "V L"]  # whether a viewpoint shows enough of a category to count
    planned: Int[np.ndarray, "V J L"]  # levels, 1 to K
    fidelity: Float32[np.ndarray, "V J L+1"]  # the last column is the whole image

    def views(self, label: int) -> Int[np.ndarray, " n"]:
        """Rows of the viewpoints that show a category."""
        return np.flatnonzero(self.shown[:, list(self.labels).index(label)])

    def critical(self, model: ViewModel) -> Float[np.ndarray, "G n"]:
        """For each of TARGETS the critical nominal target in the viewpoints that show the category."""
        column, rows = list(self.labels).index(model.label_id), self.views(model.label_id)
        bound = _bounds(model, self.distance[rows, column], [self.cameras[row] for row in rows])
        taken, got = self.planned[rows, :, column] - 1, self.fidelity[rows, :, column]
        return np.stack([critical_nominals(bound, NOMINAL, taken, got, target) for target in TARGETS])

    def missed(self, label: int) -> Int[np.ndarray, " J"]:
        """In how many of these viewpoints each of NOMINAL was missed."""
        rows = self.views(label)
        got = self.fidelity[rows][..., list(self.labels).index(label)]
        return (got < NOMINAL).sum(0)

    def least_support(self, model: ViewModel) -> float:
        """The least support of any of these viewpoints: further away nothing was tried."""
        column, rows = list(self.labels).index(model.label_id), self.views(model.label_id)
        distance = self.distance[rows, column].astype(np.float64)
        x = model.inputs_at(distance, *where([self.cameras[row] for row in rows], model.focal))
        return float(matern32(x, model.inputs, model.lengths).max(1).min())


def remove_composition_bias(
    models: Mapping[int, ViewModel], trial: Trial, confidence: float
) -> dict[int, ViewModel]:
    """The models with thresholds that allow for the neighbours' levels; `trial` was planned with the models.

    This is no calibration: it brings what is calibrated close to what is asked.
    """
    return {
        label: _asked(model, _empirical(trial.critical(model), confidence))
        if len(trial.views(label))
        else model
        for label, model in models.items()
    }


def hold_all_categories(
    models: Mapping[int, ViewModel], trial: Trial, confidence: float
) -> tuple[dict[int, ViewModel], Bool[np.ndarray, " G"]]:
    """The same, and targets at which all categories are held for those that cannot help themselves.

    `trial` was planned with models of `remove_composition_bias`. A category that still misses a target in
    more views than chance explains does so at any level of its own: its neighbours' low levels spill over it.
    All ask for the nominal target that keeps it.
    """
    floor, asked = np.full(len(TARGETS), -np.inf), {}
    for label, model in models.items():
        if not (views := len(trial.views(label))):
            continue
        asked[label] = _empirical(trial.critical(model), confidence)
        if views < fewest_views(confidence):
            continue
        chance = views * (1 - confidence) + _NOISE_SIGMAS * np.sqrt(views * confidence * (1 - confidence))
        spilled = np.interp(TARGETS, NOMINAL, (trial.missed(label) > chance).astype(float)) > 0
        floor = np.maximum(floor, np.where(spilled, asked[label], -np.inf))
    held = np.isfinite(floor)
    found = {
        label: _asked(model, np.maximum(asked[label], floor)) if label in asked else model
        for label, model in models.items()
    }
    return found, held


def _empirical(critical: Float[np.ndarray, "G n"], confidence: float) -> Float[np.ndarray, " G"]:
    return np.quantile(critical, confidence, axis=1, method="higher")


def calibrated(
    models: Mapping[int, ViewModel],
    trial: Trial,
    confidence: float,
    held: Bool[np.ndarray, " G"] = NOTHING_HELD,
) -> dict[int, ViewModel]:
    """The models with thresholds that keep each target at a confidence.

    Args:
        models: From `remove_composition_bias` or `hold_all_categories`.
        trial: Planned with these models, at viewpoints used for nothing else.
        confidence: Share of decisions that are to hold, between 0 and 1.
        held: Targets whose thresholds must not fall, as other categories need them.

    Returns:
        Models by label id. "calibrated" from 19 viewpoints that show the category (at 0.95). With fewer the
        nominal targets are the largest ones of all categories and of its own: "uncalibrated".
    """
    fewest, asked = fewest_views(confidence), {}
    for label, model in models.items():
        if len(trial.views(label)) >= fewest:
            values = [conformal_quantile(values, confidence) for values in trial.critical(model)]
            asked[label] = np.where(held, np.maximum(values, TARGETS), values)
    # nothing is known below the last level where not even one category could be calibrated
    widest = np.max([*asked.values()], axis=0) if asked else np.ones(len(TARGETS))
    found = {}
    for label, model in models.items():
        views = len(trial.views(label))
        nominal = asked.get(label)
        if nominal is None:
            nominal = np.maximum(widest, trial.critical(model).max(1)) if views else widest
        made = _asked(model, nominal)
        status = "calibrated" if label in asked else "uncalibrated"
        least = model.calibration.least_support
        least = min(least, trial.least_support(model)) if views else least
        calibration = replace(
            made.calibration, status=status, confidence=confidence, num_views=views, least_support=least
        )
        found[label] = replace(made, calibration=calibration)
    return found


def _asked(model: ViewModel, nominal: Float[np.ndarray, " G"]) -> ViewModel:
    """The model with the thresholds at which its present bound is `nominal`, the ones to ask for TARGETS."""
    now = model.calibration
    low = nominal - (now.targets[0] - now.thresholds[0])  # below the first target, as `Calibration.bound`
    known = np.interp(nominal, now.targets, now.thresholds)
    thresholds = np.where(nominal < now.targets[0], low, known)
    slopes = np.interp(nominal, now.targets, now.slopes)
    calibration = _calibration(
        thresholds, slopes, now.status, now.confidence, now.num_views, now.least_support
    )
    return replace(model, calibration=calibration)


def _bounds(
    model: ViewModel, distance: Float32[np.ndarray, " V"], cameras: Sequence[Camera]
) -> Float[np.ndarray, "V K"]:
    """The model's bounds at viewpoints; -1 where it gives none."""
    at = where(cameras, model.focal)
    return np.nan_to_num(model.predict(distance.astype(np.float64), *at).bound, nan=-1.0)
