"""Plans for a viewpoint from lower bounds: the cheapest levels that keep a target. Plans within a budget."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from sagesplat.adapt.allocate import best_within, cheapest
from sagesplat.adapt.fill import fill
from sagesplat.adapt.plan import Choice, Plan, Status, check_target
from sagesplat.adapt.viewpoint import QualityKind, ViewModel, where
from sagesplat.scene.scene import Camera

Unit = Literal["bytes", "gpu-bytes", "count"]


@dataclass(frozen=True, eq=False)
class Costs:
    """What each category's levels cost in full; rows are `labels`, columns levels 1 to K."""

    labels: tuple[int, ...]  # ids, ascending
    count: Int[np.ndarray, "L K"]  # Gaussians
    transfer_bytes: Int[np.ndarray, "L K"]  # bytes of the increments
    gpu: Int[np.ndarray, "L K"]  # bytes on the viewer's GPU

    def of(self, unit: Unit) -> Int[np.ndarray, "L K"]:
        """The costs in a unit."""
        return {"bytes": self.transfer_bytes, "gpu-bytes": self.gpu, "count": self.count}[unit]


@dataclass(frozen=True, eq=False)
class Quality:
    """What is predicted of each category and level in each view; NaN where a category has no model."""

    kind: QualityKind
    mean: Float[np.ndarray, "V L K"]  # expected
    bound: Float[np.ndarray, "V L K"]  # that it is not to fall below; NaN too where nothing is promised
    distance: Float[np.ndarray, "V L"]  # of the closest points in sight, world units; NaN: none
    calibrated: Bool[np.ndarray, " L"]  # whether the bound is proven


def quality_at(
    costs: Costs,
    promises: Mapping[int, ViewModel],
    distances: Mapping[int, Float[np.ndarray, " V"]],
    cameras: Sequence[Camera],
    kind: QualityKind | None = None,
) -> Quality:
    """Predict every category at every level from V viewpoints.

    Args:
        costs: The levels that there are.
        promises: Models of one quality, by label id.
        distances: d_min by label id, [V] in world units (`observe.distances_in_views`); NaN: not in sight.
        cameras: V viewpoints; no photo has to be taken there.
        kind: The quality; None: that of the models.

    Returns:
        mean and bound [V, L, K], NaN for categories without a model; distance [V, L].
    """
    shape = len(cameras), *costs.count.shape
    mean, bound, far = np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape[:2], np.nan)
    calibrated = np.zeros(len(costs.labels), bool)
    at = where(cameras, next((model.focal for model in promises.values()), 1.0))  # one for all of a quality
    for i, label in enumerate(costs.labels):
        far[:, i] = distances.get(label, far[:, i])
        if label in promises:
            predicted = promises[label].predict(far[:, i], *at)
            known = np.array(promises[label].levels) - 1
            mean[:, i, known], bound[:, i, known] = predicted.mean, predicted.bound
            calibrated[i] = promises[label].status == "calibrated"
    for model in promises.values():
        kind = kind or model.quality
    return Quality(kind or "ssim", mean, bound, far, calibrated)


