"""Thresholds from views left out: the risk is that of what is accepted, and nothing insufficient is given."""

from dataclasses import replace

import numpy as np
import pytest

from sagesplat.adapt.calibrate_photos import (
    MULTIPLIERS,
    TARGETS,
    LeftOut,
    _decisions,
    _envelope,
    _inflation,
    _multipliers,
    _risks,
    _Scored,
    _slope,
    calibrate_photos,
    with_changes,
)

STEPS = np.array([0.45, 0.6, 0.75, 0.9])  # SSIM of levels


def left_out(
    n: int, heldout: int, seed: int = 0, std: float = 0.03, heldout_std: float | None = None
) -> LeftOut:
    """Views around STEPS, whose errors are the same at all levels; the last ones held out."""
    rng = np.random.default_rng(seed)
    u = np.arange(n) >= n - heldout
    scale = np.where(u, std if heldout_std is None else heldout_std, std)
    mean = STEPS + 0.05 * rng.standard_normal((n, 1))
    ssim = mean + (scale * rng.standard_normal(n))[:, None]
    return LeftOut.alone(np.arange(n), u, mean, ssim, np.full(n, 0.9))


def test_each_multiplier_keeps_the_risk_and_a_smaller_one_does_not():
    own = left_out(120, 30)
    views = {3: own}
    found = calibrate_photos(views, 0.95)[3]
    assert found.status == "calibrated"
    assert (np.diff(found.targets) > 0).all()
    assert (np.diff(found.thresholds) > 0).all()
    inflation = _inflation(views)[3]
    error = np.where(own.heldout, 1, inflation)[:, None] * (own.ssim - own.mean)
    score = own.mean - found.slopes[0] * (1 - own.support)[:, None]
    for target, threshold in zip(found.targets, found.thresholds, strict=True):
        ok = score >= threshold
        accepted, level = ok.any(1), ok.argmax(1)
        missed = accepted & ((own.mean + error)[np.arange(120), level] < target)
        assert (missed.sum() + 1) / (accepted.sum() + 1) <= 0.05 + 1e-9
    # without any margin the risk would be far larger: the thresholds do something
    ok = own.mean >= 0.6
    assert np.mean((own.mean + error)[np.arange(120), ok.argmax(1)] < 0.6) > 0.1


def test_calibration_views_hold_by_themselves():
    """Two hundred training views that are predicted exactly do not hide that new photos are not."""
    own = left_out(220, 20, std=1e-4)
    low = own.ssim - np.where(own.heldout & (np.arange(220) % 4 > 0), 0.1, 0.0)[:, None]
    found = calibrate_photos({3: replace(own, ssim=low)}, 0.95)[3]
    bound = found.bound(own.mean, own.support)
    for target in found.targets:
        ok = bound[own.heldout] >= target
        got = low[own.heldout][np.arange(20), ok.argmax(1)]
        assert (ok.any(1) & (got < target)).sum() <= 0.05 * ok.any(1).sum()


@pytest.mark.parametrize(("n", "heldout", "status"), [(120, 19, "calibrated"), (120, 18, "uncalibrated")])
def test_nineteen_views_calibrate_and_fewer_widen(n, heldout, status):
    """Views that training saw do not count; below 19 one failure more is counted in."""
    found = calibrate_photos({3: left_out(n, heldout, heldout_std=0.01)}, 0.95)[3]
    assert (found.status, found.num_views) == (status, heldout)
    full = calibrate_photos({3: left_out(n, 19, heldout_std=0.01)}, 0.95)[3]
    at = np.interp(0.6, found.targets, found.thresholds) - np.interp(0.6, full.targets, full.thresholds)
    assert (at > 0) == (heldout < 19)


