"""Plans for a viewpoint: the cheapest levels that keep a target. Plans within a budget."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from sagesplat.adapt.allocate import cheapest
from sagesplat.adapt.cell_models import Expected, FidelityModel, needed, promised
from sagesplat.adapt.cell_plans import reach, within
from sagesplat.adapt.fill import fill
from sagesplat.adapt.plan import Choice, Plan, Status, check_target
from sagesplat.adapt.viewpoint import QualityKind, ViewModel, where
from sagesplat.core.errors import RunError
from sagesplat.scene.scene import Camera

Unit = Literal["bytes", "gpu-bytes", "count"]


@dataclass(frozen=True, eq=False)
class Costs:
    """What the levels of each category, or cell, cost in full; rows are `labels`, columns levels 1 to K."""

    labels: tuple[int, ...]  # ids of categories or cells, ascending
    count: Int[np.ndarray, "L K"]  # Gaussians
    transfer_bytes: Int[np.ndarray, "L K"]  # bytes of the increments
    gpu: Int[np.ndarray, "L K"]  # bytes on the viewer's GPU

    def by_label(self, label_of: Mapping[int, int]) -> "Costs":
        """Those of categories with all their cells at one level, from those of the cells."""
        labels, column = np.unique([label_of[cell] for cell in self.labels], return_inverse=True)
        member = (column == np.arange(len(labels))[:, None]).astype(np.int64)
        sums = (member @ costs for costs in (self.count, self.transfer_bytes, self.gpu))
        return Costs(tuple(labels.tolist()), *sums)

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


def quality_of_cells(models: Mapping[int, FidelityModel], expected: Expected) -> Quality:
    """Predict the fidelity of categories with all their cells at one level."""
    V, C, K = expected.mean.shape
    mean = np.full((V, len(expected.labels), K), np.nan)
    bound = mean.copy()
    for k in range(K):
        mean[..., k] = expected.of_composition(np.full((V, C), k + 1))
        bound[..., k] = promised(models, expected, mean[..., k])
    far = np.where(expected.member, np.nan_to_num(expected.distance, nan=np.inf)[..., None], np.inf).min(
        1, initial=np.inf
    )
    certain = [label in models and models[label].status == "calibrated" for label in expected.labels.tolist()]
    return Quality("fidelity", mean, bound, np.where(np.isinf(far), np.nan, far), np.array(certain, bool))


def plan_for_cells(
    models: Mapping[int, FidelityModel],
    expected: Expected,
    quality: Quality,
    costs: Costs,
    target: float,
    view: int,
) -> Plan:
    """Choose the levels of the cells by which each category is promised a fidelity in one view.

    They are the ones of the fewest bytes (`adapt.cell_plans`), filled so that the image as a whole is no
    worse than with all cells at one level, at equal bytes (`adapt.fill`). Cells out of sight get the
    first one.

    Args:
        models: Of fidelity, by label id.
        expected: From V viewpoints.
        quality: The same with all cells at one level (`quality_of_cells`).
        costs: What the cells' levels cost; bytes to send are minimised.
        target: Above 0 and at most 1.
        view: Row of `expected`.

    Returns:
        One choice per category, with the highest level of its cells; and the levels of the cells.

    Raises:
        RunError: For an impossible target.
    """
    check_target(target, "fidelity")
    here = expected.at(view)
    mean, share = here.mean[0], here.share[0]
    least = needed(models, here, target)[0]
    found = reach(costs.transfer_bytes, mean, share, here.column, least)
    levels = fill(found.levels, mean, costs.transfer_bytes, share)
    bound = promised(models, here, here.of_composition(levels[None] + 1))[0]
    shown = here.category_shares()[0] > 0
    choices = []
    for column, label in enumerate(expected.labels.tolist()):
        mine = np.flatnonzero(expected.column == column)
        if label not in models:
            status: Status = "no model"
        elif np.isnan(least[column]) and shown[column]:
            status = "no promise"
        else:
            status = "ok" if found.met[column] else "infeasible"
        taken = costs.count[mine, levels[mine]], costs.transfer_bytes[mine, levels[mine]]
        choices.append(
            Choice(
                label_id=label,
                level=int(levels[mine].max()) + 1,
                predicted=float(bound[column]),
                distance=float(quality.distance[view, column]),
                count=int(taken[0].sum()),
                status=status,
                transfer_bytes=int(taken[1].sum()),
                calibrated=bool(quality.calibrated[column]) if np.isfinite(bound[column]) else None,
            )
        )
    cells = dict(zip(costs.labels, (levels + 1).tolist(), strict=True))
    return Plan(float(target), view, tuple(choices), quality="fidelity", cells=cells)


def plan_for_view(quality: Quality, costs: Costs, target: float, view: int) -> Plan:
    """Choose the cheapest level of each category whose lower bound reaches a target in one view.

    Args:
        quality: Predictions of `quality_at`.
        costs: What the levels cost; bytes to send are minimised.
        target: Above 0 and at most 1, of the quality's kind.
        view: Row of `quality`.

    Returns:
        One choice per category; "infeasible" where no level reaches the target, "no promise" where the view
        is too far from all that was sampled: then the highest level.

    Raises:
        RunError: For an impossible target.
    """
    check_target(target, quality.kind)
    bound, mean = quality.bound[view], quality.mean[view]
    known, proven = ~np.isnan(mean).all(1), ~np.isnan(bound).all(1)
    found = cheapest(bound, costs.transfer_bytes, target)
    lost = np.isnan(bound).all(1)
    statuses = np.select(
        [~known, lost, found.missed], ["no model", "no promise", "infeasible"], "ok"
    ).tolist()
    calibrated = [bool(c) if p else None for c, p in zip(quality.calibrated, proven, strict=True)]
    choices = make_choices(
        costs, found.levels, quality.bound[view], quality.distance[view], statuses, calibrated
    )
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

    Of the sum over rows of weight x mean quality the steepest upgrades are taken (`cell_plans.within`).

    Args:
        mean: [L, K], expected quality of each row of `costs` and level (`pooled`); NaN: unknown.
        costs: What the levels cost.
        budget: Most that the composition may cost, in `unit`.
        unit: "bytes" to send, "gpu-bytes" on the viewer's GPU, or "count" of Gaussians.
        weight: [L], pixels of each category, times what they count.
        kind: The quality.

    Returns:
        One choice per row. Status "over budget": the smallest composition, where even that does not fit.

    Raises:
        RunError: For an impossible budget.
    """
    if not budget > 0:
        raise RunError(f"budget {budget} is impossible; choose one above 0, in the unit of the costs")
    cost = costs.of(unit)
    levels = within(cost, mean, weight, budget)
    statuses = np.where(np.isnan(mean).all(1), "no model", "ok").tolist()
    nowhere = np.full(len(costs.labels), np.nan)
    choices = make_choices(costs, levels, mean, nowhere, statuses)
    fits = bool(cost[:, 0].sum() <= budget)
    return Plan(math.nan, None, choices, budget=float(budget), unit=unit, fits=fits, quality=kind)


def by_label(plan: Plan, label_of: Mapping[int, int], pixels: Float[np.ndarray, " C"]) -> Plan:
    """A plan of cells as one of categories: what is predicted of them is the mean over pixels."""
    weight = dict(zip(sorted(label_of), pixels.tolist(), strict=True))
    cells: dict[int, list[Choice]] = {}
    for choice in plan.choices:
        cells.setdefault(label_of[choice.label_id], []).append(choice)
    choices = []
    for label, mine in sorted(cells.items()):
        known = [one for one in mine if weight[one.label_id] > 0 and not math.isnan(one.predicted)]
        total = sum(weight[one.label_id] for one in known)
        mean = sum(weight[one.label_id] * one.predicted for one in known) / total if total else math.nan
        choices.append(
            Choice(
                label_id=label,
                level=max(one.level for one in mine),
                predicted=mean,
                distance=math.nan,
                count=sum(one.count for one in mine),
                status="ok" if known else "no model",
                transfer_bytes=sum(one.transfer_bytes or 0 for one in mine),
            )
        )
    return replace(plan, choices=tuple(choices), cells=plan.levels)


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
