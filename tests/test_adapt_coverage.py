"""Coverage: decisions counted by hand, intervals, and predictors that are all treated alike."""

import numpy as np
import pytest
from viewpoint_fields import LEVELS, orbit, synthetic, viewpoints

from sagesplat.adapt.coverage import PREDICTORS, Decisions, decide, score
from sagesplat.adapt.photo_models import fit_photo_models
from sagesplat.core.errors import RunError

SCENE = orbit(160)
COSTS = {(5, level): 10 * level for level in LEVELS}


@pytest.fixture(scope="module")
def model():
    return fit_photo_models(synthetic(SCENE, 1), SCENE)[5]


def test_decisions_by_hand():
    measured = np.array([[0.5, 0.72, 0.9], [0.71, 0.8, 0.95], [0.3, 0.4, 0.5], [0.2, 0.69, 0.9]])
    says = np.array([[0.4, 0.6, 0.8], [0.72, 0.8, 0.9], [0.3, 0.4, 0.6], [0.5, 0.75, 0.9]])
    cost = np.array([10, 20, 40])
    found = decide({"bound": says}, measured, cost, [0.7], np.array([4, 5, 6, 7]), 3)
    assert found.accepted.tolist() == [True, True, False, True]
    assert found.kept.tolist() == [True, True, False, False]
    assert found.reachable.tolist() == [True, True, False, True]
    assert found.chosen.tolist() == [True, False, False, True]
    np.testing.assert_allclose(found.excess[[0, 1, 3]], [0.2, 0.01, -0.01])
    np.testing.assert_allclose(found.perfect_excess, [0.02, 0.01, np.nan, 0.2])
    np.testing.assert_allclose(found.regret[[0, 1]], [20, 0])
    totals = found.totals()
    assert (totals["decisions"], totals["accepted"], totals["violated"]) == (4, 3, 1)
    assert totals["coverage"] == pytest.approx(2 / 3)
    assert totals["overshoot"] == pytest.approx(0.2 / 3)
    assert totals["excess"] == pytest.approx(0.19 / 2)  # with more than the cheapest level
    assert totals["perfect_excess"] == pytest.approx(0.22 / 2)
    assert totals["regret"] == pytest.approx(10)
    assert totals["false_rejections"] == 0
    nothing = decide({"bound": np.full((4, 3), np.nan)}, measured, cost, [0.7], np.arange(4), 3).totals()
    assert (nothing["accepted"], nothing["false_rejections"]) == (0, 3)
    assert np.isnan([nothing["coverage"], nothing["low"], nothing["excess"]]).all()


def test_the_interval_draws_views_not_decisions():
    """Ten categories that agree in each view are one witness, not ten."""
    rng = np.random.default_rng(0)
    good = rng.random(40) < 0.9
    measured = np.where(good, 0.8, 0.6)[:, None]
    says, cost = np.full((40, 1), 0.75), np.ones(1, np.int64)
    parts = [decide({"bound": says}, measured, cost, [0.7], np.arange(40), label) for label in range(10)]
    one, ten = parts[0].interval(), Decisions.joined(parts).interval()
    assert one == ten
    assert one[0] < good.mean() < one[1]
    standard_error = np.sqrt(good.mean() * (1 - good.mean()) / 40)
    assert one[1] - one[0] == pytest.approx(4 * standard_error, rel=0.3)


def test_every_predictor_gets_the_same_treatment(model):
    """Less its own margin each holds; what knows the viewpoint pays least for it."""
    result = score(synthetic(SCENE, 1), SCENE, {5: model}, COSTS, [0.6, 0.65, 0.7, 0.75])
    assert list(dict.fromkeys(result.predictor.tolist())) == list(PREDICTORS)
    totals = {name: result.by(name).totals() for name in PREDICTORS}
    for name in ("constant", "eq3", "mean"):
        bound = totals["bound" if name == "mean" else f"{name} bound"]
        assert totals[name]["coverage"] < 0.92
        assert bound["coverage"] >= 0.95
        assert bound["overshoot"] > totals[name]["overshoot"]
    assert totals["bound"]["overshoot"] < min(totals[f"{n} bound"]["overshoot"] for n in ("constant", "eq3"))
    assert totals["bound"]["regret"] < min(totals[f"{n} bound"]["regret"] for n in ("constant", "eq3"))


def test_nothing_to_score(model):
    assert len(score(synthetic(SCENE, 1), SCENE, {}, COSTS, [0.7]).view) == 0
    assert len(score(synthetic(SCENE, 1), SCENE, {5: model}, {}, [0.7]).view) == 0
    empty = score(synthetic(SCENE, 1), SCENE, {5: model}, COSTS, [0.7], np.zeros(0, np.int64))
    assert empty.totals()["accepted"] == 0
    with pytest.raises(RunError, match="target"):
        score(synthetic(SCENE, 1), SCENE, {5: model}, COSTS, [1.5])


def test_score_by_hand(model):
    observations = synthetic(SCENE, 1)
    result = score(observations, SCENE, {5: model}, COSTS, [0.7], SCENE.calibration_ids)
    totals = result.by("bound").totals()
    measured = observations.ssim.reshape(-1, 4)[SCENE.calibration_ids].astype(np.float64)
    bound = model.predict(*viewpoints(SCENE, SCENE.calibration_ids)).bound
    accepted = (bound >= 0.7).any(1)
    level = (bound >= 0.7).argmax(1)
    got = measured[np.arange(len(level)), level]
    kept = accepted & (got >= 0.7)
    assert totals["decisions"] == len(level)
    assert totals["accepted"] == accepted.sum()
    assert totals["violated"] == (accepted & ~kept).sum()
    assert totals["overshoot"] == pytest.approx(np.mean(got[accepted] - 0.7))
    assert totals["false_rejections"] == (~accepted & (measured >= 0.7).any(1)).sum()
    oracle = (measured >= 0.7).argmax(1)
    assert totals["regret"] == pytest.approx(10 * np.mean((level - oracle)[kept]))
    best = result.by("perfect").totals()
    assert (best["coverage"], best["regret"], best["false_rejections"], best["violated"]) == (1, 0, 0, 0)
    assert best["excess"] == best["perfect_excess"]
