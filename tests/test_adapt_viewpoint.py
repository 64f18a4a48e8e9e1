"""Quality models: the formulas that a viewer shares, and files of them."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from viewpoint_fields import LEVELS, orbit, synthetic, viewpoints

from sagesplat.adapt.photo_models import fit_photo_models
from sagesplat.adapt.process import GROUPS
from sagesplat.adapt.viewpoint import (
    NO_CALIBRATION,
    STATUSES,
    Calibration,
    ViewModel,
    monotone,
    read_promises,
    write_promises,
)
from sagesplat.core.errors import DataError
from sagesplat.io.typed import to_plain

SCENE = orbit(160)
CALIBRATION = Calibration(
    "calibrated", 0.95, 40, np.array([0.6, 0.7, 0.8]), np.array([0.62, 0.75, 0.81]), np.full(3, 0.02), 0.1
)


@pytest.fixture(scope="module")
def model() -> ViewModel:
    return replace(fit_photo_models(synthetic(SCENE, 1), SCENE)[5], calibration=CALIBRATION)


def test_formulas_of_the_module_text(model):
    """What a viewer computes from promises.json, written out for one viewpoint."""
    entry = json.loads(json.dumps(to_plain(model)))
    distance, position, direction = viewpoints(SCENE, SCENE.test_ids[:1])
    x = np.array([*position[0] / entry["extent"], *direction[0], 0.0, 0.0, np.log(distance[0])])
    X, u = np.array(entry["inputs"]), np.array(entry["heldout_inputs"], float)

    def c(a, b):
        r2 = sum(((a[g] - b[g]) ** 2).sum() / ll**2 for g, ll in zip(GROUPS, entry["lengths"], strict=True))
        return (1 + np.sqrt(3 * r2)) * np.exp(-np.sqrt(3 * r2))

    near = np.array([c(x, b) for b in X])
    k = near + entry["heldout_variance"] * u
    mean = [curve(float(distance[0])) for curve in model.curves] + k @ np.array(entry["weights"])
    assert (np.diff(mean) > 0).all()
    predicted = model.predict(distance, position, direction)
    np.testing.assert_allclose(predicted.mean[0], mean, rtol=1e-9)
    assert predicted.support[0] == pytest.approx(near.max(), rel=1e-9)
    calibration = entry["calibration"]
    targets, slopes = calibration["targets"], calibration["slopes"]
    thresholds = [
        t + slope * (1 - near.max()) for t, slope in zip(calibration["thresholds"], slopes, strict=True)
    ]
    for i, one in enumerate(mean):
        above = sum(one >= t for t in thresholds)
        if above == 0:
            bound = one - thresholds[0] + targets[0]
        elif above == 3:
            bound = targets[2]
        else:
            low, high = thresholds[above - 1 : above + 1]
            bound = targets[above - 1] + (one - low) / (high - low) * (targets[above] - targets[above - 1])
        assert predicted.bound[0, i] == pytest.approx(bound, abs=1e-12)


def test_less_is_said_away_from_what_is_known(model):
    distance, position, direction = viewpoints(SCENE, SCENE.train_ids[:1])
    away = np.array([0.0, 0.05, 0.1, 1.0, 30.0])
    path = position + away[:, None] * SCENE.extent * np.array([0.6, 0.0, 0.8])
    predicted = model.predict(np.repeat(distance, 5), path, np.repeat(direction, 5, 0))
    assert predicted.support[0] == pytest.approx(1)
    assert (np.diff(predicted.support) < 0).all()
    assert predicted.support[-1] < 1e-6
    assert np.isfinite(predicted.bound[:3]).all()
    assert np.isnan(predicted.bound[-1]).all()  # outside of the support nothing is promised
    np.testing.assert_allclose(predicted.mean[-1], [c(float(distance[0])) for c in model.curves], atol=0.05)


def test_thresholds_rise_away_from_the_photos_where_they_are_known(model):
    distance, position, direction = viewpoints(SCENE, SCENE.train_ids[:1])
    place = np.concatenate([position[0] / model.extent, direction[0]])
    steep = replace(model, calibration=replace(CALIBRATION, slopes=np.full(3, 0.1), least_support=0.0))
    near = replace(steep, photos=np.column_stack([place + 9, place]))
    path = position + np.array([0, 0.03, 0.3])[:, None] * model.extent * np.array([0.6, 0.0, 0.8])
    one = near.predict(np.repeat(distance, 3), path, np.repeat(direction, 3, 0))
    # Matern 3/2 of 0, 0.1 and 1 length scales
    scaled = np.sqrt(3) * np.array([0, 0.1, 1])
    np.testing.assert_allclose(one.away, 1 - (1 + scaled) * np.exp(-scaled), atol=1e-9)
    far = replace(steep, photos=np.column_stack([place + 9]))
    other = far.predict(np.repeat(distance, 3), path, np.repeat(direction, 3, 0))
    np.testing.assert_allclose(other.away, 1, atol=1e-6)
    assert (other.bound[:, 0] < one.bound[:, 0]).all()
    np.testing.assert_array_equal(other.mean, one.mean)


def test_the_bound_of_a_mean_by_hand():
    means = np.array([[0.5, 0.62, 0.685, 0.81, 0.99]])
    plain = replace(CALIBRATION, slopes=np.zeros(3))
    np.testing.assert_allclose(plain.bound(means, np.ones(1)), [[0.48, 0.6, 0.65, 0.8, 0.8]])
    # slopes count where the support lacks
    halfway = CALIBRATION.bound(means + 0.01, np.array([0.5]))
    np.testing.assert_allclose(halfway, plain.bound(means, np.ones(1)))
    # thresholds never fall from target to target, and the full model keeps all of them
    steep = replace(CALIBRATION, thresholds=np.array([0.62, 0.75, 1.0]), slopes=np.array([0.5, 0.0, 0.0]))
    np.testing.assert_allclose(
        steep.bound(np.array([[0.5, 0.869, 0.87, 0.935, 1.0]]), np.array([0.5]))[0],
        [0.23, 0.599, 0.7, 0.75, 0.8],
    )
    far = replace(steep, slopes=np.array([0.0, 3.0, 0.0]), least_support=0.0)
    np.testing.assert_allclose(far.bound(np.array([[0.81, 1.0]]), np.zeros(1))[0], [0.65, 0.8])
    assert np.isnan(CALIBRATION.bound(means, np.array([0.05]))).all()
    assert np.isnan(NO_CALIBRATION.bound(means, np.ones(1))).all()


values = arrays(np.float64, (3, 5), elements=st.floats(-1, 1))


@given(mean=values, support=arrays(np.float64, 3, elements=st.floats(0.1, 1)))
def test_neither_mean_nor_bound_ever_falls_from_level_to_level(mean, support):
    rising = monotone(mean)
    assert (np.diff(rising, axis=1) >= 0).all()
    bound = CALIBRATION.bound(rising, support)
    assert (np.diff(bound, axis=1) >= 0).all()
    steady = np.sort(mean, 1)
    np.testing.assert_array_equal(monotone(steady), steady)


def test_round_trip(tmp_path, model):
    write_promises(tmp_path / "promises.json", {5: model})
    again = read_promises(tmp_path / "promises.json")[5]
    where = viewpoints(SCENE, SCENE.test_ids)
    for a, b in zip(model.predict(*where), again.predict(*where), strict=True):
        np.testing.assert_array_equal(a, b)
    assert (again.status, again.levels, again.quality) == (model.status, LEVELS, "ssim")
    assert again.calibration.num_views == 40
    assert model.status in STATUSES


@pytest.mark.parametrize(
    "change",
    [
        {"heldout_variance": -1}, {"lengths": [1, 1]}, {"weights": [[1.0]]}, {"curves": []},
        {"inputs": []}, {"extent": 0}, {"quality": "good"}, {"rmse": None}, {"calibration": {}},
        {"calibration": {"targets": [0.6, 0.6, 0.8]}}, {"calibration": {"thresholds": [0.1, 0.2, math.nan]}},
        {"calibration": {"targets": [0.6, 0.7]}}, {"calibration": {"thresholds": [0.1, 0.2, 1e31]}},
        {"calibration": {"confidence": 1}}, {"calibration": {"least_support": 2}},
        {"calibration": {"slopes": [0, 0, math.inf]}}, {"calibration": {"slopes": [0.0]}},
        {"screens": [2, 1]}, {"focal": 0},
    ],
)  # fmt: skip
def test_spoilt_files_are_one_line(tmp_path, model, change):
    entry = to_plain(model)
    if "calibration" in change:
        change = {"calibration": change["calibration"] and entry["calibration"] | change["calibration"]}
    path = tmp_path / "promises.json"
    path.write_text(json.dumps({"promises": [entry | change]}))
    with pytest.raises(DataError, match="not a file of promises"):
        read_promises(path)
