"""Calibrated promises: the process recovers what it is given, and its bounds hold where no photo was."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sagesplat.adapt.coverage import PREDICTORS, Decisions, score
from sagesplat.adapt.observe import TOTAL, Observations
from sagesplat.adapt.viewpoint import (
    EASY,
    GROUPS,
    PRIOR,
    STATUSES,
    _inputs,
    _inverse,
    _terms,
    _to_json,
    decisions,
    fit_promises,
    matern32,
    promise,
    read_promises,
    write_promises,
)
from sagesplat.core.errors import DataError, RunError
from sagesplat.scene.scene import Camera, Points, Scene, View

TARGETS = np.arange(0.5, 0.96, 0.05).tolist()
LEVELS = (1, 2, 3, 4)


def looking_at(position: np.ndarray) -> Camera:
    """A camera that looks at the origin."""
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.3, 0.2, 1.0])
    right /= np.linalg.norm(right)
    w2c = np.eye(4)
    w2c[:3, :3] = right, np.cross(forward, right), forward
    w2c[:3, 3] = -w2c[:3, :3] @ position
    return Camera(w2c.astype(np.float32), np.eye(3, dtype=np.float32), 64, 64)


def orbit(num_views: int, seed: int = 0, calibrate_every: int = 4) -> Scene:
    """Views in random order around the origin, over half of a sphere."""
    rng = np.random.default_rng(seed)
    angle, height = rng.uniform(0, 2 * np.pi, num_views), rng.uniform(0.1, 0.9, num_views)
    around = np.sqrt(1 - height**2)
    radius = rng.uniform(2, 4, num_views)[:, None]
    position = radius * np.stack([around * np.cos(angle), around * np.sin(angle), height], 1)
    views = tuple(View(f"{i:03}", looking_at(p), Path()) for i, p in enumerate(position))
    none = np.empty(0, np.int64)
    uv = np.empty((0, 2), np.float32)
    xyz = np.empty((0, 3), np.float32)
    points = Points(xyz, xyz.astype(np.uint8), none, none.astype(np.int32), uv)
    return Scene("orbit", Path(), views, points, test_every=4, calibrate_every=calibrate_every)


def table(label_id: int, ssim: np.ndarray, distance: np.ndarray, views: np.ndarray) -> Observations:
    """Rows of one category from SSIM [V, K]."""
    V, K = ssim.shape
    n = np.full(V * K, 100, np.int32)
    real = ssim.ravel().astype(np.float32)
    return Observations(
        label_id=np.full(V * K, label_id, np.int32),
        level=np.tile(np.arange(1, K + 1, dtype=np.int32), V),
        view=np.repeat(views, K).astype(np.int32),
        distance=np.repeat(distance, K).astype(np.float32),
        ssim=real,
        ssim_eroded=real,
        psnr=real,
        num_pixels=n,
    )


def together(*parts: Observations) -> Observations:
    return Observations(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in vars(parts[0])})


def viewpoints(scene: Scene, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance, position and direction of some views."""
    cameras = [scene.views[row].camera for row in rows]
    position = np.stack([c.position for c in cameras]).astype(np.float64)
    return np.linalg.norm(position, axis=1), position, np.stack([c.direction for c in cameras])


def synthetic(
    scene: Scene, seed: int, label_id: int = 5, drop: float = 0.02, noise: float = 0.01
) -> Observations:
    """A smooth field over the viewpoint, noise, and `drop` for views that training has not seen."""
    rng = np.random.default_rng(seed)
    rows = np.arange(len(scene.views))
    distance, position, direction = viewpoints(scene, rows)
    x = _inputs(distance, position, direction, scene.extent, 0.0)
    S = matern32(x, x, (0.5, 0.5, 1.0)) + 1e-9 * np.eye(len(x))
    field = 0.05 * np.linalg.cholesky(S) @ rng.standard_normal((len(x), 2))
    unseen = ~np.isin(rows, scene.train_ids)
    level = np.array([0.55, 0.66, 0.76, 0.85])
    quality = level + field[:, :1] * [1, 1, 0.7, 0.5] + 0.3 * field[:, 1:] * [1, 0.5, 0, 0]
    quality = quality - drop * unseen[:, None] + noise * rng.standard_normal((len(x), 1))
    return table(label_id, quality, distance, rows)


SCENE = orbit(160)


@pytest.fixture(scope="module")
def model():
    return fit_promises(synthetic(SCENE, 1), SCENE)[5]


