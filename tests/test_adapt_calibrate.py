"""Critical thresholds against trying every threshold, and conformal quantiles against their promise."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sagesplat.adapt.calibrate import (
    OTHERS,
    conformal_quantile,
    critical_asks,
    critical_margins,
    fewest_views,
)


def test_views_that_a_confidence_needs():
    assert [fewest_views(c) for c in (0.5, 0.9, 0.95, 0.99)] == [1, 9, 19, 99]


@given(st.integers(1, 200), st.sampled_from([0.5, 0.8, 0.9, 0.95]))
def test_the_quantile_is_the_rank_of_split_conformal_prediction(n, confidence):
    found = conformal_quantile(np.arange(1.0, n + 1), confidence)
    assert math.isinf(found) == (n < fewest_views(confidence))
    if not math.isinf(found):
        # a new value is as likely to be at any of n + 1 ranks
        assert found / (n + 1) >= confidence - 1e-12 > (found - 1) / (n + 1) - 1e-9


def test_the_quantile_is_kept_by_new_values():
    rng = np.random.default_rng(0)
    kept = [rng.exponential() <= conformal_quantile(rng.exponential(size=39), 0.9) for _ in range(4000)]
    assert 0.9 - 0.01 < np.mean(kept) < 0.9 + 0.025 + 0.01


def test_other_categories_make_the_quantile_of_few_values_less_a_matter_of_chance():
    rng = np.random.default_rng(1)
    draws = [(rng.exponential(size=40), rng.exponential(size=280)) for _ in range(2000)]
    alone, shared = np.transpose([
        [1 - np.exp(-conformal_quantile(own, 0.95, other)) for other in (np.zeros(0), others)]
        for own, others in draws
    ])  # fmt: skip
    assert shared.std() < 0.8 * alone.std()
    assert 0.95 < shared.mean() < 0.97


@given(st.integers(40, 200), st.integers(0, 400))
def test_other_categories_count_as_a_few_values_however_easy_or_hard_they_are(n, m):
    own = np.arange(1.0, n + 1)
    easy, hard = (conformal_quantile(own, 0.95, np.full(m, value)) for value in (-1.0, n + 2.0))
    few = 0.05 * min(m, OTHERS)
    assert conformal_quantile(own, 0.95) - few - 1 <= easy <= conformal_quantile(own, 0.95) <= hard
    # of the own values at most so many more are above
    assert (own > easy).sum() <= 0.05 * (n + min(m, OTHERS) + 1)


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(1, 6))
def test_critical_margins_by_trying_all(seed, levels):
    rng = np.random.default_rng(seed)
    mean = np.maximum.accumulate(rng.uniform(0, 1, (8, levels)).round(1), 1)
    measured, target = rng.uniform(0, 1, (8, levels)), 0.5
    scale = rng.choice([0.25, 0.5, 1.0], 8)  # exact, so that a margin gives its threshold to the bit
    found = critical_margins(mean, measured, target, scale)
    for view in range(8):
        margins = (mean - target) / scale[view]
        for margin in np.unique([*margins.ravel(), *(margins.ravel() + 0.01), -9, 9]):
            reached = margins[view] >= margin
            misses = reached.any() and measured[view, reached.argmax()] < target
            if margin > found[view]:
                assert not misses
            if margin == found[view]:
                assert misses


def test_critical_asks_between_compositions():
    nominal, bound = np.array([0.4, 0.6, 0.8, 0.95]), np.array([[0.5, 0.62, 0.8, 1.0]])

    def critical(measured, steps=(4, 4, 4), target=0.6):
        return critical_asks(nominal[None], bound, np.array([steps]), np.array([measured]), target)[0]

    assert critical([0.5, 0.7, 0.8, 1.0]) == pytest.approx(0.56)  # two of the four steps miss
    assert critical([0.5, 0.7, 0.8, 1.0], (1, 4, 4)) == pytest.approx(0.5)  # the next one keeps
    assert critical([0.5, 0.7, 0.8, 1.0], (0, 4, 4)) == 0.6  # by its neighbours alone
    assert critical([0.5, 0.55, 0.8, 1.0]) == pytest.approx(0.62)
    assert critical([0.7, 0.75, 0.8, 1.0]) == 0.4  # nothing is known below the first one
    assert critical([0.7, 0.5, 0.8, 1.0]) == pytest.approx(0.62 + 0.18 / 4)  # what keeps below does not count
    assert critical([0.1, 0.2, 0.3, 0.4]) == 1.0  # nothing but the full model
