"""Eq. 3: what the fits find, where they hold back, and what they never do."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sagesplat.adapt import eq3 as module
from sagesplat.adapt.eq3 import STATUSES, Eq3, SsimModel, fit_model, fit_models, read_models, write_models
from sagesplat.adapt.observe import TOTAL, Observations
from sagesplat.core.errors import DataError


def capture_distances(rng: np.random.Generator, n: int) -> np.ndarray:
    """Distances of an orbit at uneven radius with a tail of far views, as captures have them."""
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return 2.5 + 1.2 * np.sin(3 * angle + rng.uniform(0, 6)) + rng.gamma(1.5, 0.4, n)


def table(label_id, level, view, distance, ssim) -> Observations:
    rows = len(ssim)
    column = {
        "label_id": np.broadcast_to(label_id, rows),
        "level": np.broadcast_to(level, rows),
        "view": np.broadcast_to(view, rows),
        "num_pixels": np.full(rows, 100),
    }
    real = {"distance": distance, "ssim": ssim, "ssim_eroded": ssim, "psnr": np.full(rows, 25.0)}
    return Observations(
        **{name: np.asarray(c, np.int32) for name, c in column.items()},
        **{name: np.asarray(c, np.float32) for name, c in real.items()},
    )


def test_eq3_by_hand():
    params = Eq3(K1=0.8, g1=0.5, mu1=2.0, a1=2.0, K2=0.7, g2=0.1, mu2=3.0, a2=1.0, beta=3.0)
    expected = [0.8 * np.exp(-0.5), 0.8, 0.7, 0.7 * np.exp(-0.2)]
    np.testing.assert_allclose(params(np.array([1.0, 2.0, 3.0, 5.0])), expected)


TWO = Eq3(K1=0.55, g1=0.15, mu1=2.6, a1=1.5, K2=0.8, g2=0.05, mu2=2.6, a2=1.2, beta=2.6)
ONE = Eq3(K1=0.75, g1=0.15, mu1=3.0, a1=1.5, K2=0.75, g2=0.15, mu2=3.0, a2=1.5, beta=3.0)
FLAT = Eq3(0.6, 0.0, 0.0, 1.0, 0.6, 0.0, 0.0, 1.0, 1.0)


@pytest.mark.parametrize(("truth", "status"), [(TWO, "two regimes"), (ONE, "one regime"), (FLAT, "constant")])
@pytest.mark.parametrize("noise", [0.02, 0.06])
def test_finds_the_curve_and_no_more_regimes_than_there_are(truth, status, noise):
    rng = np.random.default_rng(3)
    for _ in range(4):
        d = capture_distances(rng, 160)
        model = fit_model(7, 1000, d, truth(d) + noise * rng.standard_normal(160))
        assert model.status == status
        assert np.sqrt(np.mean((model(d) - truth(d)) ** 2)) < noise / 2
        assert model.rmse == pytest.approx(noise, rel=0.25)
        if status == "two regimes":
            assert model.params.beta == pytest.approx(truth.beta, abs=0.15)


def test_outliers_do_not_move_the_curve():
    rng = np.random.default_rng(4)
    d = capture_distances(rng, 160)
    ssim = ONE(d) + 0.03 * rng.standard_normal(160)
    ssim[rng.choice(160, 10, replace=False)] -= 0.5
    assert np.sqrt(np.mean((fit_model(7, 1000, d, ssim)(d) - ONE(d)) ** 2)) < 0.02


@pytest.mark.parametrize("n", range(1, 9))
def test_few_observations_get_few_parameters(n):
    rng = np.random.default_rng(n)
    d = rng.uniform(1, 5, n)
    ssim = ONE(d) + 0.03 * rng.standard_normal(n)
    model = fit_model(7, 1000, d, ssim)
    assert model.status == "constant" if n <= 5 else model.status in ("constant", "one regime")
    assert model.num_observations == n
    assert ssim.min() - 1e-5 <= model(3.0) <= ssim.max() + 1e-5


def test_equal_distances_and_unknown_distances_give_a_constant():
    rng = np.random.default_rng(5)
    ssim = rng.uniform(0.4, 0.8, 60)
    same = fit_model(7, 1000, np.full(60, 2.5), ssim)
    assert (same.status, same.d_range, same(9.0)) == ("constant", (2.5, 2.5), np.median(ssim))
    unknown = fit_model(7, 1000, np.full(60, np.nan), ssim)
    assert (unknown.status, unknown.d_range, unknown(2.0)) == ("constant", (0.0, 0.0), np.median(ssim))
    assert unknown.rmse == pytest.approx(np.std(ssim), rel=0.1)


def test_ends_hold_and_nan_is_the_median():
    rng = np.random.default_rng(6)
    d = capture_distances(rng, 100)
    ssim = ONE(d) + 0.02 * rng.standard_normal(100)
    model = fit_model(7, 1000, d, ssim)
    low, high = model.d_range
    assert (low, high) == (d.min(), d.max())
    assert model(0.0) == model(low) != model(3.0)
    assert model(1e6) == model(high)
    predicted = model(np.array([np.nan, low]))
    assert predicted.tolist() == [np.median(ssim), model(low)]
    assert isinstance(model(low), float)


def test_neither_unit_nor_order_matters():
    rng = np.random.default_rng(7)
    d = capture_distances(rng, 80)
    ssim = TWO(d) + 0.02 * rng.standard_normal(80)
    model, order = fit_model(7, 1000, d, ssim), rng.permutation(80)
    for scale in (1e-4, 1e5):
        other = fit_model(7, 1000, scale * d[order], ssim[order])
        assert other.status == model.status
        np.testing.assert_allclose(other(scale * d), model(d), atol=1e-6)


def test_a_fit_that_does_not_converge_is_a_value(monkeypatch):
    real = module.least_squares
    monkeypatch.setattr(module, "least_squares", lambda *args, **kw: real(*args, **kw | {"max_nfev": 1}))
    rng = np.random.default_rng(8)
    d = capture_distances(rng, 100)
    model = fit_model(7, 1000, d, ONE(d) + 0.02 * rng.standard_normal(100))
    assert model.status == "not converged"
    assert np.sqrt(np.mean((model(d) - ONE(d)) ** 2)) < 0.05  # the best start already is close


def test_jacobian_is_the_derivative():
    x, at = np.linspace(0, 1, 23), np.array([0.7, -0.8, 0.43, 1.3])
    steps = 1e-6 * np.eye(4)
    numeric = [(module._curve(at + h, x) - module._curve(at - h, x)) / 2e-6 for h in steps]
    np.testing.assert_allclose(module._jacobian(at, x), np.stack(numeric, 1), atol=1e-7)


@settings(max_examples=60)
@given(st.data(), st.integers(1, 40))
def test_never_promises_more_than_was_seen(data, n):
    distance = data.draw(arrays(np.float32, n, elements=st.floats(0, 100, width=32) | st.just(np.nan)))
    ssim = data.draw(arrays(np.float32, n, elements=st.floats(-1, 1, width=32)))
    model = fit_model(7, 1000, distance, ssim)
    assert model.status in STATUSES
    predicted = model(np.append(np.linspace(-1, 200, 300), np.nan))
    assert (predicted <= ssim.max() + 1e-5).all()
    assert (predicted >= -1).all()


def test_fit_models_uses_training_views_only():
    rng = np.random.default_rng(9)
    d = capture_distances(rng, 40).astype(np.float32)
    good = ONE(d) + 0.02 * rng.standard_normal(40)
    test_views = np.arange(40) % 8 == 0
    spoilt = np.where(test_views, -1.0, good)
    label_ids = np.repeat([-1, 5, TOTAL, 9], 40)
    ssim = np.concatenate([good, spoilt, good, np.full(40, np.nan)])
    observations = table(label_ids, 2000, np.tile(np.arange(40), 4), np.tile(d, 4), ssim)
    models = fit_models(observations, np.flatnonzero(~test_views))
    assert list(models) == [(-1, 2000), (5, 2000)]  # not the whole image, not what was never measured
    assert models[-1, 2000].num_observations == 35
    assert models[-1, 2000].params == models[5, 2000].params
    assert models[-1, 2000] == fit_models(observations, np.flatnonzero(~test_views))[-1, 2000]


@pytest.fixture
def some_models() -> dict[tuple[int, int], SsimModel]:
    rng = np.random.default_rng(11)
    d = capture_distances(rng, 50)
    return {
        (label_id, level): fit_model(label_id, level, d[:n], TWO(d[:n]) + 0.02 * rng.standard_normal(n))
        for label_id, level, n in [(-1, 1000, 1), (-1, 2000, 12), (4, 1000, 50)]
    }


def test_models_read_back_identical(tmp_path, some_models):
    path = tmp_path / "models.json"
    write_models(path, some_models)
    assert read_models(path) == some_models


@pytest.mark.parametrize(
    "spoil",
    [
        lambda document: document["models"][0]["params"].pop("g2"),
        lambda document: document["models"][0].update(level=float("inf")),
        lambda document: document["models"][0].update(d_range=[3, 2]),
        lambda document: document["models"][0]["params"].update(g1=-1),
    ],
)
def test_an_unusable_file_is_one_line(tmp_path, some_models, spoil):
    path = tmp_path / "models.json"
    write_models(path, some_models)
    document = json.loads(path.read_text())
    spoil(document)
    path.write_text(json.dumps(document))
    says = r"models\.json: not a file of quality models.*; delete it and run `sagesplat fit` again"
    with pytest.raises(DataError, match=says):
        read_models(path)
