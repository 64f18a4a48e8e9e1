"""Means over labels and decibels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sagesplat.metrics.image import means_by_label, psnr, squared_error_map, ssim_map


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    st.integers(0, 1000), st.integers(1, 12), st.integers(1, 12), st.lists(st.integers(-1, 200), min_size=1)
)
def test_means_by_label_are_numpys(seed, height, width, labels):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(height, width)).astype(np.float32)
    label_ids = rng.choice(np.array(labels, np.int16), (height, width))
    means = means_by_label(values, label_ids)
    assert sorted(means) == sorted(set(label_ids.ravel().tolist()))
    for label, (mean, count) in means.items():
        assert count == (label_ids == label).sum()
        assert mean == pytest.approx(values[label_ids == label].astype(float).mean(), abs=1e-6)
    total = sum(mean * count for mean, count in means.values()) / values.size
    assert total == pytest.approx(values.astype(float).mean(), abs=1e-6)


def test_the_map_is_of_the_whole_image_and_not_of_a_cut_out():
    """The mean over a label sees the pixels around it, as the method asks."""
    rng = np.random.default_rng(0)
    x, y = rng.random((2, 30, 40, 3)).astype(np.float32)
    label_ids = np.zeros((30, 40), np.int16)
    label_ids[10:20, 10:30] = 7
    mean, count = means_by_label(ssim_map(x, y), label_ids)[7]
    assert count == 200
    cut = np.where((label_ids == 7)[..., None], x, 0), np.where((label_ids == 7)[..., None], y, 0)
    assert abs(means_by_label(ssim_map(*cut), label_ids)[7][0] - mean) > 1e-3


def test_psnr():
    assert psnr(1.0) == 0
    assert psnr(0.01) == pytest.approx(20)
    assert psnr(0.0) == pytest.approx(100)  # capped
    np.testing.assert_allclose(psnr(np.array([0.1, 0.001])), [10, 30])
    rng = np.random.default_rng(0)
    x, y = rng.random((2, 6, 5, 3)).astype(np.float32)
    errors = squared_error_map(x, y)
    assert errors.shape == (6, 5)
    np.testing.assert_allclose(errors, ((x - y) ** 2).sum(-1) / 3, rtol=1e-6)
    assert psnr(errors.mean()) == pytest.approx(-10 * np.log10(((x - y) ** 2).mean()))
