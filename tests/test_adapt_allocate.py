"""Levels for a target or a budget: against brute force and greed, along jittery paths, the shared vectors."""

import itertools
import json
import math

import make_plans
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sagesplat.adapt.allocate import SLACK, along, best_within, cheapest
from sagesplat.core.errors import RunError

VECTORS = [case for case in json.loads(make_plans.PATH.read_text()) if case["mode"] in ("target", "budget")]
quick = settings(max_examples=60)
IDS = [f"{case['name']}, {case['mode']}" for case in VECTORS]


@st.composite
def problems(draw, labels=5, levels=5, monotone=False):
    """Quality, cost and weight with many ties, or none at all; some levels lack a promise or are missing."""
    shape = draw(st.integers(1, labels)), draw(st.integers(1, levels))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    if draw(st.booleans()):
        quality, cost = rng.integers(0, 10, shape) / 10, np.cumsum(rng.integers(0, 4, shape), 1)
        weight = rng.integers(0 if not monotone else 1, 4, shape[0])
    else:
        quality, cost = rng.uniform(0, 1, shape), np.sort(rng.integers(0, 10**9, shape), 1)
        weight = rng.exponential(1, shape[0])
    cost = cost.astype(float)
    if monotone or draw(st.booleans()):
        quality = np.sort(quality, 1)
    if not monotone and draw(st.booleans()):
        quality[rng.random(shape) < 0.2] = np.nan
        cost[:, 1:][rng.random((shape[0], shape[1] - 1)) < 0.2] = np.inf
    return quality, cost, weight.astype(float)


def usable(quality, cost):
    """Quality and cost as the rules of the module say, label by label: a list of (level, quality, cost)."""
    labels = []
    for q, c in zip(quality, cost, strict=True):
        had = [(k, q[k], c[k]) for k in range(len(q)) if c[k] < math.inf]
        known = [level for level in had if not math.isnan(level[1])]
        most = max(1, *(c for _, _, c in had)) if had else 1
        labels.append(known or [(k, math.sqrt(c / most), c) for k, _, c in had])
    return labels


def in_units(labels, weight, previous=None, slack=0.0):
    """(cost, value in whole units, level) of each label's levels, without the cheapest's equals."""
    total = 0.0
    for w in weight:
        total += w
    choices = []
    for row, (levels, w) in enumerate(zip(labels, weight, strict=True)):
        units = w / total * 2.0**40 if total else 0.0
        had = []
        for k, q, c in levels:
            bonus = slack if previous is not None and previous[row] == k else 0.0
            had.append((int(c), -math.floor(units * (q + bonus) + 0.5), -q, k))
        first = min(had)
        choices.append([(c, -v, k) for c, v, q, k in had if v < first[1] or k == first[3]])
    return choices


def brute_force(choices, budget):
    """Levels of the best composition and its value in units; the cheapest levels where nothing fits."""
    best = None
    for composition in itertools.product(*choices):
        cost, value = sum(c for c, _, _ in composition), sum(v for _, v, _ in composition)
        levels = [k for *_, k in composition]
        if cost <= budget and (best is None or (-value, cost, levels) < best):
            best = (-value, cost, levels)
    return best[2] if best else [min(label, key=lambda choice: choice[0])[2] for label in choices]


def greed(choices, budget):
    """Value of steps by value per cost until none fits."""
    at = [min(label) for label in choices]
    left = budget - sum(c for c, _, _ in at)
    while True:
        steps = [
            ((level[1] - at[row][1]) / (level[0] - at[row][0]), at[row][0] - level[0], -row, level)
            for row, label in enumerate(choices)
            for level in label
            if level[1] > at[row][1] and 0 < level[0] - at[row][0] <= left
        ]
        if not steps:
            return sum(v for _, v, _ in at)
        _, saved, row, level = max(steps)
        left, at[-row] = left + saved, level


