"""Levels of cells by which categories reach a fidelity, with the fewest bytes: the steepest upgrades first.

Every cell begins at its lowest level. The upgrades of a cell in sight are the segments of the upper concave
hull of (bytes, share * mean) over its levels, as in `adapt.fill`. Those of a category's cells are taken by
falling slope, of equal ones the lower cell first, until sum share * mean >= needed * sum share: no other
set of segments is cheaper by more than the last one. Within a budget the steepest upgrades of all cells are
taken that still fit. `web/src/core/planner.ts` does the same; tests/data/plans.json (mode "cells") checks it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from sagesplat.adapt.fill import next_upgrade
from sagesplat.kernels.jit import njit

_EQUAL = 1e-9  # by which sums of equal values differ


@dataclass(frozen=True, eq=False)
class Reach:
    """Levels of cells, and which categories reach what they need."""

    levels: Int[np.ndarray, " C"]  # columns
    met: Bool[np.ndarray, " L"]


def reach(
    cost: Int[np.ndarray, "C K"],
    mean: Float[np.ndarray, "C K"],
    share: Float[np.ndarray, " C"],
    column: Int[np.ndarray, " C"],
    needed: Float[np.ndarray, " L"],
) -> Reach:
    """Choose the levels of each category's cells (the module's rule).

    Args:
        cost: Bytes of each cell's levels.
        mean: Expected fidelity, never falling along the levels; NaN: unknown.
        share: Of the picture's pixels; 0: out of sight.
        column: Of each cell's category, 0 to L - 1.
        needed: Mean fidelity of each category; NaN: nothing is promised, its cells in sight stay in full;
            from 1 on too.
    """
    K = mean.shape[1]
    full = (share > 0) & ~(needed[column] < 1)
    unknown = np.isnan(mean).any(1)
    wanted = np.where(np.isnan(needed), -np.inf, needed)
    value = np.where(unknown | (share <= 0), 0.0, share)[:, None] * np.nan_to_num(mean)
    levels = np.where(full | (unknown & (share > 0)), K - 1, 0)
    met = np.ones(len(needed), np.bool_)
    _reach(levels, np.ascontiguousarray(cost, np.float64), value, share * ~unknown, column, wanted, met)
    return Reach(levels, met)


def within(
    cost: Int[np.ndarray, "C K"],
    mean: Float[np.ndarray, "C K"],
    share: Float[np.ndarray, " C"],
    budget: float,
) -> Int[np.ndarray, " C"]:
    """Columns of the levels that a budget in the unit of `cost` allows: the steepest upgrades that still fit.

    All cells begin at their lowest level, whatever that costs; arguments as of `reach`. What is unknown
    counts as sqrt(cost / the cell's largest cost): more is better, but ever less so.
    """
    assumed = np.sqrt(cost / np.maximum(cost[:, -1:], 1))
    value = np.where(share > 0, share, 0.0)[:, None] * np.where(np.isnan(mean), assumed, mean)
    levels = np.zeros(len(share), np.int64)
    _within(levels, np.ascontiguousarray(cost, np.float64), value, float(budget))
    return levels


@njit(cache=True, error_model="numpy")
def _within(levels, cost, value, budget):
    C = len(levels)
    tops, slopes, left = np.empty(C, np.int64), np.empty(C), budget
    for cell in range(C):
        left -= cost[cell, 0]
        tops[cell], slopes[cell] = next_upgrade(cost[cell], value[cell], 0)
    while True:
        best = -1
        for cell in range(C):
            if tops[cell] >= 0 and (best < 0 or slopes[cell] > slopes[best]):
                best = cell
        if best < 0:
            break
        more = cost[best, tops[best]] - cost[best, levels[best]]
        if more > left:
            tops[best] = -1  # what comes after it costs more still
            continue
        left -= more
        levels[best] = tops[best]
        tops[best], slopes[best] = next_upgrade(cost[best], value[best], levels[best])


@njit(cache=True, error_model="numpy")
def _reach(levels, cost, value, share, column, needed, met):
    C = len(levels)
    tops, slopes = np.empty(C, np.int64), np.empty(C)
    left = np.zeros(len(needed))
    for cell in range(C):
        left[column[cell]] += needed[column[cell]] * share[cell] if share[cell] > 0 else 0.0
        left[column[cell]] -= value[cell, levels[cell]]
        tops[cell], slopes[cell] = next_upgrade(cost[cell], value[cell], levels[cell])
    for label in range(len(needed)):
        while left[label] > _EQUAL:
            best = -1
            for cell in range(C):
                if column[cell] == label and tops[cell] >= 0 and (best < 0 or slopes[cell] > slopes[best]):
                    best = cell
            if best < 0:
                met[label] = False
                break
            left[label] -= value[best, tops[best]] - value[best, levels[best]]
            levels[best] = tops[best]
            tops[best], slopes[best] = next_upgrade(cost[best], value[best], levels[best])
