"""Calibrates models of fidelity, in compositions measured at viewpoints that nothing was fitted to.

1. "bias": compositions planned by preliminary thresholds for a range of nominal targets are measured, and the
   thresholds corrected so that they allow for neighbours at other levels (`remove_composition_bias`). Where a
   category misses a target at any level of its own, as its neighbours spill over it, all categories are held
   at the nominal target that keeps it (`hold_all_categories`).
2. "calibration": split conformal prediction says which nominal target to ask for, so that each target is kept
   at the confidence, category by category (`adapt.calibrate`). Neighbours' levels move with that, so it is
   done twice.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from sagesplat.adapt.calibrate import conformal_quantile, critical_asks, fewest_views
from sagesplat.adapt.cell_models import Expected, FidelityModel, needed, promised
from sagesplat.adapt.cell_plans import reach
from sagesplat.adapt.viewpoint import Calibration, Status

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
_NOISE_SIGMAS = 3.0  # standard deviations of a share of views that are no more than chance
# Of the least support of the viewpoints drawn, below which nothing is promised. One more from the same
# distribution is often a little sparser where they lie far apart: on the built-in capture 8 % of decisions of
# those walking and 14 % of those stepping back had no promise with 1, 2 % and 6 % have none with this.
LEAST_SUPPORT_SHARE = 0.7
_NEAR = 0.15  # `Expected.away` of viewpoints that count as on the capture's path
# Of the share of decisions that may miss on the capture's path: on some screens and through some lenses more
# do than of all viewpoints, and each kind is to keep its share (docs/developers/promises.md).
_OF_MISSES = 0.8
_FEW = 10  # viewpoints on it, and off it, from which on both are looked at
_STEEPEST, _HALVINGS = 2.0, 20  # of thresholds over `Expected.away`


def calibration_of(
    thresholds: Float[np.ndarray, " G"],
    slopes: Float[np.ndarray, " G"],
    status: Status,
    confidence: float,
    views: int,
    least: float,
    last: float,
) -> Calibration:
    """A calibration from the thresholds of TARGETS; up to `last` the last levels keep all, and above none."""
    below = last > TARGETS
    targets = np.append(TARGETS[below], last)
    thresholds = np.append(np.clip(thresholds[below] + _ABOVE, -1, 1), 1.0)
    return Calibration(status, confidence, views, targets, thresholds, np.append(slopes[below], 0.0), least)


def plan_nominal(
    models: Mapping[int, FidelityModel],
    expected: Expected,
    cost: Int[np.ndarray, "C K"],
    nominal: Float[np.ndarray, " J"],
) -> Int[np.ndarray, "V J C"]:
    """The levels (from 1) of the fewest bytes by which each category reaches each nominal target.

    A category is at its last level where nothing is promised, and a cell out of sight at its first one.
    `cost`: bytes of each cell's levels.
    """
    V, C = expected.share.shape
    planned = np.ones((V, len(nominal), C), int)
    for j, target in enumerate(nominal):
        least = needed(models, expected, float(target))
        for row in range(V):
            planned[row, j] = (
                reach(cost, expected.mean[row], expected.share[row], expected.column, least[row]).levels + 1
            )
    return planned


def trial_of(
    models: Mapping[int, FidelityModel],
    expected: Expected,
    planned: Int[np.ndarray, "V J C"],
    shown: Bool[np.ndarray, "V L"],
    fidelity: Float32[np.ndarray, "V J L"],
) -> "Trial":
    """What compositions of `plan_nominal` measured, beside what is promised of them."""
    mean = np.stack([expected.of_composition(planned[:, j]) for j in range(len(NOMINAL))], 1)
    bound = np.stack([promised(models, expected, mean[:, j]) for j in range(len(NOMINAL))], 1)
    threshold = np.full(mean.shape, np.nan)
    for column, label in enumerate(expected.labels.tolist()):
        if label in models:
            asked = np.repeat(NOMINAL[:, None], len(expected.away), 1)
            threshold[..., column] = models[label].calibration.needed(asked, expected.away).T
    steps = np.diff(planned, axis=1) @ expected.member
    return Trial(
        expected.labels.tolist(), shown, expected.support, expected.away, bound, np.minimum(threshold, 1),
        1 - (1 - mean) * expected.strictness[:, None, None], np.maximum(steps, 0), fidelity,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Decisions:
    """What the viewpoints that show a category say of it."""

    critical: Float[np.ndarray, "G n"]  # for each of TARGETS the critical nominal target
    needs: Float[np.ndarray, "G n"]  # the critical threshold of each
    away: Float[np.ndarray, " n"]

    @property
    def near(self) -> Bool[np.ndarray, " n"]:
        """Which viewpoints are on the capture's path."""
        return self.away < _NEAR

    def kinds(self, fewest: int) -> tuple[bool | None, ...]:
        """On the path and off it, if there are enough viewpoints of both to look at them apart; else all."""
        near = int(self.near.sum())
        return (True, False) if min(near, len(self.away) - near) >= fewest else (None,)

    def of(self, kind: bool | None) -> "Decisions":
        """Of the viewpoints on the path (True), off it (False), or of all (None)."""
        if kind is None:
            return self
        rows = self.near == kind
        return Decisions(self.critical[:, rows], self.needs[:, rows], self.away[rows])

    def for_model(self, model: FidelityModel) -> "Decisions":
        """The thresholds of the model at which its bound is `critical`."""
        needs = np.minimum(model.calibration.needed(self.critical, self.away), 1)
        return replace(self, needs=needs)

    def joined(self, others: Sequence["Decisions"]) -> "Decisions":
        """With those of others after them."""
        parts = [self, *others]
        critical, needs = (np.hstack([getattr(one, name) for one in parts]) for name in ("critical", "needs"))
        return Decisions(critical, needs, np.concatenate([one.away for one in parts]))


