"""FLIP: its map is that of flip-evaluator, its pixels per degree count."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sagesplat.metrics.flip import PIXELS_PER_DEGREE, flip_map


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    x = rng.random((40, 60, 3), np.float32)
    return x, (x + 0.2 * rng.standard_normal(x.shape)).clip(0, 1).astype(np.float32)


def test_a_map_of_the_visible_difference(pair):
    x, y = pair
    before = x.copy(), y.copy()
    found = flip_map(y, x)
    assert found.shape == (40, 60)
    assert found.dtype == np.float32
    assert 0 < found.mean() < 1
    assert flip_map(x, x).max() == 0
    np.testing.assert_array_equal(before, pair)  # not written to
    half = np.concatenate([x[:, :30], y[:, 30:]], 1)
    assert flip_map(half, x)[:, :10].max() < 1e-3 < flip_map(half, x)[:, 40:].min()
    wide = np.repeat(x, 2, axis=1)[:, ::2]  # the same image in other memory
    np.testing.assert_array_equal(flip_map(y, wide), found)


def test_black_and_white_differ_most():
    black = np.zeros((16, 16, 3), np.float32)
    assert flip_map(black, black + 1).mean() > 0.9


def test_noise_of_smaller_pixels_is_less_visible(pair):
    x, y = pair
    near, default, far = (float(flip_map(x, y, ppd).mean()) for ppd in (33, PIXELS_PER_DEGREE, 134))
    assert near > default > far
    assert float(flip_map(x, y).mean()) == default


@pytest.mark.parametrize(("shape", "ppd"), [((72, 96), PIXELS_PER_DEGREE), ((90, 40), 33), ((7, 9), 134)])
def test_the_map_is_that_of_its_authors(shape, ppd):
    evaluator = pytest.importorskip("flip_evaluator", reason="needs flip-evaluator, of the extra dev")
    rng = np.random.default_rng(1)
    x = (2 * gaussian_filter(rng.random((*shape, 3)), (3, 3, 0)) - 0.5).clip(0, 1).astype(np.float32)
    y = (x + gaussian_filter(rng.standard_normal(x.shape), (1, 1, 0))).clip(0, 1).astype(np.float32)
    how = {"ppd": float(ppd)}
    theirs = evaluator.evaluate(x, y, "LDR", applyMagma=False, computeMeanError=False, parameters=how)[0]
    np.testing.assert_allclose(flip_map(y, x, ppd), theirs[..., 0], atol=1e-5)
    pure = np.zeros((1, 40, 3), np.float32)
    pure[:, :20, 1] = pure[:, 20:, 2] = 1  # green, blue: the largest difference of colour
    assert flip_map(pure[:, :20], pure[:, 20:]).max() == pytest.approx(1, abs=1e-5)
