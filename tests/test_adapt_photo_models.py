"""Models of SSIM against photos: they recover a known field, and hold where training never looked."""

from dataclasses import replace

import numpy as np
import pytest
from viewpoint_fields import LEVELS, orbit, synthetic, table, together, viewpoints

from sagesplat.adapt.calibrate_photos import TARGETS
from sagesplat.adapt.coverage import score
from sagesplat.adapt.observe import TOTAL
from sagesplat.adapt.photo_models import (
    calibrated,
    fit_photo_models,
    fit_photos,
    in_composition,
    measured_at,
)
from sagesplat.core.errors import RunError
from sagesplat.io.typed import to_plain

GRID = np.arange(0.5, 0.86, 0.05).round(2).tolist()
SCENE = orbit(160)


@pytest.fixture(scope="module")
def model():
    return fit_photo_models(synthetic(SCENE, 1), SCENE)[5]


def test_finds_the_field_and_the_drop_of_unseen_views(model):
    observations = synthetic(SCENE, 1)
    truth = observations.ssim.reshape(-1, 4)[SCENE.test_ids]
    predicted = model.predict(*viewpoints(SCENE, SCENE.test_ids))
    error = predicted.mean - truth
    by_distance = np.stack([c(viewpoints(SCENE, SCENE.test_ids)[0]) for c in model.curves], 1) - truth
    assert np.sqrt(np.mean(error**2)) < 0.6 * np.sqrt(np.mean(by_distance**2))
    assert abs(error.mean()) < 0.008 < 0.01 < by_distance.mean()  # the drop is 0.02
    assert 0.6 < np.sqrt(np.mean(error**2)) / model.rmse < 1.5
    assert (model.status, model.quality, model.levels) == ("calibrated", "ssim", LEVELS)
    assert model.num_views == len(SCENE.train_ids) + len(SCENE.calibration_ids)
    assert model.calibration.num_views == len(SCENE.calibration_ids)


def test_bounds_hold_on_unseen_views_over_many_draws():
    """At every target, and no wider than needed: a bound that accepts nothing would hold too."""
    accepted, kept, excess, perfect, wrong = (np.zeros(len(GRID)) for _ in range(5))
    for seed in range(4):
        scene = orbit(144, seed)
        observations = together(*(synthetic(scene, 100 * seed + i, label_id=i) for i in range(2)))
        promises = fit_photo_models(observations, scene)
        costs = {(label, level): 1000 * 2**level for label in promises for level in LEVELS}
        scores = score(observations, scene, promises, costs, GRID)
        for i, target in enumerate(GRID):
            rows = scores.select((scores.target == target) & (scores.predictor == "bound"))
            both = rows.chosen & rows.reachable
            accepted[i] += rows.accepted.sum()
            kept[i] += rows.kept.sum()
            excess[i] += rows.excess[both].sum()
            perfect[i] += rows.perfect_excess[both].sum()
            wrong[i] += (rows.reachable & ~rows.accepted).sum()
    some = accepted > 100
    assert some.sum() >= 6
    assert (kept[some] / accepted[some] > 0.94).all()
    assert ((excess - perfect)[some] / accepted[some]).max() < 0.03
    assert wrong[some].sum() < 0.05 * accepted[some].sum()


