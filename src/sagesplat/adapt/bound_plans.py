"""Plans from promises: the cheapest levels that keep a target, or the best ones within a budget."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from sagesplat.adapt.allocate import Allocation, best_within, cheapest
from sagesplat.adapt.plan import Choice, Plan, check_share, check_target
from sagesplat.adapt.viewpoint import ViewModel
from sagesplat.scene.scene import Camera

Unit = Literal["bytes", "gpu-bytes", "count"]


@dataclass(frozen=True, eq=False)
class Costs:
    """What each category's levels cost in full; rows are `labels`, columns levels 1 to K."""

    labels: tuple[int, ...]  # ids, ascending
    count: Int[np.ndarray, "L K"]  # Gaussians
    transfer_bytes: Int[np.ndarray, "L K"]  # bytes of the chunks
    gpu: Int[np.ndarray, "L K"]  # bytes on the viewer's GPU

    def of(self, unit: Unit) -> Int[np.ndarray, "L K"]:
        """The costs in a unit."""
        return {"bytes": self.transfer_bytes, "gpu-bytes": self.gpu, "count": self.count}[unit]


@dataclass(frozen=True, eq=False)
class Quality:
    """What is promised of each category and level in each view; NaN where a category has no model."""

    mean: Float[np.ndarray, "V L K"]  # expected SSIM
    bound: Float[np.ndarray, "V L K"]  # that it is not to fall below
    distance: Float[np.ndarray, "V L"]  # of the closest points in sight, world units; NaN: none


def quality_at(
    costs: Costs,
    promises: Mapping[int, ViewModel],
    distances: Mapping[int, Float[np.ndarray, " V"]],
    cameras: Sequence[Camera],
) -> Quality:
    """Predict every category at every level from V viewpoints.

    Args:
        costs: The levels that there are.
        promises: Models by label id.
        distances: d_min by label id, [V] in world units (`observe.distances_in_views`); NaN: not in sight.
        cameras: V viewpoints; no photo has to be taken there.

    Returns:
        mean and bound [V, L, K] in SSIM, NaN for categories without a model; distance [V, L].
    """
    shape = len(cameras), *costs.count.shape
    position = np.stack([camera.position for camera in cameras])
    direction = np.stack([camera.direction for camera in cameras])
    mean, bound, far = np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape[:2], np.nan)
    for i, label in enumerate(costs.labels):
        far[:, i] = distances.get(label, far[:, i])
        if label in promises:
            told = promises[label].predict(far[:, i], position, direction)
            known = np.array(promises[label].levels) - 1
            mean[:, i, known], bound[:, i, known] = told.mean, told.bound
    return Quality(mean, bound, far)


def plan_for_view(quality: Quality, costs: Costs, target: float, view: int) -> Plan:
    """Choose the cheapest level of each category whose lower bound reaches a target in one view.

    Args:
        quality: Predictions of `quality_at`.
        costs: What the levels cost; bytes to send are minimised.
        target: SSIM, above 0 and at most 1.
        view: Row of `quality`.

    Returns:
        One choice per category; "infeasible" where no level reaches the target.

    Raises:
        RunError: For an impossible target.
    """
    check_target(target)
    bound = quality.bound[view]
    found = cheapest(bound, costs.transfer_bytes, target)
    return Plan(float(target), view, _choices(found, bound, quality.distance[view], costs))


def plan_for_scene(
    quality: Quality,
    costs: Costs,
    target: float,
    share: float,
    shown: Float[np.ndarray, "V L"],
) -> Plan:
    """Choose the cheapest level of each category whose lower bound reaches a target in a share of the views.

    Args:
        quality: Predictions of `quality_at`.
        costs: What the levels cost; bytes to send are minimised.
        target: SSIM, above 0 and at most 1.
        share: Of the views that show the category, above 0 and at most 1.
        shown: [V, L], pixels of each category in each view; 0: the view does not count for it.

    Returns:
        One choice per category; "infeasible" where no level reaches the target.

    Raises:
        RunError: For an impossible target or share.
    """
    check_target(target)
    check_share(share)
    bound = np.stack([_kept_in(quality.bound[shown[:, i] > 0, i], share) for i in range(len(costs.labels))])
    found = cheapest(bound, costs.transfer_bytes, target)
    nowhere = np.full(len(costs.labels), np.nan)
    return Plan(float(target), None, _choices(found, bound, nowhere, costs), float(share))


def plan_within(
    quality: Quality,
    costs: Costs,
    budget: float,
    unit: Unit,
    shown: Float[np.ndarray, "V L"],
    weights: Mapping[int, float] | None = None,
    view: int | None = None,
) -> Plan:
    """Choose the levels of the highest expected SSIM within a budget.

    The sum over categories of weight x pixels x mean SSIM is maximised: a multiple-choice knapsack
    (`allocate.best_within`).

    Args:
        quality: Predictions of `quality_at`.
        costs: What the levels cost.
        budget: Most that the composition may cost, in `unit`.
        unit: "bytes" to send, "gpu-bytes" on the viewer's GPU, or "count" of Gaussians.
        shown: [V, L], pixels of each category in each view.
        weights: Factors by label id (1 where none is given).
        view: Row of `quality` to plan for; None: all views that `shown` has pixels of.

    Returns:
        One choice per category. Status "over budget": the smallest composition, where even that does not fit.
    """
    rows = [view] if view is not None else np.flatnonzero(shown.any(1)).tolist()
    pixels = shown[rows]
    total = pixels.sum(0)
    mean = (quality.mean[rows] * pixels[..., None]).sum(0) / np.maximum(total, 1)[:, None]
    mean[total == 0] = np.nan
    weight = total * [(weights or {}).get(label, 1.0) for label in costs.labels]
    found = best_within(mean, costs.of(unit), weight, budget)
    where = quality.distance[view] if view is not None else np.full(len(costs.labels), np.nan)
    choices = _choices(found, mean, where, costs)
    return Plan(math.nan, view, choices, budget=float(budget), unit=unit, fits=found.status == "ok")


def _kept_in(bound: Float[np.ndarray, "v K"], share: float) -> Float[np.ndarray, " K"]:
    """What at least a share of the views reach, per level; NaN without any view."""
    if not len(bound):
        return np.full(bound.shape[1], np.nan)
    needed = max(1, math.ceil(share * len(bound) - 1e-9))
    return np.sort(bound, axis=0)[len(bound) - needed]


def _choices(
    found: Allocation, promised: Float[np.ndarray, "L K"], distance: np.ndarray, costs: Costs
) -> tuple[Choice, ...]:
    choices = []
    for i, label in enumerate(costs.labels):
        level = int(found.levels[i])
        known = not np.isnan(promised[i]).all()
        status = "infeasible" if found.missed[i] else "ok"
        choices.append(
            Choice(
                label_id=label,
                level=level + 1,
                predicted_ssim=float(promised[i, level]),
                distance=float(distance[i]),
                count=int(costs.count[i, level]),
                status=status if known else "no model",
                transfer_bytes=int(costs.transfer_bytes[i, level]),
            )
        )
    return tuple(choices)
