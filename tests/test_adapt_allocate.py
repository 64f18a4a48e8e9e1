"""Levels for a target: the plain rule, along jittery paths, the shared vectors."""

import itertools
import json
import math

import make_plans
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sagesplat.adapt.allocate import along, cheapest
from sagesplat.core.errors import RunError

VECTORS = [case for case in json.loads(make_plans.PATH.read_text()) if case["mode"] == "target"]
quick = settings(max_examples=60)
IDS = [case["name"] for case in VECTORS]


@st.composite
def problems(draw, labels=5, levels=5, monotone=False):
    """Quality and cost with many ties, or none at all; some levels lack a promise or are missing."""
    shape = draw(st.integers(1, labels)), draw(st.integers(1, levels))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    if draw(st.booleans()):
        quality, cost = rng.integers(0, 10, shape) / 10, np.cumsum(rng.integers(0, 4, shape), 1)
    else:
        quality, cost = rng.uniform(0, 1, shape), np.sort(rng.integers(0, 10**9, shape), 1)
    cost = cost.astype(float)
    if monotone or draw(st.booleans()):
        quality = np.sort(quality, 1)
    if not monotone and draw(st.booleans()):
        quality[rng.random(shape) < 0.2] = np.nan
        cost[:, 1:][rng.random((shape[0], shape[1] - 1)) < 0.2] = np.inf
    return quality, cost


def usable(quality, cost):
    """Quality and cost as the rules of the module say, label by label: a list of (level, quality, cost)."""
    labels = []
    for q, c in zip(quality, cost, strict=True):
        had = [(k, q[k], c[k]) for k in range(len(q)) if c[k] < math.inf]
        known = [level for level in had if not math.isnan(level[1])]
        labels.append(known or had)
    return labels


@pytest.mark.parametrize("case", VECTORS, ids=IDS)
def test_vectors_are_those_of_the_implementation(case):
    assert json.loads(json.dumps(make_plans.expected(case))) == case["expected"]


def best_of(levels, target, quality):
    """Plain rule of a target for one label."""
    if all(math.isnan(quality[k]) for k, _, _ in levels):
        return levels[-1][0]
    if reaching := [(c, -q, k) for k, q, c in levels if q >= target]:
        return min(reaching)[2]
    return min((-q, c, k) for k, q, c in levels)[2]


@quick
@given(problems(), st.floats(0.01, 1.0))
def test_cheapest_is_the_plain_rule(problem, target):
    quality, cost = problem
    plan = cheapest(quality, cost, target)
    labels = usable(quality, cost)
    assert plan.levels.tolist() == [best_of(a, target, b) for a, b in zip(labels, quality, strict=True)]
    for row, levels in enumerate(labels):
        promises = not all(math.isnan(quality[row, k]) for k, _, _ in levels)
        assert plan.missed[row] == (promises and all(q < target for _, q, _ in levels))
    assert plan.status == ("infeasible" if plan.missed.any() else "ok")


def jittered(quality, positions, swing, rng):
    """Each promise within `swing` / 2 of its own value, rising along the levels where they did."""
    noise = rng.uniform(-swing / 2, swing / 2, (positions, *quality.shape))
    return np.clip(np.sort(quality + noise, -1), -1, 1)


def returns(steps):
    """Whether anything that was left comes back."""
    runs = [step for step, _ in itertools.groupby(steps)]
    return len(set(runs)) < len(runs)


@quick
@given(problems(monotone=True), st.floats(0.01, 1.0), st.sampled_from([0.0, 0.01, 0.1]), st.integers(0, 99))
def test_target_is_kept_without_flicker(problem, target, slack, seed):
    quality, cost = problem
    swing = 0.99 * min(slack, (1 - target) / 2)
    quality = jittered(0.9 * quality, 30, swing, np.random.default_rng(seed))
    plan = along(quality, cost, target, slack=slack)
    for p in range(len(plan)):
        plain = cheapest(quality[p], cost, target)
        kept = quality[p][np.arange(len(cost)), plan[p]] >= target
        assert (kept == ~plain.missed).all()
        assert (
            cheapest(quality[p], cost, target, previous=plan[p], slack=slack).levels.tolist()
            == plan[p].tolist()
        )
    if swing > 0:
        assert not any(returns(label.tolist()) for label in plan.T)


GOOD = {"quality": [[0.5, 0.8], [0.4, 0.9]], "cost": [[1, 2], [3, 4]], "target": 0.5}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"quality": [[0.5, 0.8]]}, r"do not fit; give \[labels, levels\] and \[labels, levels\]"),
        ({"quality": [[0.5, 1.8], [0.4, 0.9]]}, "outside -1 to 1; give SSIM"),
        ({"cost": [[1, math.nan], [3, 4]]}, "whole number"),
        ({"cost": [[1, 2], [3, 2**53]]}, "larger unit"),
        ({"cost": [[1, 2], [math.inf, math.inf]]}, "label 1 has no level"),
        ({"previous": [0, 2]}, "previous levels do not fit; give whole numbers, -1 to 1, for 2 labels"),
        ({"slack": math.nan}, "slack nan is impossible"),
    ],
)
def test_impossible_arguments_are_named(change, message):
    with pytest.raises(RunError, match=message):
        cheapest(**GOOD | change)


@pytest.mark.parametrize("target", [0, 1.01, -0.5, math.nan, [0.5, 0.0], [0.5] * 3])
def test_impossible_targets_are_named(target):
    with pytest.raises(RunError, match=r"target SSIM .* is impossible; choose"):
        cheapest(GOOD["quality"], GOOD["cost"], target)


def test_a_path_wants_positions():
    with pytest.raises(RunError, match=r"give \[positions, labels, levels\]"):
        along(GOOD["quality"], GOOD["cost"], 0.5)


def test_a_path_is_one_plan_after_another():
    quality, cost, _ = make_plans.scene(np.random.default_rng(1), 25, 6, 8)
    plan = along(quality, cost, 0.8)
    levels = None
    for p in range(25):
        levels = cheapest(quality[p], cost, 0.8, previous=levels).levels
        assert plan[p].tolist() == levels.tolist()
    assert len(np.unique(plan, axis=0)) > 2