def test_labels_with_hardly_any_data():
    rng = np.random.default_rng(0)
    train, calibration = SCENE.train_ids, SCENE.calibration_ids
    all_views = np.arange(len(SCENE.views))
    distance = viewpoints(SCENE, all_views)[0]

    def rows(label_id, views, ssim, d=distance):
        return table(label_id, np.asarray(ssim)[: len(views)], d[views], views)

    noisy = 0.5 + 0.1 * np.arange(3) + 0.02 * rng.standard_normal((200, 3))
    parts = {
        1: rows(1, train[:1], noisy),  # one view
        2: rows(2, train, noisy),  # no calibration view
        3: rows(3, all_views, noisy[:, :1]),  # one level
        4: rows(4, all_views, noisy, np.full(len(all_views), np.nan)),
        5: rows(5, all_views, np.full((200, 3), 0.7)),
        6: rows(6, calibration[:2], noisy),  # no training view
        -1: rows(-1, np.append(train[:3], calibration[:2]), noisy),
        TOTAL: rows(TOTAL, all_views, noisy),
        8: rows(8, SCENE.test_ids, noisy),  # never seen
    }
    holes = parts[4].select(np.arange(len(parts[4])) % 7 > 0)  # views that miss a level
    models = fit_photo_models(together(*(p for k, p in parts.items() if k != 4), holes), SCENE)
    assert set(models) == {-1, 1, 2, 3, 4, 5, 6}
    calibrated_ones = {label for label, model in models.items() if model.status == "calibrated"}
    assert calibrated_ones == {3, 5} | ({4} if models[4].calibration.num_views >= 19 else set())
    assert models[1].num_views == 1
    assert models[3].levels == (1,)
    d, position, direction = viewpoints(SCENE, SCENE.test_ids)
    for label, model in models.items():
        for distances in (d, np.full(len(d), np.nan), np.zeros(len(d))):
            predicted = model.predict(distances, position, direction)
            assert np.isfinite(predicted.mean).all(), label
            near = predicted.support >= model.calibration.least_support
            assert np.isfinite(predicted.bound[near]).all() or not len(model.calibration.targets), label
        assert model.predict(d[:0], position[:0], direction[:0]).bound.shape == (0, len(model.levels))
        assert np.isfinite([*model.calibration.slopes, *model.calibration.thresholds]).all()
    exact = models[5].predict(d, position, direction)
    assert np.nanmax(exact.bound) <= 0.7 + 1e-6
    costs = {(label, level): level for label, model in models.items() for level in model.levels}
    observations = together(*parts.values())
    result = score(observations, SCENE, models, costs, [0.6])
    assert set(result.label_id.tolist()) == set(models) - {1, 2, 6, -1}  # in no test view
    planned = {key: cost for key, cost in costs.items() if key[0] != 5}  # no Gaussians of 5: in no plan
    assert 5 not in score(observations, SCENE, models, planned, [0.6]).label_id


@pytest.mark.parametrize("count", [0, 1, 2, 6])
def test_scenes_of_a_few_views(count):
    scene = orbit(80, calibrate_every=0)
    few = synthetic(scene, 1)
    models = fit_photo_models(few.select(np.isin(few.view, scene.train_ids[:count])), scene)
    assert len(models) == (count > 0)
    for model in models.values():
        assert model.status == "uncalibrated"
        assert bool(len(model.calibration.targets)) == (count > 1)  # of one view nothing can be said
        where = viewpoints(scene, scene.train_ids[:1])
        assert np.isfinite(model.predict(*where).mean).all()


def test_test_views_change_nothing(model):
    observations = synthetic(SCENE, 1)
    spoiled = np.where(np.isin(observations.view, SCENE.test_ids), np.float32(0.1), observations.ssim)
    again = fit_photo_models(replace(observations, ssim=spoiled), SCENE)[5]
    assert to_plain(again) == to_plain(model)


def test_what_is_lost_in_composition_raises_the_thresholds():
    fits = fit_photos(synthetic(SCENE, 1), SCENE)
    alone = calibrated(fits, 0.95)[5].calibration
    loss = np.full(len(TARGETS), -0.03)
    loss[:5] = np.nan  # not measured at low targets
    changes = {5: dict.fromkeys(SCENE.calibration_ids.tolist(), loss), 9: {0: loss}}
    fits = in_composition(fits, changes)
    np.testing.assert_allclose(
        fits[5].left_out.change, -0.03
    )  # of views and targets that were not measured too
    beside = calibrated(fits, 0.95)[5].calibration
    both = np.intersect1d(alone.targets, beside.targets)
    assert len(both) >= 5
    rise = beside.thresholds[np.isin(beside.targets, both)] - alone.thresholds[np.isin(alone.targets, both)]
    assert np.mean(rise) == pytest.approx(0.03, abs=0.015)
    assert in_composition(fits, {})[5] == fits[5]


def test_measured_at_takes_views_with_all_levels():
    observations = synthetic(SCENE, 1)
    holes = observations.select(~((observations.view == 3) & (observations.level == 2)))
    found = measured_at(holes, SCENE, 5, LEVELS, np.array([1, 3, 5]))
    assert found.rows.tolist() == [1, 5]
    np.testing.assert_array_equal(found.ssim, observations.ssim.reshape(-1, 4)[[1, 5]])
    assert len(measured_at(holes, SCENE, 6, LEVELS, np.array([1])).rows) == 0


@pytest.mark.parametrize("confidence", [0.0, 1.0, -1, 95, float("nan")])
def test_impossible_confidence(confidence):
    with pytest.raises(RunError, match="confidence"):
        fit_photo_models(synthetic(SCENE, 1), SCENE, confidence)


def test_values_that_are_no_numbers_are_left_out(model):
    observations = synthetic(SCENE, 1)
    spoiled = observations.ssim.copy()
    spoiled[np.isin(observations.view, SCENE.train_ids[:3])] = np.nan
    again = fit_photo_models(replace(observations, ssim=spoiled), SCENE)[5]
    assert again.num_views == model.num_views - 3