def test_targets_that_few_views_accept_are_not_returned():
    """All but ten views lie far below: at 0.95 ten can prove nothing, however well they are predicted."""
    own = left_out(120, 30, std=0.001)
    down = np.where(np.arange(120) < 110, 0.4, 0.0)[:, None]
    found = calibrate_photos({3: replace(own, mean=own.mean - down, ssim=own.ssim - down)}, 0.95)[3]
    assert found.targets[-1] < 0.6


def test_inflation_follows_the_errors_of_new_photos():
    alike, worse = left_out(200, 40), left_out(200, 40, heldout_std=0.09)
    assert 1.0 <= _inflation({1: alike})[1] < 1.6
    assert 2.5 < _inflation({1: worse})[1] < 4.5
    # a category that few new photos show borrows from the others
    few = left_out(200, 1, seed=3)
    assert _inflation({1: worse, 2: few})[2] > 1.5 * _inflation({2: few})[2]
    assert _inflation({1: left_out(50, 0)})[1] > 1.5
    assert _inflation({1: left_out(5, 5)})[1] >= 1  # no training view


def test_the_discount_follows_errors_that_grow_away_from_known_views():
    own = left_out(200, 40)
    away = np.linspace(0, 0.5, 200)
    rng = np.random.default_rng(0)
    error = (0.01 + 0.2 * away * np.abs(rng.standard_normal(200)))[:, None]
    far = replace(own, support=1 - away, ssim=own.mean - error, heldout=np.arange(200) % 5 == 0)
    assert _slope({1: far}) > 0.6
    flat = replace(far, ssim=own.mean + 0.02 * np.sign(rng.standard_normal((200, 1))))
    assert _slope({1: flat}) < 0.2
    one, other = calibrate_photos({1: far}, 0.95)[1], calibrate_photos({1: flat}, 0.95)[1]
    assert one.slopes.min() > 0.1 > other.slopes.max()
    assert one.least_support == pytest.approx(0.5)


def test_changes_of_views_that_were_not_measured_are_those_of_the_nearest():
    own = left_out(4, 2)
    near = np.eye(4)
    near[0, 2] = near[1, 3] = 0.9
    near[0, 3] = near[1, 2] = 0.1
    partly = np.full(len(TARGETS), np.nan)
    partly[[4, 6]] = -0.02, -0.04
    found = with_changes(own, {2: partly, 3: np.full(len(TARGETS), 0.01)}, near)
    np.testing.assert_allclose(found.change[0], found.change[2])
    np.testing.assert_allclose(found.change[0][[0, 4, 5, 6, -1]], [-0.02, -0.02, -0.03, -0.04, -0.04])
    np.testing.assert_allclose(found.change[[1, 3]], 0.01)
    np.testing.assert_allclose(found.bias[[4, 6]], [-0.01 / 10, -0.03 / 10])  # of two views
    assert with_changes(own, {}, near) is own
    assert with_changes(own, {2: np.full(len(TARGETS), np.nan)}, near) is own


@pytest.mark.parametrize("confidence", [1e-12, 0.01, 0.5, 0.999999, 1 - 1e-15])
def test_any_confidence_gives_a_calibration_that_can_be_stored(confidence):
    for found in calibrate_photos({1: left_out(60, 25), 2: left_out(3, 1, std=0.0)}, confidence).values():
        numbers = [*found.targets, *found.thresholds, *found.slopes, found.least_support]
        assert np.isfinite(numbers).all()
        assert (np.diff(found.thresholds) > 0).all()
        assert (np.abs(found.thresholds) <= 1).all()


