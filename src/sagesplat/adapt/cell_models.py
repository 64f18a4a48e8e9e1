"""Models of fidelity: what to expect of each cell at each level from any viewpoint, promised by category.

Levels are chosen cell by cell; what is promised is the category's fidelity, over the pixels of its cells:

    mean_uk  = offset_uk + missing_uk * sum_j cos(pi j t_k) p_uj            of cell u at level k, monotone;
               t_k = (k - 1/2) / K, j = 0 to 5
    missing  = max(1 - offset, 0.025); 0 where the offset is 1
    p_uj     = sum_i c(x, x_i) weights_uij                                  c, x: the kernel and the inputs of
               (C + 0.001 I) weights = values, C_ij = c(x_i, x_j)           `adapt.process`, with the distance
                                                                            of the cell (`adapt.cells`)
    share_u  = apparent_u * factor_u / max(1, sum over all cells)           of the picture's pixels; of a cell
                                                                            in sight at least 0.0001
    factor_u = (sum_i k_i v_ui + 0.001 v_u) / (sum_i k_i + 0.001)           k_i: by position and direction
               v_ui: true share over `apparent` in view i, what others leave of the cell; v_u: their mean
    mean     = sum_u share_u mean_u,level(u) / sum_u share_u                of the category's composition
    needed   = 1 - (1 - threshold - slope * away) / strictness              of a target (`adapt.viewpoint`),
               at most the mean of all cells' last levels                   up to the last target
    strictness = exp(0.15 f + 0.05 s - 0.2 f s)                             logs of field and screen; over
                                                                            that of the known views; 1 where
                                                                            there is but one category

So what is missing to the full model, over what is missing on average, is a few cosines over the levels: views
differ by 0.35 of it, of which six leave 0.05 (docs/developers/promises.md). Numbers are whole steps of units:
a viewer has the same ones (`viewer.promises`).

A target is kept where the mean reaches what is needed. Through wide lenses and on fine screens compositions
measure less than their means more often, and thresholds are found over all of them: hence the strictness. Not
of a splat of one category: there it kept fewer promises (docs/developers/promises.md). A viewpoint's support
is the kernel by position, direction and screen to the nearest known view; below `least_support` nothing is
promised.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from sagesplat.adapt.cells import Cells, Sight, look
from sagesplat.adapt.process import inputs_of, matern32, weights_from
from sagesplat.adapt.viewpoint import (
    NO_CALIBRATION,
    PHOTO_LENGTHS,
    Calibration,
    QualityKind,
    Status,
    check_parts,
    monotone,
    where,
)
from sagesplat.core.limits import LabelId, Number, Positive
from sagesplat.io.files import write_json
from sagesplat.io.typed import read_json_as, refused, to_plain
from sagesplat.scene.scene import Camera

LEAST_SHARE = 1e-4  # of a cell in sight: it may be there though it was hidden in all known views
MOST_FACTOR = 4.0  # of a share over what it would be unhidden
_PRIOR = 1e-3  # weight of a factor's mean
TERMS = 6  # cosines over the levels
LEAST_MISSING = 0.025  # that a level's deviation is a part of
# steps of positions over the extent, directions, log screens and log fields; of log distances; of values;
# of factors
STEP, LOG_STEP, VALUE_STEP, FACTOR_STEP = 1e-4, 0.02, 0.03, 0.05
_STRICTER = np.array([0.05, 0.15])  # of screen and field: docs/developers/promises.md compares them
_BOTH_STRICTER = -0.2


@dataclass(frozen=True, eq=False)
class CellModel:
    """The fidelity of one cell; `rows` are views of its `FidelityModel`."""

    cell: LabelId
    offsets: Float[np.ndarray, " K"]  # mean of each level
    places: Float[np.ndarray, " K"]  # t_k, of each level
    rows: Int[np.ndarray, " n"]  # views behind the process; none: the offsets are all there is
    log_distances: Float[np.ndarray, " n"]  # log of the cell's distance in them
    median_log_distance: Number  # where it is unknown
    values: Int[np.ndarray, "J n"]  # of the terms in them, in VALUE_STEP
    factors: Float[np.ndarray, " V"]  # v_ui of the module's text; -1: the view tells nothing


@dataclass(frozen=True, eq=False)
class FidelityModel:
    """What fidelity to expect of one category (formulas: the module's text)."""

    label_id: LabelId
    extent: Positive  # of the scene, world units
    focal: Positive  # of the photos, pixels: what screens are measured by
    screens: tuple[Positive, Positive]  # from and to; what lies outside counts as the end of it
    views: Float[np.ndarray, "V 8"]  # position / extent, direction, log screen, log field
    lengths: tuple[Positive, Positive, Positive, Positive]  # of the groups of inputs
    photos: Float[np.ndarray, "6 P"]  # position / extent and direction of photos
    cells: tuple[CellModel, ...]  # ascending
    rmse: Number  # of the category at equal levels, each view predicted without itself; over all levels
    calibration: Calibration = field(default=NO_CALIBRATION)
    quality: ClassVar[QualityKind] = "fidelity"

    @property
    def levels(self) -> tuple[int, ...]:
        """The levels that it predicts, ascending."""
        return tuple(range(1, len(self.cells[0].offsets) + 1))

    def own_inputs(self, cell: CellModel) -> Float[np.ndarray, "n 9"]:
        """The inputs of the views behind a cell's process."""
        return np.column_stack([self.views[cell.rows], cell.log_distances])

    @cached_property
    def weights(self) -> tuple[np.ndarray, ...]:
        """The weights of each cell's n views, from its values in them: [n, J]."""
        return tuple(
            weights_from(self.own_inputs(cell), VALUE_STEP * cell.values.T, self.lengths)
            for cell in self.cells
        )

    @property
    def num_views(self) -> int:
        """Views in it that show some of its cells."""
        return len(np.unique(np.concatenate([cell.rows for cell in self.cells])))

    @property
    def status(self) -> Status:
        """One of STATUSES."""
        return self.calibration.status

    @property
    def confidence(self) -> float:
        """Share of accepted decisions that hold."""
        return self.calibration.confidence


@dataclass(frozen=True, eq=False)
class Expected:
    """What is expected of C cells of L categories from V viewpoints."""

    cells: Int[np.ndarray, " C"]  # ids, ascending
    labels: Int[np.ndarray, " L"]  # ids, ascending; of categories without a model too
    column: Int[np.ndarray, " C"]  # of each cell's category among the labels
    mean: Float[np.ndarray, "V C K"]  # NaN: of a category without a model
    share: Float[np.ndarray, "V C"]  # of the picture's pixels; 0: out of sight
    distance: Float[np.ndarray, "V C"]  # world units; NaN: out of sight
    support: Float[np.ndarray, "V L"]  # NaN without a model
    away: Float[np.ndarray, " V"]  # 0 at a photo, 1 far from all
    strictness: Float[np.ndarray, " V"]  # divides the loss that thresholds allow

    def at(self, view: int) -> "Expected":
        """What is expected from one of the viewpoints."""
        one = slice(view, view + 1)
        of_views = ("mean", "share", "distance", "support", "away", "strictness")
        arrays = {name: getattr(self, name)[one] for name in of_views}
        return replace(self, **arrays)

    @property
    def member(self) -> Bool[np.ndarray, "C L"]:
        """Which cells are of which categories."""
        return self.column[:, None] == np.arange(len(self.labels))

    def category_shares(self) -> Float[np.ndarray, "V L"]:
        """Share of the picture's pixels of each category."""
        return self.share @ self.member

    @property
    def last(self) -> Float[np.ndarray, "V L"]:
        """Expected fidelity of each category at the last level; NaN out of sight."""
        return self.of_composition(np.full(self.share.shape, self.mean.shape[2]))

    def of_composition(self, levels: Int[np.ndarray, "V C"]) -> Float[np.ndarray, "V L"]:
        """Expected fidelity of each category in compositions (levels from 1); NaN out of sight."""
        at = np.take_along_axis(self.mean, levels[..., None] - 1, 2)[..., 0]
        seen = self.share > 0
        unknown = seen & np.isnan(at)  # in a product with `member`, NaN would reach other categories too
        value, weight = np.where(seen & ~unknown, self.share * at, 0) @ self.member, self.category_shares()
        known = (weight > 0) & ~(unknown @ self.member)
        return np.where(known, value / np.where(known, weight, 1), np.nan)


def expect(
    models: Mapping[int, FidelityModel], cells: Cells, cameras: Sequence[Camera], levels: int
) -> Expected:
    """What V cameras are expected to see of the cells, at each of `levels` levels.

    Models of fewer levels have their last one from there on.
    """
    labels, column = np.unique(cells.labels, return_inverse=True)
    sight = look(cells, cameras)
    shape = len(cameras), len(cells.ids)
    mean, factor = np.full((*shape, levels), np.nan), np.ones(shape)
    support = np.full((len(cameras), len(labels)), np.nan)
    away, strictness = np.zeros(len(cameras)), np.ones(len(cameras))
    place = {cell: i for i, cell in enumerate(cells.ids.tolist())}
    for label, model in models.items():
        known = views_of(cameras, model.extent, model.focal, model.screens)
        away = 1 - matern32(known[:, :6], model.photos.T, PHOTO_LENGTHS).max(1)
        if len(models) > 1:
            strictness = strictness_of(known, model.views)
        support[:, np.searchsorted(labels, label)] = matern32(known, model.views, model.lengths[:3]).max(1)
        near = matern32(known[:, :6], model.views[:, :6], PHOTO_LENGTHS)
        for cell, weights in zip(model.cells, model.weights, strict=True):
            i = place[cell.cell]
            of_levels = cell_means(model, cell, weights, known, sight.distance[:, i])
            mean[:, i] = of_levels[:, np.minimum(np.arange(levels), of_levels.shape[1] - 1)]
            factor[:, i] = visible_factor(near, cell.factors)
    share = sight.apparent * factor
    share /= np.maximum(share.sum(1, keepdims=True), 1)
    share = np.where(sight.apparent > 0, np.maximum(share, LEAST_SHARE), 0)
    return Expected(cells.ids, labels, column, mean, share, sight.distance, support, away, strictness)


def views_of(
    cameras: Sequence[Camera], extent: float, focal: float, screens: tuple[float, float]
) -> Float[np.ndarray, "V 8"]:
    """The inputs of viewpoints without distances, as `FidelityModel.views`."""
    position, direction, screen = where(cameras, focal)
    field = np.sqrt([camera.width * camera.height / camera.focal**2 for camera in cameras])
    screen = np.clip(screen, *screens)
    return inputs_of(np.ones(len(cameras)), position, direction, extent, 0.0, screen, field)[:, :-1]


def strictness_of(
    views: Float[np.ndarray, "V 8"], known: Float[np.ndarray, "N 8"]
) -> Float[np.ndarray, " V"]:
    """What divides the loss that thresholds allow, of viewpoints (`views_of`); `known`: those of a model."""
    here, usual = (of[:, 6:] @ _STRICTER + _BOTH_STRICTER * of[:, 6] * of[:, 7] for of in (views, known))
    return np.exp(here - usual.mean())


def cell_means(
    model: FidelityModel,
    cell: CellModel,
    weights: Float[np.ndarray, "n J"],
    known: Float[np.ndarray, "V 8"],
    distance: Float[np.ndarray, " V"],
) -> Float[np.ndarray, "V K"]:
    """The mean of a cell's levels at viewpoints with these inputs and distances."""
    mean = np.repeat(cell.offsets[None], len(known), 0)
    if len(cell.rows):
        seen = np.isfinite(distance) & (distance > 0)
        log = np.where(seen, np.log(np.where(seen, distance, 1.0)), cell.median_log_distance)
        terms = matern32(np.column_stack([known, log]), model.own_inputs(cell), model.lengths) @ weights
        mean = mean + terms @ shapes_of(cell.offsets, cell.places)
    return monotone(mean)


def shapes_of(offsets: Float[np.ndarray, " K"], places: Float[np.ndarray, " K"]) -> Float[np.ndarray, "J K"]:
    """By how much each term moves the levels: missing_k * cos(pi j t_k)."""
    missing = np.where(offsets < 1, np.maximum(1 - offsets, LEAST_MISSING), 0)
    return missing * np.cos(np.pi * np.arange(TERMS)[:, None] * places)


def visible_factor(
    near: Float[np.ndarray, "V N"], factors: Float[np.ndarray, " N"]
) -> Float[np.ndarray, " V"]:
    """What others leave of a cell, from what they leave in known views; `near`: the kernel to these."""
    tells = factors >= 0
    if not tells.any():
        return np.ones(len(near))
    weight = near[:, tells]
    return (weight @ factors[tells] + _PRIOR * factors[tells].mean()) / (weight.sum(1) + _PRIOR)


def factors_of(sight: Sight, shares: Float[np.ndarray, "V C"]) -> Float[np.ndarray, "V C"]:
    """v_ui from the true shares of pixels."""
    seen = sight.apparent > 0
    found = shares / np.where(seen, sight.apparent, 1)
    return np.where(seen, np.clip(found, 0, MOST_FACTOR), -1.0)


def promised(
    models: Mapping[int, FidelityModel], expected: Expected, composed: Float[np.ndarray, "V L"]
) -> Float[np.ndarray, "V L"]:
    """The largest target that each category keeps, by its composition's mean; NaN: nothing is promised."""
    found, last = np.full(composed.shape, np.nan), expected.last
    for column, label in enumerate(expected.labels.tolist()):
        if label in models:
            calibration = models[label].calibration
            found[:, column] = calibration.bound(
                composed[:, [column]], expected.support[:, column], expected.away, expected.strictness,
                last[:, column],
            )[:, 0]  # fmt: skip
    return found


def needed(
    models: Mapping[int, FidelityModel], expected: Expected, target: float
) -> Float[np.ndarray, "V L"]:
    """The mean from which on each category keeps a target; NaN: nothing is promised."""
    found, last = np.full(expected.support.shape, np.nan), expected.last
    for column, label in enumerate(expected.labels.tolist()):
        if label in models:
            calibration, support = models[label].calibration, expected.support[:, column]
            least = support >= calibration.least_support
            asked = calibration.needed(target, expected.away, expected.strictness, last[:, column])
            found[:, column] = np.where(least, asked, np.nan)
    return found


def write_fidelity(path: Path, models: Mapping[int, FidelityModel]) -> None:
    """fidelity.json: one entry per category."""
    write_json(path, {"models": [to_plain(model) for model in models.values()]})


@dataclass(frozen=True, eq=False)
class _Models:
    models: list[FidelityModel]


def read_fidelity(path: Path | str) -> dict[int, FidelityModel]:
    """What `write_fidelity` wrote; DataError where the content cannot be used."""
    path, what, cure = Path(path), "a file of fidelity models", "delete it and run `sagesplat fit` again"
    models = read_json_as(path, _Models, what, cure).models
    with refused(path, what, cure):
        for model in models:
            _check(model)
    return {model.label_id: model for model in models}


def _check(model: FidelityModel) -> None:
    """ValueError for a model whose parts do not belong together."""
    V = len(model.views)
    if not (model.cells and len(model.cells[0].offsets) and V and model.photos.size):
        raise ValueError("a model of nothing")
    check_parts(model.calibration, model.screens, model.views, model.photos)
    for cell in model.cells:
        terms, n = cell.values.shape
        if (len(cell.rows), len(cell.log_distances), terms) != (n, n, TERMS) or len(cell.factors) != V:
            raise ValueError("lists of unequal length")
        if {len(cell.places), len(cell.offsets)} != {len(model.levels)}:
            raise ValueError("cells of unequal levels")
        if n and (cell.rows.min() < 0 or cell.rows.max() >= V):
            raise ValueError("views out of range")
        numbers = cell.offsets, cell.places, cell.log_distances, cell.values, cell.factors
        check_parts(NO_CALIBRATION, model.screens, *numbers)
