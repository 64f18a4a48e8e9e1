"""Models of fidelity over the viewpoint, fitted to what every level measures at drawn viewpoints.

A Gaussian process per cell learns the expected fidelity of each level, all cells at the same level; those of
a category share their length scales. Each viewpoint predicted without itself gives preliminary thresholds of
the categories. `adapt.calibrate_fidelity` makes them keep targets.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from sagesplat.adapt.calibrate import AT_A_PHOTO, conformal_quantile, critical_margins
from sagesplat.adapt.calibrate_fidelity import LEAST_SUPPORT_SHARE, TARGETS, calibration_of
from sagesplat.adapt.cell_models import (
    FACTOR_STEP,
    LOG_STEP,
    STEP,
    VALUE_STEP,
    CellModel,
    FidelityModel,
    factors_of,
    shapes_of,
    strictness_of,
    views_of,
)
from sagesplat.adapt.cells import Cells, Sight, look
from sagesplat.adapt.fidelity import SampledFidelity
from sagesplat.adapt.process import fit_together, matern32, values_at
from sagesplat.adapt.viewpoint import PHOTO_LENGTHS, away_from, monotone, where
from sagesplat.scene.scene import Camera

_MARGINS = (-1.0, 10.0)  # limits of those of preliminary thresholds
MOST_PHOTOS = 256  # by which it is known how far a place is from the photos
# Inducing views, of all that the models learn from: what a browser loads grows with them. Built-in scene and
# dinosaur, 400 viewpoints, error over that with all of them: 48 1.16 and 1.10; 64 1.13 and 1.06; 96 1.08 and
# 1.04; 128 1.07 and 1.02.
MOST_INDUCING = 60
CELL_SHARE = 5e-4  # of a picture that a cell has to cover where its model learns
_TOWARDS = 4.0  # views that a category's mean counts as, beside those of a cell


def fit_fidelity(
    sampled: SampledFidelity,
    cells: Cells,
    cameras: Sequence[Camera],
    extent: float,
    confidence: float,
    focal: float,
    screens: tuple[float, float],
    photos: Sequence[Camera],
) -> dict[int, FidelityModel]:
    """Fit the expected fidelity of each cell over the viewpoint, with preliminary thresholds by category.

    Args:
        sampled: Of the cells, measured at V viewpoints that are used for nothing else.
        cells: Where they are.
        cameras: The V viewpoints.
        extent: Of the scene, world units.
        confidence: Of the preliminary thresholds.
        focal: Of the photos, pixels.
        screens: Of the viewpoints (`FidelityModel`).
        photos: At least one camera; margins grow away from them.

    Returns:
        Models by label id; a category that is shown in no viewpoint has none. They are not calibrated yet.
    """
    views = views_of(cameras, extent, focal, screens)
    sight, places = look(cells, cameras), photo_places(photos, extent)
    inducing = _farthest(views, MOST_INDUCING, (*PHOTO_LENGTHS, 1.0))
    whole = sampled.by_label(cells.label_of)
    models, shown = {}, whole.shown()
    for column, label in enumerate(whole.labels):
        if shown[:, column].any():
            mine = np.flatnonzero(cells.labels == label)
            part = _Part(mine, cells.ids[mine].tolist(), sampled, sight)
            rows = np.flatnonzero(shown[:, column])
            models[label] = _fit(
                label, part, views, inducing, whole.fidelity[rows, column].astype(np.float64), rows,
                confidence, places, extent, focal, screens,
            )  # fmt: skip
    return models


@dataclass(frozen=True, eq=False)
class _Part:
    """The cells of one category at the viewpoints."""

    columns: Int[np.ndarray, " c"]
    ids: list[int]
    sampled: SampledFidelity
    sight: Sight


def _fit(
    label: int,
    part: _Part,
    views: Float[np.ndarray, "V 8"],
    inducing: Int[np.ndarray, " M"],  # rows of the views that stay in the model
    category: Float[np.ndarray, "n K"],  # fidelity in the rows that show it
    rows: Int[np.ndarray, " n"],
    confidence: float,
    photos: Float[np.ndarray, "6 P"],
    extent: float,
    focal: float,
    screens: tuple[float, float],
) -> FidelityModel:
    sampled, sight = part.sampled, part.sight
    shares = sampled.shares()
    factors, average = factors_of(sight, shares), category.mean(0)
    places = (np.arange(len(average)) + 0.5) / len(average)
    seen = [np.flatnonzero(shares[:, column] >= CELL_SHARE) for column in part.columns]
    inputs, offsets, shapes, terms, medians = [], [], [], [], []
    for column, own in zip(part.columns, seen, strict=True):
        values = sampled.fidelity[own, column].astype(np.float64)
        distance = sight.distance[own, column]
        logs = np.log(distance[distance > 0])
        medians.append(round(float(np.median(logs)), 4) if len(logs) else 0.0)
        log = np.where(distance > 0, np.log(np.where(distance > 0, distance, 1.0)), medians[-1])
        inputs.append(np.column_stack([views[own], log]))
        offsets.append(((values.sum(0) + _TOWARDS * average) / (len(own) + _TOWARDS)).round(4))
        shapes.append(shapes_of(offsets[-1], places))
        terms.append(terms_of(values - offsets[-1], shapes[-1]))
    induces = [np.isin(own, inducing) for own in seen]
    process = fit_together(inputs, terms, induces, shapes)
    known = np.round(views[inducing] / STEP) * STEP
    cells, left_out = [], np.full((*shares.shape, len(average)), np.nan)
    for i, (column, own, kept) in enumerate(zip(part.columns, seen, induces, strict=True)):
        left_out[own, column] = monotone(offsets[i] + process.left_out[i] @ shapes[i])
        rows_of_cell = np.searchsorted(inducing, own[kept])
        logs = np.round(inputs[i][kept, -1] / LOG_STEP) * LOG_STEP
        sent = np.column_stack([known[rows_of_cell], logs])
        values = values_at(sent, inputs[i][kept], process.weights[i], process.lengths)
        values = np.round(values.T / VALUE_STEP).astype(int)
        told = factors[inducing, column]
        told = np.where(told < 0, -1, np.round(told / FACTOR_STEP) * FACTOR_STEP)
        cells.append(CellModel(part.ids[i], offsets[i], places, rows_of_cell, logs, medians[i], values, told))
    # the category at equal levels, from its cells without the view
    weight = np.where(np.isnan(left_out[:, part.columns, 0]), 0, shares[:, part.columns])[rows]
    sums = np.einsum("vc,vck->vk", weight, np.nan_to_num(left_out[:, part.columns])[rows])
    total = weight.sum(1, keepdims=True)
    without = np.where(total > 0, sums / np.where(total > 0, total, 1), average)
    near = matern32(views, views[inducing], process.lengths[:3])
    near[inducing, np.arange(len(inducing))] = 0
    scale = AT_A_PHOTO + away_from(views[rows], photos, near[rows].max(1))
    told = 1 - (1 - without) * strictness_of(views[rows], views[inducing])[:, None]
    margins = np.clip(
        [
            np.quantile(critical_margins(told, category, target, scale), confidence, method="higher")
            for target in TARGETS
        ],
        *_MARGINS,
    )
    # that of an adopted splat is compared with what came in; of too few views the worst
    last = max(-float(conformal_quantile(-category[:, -1], confidence)), float(category[:, -1].min()))
    return FidelityModel(
        label_id=label,
        extent=extent,
        focal=focal,
        screens=screens,
        views=known,
        lengths=process.lengths,
        photos=photos,
        cells=tuple(cells),
        rmse=float(np.sqrt(((without - category) ** 2).mean(0)).mean()),
        calibration=calibration_of(
            TARGETS + AT_A_PHOTO * margins, margins, "uncalibrated", confidence, 0,
            LEAST_SUPPORT_SHARE * float(near[rows].max(1).min()), last,
        ),
    )  # fmt: skip


def terms_of(
    deviations: Float[np.ndarray, "n K"], shapes: Float[np.ndarray, "J K"]
) -> Float[np.ndarray, "n J"]:
    """The terms that come closest to deviations of all levels, each as a part of what is missing."""
    missing = shapes[:1]  # the first cosine is 1
    moves, parts = (
        np.divide(of, missing, out=np.zeros(of.shape), where=missing > 0) for of in (shapes, deviations)
    )
    return parts @ np.linalg.pinv(moves)


def photo_places(photos: Sequence[Camera], extent: float) -> Float[np.ndarray, "6 P"]:
    """`ViewModel.photos` of cameras, at most `MOST_PHOTOS`."""
    position, direction, _ = where(photos, 1.0)
    places = np.column_stack([position / extent, direction])
    return places[_farthest(places, MOST_PHOTOS, PHOTO_LENGTHS)].T


def _farthest(places: Float[np.ndarray, "n D"], most: int, lengths: Sequence[float]) -> Int[np.ndarray, " m"]:
    """Rows of at most so many of n >= 1 places, ascending: each is the farthest from those before it."""
    chosen, away = [0], np.full(len(places), np.inf)
    while len(chosen) < min(most, len(places)):
        away = np.minimum(away, 1 - matern32(places, places[chosen[-1:]], lengths)[:, 0])
        chosen.append(int(away.argmax()))
    return np.unique(chosen)
