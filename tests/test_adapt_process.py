"""The Gaussian process: its formulas in float64, and derivatives against differences."""

import numpy as np
import pytest

from sagesplat.adapt.process import (
    GROUPS,
    PRIOR,
    PRIOR_REACH,
    PRIOR_WIDTH,
    _cost,
    _inverse,
    _terms,
    fit_process,
    fit_together,
    inputs_of,
    matern32,
)


def drawn(n: int = 20, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((n, 9)), np.arange(n) % 3 == 0, 0.1 * rng.standard_normal((n, 2))


def squares_of(x: np.ndarray) -> list[np.ndarray]:
    return [((x[:, None, g] - x[None, :, g]) ** 2).sum(-1) for g in GROUPS]


def test_leaving_one_out_in_closed_form_is_what_a_fit_without_the_view_says():
    x, u, values = drawn()
    process = fit_process(x, u, values)
    S = matern32(x, x, process.lengths) + process.heldout_variance * np.outer(u, u)
    S += process.noise * np.eye(20)
    np.testing.assert_allclose(S @ process.weights, values, atol=1e-10)
    for i in range(20):
        rest = np.arange(20) != i
        k = np.linalg.solve(S[np.ix_(rest, rest)], S[rest, i])
        np.testing.assert_allclose(process.left_out[i], k @ values[rest], atol=1e-9)


def test_of_many_views_some_stay_with_the_weights_that_are_best_for_all():
    x, _, values = drawn(40)
    stay = np.arange(40) % 3 == 0
    (lengths, (weights,), (left_out,)), noise = through([x], [values], [stay])
    C, C_nm = matern32(x[stay], x[stay], lengths), matern32(x, x[stay], lengths)

    def best(rows: np.ndarray) -> np.ndarray:
        return np.linalg.solve(C_nm[rows].T @ C_nm[rows] + noise * C, C_nm[rows].T @ values[rows])

    np.testing.assert_allclose(weights, best(np.ones(40, bool)), atol=1e-6)
    for i in range(40):
        np.testing.assert_allclose(left_out[i], C_nm[i] @ best(np.arange(40) != i), atol=1e-6)


def test_where_all_views_stay_it_is_the_process_itself():
    x, _, values = drawn()
    here, nowhere = np.ones(20, bool), np.zeros(20, bool)
    alone = fit_process(x, nowhere, values)
    (lengths, weights, left_out), _ = through([x, x], [values, values], [here, nowhere])
    np.testing.assert_allclose(lengths, alone.lengths, rtol=1e-6)
    np.testing.assert_allclose(weights[0], alone.weights, atol=1e-5)
    np.testing.assert_allclose(left_out[0], alone.left_out, atol=1e-5)
    assert weights[1].shape == (0, 2)  # of none that stays nothing is predicted
    np.testing.assert_array_equal(left_out[1], 0)


def through(inputs: list, values: list, stay: list) -> tuple[tuple, float]:
    """What `fit_together` finds, and the noise of the views that stay."""
    found = fit_together(inputs, values, stay, [np.eye(v.shape[1]) for v in values])
    (own, own_values), *_ = [(x[some], v[some]) for x, v, some in zip(inputs, values, stay, strict=True)]
    noise = fit_process(own, np.zeros(len(own), bool), own_values).noise
    return (found.lengths, found.weights, found.left_out), noise


def test_terms_that_move_nothing_have_no_say_in_the_lengths():
    x, _, values = drawn()
    here, first = np.ones(20, bool), values[:, :1]
    noise = np.random.default_rng(3).normal(size=(20, 1))
    alone = fit_together([x], [first], [here], [np.eye(1)])
    both = fit_together([x], [np.hstack([first, noise])], [here], [np.array([[1.0], [0.0]])])
    np.testing.assert_allclose(both.lengths, alone.lengths)
    np.testing.assert_allclose(both.weights[0][:, :1], alone.weights[0])
    assert both.weights[0].shape == (20, 2)


def test_slopes_of_the_covariance():
    x, u, _ = drawn(6)
    theta, squares = PRIOR + 0.3, squares_of(x)
    S, slopes = _terms(squares, u, theta)
    lengths = [float(np.exp(t)) for t in theta[:4]]
    whole = matern32(x, x, lengths) + np.exp(theta[4]) * np.outer(u, u) + np.exp(theta[5]) * np.eye(6)
    np.testing.assert_allclose(S, whole, atol=1e-12)
    for i, slope in enumerate(slopes):
        step = 1e-6 * (np.arange(6) == i)
        up, down = (_terms(squares, u, theta + sign * step)[0] for sign in (1, -1))
        np.testing.assert_allclose(slope, (up - down) / 2e-6, atol=1e-7)


def test_slopes_of_the_likelihood():
    x, u, values = drawn()
    for shift in (-0.5, 0.0, 0.4):
        theta = PRIOR + shift
        slope = _cost(theta, [(squares_of(x), u, values)])[1]
        for i in range(6):
            step = 1e-6 * (np.arange(6) == i)
            up, down = (_cost(theta + sign * step, [(squares_of(x), u, values)])[0] for sign in (1, -1))
            # the amplitude's own dependence on theta adds nothing but for the floor under it
            assert slope[i] == pytest.approx((up - down) / 2e-6, rel=0.02, abs=0.02)


def test_hyperparameters_are_the_best_near_by_and_within_bounds():
    x, u, values = drawn(30, 3)
    process = fit_process(x, u, values)
    theta = np.log([*process.lengths, process.heldout_variance, process.noise])
    assert (np.abs(theta - PRIOR) <= PRIOR_REACH * PRIOR_WIDTH + 1e-9).all()
    best = _cost(theta, [(squares_of(x), u, values)])[0]
    for i in range(6):
        for step in (-0.2, 0.2):
            assert _cost(theta + step * (np.arange(6) == i), [(squares_of(x), u, values)])[0] > best - 0.05


def test_one_view_and_views_in_one_place():
    x, u, values = drawn(1)
    process = fit_process(x, u, values)
    np.testing.assert_allclose(process.left_out, 0, atol=1e-12)  # nothing else is known
    again = fit_process(np.repeat(x, 4, 0), np.zeros(4, bool), np.repeat(values, 4, 0))
    assert np.isfinite(again.left_out).all()
    inverse, log_determinant = _inverse(np.eye(3) * 2)
    np.testing.assert_allclose(inverse, np.eye(3) / 2)
    assert log_determinant == pytest.approx(3 * np.log(2))


def test_an_unknown_distance_counts_as_the_median():
    distance = np.array([2.0, np.nan, 0.0, -1.0, np.inf])
    where = np.zeros((5, 3)), np.ones((5, 3))
    x = inputs_of(distance, *where, 2.0, 0.7)
    np.testing.assert_allclose(x[:, 8], [np.log(2), 0.7, 0.7, 0.7, 0.7])
    np.testing.assert_array_equal(x[:, 6], 0)  # no screen: the photos'
    screens = inputs_of(distance, *where, 2.0, 0.7, np.full(5, 2.0))
    np.testing.assert_allclose(screens[:, 6], np.log(2))
