"""Levels of cells by which categories reach a fidelity: by hand, and against every combination."""

import json
from itertools import product
from typing import Any

import make_plans
import numpy as np
import pytest

from sagesplat.adapt.cell_plans import reach

VECTORS = [case for case in json.loads(make_plans.PATH.read_text()) if case["mode"] == "cells"]


@pytest.mark.parametrize("case", VECTORS, ids=[case["name"] for case in VECTORS])
def test_vectors(case: dict[str, Any]) -> None:
    assert make_plans.reached(case) == case["expected"]["levels"]
    for label, levels in zip(case["labels"], case["expected"]["levels"], strict=True):
        seen = [(one, k) for one, k in zip(label["cells"], levels, strict=True) if one["visible"]]
        if label["theta"] is None or not seen or not label["weight"]:
            continue
        total = sum(one["share"] for one, _ in seen)
        mean = sum(one["share"] * one["mean"][k] for one, k in seen) / total
        best = sum(one["share"] * one["mean"][-1] for one, _ in seen) / total
        assert mean >= min(label["theta"], best) - 1e-8


def test_a_category_that_cannot_reach_it_says_so() -> None:
    cost, mean = np.array([[1, 2], [1, 3]]), np.array([[0.2, 0.5], [0.4, 0.9]])
    found = reach(cost, mean, np.array([0.1, 0.1]), np.array([0, 1]), np.array([0.8, 0.8]))
    assert (found.levels.tolist(), found.met.tolist()) == ([1, 1], [False, True])


def test_the_steepest_upgrade_comes_first():
    # gains of fidelity per byte, weighted by share: 0.6 * 0.4 / 10, 0.2 * 0.4 / 10, then 0.6 * 0.1 / 10
    cost = np.array([[10, 20, 30], [10, 20, 30]])
    mean = np.array([[0.4, 0.8, 0.9], [0.4, 0.8, 0.9]])
    share, column = np.array([0.6, 0.2]), np.array([0, 0])
    for needed, levels in ((0.4, [0, 0]), (0.7, [1, 0]), (0.8, [1, 1]), (0.85, [2, 1]), (0.9, [2, 2])):
        found = reach(cost, mean, share, column, np.array([needed]))
        assert found.levels.tolist() == levels
        assert found.met.tolist() == [True]


def test_of_equal_slopes_the_lower_cell_is_raised():
    cost, mean = np.array([[1, 2]] * 3), np.array([[0.0, 1.0]] * 3)
    found = reach(cost, mean, np.ones(3), np.zeros(3, int), np.array([0.3]))
    assert found.levels.tolist() == [1, 0, 0]


def test_levels_below_the_hull_are_skipped():
    found = reach(
        np.array([[10, 20, 30]]), np.array([[0.1, 0.11, 0.9]]), np.ones(1), np.array([0]), np.array([0.105])
    )
    assert found.levels.tolist() == [2]


def test_what_cannot_be_reached_or_is_not_promised():
    cost = np.array([[1, 2, 3]] * 6)
    mean = np.array([[0.1, 0.5, 0.6]] * 6)
    share = np.array([1.0, 0, 1, 0, 1, 0])
    column = np.array([0, 0, 1, 1, 2, 2])
    found = reach(cost, mean, share, column, np.array([0.7, np.nan, 1]))
    # in sight: as good as they get; in full without a promise; in full from 1 on. Out of sight: the lowest
    assert found.levels.tolist() == [2, 0, 2, 0, 2, 0]
    assert found.met.tolist()[:2] == [False, True]


def test_a_cell_of_unknown_fidelity_stays_in_full_and_does_not_count():
    mean = np.array([[np.nan, np.nan], [0.5, 0.9]])
    found = reach(np.array([[1, 2]] * 2), mean, np.ones(2), np.zeros(2, int), np.array([0.5]))
    assert found.levels.tolist() == [1, 0]
    assert found.met.tolist() == [True]


def test_out_of_sight_asks_nothing():
    mean = np.array([[0.1, 0.2]])
    found = reach(np.array([[1, 2]]), mean, np.zeros(1), np.zeros(1, int), np.array([0.9]))
    assert found.levels.tolist() == [0]
    assert found.met.tolist() == [True]


@pytest.mark.parametrize("seed", range(20))
def test_at_most_one_segment_dearer_than_the_cheapest(seed):
    rng = np.random.default_rng(seed)
    C, K = 4, 4
    cost = np.cumsum(rng.integers(1, 50, (C, K)), 1)
    mean = np.sort(rng.random((C, K)), 1)
    share = rng.random(C) * (rng.random(C) < 0.8)
    column = rng.integers(0, 2, C)
    needed = rng.uniform(0.2, 0.95, 2)
    found = reach(cost, mean, share, column, needed)
    for label in range(2):
        cells = np.flatnonzero((column == label) & (share > 0))
        rows = np.arange(len(cells))
        goal = needed[label] * share[cells].sum() - 1e-9

        def value(levels, cells=cells):
            return (share[cells] * mean[cells, levels]).sum()

        every = [np.array(levels, int) for levels in product(range(K), repeat=len(cells))]
        reaching = [cost[cells, levels].sum() for levels in every if value(levels) >= goal]
        chosen = found.levels[cells]
        assert found.met[label] == bool(reaching) == (value(chosen) >= goal)
        if reaching:
            dearest = max([int(cost[c, -1] - cost[c, 0]) for c in cells], default=0)
            assert cost[cells, chosen].sum() <= min(reaching) + dearest
        assert (found.levels[(column == label) & (share <= 0)] == 0).all()
        assert len(rows) == len(chosen)
