"""Plans for a viewpoint from lower bounds: levels, statuses, the fill; plans within a budget."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import orbit
from hypothesis import given
from hypothesis import strategies as st

from sagesplat.adapt.bound_plans import Costs, Quality, plan_for_view, plan_within, pooled, quality_at
from sagesplat.adapt.cell_plans import within
from sagesplat.adapt.viewpoint import NO_CALIBRATION, Calibration, QualityKind, ViewModel, constant_curve
from sagesplat.core.errors import RunError

BYTES = np.array([[10, 20, 60], [10, 30, 90], [5, 6, 7]])
COSTS = Costs((3, 7, 9), BYTES * 2, BYTES, BYTES * 4)


def quality(mean, bound=None, kind: QualityKind = "fidelity", calibrated=(True, True, True)) -> Quality:
    """One view."""
    mean = np.array([mean], float)
    bound = mean - 0.05 if bound is None else np.array([bound], float)
    return Quality(kind, mean, bound, np.full(mean.shape[:2], 2.0), np.array(calibrated))


FOCAL = orbit(1)[0].focal


def model(label: int, calibration: Calibration = NO_CALIBRATION) -> ViewModel:
    """Fidelity 0.6, 0.8 and 1 everywhere; known at the origin, looking along z."""
    curves = tuple(constant_curve(label, k + 1, v, 0.0, 1) for k, v in enumerate((0.6, 0.8, 1.0)))
    x = np.array([[0, 0, 0, 0, 0, 1, 0, 0, 0]], float)
    return ViewModel(
        label, "fidelity", curves, 1.0, 0.0, FOCAL, (0.5, 2.0), x, np.zeros(1, bool), (1.0, 1.0, 1.0, 1.0),
        0.0, np.zeros((6, 0)), np.zeros((1, 3)), 0.0, calibration,
    )  # fmt: skip


MEAN = [[0.3, 0.4, 0.9], [0.5, 0.95, 1.0], [0.6, 0.7, 0.8]]
NAN = [math.nan] * 3


def test_the_cheapest_level_whose_bound_holds():
    plan = plan_for_view(quality(MEAN), COSTS, 0.62, 0)
    assert plan.levels == {3: 3, 7: 2, 9: 2}
    assert [choice.predicted for choice in plan.choices] == pytest.approx([0.85, 0.9, 0.65])
    assert (plan.quality, plan.status, plan.verdict, plan.asked) == ("fidelity", "ok", "ok", "fidelity 0.62")
    assert (plan.transfer_bytes, plan.count) == (96, 192)
    assert {choice.calibrated for choice in plan.choices} == {True}


def test_statuses():
    """No model, no promise here, out of reach, held by too few views."""
    bound = [NAN, [0.4, 0.5, 0.6], [0.5, 0.6, 0.7]]
    plan = plan_for_view(quality(MEAN, bound, "ssim", (True, True, False)), COSTS, 0.65, 0)
    assert [c.status for c in plan.choices] == ["no promise", "infeasible", "ok"]
    assert plan.levels == {3: 3, 7: 3, 9: 3}
    assert [c.calibrated for c in plan.choices] == [None, True, False]
    assert [c.verdict for c in plan.choices] == ["no promise", "infeasible", "ok, uncalibrated"]
    assert math.isnan(plan.choices[0].predicted)
    assert (plan.status, plan.calibrated, plan.verdict) == ("infeasible", False, "infeasible, uncalibrated")
    unknown = plan_for_view(quality([NAN, *MEAN[1:]], [NAN, *bound[1:]]), COSTS, 0.5, 0)
    assert [c.status for c in unknown.choices] == ["no model", "ok", "ok"]
    assert unknown.choices[0].level == 3
    nothing = plan_for_view(quality(MEAN, [NAN] * 3), COSTS, 0.5, 0)
    assert (nothing.status, set(nothing.levels.values())) == ("no promise", {3})


@pytest.mark.parametrize(("kind", "name"), [("fidelity", "target fidelity"), ("ssim", "target SSIM")])
@pytest.mark.parametrize("target", [0.0, -1.0, 1.5, math.nan])
def test_impossible_targets_are_one_line(kind, name, target):
    with pytest.raises(RunError, match=rf"{name} .* is impossible; choose a number above 0 and at most 1"):
        plan_for_view(quality(MEAN, kind=kind), COSTS, target, 0)


def test_quality_of_models_outside_of_their_support():
    known = Calibration("calibrated", 0.95, 40, np.array([0.5, 1.0]), np.array([0.55, 1.0]), np.zeros(2), 0.2)
    cameras = [*orbit(2), orbit(1)[0]]
    cameras[0] = cameras[0].__class__(np.eye(4, dtype=np.float32), *list(vars(cameras[0]).values())[1:])
    far = np.eye(4, dtype=np.float32)
    far[2, 3] = 50.0
    cameras[1] = cameras[1].__class__(far, *list(vars(cameras[1]).values())[1:])
    near = {3: np.array([1.0, 1.0, np.nan]), 9: np.ones(3)}
    found = quality_at(COSTS, {3: model(3, known), 9: model(9)}, near, cameras[:2] + cameras[2:])
    assert found.kind == "fidelity"
    assert found.bound[0, 0] == pytest.approx([0.5 + 0.05 / 0.9, 0.5 + 0.25 / 0.9, 1.0])
    assert np.isnan(found.bound[1, 0]).all()  # far from all that was sampled
    assert found.mean[1, 0] == pytest.approx([0.6, 0.8, 1.0])
    assert np.isnan(found.mean[:, 1]).all()  # no model
    assert np.isnan(found.bound[:, 2]).all()  # nothing calibrated at all
    assert found.calibrated.tolist() == [True, False, False]
    plan = plan_for_view(found, COSTS, 0.6, 0)
    assert [c.status for c in plan.choices] == ["ok", "no model", "no promise"]
    assert quality_at(COSTS, {}, {}, cameras, "fidelity").kind == "fidelity"


def test_within_a_budget():
    pixels = np.array([100.0, 900.0, 10.0])
    plan = plan_within(np.array(MEAN), COSTS, 60, "bytes", pixels, "fidelity")
    assert plan.transfer_bytes is not None
    assert plan.transfer_bytes <= 60
    assert (plan.status, plan.quality, plan.asked) == ("ok", "fidelity", "budget 60 bytes")
    assert replace(plan, budget=4e6, unit="gpu-bytes").asked == "budget 4,000,000 bytes of GPU memory"
    assert plan_within(np.array(MEAN), COSTS, 3, "bytes", pixels).status == "over budget"
    with pytest.raises(RunError, match="budget nan is impossible; choose one above 0"):
        plan_within(np.array(MEAN), COSTS, math.nan, "bytes", pixels)


@given(st.integers(0, 999), st.floats(0.01, 1.1))
def test_budgets_miss_the_best_by_less_than_an_upgrade(seed, share):
    rng = np.random.default_rng(seed)
    cost = np.cumsum(rng.integers(1, 50, (4, 3)), 1)
    mean, weight = np.sort(rng.uniform(0, 1, (4, 3)), 1), rng.exponential(1, 4)
    budget = cost[:, 0].sum() + share * (cost[:, -1] - cost[:, 0]).sum()
    value, rows = weight[:, None] * mean, np.arange(4)
    found = within(cost, mean, weight, budget)
    assert cost[rows, found].sum() <= budget
    every = np.array(list(itertools.product(range(3), repeat=4)))
    fits = every[cost[rows, every].sum(1) <= budget]
    best = value[rows, fits].sum(1).max()
    assert best - (value[:, -1] - value[:, 0]).max() <= value[rows, found].sum() <= best + 1e-9


def test_means_over_pixels_are_those_of_the_whole_images():
    rng = np.random.default_rng(0)
    values, pixels = rng.uniform(0, 1, (5, 3, 4)), rng.integers(1, 9, (5, 3)).astype(float)
    mean, total = pooled(values, pixels)
    whole = (values * pixels[..., None]).sum((0, 1)) / pixels.sum()
    assert (total @ mean / total.sum()) == pytest.approx(whole)
    values[:, 1], values[2, 0] = np.nan, np.nan
    mean, total = pooled(values, pixels)
    assert np.isnan(mean[1]).all()
    assert total.tolist() == [pixels[[0, 1, 3, 4], 0].sum(), 0, pixels[:, 2].sum()]