@dataclass(frozen=True, eq=False)
class Trial:
    """Compositions planned for NOMINAL at viewpoints of one set, and what they measured."""

    labels: Sequence[int]  # of the columns, ascending
    shown: Bool[np.ndarray, "V L"]  # whether a viewpoint shows enough of a category to count
    support: Float[np.ndarray, "V L"]  # of the viewpoints; NaN without a model
    away: Float[np.ndarray, " V"]  # 0 at a photo, 1 far from all
    bound: Float[np.ndarray, "V J L"]  # what is promised of the compositions; NaN: nothing
    threshold: Float[np.ndarray, "V J L"]  # that they were planned for, and what they are expected to have;
    mean: Float[np.ndarray, "V J L"]  # both where the allowed loss is not divided by a strictness
    steps: Int[np.ndarray, "V J-1 L"]  # by how many levels of its cells each composition is above the last
    fidelity: Float32[np.ndarray, "V J L"]  # what they measure

    def views(self, label: int) -> Int[np.ndarray, " n"]:
        """Rows of the viewpoints that show a category."""
        return np.flatnonzero(self.shown[:, list(self.labels).index(label)])

    def decisions(self, label: int) -> Decisions:
        """What the viewpoints say of a category."""
        column, rows = list(self.labels).index(label), self.views(label)
        bound, threshold, mean, steps, got = (
            of[rows, :, column] for of in (self.bound, self.threshold, self.mean, self.steps, self.fidelity)
        )
        nominal = np.repeat(NOMINAL[None], len(rows), 0)
        critical, needs = (
            np.stack(
                [critical_asks(asked, np.nan_to_num(has, nan=1.0), steps, got, target) for target in TARGETS]
            )
            for asked, has in ((nominal, bound), (threshold, mean))
        )
        return Decisions(critical, needs, self.away[rows])

    def missed(self, label: int) -> Int[np.ndarray, " J"]:
        """In how many of these viewpoints each of NOMINAL was missed."""
        rows = self.views(label)
        got = self.fidelity[rows][..., list(self.labels).index(label)]
        return (got < NOMINAL).sum(0)

    def least_support(self, label: int) -> float:
        """The support from which on something is promised, after these viewpoints."""
        return LEAST_SUPPORT_SHARE * float(
            self.support[self.views(label), list(self.labels).index(label)].min()
        )


def remove_composition_bias(
    models: Mapping[int, FidelityModel], trial: Trial, confidence: float
) -> dict[int, FidelityModel]:
    """The models with thresholds that allow for the neighbours' levels; `trial` was planned with the models.

    On the capture's path and off it they are found apart, where enough viewpoints of both show the category:
    one threshold for all would keep more than is asked on the path, and less among the cameras.
    This is no calibration: it brings what is calibrated close to what is asked.
    """
    found = dict(models)
    for label, model in models.items():
        if len(trial.views(label)):
            decisions = trial.decisions(label)
            of_kinds = [decisions.of(kind) for kind in decisions.kinds(_FEW)]
            found[label] = _by_place(
                model, [(some, partial(_empirical, confidence=confidence)) for some in of_kinds]
            )
    return found


def _by_place(
    model: FidelityModel, of_kinds: Sequence[tuple[Decisions, Callable[[np.ndarray], np.ndarray]]]
) -> FidelityModel:
    """The model with thresholds that rise linearly away from the photos by as much as viewpoints need.

    `of_kinds`: decisions in all viewpoints, or in those on the path and in those off it, and which quantile
    of what they need [G, n] is kept. With both kinds the slope is the one at which they need the same
    threshold at a photo, 0 where less is needed off the path; with one it stays unless it falls.
    """

    def at_a_photo(slopes: Float[np.ndarray, " G"]) -> list[Float[np.ndarray, " G"]]:
        return [quantile(one.needs - slopes[:, None] * one.away) for one, quantile in of_kinds]

    if len(of_kinds) == 1:
        slopes = np.maximum(np.interp(TARGETS, model.calibration.targets, model.calibration.slopes), 0)
        (needs,) = at_a_photo(slopes)
        return _with_needs(model, needs, slopes)
    low, high = np.zeros(len(TARGETS)), np.full(len(TARGETS), _STEEPEST)
    for _ in range(_HALVINGS):
        slopes = (low + high) / 2
        near, off = at_a_photo(slopes)
        low, high = np.where(off > near, slopes, low), np.where(off > near, high, slopes)
    return _with_needs(model, np.maximum(*at_a_photo(low)), low)


