"""Which level each label gets: the cheapest that keeps a target, or the most quality within a budget.

Rules that a second implementation must share, so that both give the same levels (tests/data/plans.json):
- Of equal levels the cheaper comes first, then the one of higher quality, then the lower index. Compositions
  within a budget: more value, then less cost, then the lower level at the first label where they differ;
  where a label's cheapest levels are worth the same, the rule for levels says which of them takes part.
- Costs are whole numbers. Values are whole multiples of 2**-40 of the total weight, by floor(x + 0.5): sums
  of both are exact in float64 in any order. Weights and reported values are summed label by label.
- A level whose cost is infinite cannot be had. A level without a promise (NaN) is passed over where its label
  has others with one. A label without any takes its highest level towards a target; within a budget its
  levels count as SSIM sqrt(cost / its largest cost), as more is better, but ever less so.
- A label of weight 0 has no value: within a budget it stays at its cheapest level.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from sagesplat.adapt.knapsack import UNITS, most_within
from sagesplat.core.errors import RunError

SLACK = 0.01  # SSIM that a change of level must be worth
STATES = 4096  # partial compositions to keep before a plan is left unproven: half a millisecond


@dataclass(frozen=True, eq=False)
class Allocation:
    """A level per label."""

    levels: Int[np.ndarray, "L"]
    status: str  # "ok"; "infeasible": a label misses the target; "over budget": the smallest does not fit
    cost: int  # of the composition, in the unit of the costs
    value: float  # sum of weight x promised SSIM; labels without a promise count as in the module's rules
    bound: float  # no composition within the budget has more, what `previous` is worth included
    optimal: bool  # proven: by the module's rules nothing comes before this
    missed: Bool[np.ndarray, "L"]  # labels with promises of which none reaches the target


def cheapest(
    quality: Float[np.ndarray, "L K"],
    cost: Float[np.ndarray, "L K"] | Int[np.ndarray, "L K"],
    target: float | Float[np.ndarray, "L"],
    *,
    weight: Float[np.ndarray, "L"] | None = None,
    previous: Int[np.ndarray, "L"] | None = None,
    slack: float = SLACK,
) -> Allocation:
    """Choose per label the cheapest level whose promised SSIM reaches a target.

    With `previous` levels there is hysteresis. A label goes up at once where its level no longer reaches the
    target. It comes down only to a level that reaches it by `slack` more, or by half of what is left to 1 if
    that is less. Where nothing reaches the target it stays if that is within `slack` of the best. So promises
    that vary by less than the slack never alternate between two levels, if they rise along the levels.

    Args:
        quality: [L, K], promised SSIM of each label and level; NaN: no promise.
        cost: [L, K], whole numbers; inf: a level that cannot be had.
        target: SSIM, for all labels or [L].
        weight: [L], for `value` alone; None: 1 each.
        previous: [L], the levels before, -1: none.
        slack: SSIM.

    Returns:
        A level per label (column of `quality`); where none reaches the target the best one, "infeasible".

    Raises:
        RunError: For impossible arguments.

    Example:
        >>> import numpy as np
        >>> from sagesplat.adapt.allocate import cheapest
        >>> quality, cost = np.array([[0.6, 0.8, 0.9], [0.3, 0.4, 0.5]]), np.array([[1, 4, 9], [2, 3, 4]])
        >>> found = cheapest(quality, cost, target=0.7)
        >>> found.levels.tolist(), found.status, found.missed.tolist()
        ([1, 2], 'infeasible', [False, True])
    """
    quality, cost, weight, previous = _arguments(quality, cost, weight, previous, slack)
    q, c, promised = _known(quality, cost)
    target = _targets(target, len(q))
    wanted, met, lower = _reaching(q, c, promised, target, slack)
    levels = _hold(previous, wanted, lower, q, c, promised, met, target, slack)
    missed = promised & ~met
    total, value = _totals(levels, q, c, weight)
    return Allocation(levels, "infeasible" if missed.any() else "ok", total, value, value, True, missed)


def best_within(
    quality: Float[np.ndarray, "L K"],
    cost: Float[np.ndarray, "L K"] | Int[np.ndarray, "L K"],
    weight: Float[np.ndarray, "L"],
    budget: float,
    *,
    previous: Int[np.ndarray, "L"] | None = None,
    slack: float = SLACK,
    states: int = STATES,
) -> Allocation:
    """Choose the levels of the largest sum of weight x promised SSIM within a budget.

    A multiple-choice knapsack: Pareto fronts label by label, cut by a Lagrangian bound (Kellerer, Pferschy
    and Pisinger 2004, ch. 11). Exact if about `states` partial compositions suffice, else no worse than
    greedy; `optimal` says which. With `previous` levels a label that keeps its level counts as `slack` SSIM
    better. Promises that stay within slack / 2 of some values then never bring back a composition that was
    left, as each change gains on those values.

    Args:
        quality: [L, K], promised SSIM of each label and level; NaN: no promise.
        cost: [L, K], whole numbers; inf: a level that cannot be had.
        weight: [L]; a label of weight 0 stays at its cheapest level.
        budget: In the unit of the costs.
        previous: [L], the levels before, -1: none.
        slack: SSIM.
        states: Partial compositions to keep; 0: greedy alone.

    Returns:
        A level per label (column of `quality`). Where the smallest composition does not fit: that one, with
        status "over budget".

    Raises:
        RunError: For impossible arguments.

    Example:
        >>> import numpy as np
        >>> from sagesplat.adapt.allocate import best_within
        >>> quality, cost = np.array([[0.6, 0.8, 0.9], [0.3, 0.4, 0.5]]), np.array([[1, 4, 9], [2, 3, 4]])
        >>> found = best_within(quality, cost, np.array([2.0, 1.0]), budget=8)
        >>> found.levels.tolist(), found.cost, found.optimal
        ([1, 2], 8, True)
    """
    quality, cost, weight, previous = _arguments(quality, cost, weight, previous, slack)
    budget = _budget(budget)
    q, c, _ = _known(quality, cost)
    levels, fits, bound, optimal = most_within(q, c, weight, budget, previous, float(slack), states)
    total, value = _totals(levels, q, c, weight)
    status = "ok" if fits else "over budget"
    bound = max(bound / UNITS * _sum(weight), value)
    return Allocation(levels, status, total, value, bound, optimal, np.zeros(len(q), bool))


def along(
    quality: Float[np.ndarray, "P L K"],
    cost: Float[np.ndarray, "L K"] | Int[np.ndarray, "L K"],
    *,
    target: float | Float[np.ndarray, "L"] | None = None,
    budget: float | None = None,
    weight: Float[np.ndarray, "L"] | Float[np.ndarray, "P L"] | None = None,
    slack: float = SLACK,
    states: int = STATES,
) -> Int[np.ndarray, "P L"]:
    """Levels at each position of a path: `cheapest` or `best_within` after the levels of the position before.

    Give `target` or `budget`. Where levels cost more than the budget they are the smallest composition.
    RunError for impossible arguments.
    """
    if (target is None) == (budget is None):
        raise RunError("a path is planned for a target or for a budget; give one of them")
    quality, cost, weight, levels = _arguments(quality, cost, weight, None, slack, path=True)
    q, c, promised = _known(quality, cost)
    plan = np.empty(q.shape[:2], np.int64)
    if budget is not None:
        budget = _budget(budget)
        for p in range(len(q)):
            w = weight if weight.ndim == 1 else weight[p]
            levels = plan[p] = most_within(q[p], c[p], w, budget, levels, float(slack), states)[0]
        return plan
    target = _targets(target, q.shape[1])
    wanted, met, lower = _reaching(q, c, promised, target, slack)
    for p in range(len(q)):
        at = (wanted[p], lower[p], q[p], c[p], promised[p], met[p])
        levels = plan[p] = _hold(levels, *at, target, slack)
    return plan


def choose(
    quality: Float[np.ndarray, "... K"],
    cost: Float[np.ndarray, "... K"] | Int[np.ndarray, "... K"],
    target: float | Float[np.ndarray, "... 1"],
    otherwise: Sequence[Float[np.ndarray, "... K"] | Int[np.ndarray, "... K"]] = (),
) -> tuple[Int[np.ndarray, "..."], Bool[np.ndarray, "..."]]:
    """The cheapest level whose SSIM reaches `target`, else the best one; and whether one reaches it.

    Every plan for a target chooses by this rule, whatever predicts the SSIM and whatever a level costs. Of
    equal levels the module's rules take the one of lower index. `otherwise`: what makes a level the best
    where none reaches the target, the first key first (default: its SSIM). A level of unknown SSIM (NaN) or
    of infinite cost is never chosen while there is another.
    """
    usable = np.isfinite(cost) & ~np.isnan(quality)
    good = usable & (quality >= target)
    met = np.asarray(good.any(-1))
    best = [-key for key in otherwise or (quality,)]
    return np.where(met, _first(good, cost, -quality), _first(usable, *best, cost)), met


def _known(quality, cost):
    """Quality without NaN, cost with inf for what is passed over, both [..., L, K]; which labels promise."""
    finite = np.isfinite(cost)
    known = finite & ~np.isnan(quality)
    promised = known.any(-1)
    largest = np.where(finite, cost, 0).max(-1, keepdims=True)
    assumed = np.sqrt(np.where(finite, cost, 0) / np.maximum(largest, 1))
    usable = np.where(promised[..., None], known, finite)
    q = np.where(promised[..., None], np.where(known, quality, 0.0), assumed)
    return q, np.where(usable, cost, np.inf), promised


def _first(allowed, *keys):
    """Along the last axis the allowed index with the smallest keys, the first key first; 0 if none is."""
    for key in keys:
        key = np.where(allowed, key, np.inf)
        allowed = allowed & (key == key.min(-1, keepdims=True))
    return allowed.argmax(-1)


def _reaching(q, c, promised, target, slack):
    """Level of each label without hysteresis, whether one reaches the target, level to come down to or -1."""
    usable = np.isfinite(c)
    wanted, met = choose(q, c, target[:, None])
    highest = q.shape[-1] - 1 - usable[..., ::-1].argmax(-1)
    safe = usable & (q >= (target + np.minimum(slack, (1 - target) / 2))[:, None])
    lower = np.where(safe.any(-1), _first(safe, c, -q), -1)
    return np.where(promised, wanted, highest), met, lower


def _hold(previous, wanted, lower, q, c, promised, met, target, slack):
    """Levels [L] at one position after those before it, from what `_reaching` says of it."""
    rows = np.arange(len(q))
    before, at = q[rows, previous], c[rows, previous]
    down = met & (lower >= 0) & (c[rows, lower] < at)
    stays = np.where(met, before >= target, before >= q[rows, wanted] - slack)
    stays &= (previous >= 0) & np.isfinite(at) & promised
    return np.where(stays, np.where(down, lower, previous), wanted)


def _totals(levels, q, c, weight):
    """Cost and value of a composition."""
    rows = np.arange(len(levels))
    return int(c[rows, levels].sum()), _sum(weight * q[rows, levels])


def _sum(parts):
    """In order, which numpy's own sum is not."""
    return float(np.cumsum(parts)[-1])