def test_finds_the_field_and_the_drop_of_unseen_views(model):
    observations = synthetic(SCENE, 1)
    truth = observations.ssim.reshape(-1, 4)[SCENE.test_ids]
    predicted = model.predict(*viewpoints(SCENE, SCENE.test_ids))
    error = predicted.mean - truth
    by_distance = np.stack([c(viewpoints(SCENE, SCENE.test_ids)[0]) for c in model.curves], 1) - truth
    assert np.sqrt(np.mean(error**2)) < 0.6 * np.sqrt(np.mean(by_distance**2))
    assert abs(error.mean()) < 0.008 < 0.01 < by_distance.mean()  # the drop is 0.02
    assert 0.7 < np.sqrt(np.mean((error / predicted.spread) ** 2)) < 1.3
    assert model.status == "calibrated"
    assert model.levels == LEVELS
    assert model.num_views == len(SCENE.train_ids) + len(SCENE.calibration_ids)


@pytest.mark.parametrize("confidence", [0.9, 0.95])
def test_promises_are_kept_on_unseen_views(confidence):
    """Over many draws: about the confidence, and not much more, which would be overshoot."""
    feasible = kept = 0
    overshoot = {}
    for seed in range(8):
        scene = orbit(112, seed)
        observations = together(*(synthetic(scene, 100 * seed + i, label_id=i) for i in range(3)))
        promises = fit_promises(observations, scene, confidence)
        counts = {(label, level): 1000 * 2**level for label in promises for level in LEVELS}
        result = score(observations, scene, promises, counts, TARGETS)
        for predictor in PREDICTORS:
            totals = result.select(result.predictor == predictor).totals()
            overshoot.setdefault(predictor, []).append(totals["overshoot"])
            if predictor == "bound":
                feasible += totals["accepted"]
                kept += totals["kept"] * totals["accepted"]
    assert confidence - 0.015 < kept / feasible < confidence + 0.04
    mean = {name: np.mean(values) for name, values in overshoot.items()}
    assert mean["eq3"] < mean["oracle"] < mean["bound"] < mean["oracle"] + 0.05


def test_leaving_one_out_in_closed_form_is_what_a_fit_without_the_view_says():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((20, 7))
    u = np.arange(20) % 3 == 0
    residual = rng.standard_normal((20, 2))
    S = matern32(x, x, (0.8, 1.2, 2.0)) + 0.3 * np.outer(u, u) + 0.1 * np.eye(20)
    inverse = _inverse(S)
    own = np.diag(inverse)
    left_out = residual - inverse @ residual / own[:, None]
    for i in range(20):
        rest = np.arange(20) != i
        k = np.linalg.solve(S[np.ix_(rest, rest)], S[rest, i])
        np.testing.assert_allclose(left_out[i], k @ residual[rest], atol=1e-9)
        assert 1 / own[i] == pytest.approx(S[i, i] - k @ S[rest, i])


def test_slopes_of_the_covariance():
    rng = np.random.default_rng(0)
    x, u, theta = rng.standard_normal((6, 7)), np.arange(6) > 3, PRIOR + 0.3
    squares = [((x[:, None, g] - x[None, :, g]) ** 2).sum(-1) for g in GROUPS]
    S, slopes = _terms(squares, u, theta)
    lengths = [float(np.exp(t)) for t in theta[:3]]
    whole = matern32(x, x, lengths) + np.exp(theta[3]) * np.outer(u, u) + np.exp(theta[4]) * np.eye(6)
    np.testing.assert_allclose(S, whole, atol=1e-12)
    for i, slope in enumerate(slopes):
        step = 1e-6 * (np.arange(5) == i)
        up, down = (_terms(squares, u, theta + sign * step)[0] for sign in (1, -1))
        np.testing.assert_allclose(slope, (up - down) / 2e-6, atol=1e-7)


def test_widens_away_from_photos(model):
    distance, position, direction = viewpoints(SCENE, SCENE.train_ids[:1])
    away = np.array([0.0, 0.3, 1.0, 3.0, 30.0])
    path = position + away[:, None] * SCENE.extent * np.array([0.6, 0.0, 0.8])
    predicted = model.predict(np.repeat(distance, 5), path, np.repeat(direction, 5, 0))
    assert predicted.support[0] == pytest.approx(1)
    assert (np.diff(predicted.support) < 0).all()
    assert predicted.support[-1] < 1e-6
    assert (np.diff(predicted.spread, axis=0) > -1e-9).all()
    gap = predicted.mean - predicted.bound
    assert (gap[-1] > gap[0]).all()
    np.testing.assert_allclose(predicted.mean[-1], [c(float(distance[0])) for c in model.curves], atol=0.05)