def hold_all_categories(
    models: Mapping[int, FidelityModel], trial: Trial, confidence: float
) -> tuple[dict[int, FidelityModel], Bool[np.ndarray, " G"]]:
    """The same, and targets at which all categories are held for those that cannot help themselves.

    `trial` was planned with models of `remove_composition_bias`. A category that still misses a target in
    more views than chance explains does so at any level of its own: its neighbours' low levels spill over it.
    All ask for the nominal target that keeps it.
    """
    floor, asked = np.full(len(TARGETS), -np.inf), {}
    for label in models:
        if not (views := len(trial.views(label))):
            continue
        asked[label] = _empirical(trial.decisions(label).critical, confidence)
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
    models: Mapping[int, FidelityModel],
    trial: Trial,
    confidence: float,
    held: Bool[np.ndarray, " G"] = NOTHING_HELD,
) -> dict[int, FidelityModel]:
    """The models with thresholds that keep each target at a confidence.

    Args:
        models: From `remove_composition_bias` or `hold_all_categories`.
        trial: Planned with these models, at viewpoints used for nothing else.
        confidence: Share of decisions that are to hold, between 0 and 1.
        held: Targets whose thresholds must not fall, as other categories need them.

    Returns:
        Models by label id. "calibrated" from 19 viewpoints that show the category (at 0.95); where as many do
        on the capture's path and off it, each by itself. With fewer the nominal targets are the largest ones
        of all categories and of its own: "uncalibrated".
    """
    fewest, stricter = fewest_views(confidence), 1 - _OF_MISSES * (1 - confidence)
    least = np.where(held, TARGETS, -np.inf)[:, None]
    decisions = {}
    for label, model in models.items():
        own = trial.decisions(label)
        nominal = replace(own, critical=np.maximum(own.critical, least))
        # of a target that is held as much as it needs by itself
        needs = np.where(held[:, None], np.maximum(own.needs, nominal.for_model(model).needs), own.needs)
        decisions[label] = replace(nominal, needs=needs)

    def conformal(label: int, kind: bool | None) -> tuple[Decisions, Callable[[np.ndarray], np.ndarray]]:
        own = decisions[label].of(kind)
        others = [one.of(kind).for_model(models[label]) for other, one in decisions.items() if other != label]
        # off the path, and from too few viewpoints, as strict as promised
        shares = (confidence,) if kind is False else (stricter, confidence)
        return own.joined(others), partial(_conformal, own=len(own.away), shares=shares)

    enough = [label for label, one in decisions.items() if len(one.away) >= fewest]
    asked = {}
    for label in enough:
        every, quantile = conformal(label, None)
        asked[label] = quantile(every.critical)
    # nothing is known below the last level where not even one category could be calibrated
    widest = np.max([*asked.values()], axis=0) if asked else np.ones(len(TARGETS))
    found = {}
    for label, model in models.items():
        mine = decisions[label]
        views = len(mine.away)
        if label in asked:
            made = _by_place(model, [conformal(label, kind) for kind in mine.kinds(fewest)])
        else:
            made = _asked(model, np.maximum(widest, mine.critical.max(1)) if views else widest)
        status = "calibrated" if label in asked else "uncalibrated"
        least = model.calibration.least_support
        least = min(least, trial.least_support(label)) if views else least
        calibration = replace(
            made.calibration, status=status, confidence=confidence, num_views=views, least_support=least
        )
        found[label] = replace(made, calibration=calibration)
    return found


def _conformal(
    of_views: Float[np.ndarray, "G n"], own: int, shares: Sequence[float]
) -> Float[np.ndarray, " G"]:
    """The conformal quantile at the first share for which there are enough viewpoints; `own` come first."""
    found = np.full(len(of_views), np.inf)
    for share in shares:
        if np.isinf(found).any():
            found = conformal_quantile(of_views[:, :own], share, of_views[:, own:])
    return found


def _asked(model: FidelityModel, nominal: Float[np.ndarray, " G"]) -> FidelityModel:
    """The model with the thresholds at which its present bound is `nominal`, the ones to ask for TARGETS."""
    return _with_needs(model, *_needs(model, nominal))


def _with_needs(
    model: FidelityModel, thresholds: Float[np.ndarray, " G"], slopes: Float[np.ndarray, " G"]
) -> FidelityModel:
    now = model.calibration
    calibration = calibration_of(
        thresholds, slopes, now.status, now.confidence, now.num_views, now.least_support, now.targets[-1]
    )
    return replace(model, calibration=calibration)


def _needs(
    model: FidelityModel, nominal: Float[np.ndarray, " G"]
) -> tuple[Float[np.ndarray, " G"], Float[np.ndarray, " G"]]:
    """Thresholds and slopes at which the model's bound is `nominal`."""
    now = model.calibration
    low = nominal - (now.targets[0] - now.thresholds[0])  # below the first target, as `Calibration.bound`
    known = np.interp(nominal, now.targets, now.thresholds)
    return np.where(nominal < now.targets[0], low, known), np.interp(nominal, now.targets, now.slopes)
