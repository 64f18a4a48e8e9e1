"""Plans for all viewpoints of a scene, cell by cell: fewer bytes than with a category's cells at one level.

With all cells of a category at one level, a viewpoint measures more than is asked wherever it shows what is
easy, and the plan takes the next level as soon as one viewpoint in twenty misses. So the cells begin at their
lowest levels, and upgrades are added by what they bring per byte to the viewpoints that still miss the
target, each counted up to the target (a greedy cover), until as many keep it as with equal levels. What is
added up is what cells measure with all at one level; the composition is measured afterwards
(`stages.methods`).
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from sagesplat.adapt.bound_plans import Costs
from sagesplat.adapt.plan import Plan

_CLOSE = 0.004  # fidelity: over the target; asked for, between what is enough and what is not
_FURTHER = 1.2  # times what is missed
_ROUNDS, _SEARCHED = 9, 4  # of a search at most; after so many, what was enough is asked for
_PRIOR = 1e-3  # of a gain where the target is kept already, beside one where it is missed


class Search:
    """What to ask of each category so that what it measures in the composition is just the plan's target."""

    def __init__(self, plan: Plan, costs: Costs) -> None:
        """`costs`: of categories."""
        self._most = dict(zip(costs.labels, costs.transfer_bytes[:, -1].tolist(), strict=True))
        self.asked = {choice.label_id: plan.target for choice in plan.choices if choice.status == "ok"}
        self._too_little = dict[int, float]()  # by category, the most that was
        self._enough = dict[int, float]()  # the least that was
        self._rounds = 0

    def narrow(self, plan: Plan, over: Mapping[int, float]) -> bool:
        """Ask for something else by how much a plan's categories exceed the target; False: nothing is left.

        A category that misses the target with all it can get lies beside others that spill over it: those
        that were lowered are asked for what was enough; else all count as missing half of that.
        """
        self._rounds += 1
        if self._rounds == _ROUNDS or all(0 <= by <= _CLOSE for by in over.values()):
            return False
        before, sent = dict(self.asked), {choice.label_id: choice.transfer_bytes for choice in plan.choices}
        spilt = max((-by for label, by in over.items() if sent[label] == self._most[label]), default=0.0)
        lowered = {label: more for label, more in self._enough.items() if more > before[label]}
        for label, by in over.items():
            spills = spilt > 0 and not lowered
            self.asked[label] = self._next(label, min(by, -spilt / 2) if spills else by)
        if spilt > 0:
            self.asked |= lowered
        return self.asked != before

    def _next(self, label: int, by: float) -> float:
        asked, settle = self.asked[label], self._rounds > _SEARCHED
        # what was found beside other neighbours may no longer be so
        if by >= 0:
            self._enough[label] = asked
            if self._too_little.get(label, -np.inf) >= asked:
                del self._too_little[label]
        else:
            self._too_little[label] = asked
            if self._enough.get(label, np.inf) <= asked:
                del self._enough[label]
        enough, too_little = self._enough.get(label), self._too_little.get(label)
        if enough is None:
            return min(asked - _FURTHER * by + settle * _CLOSE, 1.0)
        if settle or (too_little is not None and enough - too_little < _CLOSE):
            return enough
        return asked - by if too_little is None else (enough + too_little) / 2


def thinned(
    plan: Plan,
    measured: Float[np.ndarray, "V C K"],
    pixels: Float[np.ndarray, "V C"],
    costs: Costs,
    label_of: Mapping[int, int],
    asked: Mapping[int, float],
) -> Plan:
    """A scene's plan with levels of cells that keep what is asked in its share of the viewpoints.

    Args:
        plan: Of `scene_plans.plan_for_scene`, for fidelity; a category that reaches its target may get less.
        measured: [V, C, K], fidelity of each cell at each level; NaN out of sight.
        pixels: [V, C], of each cell; 0 where the viewpoint shows too little of the category to count.
        costs: What the cells' levels cost; rows ascending by cell id.
        label_of: Label id by cell id.
        asked: Fidelity by label id, of the categories to change; at least the plan's target.

    Returns:
        The plan with `Plan.cells`. The cells of a category stay at one level, the plan's or the cheapest
        above it that keeps what is asked, where levels of their own would not take less.
    """
    assert plan.share is not None
    labels = np.array([label_of[cell] for cell in costs.labels])
    levels = np.array([plan.levels[label] - 1 for label in labels.tolist()])
    nbytes = costs.transfer_bytes
    for label, target in asked.items():
        mine = np.flatnonzero(labels == label)
        weight = pixels[:, mine]
        views = weight.sum(1) > 0
        rank = math.ceil((views.sum() + 1) * plan.share - 1e-9)
        if rank > views.sum():
            continue
        share = weight[views] / weight[views].sum(1, keepdims=True)
        value = share[..., None] * np.nan_to_num(measured[views][:, mine].astype(np.float64))
        value = np.maximum.accumulate(value, 2)
        keeps = (value.sum(1) >= target).sum(0) >= rank
        keeps[-1] = True  # there is nothing above
        levels[mine] = np.maximum(levels[mine], keeps.argmax())
        found = _cover(value, nbytes[mine], target, int(rank), levels[mine])
        if found is not None and _total(nbytes[mine], found) < _total(nbytes[mine], levels[mine]):
            levels[mine] = found
    return _with_cells(plan, costs, labels, levels)


def _cover(
    value: Float[np.ndarray, "n c K"],
    cost: Int[np.ndarray, "c K"],
    target: float,
    rank: int,
    equal: Int[np.ndarray, " c"],
) -> Int[np.ndarray, " c"] | None:
    """Levels (columns) of cells by which `rank` views reach the target; None where no upgrade helps.

    `value`: what each cell adds to the fidelity of each view. A cell that no view shows is at `equal`.
    """
    cells, columns = np.arange(len(cost)), np.arange(cost.shape[1])
    levels = np.where(value[..., -1].any(0), 0, equal)
    while True:
        now = value[:, cells, levels]
        missing = np.maximum(target - now.sum(1), 0)
        if (missing == 0).sum() >= rank:
            return levels
        gain = value - now[..., None]
        bring = np.minimum(gain, missing[:, None, None]).sum(0) + _PRIOR * gain.sum(0)
        more = cost - cost[cells, levels][:, None]
        slope = np.where((columns > levels[:, None]) & (bring > 0), bring / np.maximum(more, 1), 0)
        cell, column = np.unravel_index(slope.argmax(), slope.shape)
        if slope[cell, column] <= 0:
            return None
        levels[cell] = column


def _total(cost: Int[np.ndarray, "c K"], levels: Int[np.ndarray, " c"]) -> int:
    return int(cost[np.arange(len(cost)), levels].sum())


def _with_cells(plan: Plan, costs: Costs, labels: np.ndarray, levels: np.ndarray) -> Plan:
    """The plan at these levels (columns) of the cells."""
    choices = []
    for choice in plan.choices:
        mine = np.flatnonzero(labels == choice.label_id)
        count, nbytes = (_total(of[mine], levels[mine]) for of in (costs.count, costs.transfer_bytes))
        level = int(levels[mine].max()) + 1
        choices.append(replace(choice, level=level, count=count, transfer_bytes=nbytes))
    cells = dict(zip(costs.labels, (levels + 1).tolist(), strict=True))
    return replace(plan, choices=tuple(choices), cells=cells)
