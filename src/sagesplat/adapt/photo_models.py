"""Models of SSIM against photos: Eq. 3 and a Gaussian process per category, calibrated by view.

The process learns from training and calibration views (`adapt.process`). Photos are too few to keep some for
calibration alone, so each view is predicted without itself, and `adapt.calibrate_photos` turns these
predictions into thresholds. Observations have all categories at the same level, and the SSIM of one changes
with the levels of its neighbours: what it gains or loses in compositions is measured, and calibrated with.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sagesplat.adapt.calibrate_photos import LeftOut, calibrate_photos, with_changes
from sagesplat.adapt.eq3 import SsimModel, fit_models
from sagesplat.adapt.observe import TOTAL, Observations
from sagesplat.adapt.process import fit_process, inputs_of, matern32
from sagesplat.adapt.viewpoint import PHOTOS_ONLY, ViewModel, means_at, monotone
from sagesplat.scene.scene import Scene


class PhotoFit(NamedTuple):
    """One category's model before calibration, and its views, each predicted without itself."""

    model: ViewModel
    left_out: LeftOut


class Measured(NamedTuple):
    """Views that show one category, measured at all of its levels."""

    rows: np.ndarray  # [n] rows of Scene.views
    ssim: Float[np.ndarray, "n K"]
    distance: Float[np.ndarray, " n"]  # world units; NaN: unknown
    position: Float[np.ndarray, "n 3"]
    direction: Float[np.ndarray, "n 3"]


def fit_photo_models(
    observations: Observations,
    scene: Scene,
    confidence: float = 0.95,
    curves: Mapping[tuple[int, int], SsimModel] | None = None,
) -> dict[int, ViewModel]:
    """Fit a calibrated model of SSIM against photos per category: Eq. 3, a Gaussian process, and thresholds.

    Rows of test views and of the full image are ignored. A category has the levels that Eq. 3 could be fitted
    for, and learns from the views measured at all of them.

    Args:
        observations: Rows of `observe`.
        scene: The capture; its training and calibration views are used.
        confidence: 1 - the accepted risk of a violated target, between 0 and 1.
        curves: Result of `fit_models` on the same rows, if it is at hand.

    Returns:
        Models by label id. A category that no view shows at all levels has none.

    Raises:
        RunError: For an impossible confidence.

    Example:
        >>> from sagesplat import open_run
        >>> from sagesplat.adapt.observe import read_observations
        >>> from sagesplat.adapt.photo_models import fit_photo_models
        >>> run = open_run("runs/garden").job  # doctest: +SKIP
        >>> models = fit_photo_models(read_observations(run.run.observations), run.scene)  # doctest: +SKIP
    """
    return calibrated(fit_photos(observations, scene, curves), confidence)


def fit_photos(
    observations: Observations, scene: Scene, curves: Mapping[tuple[int, int], SsimModel] | None = None
) -> dict[int, PhotoFit]:
    """What `fit_photo_models` calibrates, by label id."""
    rows = observations.select((observations.label_id != TOTAL) & np.isfinite(observations.ssim))
    seen = set(rows.label_id.tolist())
    curves = fit_models(rows, scene.train_ids) if curves is None else curves
    curves = {key: curve for key, curve in curves.items() if key[0] in seen}
    if absent := seen - {label for label, _ in curves}:  # not in any training view
        late = rows.select(np.isin(rows.label_id, list(absent)))
        curves |= fit_models(late, scene.calibration_ids)
    fits = {}
    for label_id in sorted({label for label, _ in curves}):
        mine = tuple(curve for (label, _), curve in sorted(curves.items()) if label == label_id)
        if fitted := _fit(rows.select(rows.label_id == label_id), scene, mine):
            fits[label_id] = fitted
    return fits


def in_composition(
    fits: Mapping[int, PhotoFit], changes: Mapping[int, Mapping[int, Float[np.ndarray, " G"]]]
) -> dict[int, PhotoFit]:
    """The fits with what was measured in compositions, by label id and row (`with_changes`)."""
    found = {}
    for label, fit in fits.items():
        near = matern32(fit.model.inputs, fit.model.inputs, fit.model.lengths)
        found[label] = fit._replace(left_out=with_changes(fit.left_out, changes.get(label, {}), near))
    return found


def calibrated(fits: Mapping[int, PhotoFit], confidence: float) -> dict[int, ViewModel]:
    """The models with their thresholds; RunError for an impossible confidence."""
    found = calibrate_photos({label: fit.left_out for label, fit in fits.items()}, confidence)
    return {label: replace(fit.model, calibration=found[label]) for label, fit in fits.items()}


def measured_at(
    observations: Observations, scene: Scene, label_id: int, levels: Sequence[int], views: np.ndarray
) -> Measured:
    """What was measured of a category in those of some views that have all of its levels."""
    wanted = np.array(levels)
    mine = observations.select(
        (observations.label_id == label_id)
        & np.isin(observations.view, views)
        & np.isin(observations.level, wanted)
    )
    rows, row = np.unique(mine.view, return_inverse=True)
    ssim = np.full((len(rows), len(wanted)), np.nan)
    ssim[row, np.searchsorted(wanted, mine.level)] = mine.ssim
    distance = np.full(len(rows), np.nan)
    distance[row] = mine.distance
    whole = np.isfinite(ssim).all(1)
    cameras = [scene.views[row].camera for row in rows[whole]]
    position = np.array([camera.position for camera in cameras], np.float64).reshape(-1, 3)
    direction = np.array([camera.direction for camera in cameras], np.float64).reshape(-1, 3)
    return Measured(rows[whole], ssim[whole], distance[whole], position, direction)


def _fit(rows: Observations, scene: Scene, curves: tuple[SsimModel, ...]) -> PhotoFit | None:
    known = np.concatenate([scene.train_ids, scene.calibration_ids])
    label_id, levels = curves[0].label_id, [curve.level for curve in curves]
    views, ssim, distance, position, direction = measured_at(rows, scene, label_id, levels, known)
    if not len(views):
        return None
    in_sight = np.log(distance[distance > 0])
    median_log_distance = float(np.median(in_sight)) if len(in_sight) else 0.0
    extent = scene.scale
    x = inputs_of(distance, position, direction, extent, median_log_distance)
    heldout = np.isin(views, scene.calibration_ids)
    means = means_at(curves, distance)
    process = fit_process(x, heldout, ssim - means)
    left_out = monotone(means + process.left_out)
    near = matern32(x, x, process.lengths)
    np.fill_diagonal(near, 0)
    model = ViewModel(
        label_id=label_id,
        quality="ssim",
        curves=curves,
        extent=extent,
        median_log_distance=median_log_distance,
        focal=float(np.median([view.camera.focal for view in scene.views])),
        screens=PHOTOS_ONLY,
        inputs=x,
        heldout_inputs=heldout,
        lengths=process.lengths,
        heldout_variance=process.heldout_variance,
        photos=np.zeros((6, 0)),
        weights=process.weights,
        rmse=float(np.sqrt(np.mean((left_out - ssim) ** 2))),
    )
    return PhotoFit(model, LeftOut.alone(views, heldout, left_out, ssim, near.max(1)))