def test_coverage_of_new_views_over_many_draws():
    """Calibrated on some views of a kind, tested on others: at each target what is accepted is kept."""
    accepted, kept = np.zeros(len(TARGETS)), np.zeros(len(TARGETS))
    for seed in range(40):
        views = {label: left_out(60, 25, 10 * seed + label, heldout_std=0.05) for label in range(3)}
        for label, found in calibrate_photos(views, 0.95).items():
            new = left_out(40, 40, 5000 + 10 * seed + label, heldout_std=0.05)
            bound = found.bound(new.mean, new.support)
            for g, target in enumerate(TARGETS):
                ok = bound >= target
                got = new.ssim[np.arange(40), ok.argmax(1)]
                accepted[g] += ok.any(1).sum()
                kept[g] += (ok.any(1) & (got >= target)).sum()
    some = accepted > 500
    assert some.sum() >= 8
    assert (kept[some] / accepted[some]).min() > 0.94
    assert (kept[some] / accepted[some]).mean() < 0.995  # and not by accepting nothing


def test_decisions_and_risks_by_hand():
    g = int(np.argmin(np.abs(TARGETS - 0.6)))
    change, bias = np.zeros((2, len(TARGETS))), np.zeros(len(TARGETS))
    change[1, g], bias[g] = 0.2, 0.03
    score, measured = np.array([[0.5, 0.7], [0.4, 0.6]]), np.array([[0.65, 0.7], [0.3, 0.55]])
    own = _Scored(score, measured, change, bias, 0.1, 0.0)
    accepted, missed = _decisions(own, g)
    for column, multiplier in enumerate(MULTIPLIERS):
        threshold = 0.6 + multiplier * 0.1 - 0.03
        for view in range(2):
            level = next((k for k in range(2) if own.score[view, k] >= threshold), None)
            got = np.nan if level is None else own.measured[view, level] + [0.0, 0.2][view]
            assert accepted[view, column] == (level is not None)
            assert missed[view, column] == (level is not None and got < 0.6)
    risk = _risks(np.array([[4.0], [1.0], [0.0]]), np.array([[1.0], [1.0], [0.0]]), 1)
    by_view, by_decision = (0.25 + 1 + 1) / (2 + 1), (2 + 2.5) / (5 + 2.5)
    np.testing.assert_allclose(risk, [max(by_view, by_decision)])


def test_a_target_that_no_threshold_keeps_is_left_out():
    """Half of all views measure far less than predicted: no margin helps at the top."""
    own = left_out(120, 30)
    low = own.ssim - 0.5 * (np.arange(120) % 2)[:, None]
    found = calibrate_photos({3: replace(own, ssim=low)}, 0.95)[3]
    assert not len(found.targets) or found.targets[-1] < 0.4
    good = calibrate_photos({3: own}, 0.95)[3]
    assert 0.7 <= good.targets[-1] < 0.95  # the mean of the highest level is 0.9
    assert good.thresholds[-1] <= own.mean.max()


def test_a_multiplier_is_at_least_that_of_the_targets_beside_it():
    views = {3: left_out(120, 30)}
    none = views[3].change
    scored = {3: _Scored(views[3].mean, views[3].ssim, none, none[0], 0.03, 0.0)}
    found = _multipliers(views, scored, 0.95)
    finite = np.flatnonzero(np.isfinite(found))
    assert len(finite) >= 5
    # what a target alone needs, by a grid of multipliers
    for g in finite[1:-1]:
        for beside in (g - 1, g, g + 1):
            accepted, missed = _decisions(scored[3], int(beside))
            at = np.argmin(np.abs(MULTIPLIERS - found[g]))
            assert missed[:, at].sum() + 1 <= 0.05 * (accepted[:, at].sum() + 1) + 1e-9


def test_a_higher_targets_threshold_keeps_a_lower_target_too():
    none = np.zeros((1, len(TARGETS)))
    own = _Scored(np.full((1, 1), 0.95), np.full((1, 1), 0.95), none, none[0], 0.1, 0.0)
    multipliers = np.where(TARGETS < 0.5, 4.0, 0.5)
    multipliers[-3:] = np.inf
    targets, thresholds = _envelope(multipliers, own)
    assert targets[-1] == TARGETS[-4]
    assert (thresholds[:4] <= 0.5 + 0.05 + 1e-6).all()
    assert (np.diff(thresholds) > 0).all()