def value_in_units(choices, levels):
    return sum(
        next(v for _, v, k in label if k == level) for label, level in zip(choices, levels, strict=True)
    )


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
    quality, cost, _ = problem
    plan = cheapest(quality, cost, target)
    labels = usable(quality, cost)
    assert plan.levels.tolist() == [best_of(a, target, b) for a, b in zip(labels, quality, strict=True)]
    for row, levels in enumerate(labels):
        promises = not all(math.isnan(quality[row, k]) for k, _, _ in levels)
        assert plan.missed[row] == (promises and all(q < target for _, q, _ in levels))
    assert plan.status == ("infeasible" if plan.missed.any() else "ok")


@settings(max_examples=300)
@given(problems(), st.floats(0, 1.1), st.booleans())
def test_small_plans_are_exact(problem, share, again):
    quality, cost, weight = problem
    labels = usable(quality, cost)
    least, most = (sum(f(c for _, _, c in levels) for levels in labels) for f in (min, max))
    budget = max(1.0, least + share * (most - least)) if share > 0 else max(1.0, least - 1)
    previous = np.array([levels[-1][0] for levels in labels]) if again else None
    plan = best_within(quality, cost, weight, budget, previous=previous)
    choices = in_units(labels, weight, previous, SLACK)
    assert plan.levels.tolist() == brute_force(choices, budget)
    assert plan.optimal
    assert plan.status == ("ok" if plan.cost <= budget else "over budget")
    if not again and plan.status == "ok":  # the values themselves, not rounded to units
        fits = (p for p in itertools.product(*labels) if sum(c for _, _, c in p) <= budget)
        best = max(math.fsum(w * q for w, (_, q, _) in zip(weight, p, strict=True)) for p in fits)
        assert abs(plan.value - best) <= 1e-10 * max(1.0, weight.sum())


@quick
@given(problems(25, 9), st.floats(0.01, 0.9), st.sampled_from([0, 300, 4096]))
def test_never_worse_than_greed_nor_over_the_budget(problem, share, states):
    quality, cost, weight = problem
    labels = usable(quality, cost)
    least, most = (sum(f(c for _, _, c in levels) for levels in labels) for f in (min, max))
    budget = max(1.0, math.ceil(least + share * (most - least)))
    plan = best_within(quality, cost, weight, budget, states=states)
    choices = in_units(labels, weight)
    assert plan.cost <= budget
    assert value_in_units(choices, plan.levels) >= greed(choices, budget)
    best = best_within(quality, cost, weight, budget, states=500_000)
    assert best.optimal
    assert plan.value <= best.value + 1e-9 <= plan.bound + 1e-8 * max(1.0, weight.sum())


def test_subset_sums_of_large_costs_are_exact():
    """Value = cost, the hardest kind: the best fill of the budget is found to the byte."""
    cost = np.array([[0, c] for c in (984_373_123, 771_000_017, 512_345_679, 333_333_331, 250_000_009)])
    weight = cost[:, 1].astype(float)
    plan = best_within(np.array([[0.0, 1.0]] * 5), cost, weight, 1_600_000_000)
    sums = [sum(p) for n in range(6) for p in itertools.combinations(cost[:, 1].tolist(), n)]
    assert plan.cost == max(total for total in sums if total <= 1_600_000_000)


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
    quality, cost, _ = problem
    swing = 0.99 * min(slack, (1 - target) / 2)
    quality = jittered(0.9 * quality, 30, swing, np.random.default_rng(seed))
    plan = along(quality, cost, target=target, slack=slack)
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


@quick
@given(problems(monotone=True), st.floats(0, 1), st.sampled_from([0.01, 0.1]), st.sampled_from([0, 4096]))
def test_budget_is_kept_without_flicker(problem, share, slack, states):
    quality, cost, weight = problem
    least, most = cost[:, 0].sum(), cost[:, -1].sum()
    budget = max(1.0, least + share * (most - least))
    quality = jittered(0.9 * quality, 20, 0.99 * slack, np.random.default_rng(0))
    plan = along(quality, cost, budget=budget, weight=weight + 0.1, slack=slack, states=states)
    assert (np.take_along_axis(cost[None], plan[..., None], 2).sum((1, 2)) <= budget).all()
    assert not returns([tuple(levels) for levels in plan.tolist()])
    rest = {"previous": plan[-1], "slack": slack, "states": states}
    stays = best_within(quality[-1], cost, weight + 0.1, budget, **rest)
    assert stays.levels.tolist() == plan[-1].tolist()


