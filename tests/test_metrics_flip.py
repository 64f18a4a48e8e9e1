"""FLIP by flip-evaluator: its map, its pixels per degree, and the line where it is missing."""

import numpy as np
import pytest

from sagesplat.core.errors import BackendUnavailable
from sagesplat.metrics import flip
from sagesplat.metrics.flip import PIXELS_PER_DEGREE, flip_map


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    pytest.importorskip("flip_evaluator", reason="needs the extra flip")
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
    pytest.importorskip("flip_evaluator", reason="needs the extra flip")
    black = np.zeros((16, 16, 3), np.float32)
    assert flip_map(black, black + 1).mean() > 0.9


def test_noise_of_smaller_pixels_is_less_visible(pair):
    x, y = pair
    near, default, far = (float(flip_map(x, y, ppd).mean()) for ppd in (33, PIXELS_PER_DEGREE, 134))
    assert near > default > far
    assert float(flip_map(x, y).mean()) == default


def test_without_the_package_one_line_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(flip, "find_spec", lambda name: None)
    image = np.zeros((8, 8, 3), np.float32)
    with pytest.raises(
        BackendUnavailable, match=r"no FLIP: flip-evaluator is not installed; .*sagesplat\[flip\]"
    ):
        flip_map(image, image)
