"""The fill: against the rule written out plainly, its guarantees, the shared vectors."""

import json
import math

import make_plans
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sagesplat.adapt.fill import SLACK, fill
from sagesplat.core.errors import RunError

VECTORS = [case for case in json.loads(make_plans.PATH.read_text()) if case["mode"] == "fill"]
quick = settings(max_examples=150)


@st.composite
def problems(draw):
    """Levels to begin with, quality that never falls, cost, weight; with many ties, or none."""
    shape = draw(st.integers(1, 6)), draw(st.integers(1, 6))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    if draw(st.booleans()):
        quality, weight = rng.integers(0, 8, shape) / 8, rng.integers(0, 4, shape[0]).astype(float)
        cost = np.cumsum(rng.integers(0, 4, shape), 1).astype(float)
    else:
        quality, weight = rng.uniform(0, 1, shape), rng.exponential(1, shape[0])
        cost = np.sort(rng.integers(1, 10**7, shape), 1).astype(float)
    quality = np.sort(quality, 1)
    if draw(st.booleans()):
        quality[rng.random(shape[0]) < 0.3] = np.nan
    return rng.integers(0, shape[1], shape[0]), quality, cost, weight


def mean_of(levels, quality, weight):
    known = np.isfinite(quality).all(1) & (weight > 0)
    rows = np.arange(len(levels))
    values = np.where(known, quality[rows, levels], 0)
    return float((weight * known * values).sum() / max((weight * known).sum(), 1e-300))


def plainly(levels, quality, cost, weight):
    """The rule of the module, by sets of points instead of a walk."""
    levels, (L, K) = levels.copy(), quality.shape
    known = np.isfinite(quality).all(1) & (weight > 0)
    value = np.where(known[:, None], weight[:, None] * quality, 0)
    rows = np.arange(L)

    def lies_below():
        nbytes, sizes, values = cost[rows, levels].sum(), cost.sum(0), value.sum(0)
        fewer = int((sizes < nbytes).sum())
        some = slice(max(fewer - 1, 0), fewer + 1)
        # of equal bytes the first level, beyond them the last
        curve = np.interp(nbytes, sizes[some], values[some])
        total = max((weight * known).sum(), 1e-300)
        return value[rows, levels].sum() / total < curve / total - SLACK

    segments = []
    for label in rows[known]:
        at = levels[label]
        while steps := [
            (
                (value[label, k] - value[label, at]) / more if more > 0 else math.inf,
                -more,
                value[label, k] - value[label, at],
                -k,
            )
            for k in range(at + 1, K)
            if value[label, k] > value[label, at]
            for more in [cost[label, k] - cost[label, at]]
        ]:
            slope, _, _, k = max(steps)
            at = -k
            segments.append((-slope, label, at))
    for _, label, k in sorted(segments, key=lambda segment: segment[:2]):
        if not lies_below():
            break
        levels[label] = k
    return levels


# two levels take as many bytes: beyond these the curve goes on from the upper one
EQUAL_BYTES = (
    np.array([2, 5, 2]),
    np.array([[4, 4, 4, 4, 7, 7], [1, 5, 5, 7, 7, 7], [0, 1, 2, 2, 5, 5]]) / 8,
    np.array([[3, 3, 3, 4, 4, 7], [2, 3, 5, 8, 8, 10], [2, 4, 5, 5, 5, 8]], np.float64),
    np.array([3.0, 3.0, 1.0]),
)


@quick
@given(problems())
@example(EQUAL_BYTES)
def test_it_is_the_rule(problem):
    assert fill(*problem).tolist() == plainly(*problem).tolist()


@quick
@given(problems())
def test_what_it_guarantees(problem):
    levels, quality, cost, weight = problem
    found, rows = fill(*problem), np.arange(len(levels))
    assert (found >= levels).all()
    stays = ~np.isfinite(quality).all(1) | (weight == 0)
    assert (found[stays] == levels[stays]).all()
    top = np.where(stays, levels, quality.shape[1] - 1)
    nbytes = cost[rows, found].sum()
    assert nbytes <= cost[rows, top].sum()
    filled = mean_of(found, quality, weight)
    if not stays.any():
        # of equal bytes the first level counts, as in the rule; np.interp takes the last
        sizes, first = np.unique(cost.sum(0), return_index=True)
        uniform = np.interp(nbytes, sizes, (weight @ quality / weight.sum())[first])
        assert filled >= uniform - SLACK - 1e-8
    assert fill(found, quality, cost, weight).tolist() == found.tolist()  # twice changes nothing


@quick
@given(problems(), st.sampled_from([0.0, 0.01]))
def test_the_lowest_label_is_no_lower_than_with_equal_levels(problem, tolerance):
    levels, quality, cost, weight = problem
    found, rows = fill(*problem, lowest=tolerance), np.arange(len(levels))
    counts = np.isfinite(quality).all(1) & (weight > 0)
    assert (found >= levels).all()
    assert (found[~counts] == levels[~counts]).all()
    if counts.all():
        sizes, first = np.unique(cost.sum(0), return_index=True)
        nbytes = cost[rows, found].sum()
        assert (
            quality[rows, found].min() >= np.interp(nbytes, sizes, quality.min(0)[first]) - tolerance - 1e-9
        )
        uniform = np.interp(nbytes, sizes, (weight @ quality / weight.sum())[first])
        assert mean_of(found, quality, weight) >= uniform - SLACK - 1e-8


@pytest.mark.parametrize("case", VECTORS, ids=[case["name"] for case in VECTORS])
def test_vectors(case):
    assert make_plans.expected(case) == case["expected"]
    quality, cost, _ = make_plans.arguments(case)
    levels, weight = np.array(case["levels"]), np.array(case["weight"], float)
    assert plainly(levels, quality, cost, weight).tolist() == case["expected"]["levels"]


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("levels", "quality", "cost", "weight"),
    [
        ([0], [[0.5, 0.6]], [[1, 2, 3]], [1]),
        ([-1], [[0.5, 0.6]], [[1, 2]], [1]),
        ([0], [[0.5, 0.6]], [[1, math.inf]], [1]),
        ([0], [[0.5, 0.6]], [[1, 2]], [math.nan]),
    ],
)
def test_impossible_arguments_are_one_line(levels, quality, cost, weight):
    with pytest.raises(RunError) as error:
        fill(np.array(levels), np.array(quality), np.array(cost), np.array(weight, float))
    assert "; give" in str(error.value)