def test_formulas_of_the_module_text(model):
    """What a viewer computes from promises.json, written out for one viewpoint."""
    entry = json.loads(json.dumps(_to_json(model)))
    distance, position, direction = viewpoints(SCENE, SCENE.test_ids[:1])
    x = np.array([*position[0] / entry["extent"], *direction[0], np.log(distance[0])])
    X, u = np.array(entry["inputs"]), np.array(entry["heldout_inputs"], float)

    def c(a, b):
        r2 = sum(((a[g] - b[g]) ** 2).sum() / ll**2 for g, ll in zip(GROUPS, entry["lengths"], strict=True))
        return (1 + np.sqrt(3 * r2)) * np.exp(-np.sqrt(3 * r2))

    S = np.array([[c(a, b) for b in X] for a in X])
    S += entry["heldout_variance"] * np.outer(u, u) + entry["noise"] * np.eye(len(X))
    k = np.array([c(x, b) for b in X]) + entry["heldout_variance"] * u
    mean = [curve(float(distance[0])) for curve in model.curves] + k @ np.array(entry["weights"])
    variance = 1 + entry["heldout_variance"] + entry["noise"] - k @ np.linalg.solve(S, k)
    spread = np.array(entry["amplitudes"]) * np.sqrt(variance)
    predicted = model.predict(distance, position, direction)
    np.testing.assert_allclose(predicted.spread[0], spread, rtol=1e-6)
    assert (np.diff(mean) > 0).all()
    np.testing.assert_allclose(predicted.mean[0], mean, rtol=1e-6)
    bound = np.maximum.accumulate(mean - entry["multiplier"] * spread)
    np.testing.assert_allclose(predicted.bound[0], bound, rtol=1e-6)


values = arrays(np.float64, (3, 5), elements=st.floats(-1, 1))


@given(mean=values, spread=values, factor=st.floats(0, 5))
def test_neither_mean_nor_bound_ever_falls_from_level_to_level(mean, spread, factor):
    predicted = promise(mean, np.abs(spread), factor, np.ones(3))
    assert (np.diff(predicted.mean, axis=1) >= 0).all()
    assert (np.diff(predicted.bound, axis=1) >= 0).all()
    assert (predicted.bound <= predicted.mean + 1e-12).all()
    steady = np.sort(mean, 1)
    np.testing.assert_array_equal(promise(steady, spread, 0.0, np.ones(3)).mean, steady)


@given(ssim=values, bound=values)
@settings(max_examples=50)
def test_decisions_are_those_of_a_plan_over_a_fine_grid_of_targets(ssim, bound):
    bound = np.sort(bound, 1)
    missed, asked = decisions(ssim, bound)
    for i in range(3):
        low, high = bound[i, 0] - EASY, bound[i, -1]
        targets = low + (np.arange(4000) + 0.5) / 4000 * (high - low)
        level = np.searchsorted(bound[i], targets)
        share = np.mean(ssim[i, level] < targets)
        assert missed[i] == pytest.approx(share * (high - low), abs=0.005)
        assert asked[i] == pytest.approx(high - low)


def test_a_category_is_bounded_by_its_own_errors_where_it_has_enough():
    """Same photos, but one category's unseen views stray more than its training views let expect."""
    plain, wild = synthetic(SCENE, 1, label_id=1), synthetic(SCENE, 2, label_id=2)
    rng = np.random.default_rng(0)
    unseen = ~np.isin(wild.view, SCENE.train_ids)
    stray = 0.1 * rng.standard_normal(len(SCENE.views))[wild.view] * unseen
    wild = replace(wild, ssim=(wild.ssim + stray).astype(np.float32))
    promises = fit_promises(together(plain, wild), SCENE)
    assert promises[2].multiplier > 1.3 * promises[1].multiplier


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
    promises = fit_promises(together(*(p for k, p in parts.items() if k != 4), holes), SCENE)
    assert set(promises) == {-1, 1, 2, 3, 4, 5, 6}
    status = {label: model.status for label, model in promises.items()}
    assert [status[i] for i in (1, 2, 3, 5, 6, -1)] == [
        "pooled",
        "pooled",
        "calibrated",
        "calibrated",
        "pooled",
        "pooled",
    ]
    assert promises[1].num_views == 1
    assert promises[3].levels == (1,)
    d, position, direction = viewpoints(SCENE, SCENE.test_ids)
    for label, model in promises.items():
        for distances in (d, np.full(len(d), np.nan), np.zeros(len(d))):
            predicted = model.predict(distances, position, direction)
            assert all(np.isfinite(part).all() for part in predicted), label
            assert (predicted.spread > 0).all()
        assert model.predict(d[:0], position[:0], direction[:0]).bound.shape == (0, len(model.levels))
    # seen once: less is known than of a category seen often
    assert promises[1].predict(d, position, direction).spread.mean() > 0.05
    assert promises[5].predict(d, position, direction).bound == pytest.approx(0.7, abs=0.01)
    counts = {(label, level): level for label, model in promises.items() for level in model.levels}
    observations = together(*parts.values())
    result = score(observations, SCENE, promises, counts, [0.6])
    assert isinstance(result, Decisions)
    assert set(result.label_id) == set(promises)
    assert np.isnan(result.select(result.label_id == 1).totals()["overshoot"])  # in no test view
    planned = {key: cost for key, cost in counts.items() if key[0] != 5}  # no Gaussians of 5: in no plan
    assert set(score(observations, SCENE, promises, planned, [0.6]).label_id) == set(promises) - {5}