def plan_for_view(
    quality: Quality,
    costs: Costs,
    target: float,
    view: int,
    pixels: Float[np.ndarray, " L"] | None = None,
) -> Plan:
    """Choose the cheapest level of each category whose lower bound reaches a target in one view.

    A plan for fidelity is then filled (`adapt.fill`), so that the image as a whole is no worse than with all
    categories at one level, at equal bytes.

    Args:
        quality: Predictions of `quality_at`.
        costs: What the levels cost; bytes to send are minimised.
        target: Above 0 and at most 1, of the quality's kind.
        view: Row of `quality`.
        pixels: [L], that each category has in the view; None: unknown, nothing is filled.

    Returns:
        One choice per category; "infeasible" where no level reaches the target, "no promise" where the view
        is too far from all that was sampled: then the highest level. A category without pixels and without a
        bound is chosen by what is expected of it, as nobody sees it.

    Raises:
        RunError: For an impossible target.
    """
    check_target(target, quality.kind)
    bound, mean = quality.bound[view], quality.mean[view]
    known, promised = ~np.isnan(mean).all(1), ~np.isnan(bound).all(1)
    if pixels is not None:
        unseen = known & ~promised & (pixels == 0)
        bound = np.where(unseen[:, None], mean, bound)
    found = cheapest(bound, costs.transfer_bytes, target)
    levels = found.levels
    if quality.kind == "fidelity" and pixels is not None:
        levels = fill(levels, mean, costs.transfer_bytes, pixels)
    lost = np.isnan(bound).all(1)
    statuses = np.select(
        [~known, lost, found.missed], ["no model", "no promise", "infeasible"], "ok"
    ).tolist()
    calibrated = [bool(c) if p else None for c, p in zip(quality.calibrated, promised, strict=True)]
    choices = make_choices(costs, levels, quality.bound[view], quality.distance[view], statuses, calibrated)
    return Plan(float(target), view, choices, quality=quality.kind)


def plan_within(
    mean: Float[np.ndarray, "L K"],
    costs: Costs,
    budget: float,
    unit: Unit,
    weight: Float[np.ndarray, " L"],
    kind: QualityKind = "ssim",
) -> Plan:
    """Choose the levels of the highest expected quality within a budget.

    The sum over categories of weight x mean quality is maximised: a multiple-choice knapsack
    (`allocate.best_within`).

    Args:
        mean: [L, K], expected quality of each category and level (`pooled`); NaN: unknown.
        costs: What the levels cost.
        budget: Most that the composition may cost, in `unit`.
        unit: "bytes" to send, "gpu-bytes" on the viewer's GPU, or "count" of Gaussians.
        weight: [L], pixels of each category, times what they count.
        kind: The quality.

    Returns:
        One choice per category. Status "over budget": the smallest composition, where even that does not fit.
    """
    found = best_within(mean, costs.of(unit), weight, budget)
    statuses = np.where(np.isnan(mean).all(1), "no model", "ok").tolist()
    nowhere = np.full(len(costs.labels), np.nan)
    choices = make_choices(costs, found.levels, mean, nowhere, statuses)
    fits = found.status == "ok"
    return Plan(math.nan, None, choices, budget=float(budget), unit=unit, fits=fits, quality=kind)


def pooled(
    values: Float[np.ndarray, "V L K"], pixels: Float[np.ndarray, "V L"]
) -> tuple[Float[np.ndarray, "L K"], Float[np.ndarray, " L"]]:
    """Mean over the pixels of the views in which a value is known, and those pixels; NaN where none is.

    Summed over the categories it is the mean over the whole images.
    """
    pixels = np.where(np.isfinite(values).all(2), pixels, 0)
    total = pixels.sum(0)
    mean = (np.where(pixels[..., None] > 0, values, 0) * pixels[..., None]).sum(0)
    mean /= np.maximum(total, 1e-300)[:, None]
    mean[total == 0] = np.nan
    return mean, total


def make_choices(
    costs: Costs,
    levels: Int[np.ndarray, " L"],
    predicted: Float[np.ndarray, "L K"],
    distance: Float[np.ndarray, " L"],
    statuses: Sequence[Status],
    calibrated: Sequence[bool | None] | None = None,
) -> tuple[Choice, ...]:
    """A choice per category, from columns of `predicted`."""
    return tuple(
        Choice(
            label_id=label,
            level=int(levels[i]) + 1,
            predicted=float(predicted[i, levels[i]]),
            distance=float(distance[i]),
            count=int(costs.count[i, levels[i]]),
            status=statuses[i],
            transfer_bytes=int(costs.transfer_bytes[i, levels[i]]),
            calibrated=None if calibrated is None else calibrated[i],
        )
        for i, label in enumerate(costs.labels)
    )