def _arguments(quality, cost, weight, previous, slack, path=False):
    """Arguments as arrays of float64 and int64; RunError for what cannot be planned with."""
    quality, cost = np.ascontiguousarray(quality, np.float64), np.ascontiguousarray(cost, np.float64)
    if quality.ndim != 2 + path or not quality.size or cost.shape != quality.shape[-2:]:
        shapes = f"[{'positions, ' * path}labels, levels] and [labels, levels]"
        _refuse(f"quality {quality.shape} and cost {cost.shape} do not fit", f"give {shapes}")
    weight = np.ones(len(cost)) if weight is None else np.array(weight, np.float64, order="C")
    levels = np.full(len(cost), -1) if previous is None else np.asarray(previous)
    if weight.shape not in (quality.shape[-2:-1], quality.shape[:-1]):
        _refuse(f"weight {weight.shape} does not fit quality {quality.shape}", "give one weight per label")
    last = cost.shape[1] - 1
    whole = levels.shape == cost.shape[:1] and levels.dtype.kind in "iu"
    if not whole or levels.min() < -1 or levels.max() > last:
        _refuse("previous levels do not fit", f"give whole numbers, -1 to {last}, for {len(cost)} labels")
    if (np.abs(quality) > 1).any():
        _refuse("a quality lies outside -1 to 1", "give SSIM, NaN where no promise is known")
    finite = np.isfinite(cost)
    amounts = np.where(finite, cost, 0)
    if not (cost >= 0).all() or (amounts != np.floor(amounts)).any():
        _refuse("a cost is not a whole number from 0 on", "give bytes or Gaussians, inf to leave a level out")
    if amounts.max(-1).sum() >= 2**53:
        _refuse("costs add up to 2**53 or more", "give them in a larger unit")
    if not finite.any(-1).all():
        _refuse(f"label {finite.any(-1).argmin()} has no level", "give one a finite cost or drop the label")
    if weight.min() < 0 or not np.isfinite(weight.sum(-1)).all():
        _refuse("a weight is negative or not finite", "give 0 for a label that does not matter")
    if not 0 <= slack <= 1:
        _refuse(f"slack {slack} is impossible", "choose a difference of SSIM from 0 to 1, such as 0.01")
    return quality, cost, weight, np.array(levels, np.int64, order="C")


def _targets(target, labels):
    target = np.asarray(target, np.float64)
    if target.shape not in ((), (labels,)) or not ((target > 0) & (target <= 1)).all():
        _refuse(f"target SSIM {target} is impossible", "choose one or one per label, above 0 and at most 1")
    return np.broadcast_to(target, (labels,))


def _budget(budget):
    if not budget > 0:
        _refuse(f"budget {budget} is impossible", "choose one above 0, in the unit of the costs")
    return float(np.floor(budget))


def _refuse(problem, cure):
    raise RunError(f"{problem}; {cure}")