def test_without_calibration_views_training_views_stand_in_and_the_status_says_so():
    scene = orbit(80, calibrate_every=0)
    model = fit_promises(synthetic(scene, 1), scene)[5]
    assert model.status == "uncalibrated"
    assert model.num_calibration == 0
    assert 0.3 < model.multiplier <= 4
    few = synthetic(scene, 1)
    model = fit_promises(few.select(np.isin(few.view, scene.train_ids[:6])), scene)[5]
    assert model.status == "uncalibrated"
    assert model.multiplier == pytest.approx(1.645, abs=0.001)
    assert fit_promises(few.select(few.label_id < 0), scene) == {}


def test_test_views_change_nothing(model):
    observations = synthetic(SCENE, 1)
    spoiled = np.where(np.isin(observations.view, SCENE.test_ids), np.float32(0.1), observations.ssim)
    again = fit_promises(replace(observations, ssim=spoiled), SCENE)[5]
    assert _to_json(again) == _to_json(model)


def test_score_by_hand(model):
    observations = synthetic(SCENE, 1)
    counts = {(5, level): 10 * level for level in LEVELS}
    result = score(observations, SCENE, {5: model}, counts, [0.7], SCENE.calibration_ids)
    row = result.select(result.predictor == "bound")
    measured = observations.ssim.reshape(-1, 4)[SCENE.calibration_ids]
    bound = model.predict(*viewpoints(SCENE, SCENE.calibration_ids)).bound
    feasible = bound[:, -1] >= 0.7
    level = (bound >= 0.7).argmax(1)
    got = measured[np.arange(len(level)), level]
    kept = feasible & (got >= 0.7)
    assert row.views[0] == len(level)
    assert row.accepted[0] == feasible.sum()
    assert row.kept[0] == kept.sum()
    assert row.overshoot[0] == pytest.approx(np.mean(got[feasible] - 0.7))
    assert row.false_rejections[0] == (~feasible & (measured >= 0.7).any(1)).sum()
    oracle = (measured >= 0.7).argmax(1)
    assert row.regret[0] == pytest.approx(10 * np.mean((level - oracle)[kept]))
    best = result.select(result.predictor == "oracle").totals()
    assert best["kept"] == 1
    assert best["regret"] == 0
    assert best["false_rejections"] == 0
    with pytest.raises(RunError, match="target"):
        score(observations, SCENE, {5: model}, counts, [1.5])


def test_round_trip(tmp_path, model):
    write_promises(tmp_path / "promises.json", {5: model})
    again = read_promises(tmp_path / "promises.json")[5]
    where = viewpoints(SCENE, SCENE.test_ids)
    for a, b in zip(model.predict(*where), again.predict(*where), strict=True):
        np.testing.assert_array_equal(a, b)
    assert (again.status, again.levels, again.num_calibration) == (
        model.status,
        LEVELS,
        model.num_calibration,
    )
    assert model.status in STATUSES


@pytest.mark.parametrize(
    ("name", "value"),
    [("status", "good"), ("noise", 0), ("lengths", [1, 1]), ("weights", [[1.0]]), ("multiplier", None),
     ("curves", []), ("extent", "far"), ("inputs", []), ("amplitudes", [1, 2, 3, float("nan")])],
)  # fmt: skip
def test_spoilt_files_are_one_line(tmp_path, model, name, value):
    path = tmp_path / "promises.json"
    path.write_text(json.dumps({"promises": [{**_to_json(model), name: value}]}))
    with pytest.raises(DataError, match="not a file of promises") as error:
        read_promises(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("confidence", [0.0, 1.0, -1, 95, float("nan")])
def test_impossible_confidence(confidence):
    with pytest.raises(RunError, match="confidence") as error:
        fit_promises(synthetic(SCENE, 1), SCENE, confidence)
    assert "\n" not in str(error.value)


def test_a_thousand_viewpoints_are_quick(model):
    rng = np.random.default_rng(0)
    direction = rng.standard_normal((1000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    start = time.perf_counter()
    model.predict(rng.uniform(1, 4, 1000), -3 * direction, direction)
    assert time.perf_counter() - start < 0.5