@quick
@given(problems(12, 6), st.floats(0.1, 0.9), st.floats(0, 0.01))
def test_to_stay_is_always_considered(problem, share, slack):
    """Greed alone would leave a better composition behind."""
    quality, cost, weight = problem
    budget = max(1.0, math.ceil(share * np.where(np.isfinite(cost), cost, 0).max(1).sum()))
    before = best_within(quality, cost, weight, budget, states=500_000).levels
    plan = best_within(quality, cost, weight, budget, previous=before, slack=slack, states=0)
    choices = in_units(usable(quality, cost), weight)
    assert value_in_units(choices, plan.levels) >= value_in_units(choices, before) - len(cost)  # rounding


GOOD = {"quality": [[0.5, 0.8], [0.4, 0.9]], "cost": [[1, 2], [3, 4]], "weight": [1, 1], "budget": 5}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"quality": [[0.5, 0.8]]}, r"do not fit; give \[labels, levels\] and \[labels, levels\]"),
        ({"quality": [[0.5, 1.8], [0.4, 0.9]]}, "outside -1 to 1; give SSIM"),
        ({"cost": [[1, math.nan], [3, 4]]}, "whole number"),
        ({"cost": [[1, 2], [3, 2**53]]}, "larger unit"),
        ({"cost": [[1, 2], [math.inf, math.inf]]}, "label 1 has no level"),
        ({"weight": [1, -1]}, "weight is negative or not finite"),
        ({"budget": math.nan}, "budget nan is impossible; choose one above 0"),
        ({"previous": [0, 2]}, "previous levels do not fit; give whole numbers, -1 to 1, for 2 labels"),
        ({"slack": math.nan}, "slack nan is impossible"),
    ],
)
def test_impossible_arguments_are_named(change, message):
    with pytest.raises(RunError, match=message):
        best_within(**GOOD | change)


@pytest.mark.parametrize("target", [0, 1.01, -0.5, math.nan, [0.5, 0.0], [0.5] * 3])
def test_impossible_targets_are_named(target):
    with pytest.raises(RunError, match=r"target SSIM .* is impossible; choose"):
        cheapest(GOOD["quality"], GOOD["cost"], target)


def test_a_path_wants_positions_and_one_aim():
    with pytest.raises(RunError, match="give one of them"):
        along(np.array([GOOD["quality"]]), GOOD["cost"])
    with pytest.raises(RunError, match=r"give \[positions, labels, levels\]"):
        along(GOOD["quality"], GOOD["cost"], target=0.5)


@quick
@given(problems(), st.lists(st.floats(0, 1.1), min_size=2, max_size=6))
def test_more_budget_gives_no_less(problem, shares):
    quality, cost, weight = problem
    most = np.where(np.isfinite(cost), cost, 0).max(1).sum()
    plans = [best_within(quality, cost, weight, max(1.0, share * most)) for share in sorted(shares)]
    values = [plan.value for plan in plans if plan.status == "ok"]
    assert (np.diff(values) >= -1e-10 * weight.sum()).all()


@pytest.mark.parametrize("mode", [{"target": 0.8}, {"budget": 400_000.0}])
def test_a_path_is_one_plan_after_another(mode):
    quality, cost, weight = make_plans.scene(np.random.default_rng(1), 25, 6, 8)
    weights = weight * np.random.default_rng(2).uniform(0, 2, (25, 6))
    plan = along(quality, cost, weight=weights, **mode)
    levels = None
    for p in range(25):
        if "target" in mode:
            levels = cheapest(quality[p], cost, mode["target"], previous=levels).levels
        else:
            levels = best_within(quality[p], cost, weights[p], mode["budget"], previous=levels).levels
        assert plan[p].tolist() == levels.tolist()
    assert len(np.unique(plan, axis=0)) > 2
