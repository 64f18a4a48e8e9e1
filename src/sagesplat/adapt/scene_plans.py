"""Plans for all viewpoints of a scene: the level of each category that a share of them needs at most.

This is a statement about the distribution of viewpoints, so it is made from what views measure, not from
lower bounds of single views. Of each view let m_k be the least that it measures from level k on. With n views
drawn like those to come, the ceil((n + 1) share)-th largest m_k is reached in a new view at least with
probability `share` (split conformal prediction, Vovk et al. 2005). The cheapest level for which it is the
target or more is taken.

That is measured with all categories at the same level. In the composition the neighbours have other levels,
so it is measured at further viewpoints; where fewer than the share keep the target, levels go up
(`raise_failing_levels`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from sagesplat.adapt.allocate import choose
from sagesplat.adapt.bound_plans import Costs, make_choices, pooled
from sagesplat.adapt.calibrate import fewest_views
from sagesplat.adapt.fill import fill
from sagesplat.adapt.plan import Choice, Plan, Reached, Status, check_share, check_target
from sagesplat.adapt.viewpoint import QualityKind

_ROUNDED = 1e-6  # by which means of ones differ from one
LOWEST = 0.005  # fidelity by which the lowest category may lie below that of equal levels


def plan_for_scene(
    measured: Float[np.ndarray, "V L K"],
    pixels: Float[np.ndarray, "V L"],
    costs: Costs,
    target: float,
    share: float,
    kind: QualityKind,
    trained: Bool[np.ndarray, " V"] | None = None,
) -> Plan:
    """Choose the cheapest level of each category that reaches a target in a share of the viewpoints.

    A plan for fidelity is then filled (`adapt.fill`): all images together are at most `fill.SLACK` worse than
    with all categories at one level, at equal bytes, and the lowest category is at most `LOWEST` worse.

    Args:
        measured: [V, L, K], quality of each category and level; NaN where the view shows too little of it.
        pixels: [V, L], that each category has.
        costs: What the levels cost; bytes to send are minimised.
        target: Above 0 and at most 1.
        share: Of the viewpoints that show the category, above 0 and at most 1.
        kind: The quality that was measured. The highest level has fidelity 1, whatever the number of views;
            not that of an adopted splat, which is compared with what came in.
        trained: [V], photos that training saw (`unseen_like`); None: none.

    Returns:
        One choice per category, with the share of views that measure the target. "infeasible" where no level
        reaches it. Not calibrated where too few views were held out of training for the share.

    Raises:
        RunError: For an impossible target or share.
    """
    check_target(target, kind)
    check_share(share)
    trained = np.zeros(len(measured), bool) if trained is None else trained
    found = [
        _level(_views(measured[:, i], trained, share, kind), costs.transfer_bytes[i], target, share, kind)
        for i in range(len(costs.labels))
    ]
    levels = np.array([one.level for one in found])
    if kind == "fidelity":
        mean, total = pooled(measured, pixels)
        levels = fill(levels, np.maximum.accumulate(mean, 1), costs.transfer_bytes, total, LOWEST)
    choices = make_choices(
        costs, levels, np.stack([one.promised for one in found]), np.full(len(levels), np.nan),
        [one.status for one in found], [one.calibrated for one in found],
    )  # fmt: skip
    choices = tuple(
        replace(choice, reached=reached(one.held[:, choice.level - 1] >= target))
        for choice, one in zip(choices, found, strict=True)
    )
    return Plan(float(target), None, choices, float(share), quality=kind)


def raise_failing_levels(
    plan: Plan,
    measured: Float[np.ndarray, "V L"],
    costs: Costs,
    mean: Float[np.ndarray, "L K"],
    pixels: Float[np.ndarray, " L"],
    *,
    last: bool,
) -> tuple[Plan, bool]:
    """A plan of a scene for fidelity with what its composition measures; levels go up where that is too low.

    Args:
        plan: Of `plan_for_scene`.
        measured: [V, L], fidelity of each category in the plan's composition, at viewpoints that the plan was
            not made from; NaN where one shows too little of the category.
        costs: What the levels cost.
        mean: [L, K], expected fidelity, for the fill (`pooled`).
        pixels: [L], its weights.
        last: Leave the levels as they are, and say what is not proven.

    Returns:
        The plan, and whether its levels are still the same.
    """
    plan, over = measured_in_composition(plan, measured)
    levels = np.array([choice.level - 1 for choice in plan.choices])
    top = costs.count.shape[1] - 1
    up = np.array([over.get(choice.label_id, 0.0) < 0 for choice in plan.choices], bool)
    if (levels[up] == top).any():  # what is at its top already misses by its neighbours
        up[:] = True
    raised = np.where(up & (levels < top), levels + 1, levels)
    if last or (raised == levels).all():
        return plan, True
    raised = fill(raised, np.maximum.accumulate(mean, 1), costs.transfer_bytes, pixels, LOWEST)
    return replace(plan, choices=tuple(map(partial(_at_level, costs), plan.choices, raised.tolist()))), False


def measured_in_composition(
    plan: Plan, measured: Float[np.ndarray, "V L"], *, proven: bool = True
) -> tuple[Plan, dict[int, float]]:
    """A plan of a scene with what its composition measures, and by how much categories exceed the target.

    `measured` is that of `raise_failing_levels`. Of a plan that nothing else has `proven` for new viewpoints,
    as many must keep the target as split conformal prediction asks for.
    """
    assert plan.share is not None
    choices, over = [], dict[int, float]()
    for i, choice in enumerate(plan.choices):
        values = measured[np.isfinite(measured[:, i]), i]
        if choice.status == "ok" and plan.share < 1 and len(values) >= fewest_views(plan.share):
            needed = math.ceil((len(values) + (not proven)) * plan.share - 1e-9)
            least = float(np.sort(values)[len(values) - needed])
            here = reached(values >= plan.target)
            choice = replace(choice, predicted=least, reached=here, calibrated=least >= plan.target)
            over[choice.label_id] = least - plan.target
        choices.append(choice)
    return replace(plan, choices=tuple(choices)), over


def never_dearer(plans: Sequence[Plan]) -> list[Plan]:
    """Plans of a scene; those for fidelity take the choices of one for a higher target that costs less.

    What these say is reached is the share of the higher target: at least as much reaches the lower one.
    """
    found = []
    for plan in plans:
        higher = [
            other
            for other in plans
            if (other.quality, other.share) == (plan.quality, plan.share)
            and plan.quality == "fidelity"
            and other.target > plan.target
            and [choice.status for choice in other.choices] == [choice.status for choice in plan.choices]
            and all(choice.calibrated is not False for choice in other.choices)
        ]
        best = min([plan, *higher], key=lambda one: one.transfer_bytes or 0)
        found.append(replace(plan, choices=best.choices, cells=best.cells))
    return found


def _at_level(costs: Costs, choice: Choice, column: int) -> Choice:
    """A choice at another level."""
    row = costs.labels.index(choice.label_id)
    return replace(
        choice,
        level=column + 1,
        count=int(costs.count[row, column]),
        transfer_bytes=int(costs.transfer_bytes[row, column]),
    )


def reached(held: Bool[np.ndarray, " n"]) -> Reached | None:
    """The share of views in which something holds, with its interval; None without any view."""
    if not len(held):
        return None
    from scipy.stats import binomtest  # slow to load, and no training waits for it

    found = binomtest(int(held.sum()), len(held)).proportion_ci(0.95, "exact")
    return Reached(float(held.mean()), float(found.low), float(found.high), len(held))


@dataclass(frozen=True, eq=False)
class _Level:
    """What is found for one category."""

    level: int  # column
    status: Status
    calibrated: bool | None
    promised: Float[np.ndarray, " K"]  # what at least the asked share reaches from each level on
    held: Float[np.ndarray, "n K"]  # the least that each view measures from each level on


def _views(
    values: Float[np.ndarray, "V K"], trained: Bool[np.ndarray, " V"], share: float, kind: QualityKind
) -> tuple[Float[np.ndarray, "n K"], bool]:
    """What the views that show a category measure, and whether none of them was trained on.

    Photos that training never saw are enough where there are enough of them. Else the others are added, less
    what the two differ by in the median: training fits its own photos better.
    """
    known = np.isfinite(values).all(1)
    heldout, others = values[known & ~trained], values[known & trained]
    if kind == "fidelity":
        heldout = heldout.copy()
        if (heldout[:, -1] > 1 - _ROUNDED).all():  # the last level is the full model
            heldout[:, -1] = 1.0
        return heldout, True
    enough = share < 1 and len(heldout) >= fewest_views(share)
    if enough or not len(others):
        return heldout, enough
    if len(heldout):
        others = others + np.minimum(np.median(heldout, 0) - np.median(others, 0), 0)
    return np.concatenate([heldout, others]), False


def _level(
    views: tuple[Float[np.ndarray, "n K"], bool],
    cost: Float[np.ndarray, " K"] | Int[np.ndarray, " K"],
    target: float,
    share: float,
    kind: QualityKind,
) -> _Level:
    """The cheapest level of a category that the share of its views holds the target from."""
    values, calibrated = views
    n, K = values.shape
    if not n:
        return _Level(K - 1, "no model", None, np.full(K, np.nan), values)
    held = np.minimum.accumulate(values[:, ::-1], 1)[:, ::-1]
    rank = math.ceil((n + 1) * share - 1e-9)  # of too few views the worst, which proves nothing
    promised = np.sort(held, 0)[max(n - rank, 0)]
    if kind == "fidelity" and rank > n:
        promised[:-1] = np.nan
    level, met = choose(promised, cost, target, ((held >= target).sum(0), values.mean(0)))
    return _Level(int(level), "ok" if met else "infeasible", calibrated, promised, held)
