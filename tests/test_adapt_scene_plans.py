"""Plans for all viewpoints of a scene: the share that holds, few views, photos of training."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sagesplat.adapt.bound_plans import Costs, pooled
from sagesplat.adapt.scene_plans import never_dearer, plan_for_scene, raise_failing_levels, reached
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.core.errors import RunError

quick = settings(max_examples=80)


def costs(labels: int, levels: int) -> Costs:
    nbytes = np.cumsum(np.arange(1, labels * levels + 1).reshape(labels, levels), 1)
    return Costs(tuple(range(labels)), nbytes, nbytes, nbytes)


def draws(views: int, labels: int, levels: int, seed: int) -> np.ndarray:
    """Fidelity [V, L, K] that rises to 1, with a scale for each view and some noise from level to level."""
    rng = np.random.default_rng(seed)
    rise = np.linspace(0.2, 1, levels) ** rng.uniform(0.5, 1.5, (views, labels, 1))
    values = np.clip(rise + rng.normal(0, 0.02, rise.shape), 0, 1)
    values[..., -1] = 1
    return values


@quick
@given(st.integers(0, 60), st.floats(0.05, 1), st.sampled_from([0.5, 0.9, 0.95, 1.0]), st.integers(0, 9))
def test_the_cheapest_level_that_the_share_of_views_needs(views, target, share, seed):
    measured = draws(views, 2, 5, seed)
    plan = plan_for_scene(measured, np.zeros((views, 2)), costs(2, 5), target, share, "fidelity")
    for i, choice in enumerate(plan.choices):
        if not views:
            assert (choice.level, choice.status, choice.reached) == (5, "no model", None)
            continue
        critical = [max([k + 1 for k in range(5) if row[k] < target], default=0) for row in measured[:, i]]
        rank = math.ceil((views + 1) * share - 1e-9)
        level = sorted(critical)[rank - 1] if rank <= views else 4
        assert (choice.level - 1, choice.status, choice.calibrated) == (level, "ok", True)
        holds = np.mean([c <= level for c in critical])
        assert choice.reached is not None
        assert choice.reached.share == pytest.approx(holds)
        assert choice.reached.low <= holds <= choice.reached.high
        assert choice.predicted >= target
    assert (plan.quality, plan.view, plan.share, plan.status) == ("fidelity", None, share, "ok")


def test_a_lower_target_costs_no_more_than_a_higher_one():
    """Raising levels may go further for a lower target than planning by cell does for a higher one."""
    targets: list[tuple[float, QualityKind]] = [(0.25, "fidelity"), (0.35, "fidelity"), (0.9, "ssim")]
    low, high, ssim = (
        plan_for_scene(draws(60, 2, 5, 0), np.zeros((60, 2)), costs(2, 5), target, 0.95, kind)
        for target, kind in targets
    )
    assert never_dearer([low, high, ssim]) == [low, high, ssim]
    full = plan_for_scene(draws(60, 2, 5, 0), np.zeros((60, 2)), costs(2, 5), 1.0, 0.95, "fidelity")
    raised = replace(low, choices=full.choices)
    found = never_dearer([raised, high, ssim])
    assert found == [replace(low, choices=high.choices), high, ssim]
    unproven = replace(high, choices=tuple(replace(one, calibrated=False) for one in high.choices))
    assert never_dearer([raised, unproven])[0] == raised


def test_it_holds_in_the_asked_share_of_new_views():
    """Split conformal prediction: over many draws, new views keep the target at the share or more."""
    kept = []
    for seed in range(150):
        plan = plan_for_scene(draws(60, 1, 8, seed), np.zeros((60, 1)), costs(1, 8), 0.7, 0.9, "fidelity")
        new = draws(200, 1, 8, 10_000 + seed)[:, 0, plan.choices[0].level - 1 :].min(1)
        kept.append((new >= 0.7).mean())
    assert np.mean(kept) >= 0.9 - 2 * np.std(kept) / math.sqrt(len(kept))


def test_interval_is_clopper_and_pearson():
    found = reached(np.arange(20) > 0)
    assert found is not None
    assert (found.share, found.num_views) == (0.95, 20)
    assert (found.low, found.high) == pytest.approx((0.7513, 0.9987), abs=1e-4)
    assert reached(np.zeros(0, bool)) is None


def test_the_scene_is_filled():
    """A small category that is hard must not make the whole image worse than equal levels."""
    measured = np.tile(np.array([[0.3, 0.4, 1.0], [0.7, 0.95, 1.0]]), (40, 1, 1))
    pixels, nbytes = np.tile([100.0, 900.0], (40, 1)), np.array([[10, 20, 60], [10, 30, 90]])
    of = Costs((0, 1), nbytes, nbytes, nbytes)
    assert plan_for_scene(measured, pixels * 0, of, 0.6, 0.95, "fidelity").levels == {0: 3, 1: 1}
    assert plan_for_scene(measured, pixels, of, 0.6, 0.95, "fidelity").levels == {0: 3, 1: 2}
    assert plan_for_scene(measured, pixels, of, 0.6, 0.95, "ssim").levels == {0: 3, 1: 1}


def test_a_level_goes_up_where_its_composition_misses():
    """Neighbours at lower levels cost fidelity: with equal levels the first category seemed fine."""
    measured = np.tile(np.array([[0.6, 0.9, 0.95, 1.0], [0.9, 0.95, 0.97, 1.0]]), (40, 1, 1))
    nbytes = np.array([[10, 20, 30, 60], [10, 20, 30, 90]])
    of, pixels = Costs((0, 1), nbytes, nbytes, nbytes), np.tile([100.0, 0.0], (40, 1))
    weights = pooled(measured, pixels)
    plan = plan_for_scene(measured, pixels, of, 0.88, 0.95, "fidelity")
    assert plan.levels == {0: 2, 1: 1}
    composed = np.tile([0.85, 0.9], (39, 1))
    up, holds = raise_failing_levels(plan, composed, of, *weights, last=False)
    assert (up.levels, holds) == ({0: 3, 1: 1}, False)
    assert (up.count, up.transfer_bytes) == (40, 40)
    left, holds = raise_failing_levels(plan, composed, of, *weights, last=True)
    assert (left.levels, holds, left.verdict) == (plan.levels, True, "ok, uncalibrated")
    assert left.choices[0].reached is not None
    assert (left.choices[0].predicted, left.choices[0].reached.share) == (0.85, 0)
    one_in_39 = np.where(np.arange(39)[:, None] == 5, [0.85, 0.9], [0.89, 0.9])
    fine, holds = raise_failing_levels(up, one_in_39, of, *weights, last=False)
    assert (fine.levels, holds, fine.verdict) == (up.levels, True, "ok")
    assert fine.choices[0].reached is not None
    assert (fine.choices[0].predicted, fine.choices[0].reached.num_views) == (0.89, 39)
    two_in_39 = np.where(np.isin(np.arange(39), [5, 9])[:, None], [0.85, 0.9], [0.89, 0.9])
    assert raise_failing_levels(up, two_in_39, of, *weights, last=False)[1] is False  # 94.9 %
    few = raise_failing_levels(plan, composed[:18], of, *weights, last=False)  # 18 views say too little
    assert few == (plan, True)


def test_what_misses_at_its_highest_level_lifts_its_neighbours():
    measured = np.tile(np.array([[0.6, 1.0], [0.9, 1.0], [np.nan, np.nan]]), (40, 1, 1))
    plan = plan_for_scene(measured, np.zeros((40, 3)), costs(3, 2), 0.8, 0.95, "fidelity")
    assert plan.levels == {0: 2, 1: 1, 2: 2}
    composed = np.tile([0.7, 0.9, np.nan], (40, 1))
    weights = pooled(measured, np.zeros((40, 3)))
    up, holds = raise_failing_levels(plan, composed, costs(3, 2), *weights, last=False)
    assert (up.levels, holds) == ({0: 2, 1: 2, 2: 2}, False)


def test_few_views_take_the_full_model_or_prove_nothing():
    measured, of = np.full((18, 1, 3), 0.9), costs(1, 3)
    measured[..., -1] = 1
    full = plan_for_scene(measured, np.ones((18, 1)), of, 0.8, 0.95, "fidelity")
    assert (full.levels, full.status, full.calibrated, full.choices[0].predicted) == ({0: 3}, "ok", True, 1.0)
    found = plan_for_scene(measured, np.ones((18, 1)), of, 0.8, 0.95, "ssim")
    assert (found.levels, found.verdict) == ({0: 1}, "ok, uncalibrated")
    more = np.concatenate([measured, measured[:1]])
    found = plan_for_scene(more, np.ones((19, 1)), of, 0.8, 0.95, "ssim")
    assert (found.levels, found.verdict) == ({0: 1}, "ok")


def test_photos_of_training_count_less():
    """Training fits its own photos: held-out ones alone where they are enough, else both, corrected."""
    trained = np.arange(100) < 70
    measured = np.where(trained[:, None, None], 0.9, 0.8) * np.ones((100, 1, 1))
    of, pixels = costs(1, 1), np.ones((100, 1))
    (choice,) = plan_for_scene(measured, pixels, of, 0.75, 0.95, "ssim", trained).choices
    assert (choice.predicted, choice.calibrated) == (pytest.approx(0.8), True)
    assert choice.reached is not None
    assert choice.reached.num_views == 30
    few = np.r_[:70, 95:100]
    (choice,) = plan_for_scene(measured[few], pixels[few], of, 0.75, 0.95, "ssim", trained[few]).choices
    assert (choice.predicted, choice.calibrated) == (pytest.approx(0.8), False)
    assert choice.reached is not None
    assert choice.reached.num_views == 75
    (choice,) = plan_for_scene(measured, pixels, of, 0.85, 0.95, "ssim", trained).choices
    assert (choice.status, choice.level) == ("infeasible", 1)


def test_out_of_reach_takes_the_level_that_serves_most_views():
    measured = np.array([[0.5, 0.9, 0.6], [0.5, 0.9, 0.9], [0.5, 0.6, 0.65]])[:, None].repeat(10, 0)
    plan = plan_for_scene(measured, np.ones((30, 1)), costs(1, 3), 0.8, 0.95, "ssim")
    assert (plan.levels, plan.status) == ({0: 2}, "infeasible")


def test_a_category_in_no_view_is_shipped_whole():
    measured = draws(30, 2, 3, 0)
    measured[:, 1] = np.nan
    plan = plan_for_scene(measured, np.ones((30, 2)), costs(2, 3), 0.5, 0.95, "fidelity")
    assert (plan.choices[1].level, plan.choices[1].status, plan.status) == (3, "no model", "ok")


@pytest.mark.parametrize("wrong", [0.0, 1.5, math.nan, -0.1])
def test_impossible_targets_and_shares(wrong):
    of = draws(3, 1, 2, 0), np.ones((3, 1)), costs(1, 2)
    with pytest.raises(RunError, match=r"target fidelity .* is impossible; choose"):
        plan_for_scene(*of, wrong, 0.95, "fidelity")
    with pytest.raises(RunError, match=r"share of views .* is impossible; choose"):
        plan_for_scene(*of, 0.5, wrong, "fidelity")
