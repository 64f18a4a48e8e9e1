import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from scipy.special import softmax

from sagesplat.demo.capture import demo_cameras
from sagesplat.demo.render import render_view
from sagesplat.segment import crf
from sagesplat.segment.crf import Lattice, bilateral_features, refine


def exact(features: np.ndarray) -> np.ndarray:
    """The symmetrically normalised Gaussian kernel [N, N] of features in standard deviations."""
    square = ((features[:, None] - features[None]) ** 2).sum(2)
    kernel = np.exp(-square / 2)
    scale = 1 / np.sqrt(kernel.sum(1))
    return scale[:, None] * kernel * scale


def oracle(p: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Mean-field inference with whole matrices in float64."""
    v, u = np.indices(photo.shape[:2])
    place = np.stack([u, v], 2).reshape(-1, 2) / crf.SPATIAL_XY_STD
    alike = crf.BILATERAL_WEIGHT * exact(bilateral_features(photo))
    both = alike + crf.SPATIAL_WEIGHT * exact(place)
    log_p = np.log(np.maximum(p.reshape(len(p), -1).astype(float), 1e-5))
    q = softmax(log_p, axis=0)
    for _ in range(crf.ITERATIONS):
        q = softmax(log_p + q @ both, axis=0)
    return q.reshape(p.shape)


def photo_of(kind: str, height: int, width: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    if kind == "garden":
        return render_view(demo_cameras(6, width, height, 0)[0])[0]
    if kind == "noise":
        return rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    photo = np.full((height, width, 3), 60.0)
    photo[:, width // 2 :] = 140
    photo[3 * height // 4 :] = [20, 90, 40]
    return (photo + rng.normal(0, 2, photo.shape)).clip(0, 255).astype(np.uint8)


def smooth_probabilities(classes: int, height: int, width: int, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(classes, height, width))
    return softmax(12 * gaussian_filter(noise, (0, 4, 4)), axis=0).astype(np.float32)


@pytest.mark.parametrize("kind", ["garden", "noise", "edges"])
def test_agrees_with_whole_matrices(kind: str) -> None:
    p, photo = smooth_probabilities(4, 30, 37), photo_of(kind, 30, 37)
    expected = oracle(p, photo)
    assert (expected.argmax(0) != p.argmax(0)).mean() > 0.01  # there is something to agree on
    q = refine(p, photo)
    assert q.shape == p.shape
    assert q.dtype == np.float32
    np.testing.assert_allclose(q.sum(0), 1, atol=1e-5)
    assert np.abs(q - expected).mean() < 0.01
    assert (q.argmax(0) == expected.argmax(0)).mean() > 0.985


@pytest.mark.parametrize("std", [1.0, 2.5])
def test_the_filter_of_place_is_exact(std: float, monkeypatch) -> None:
    monkeypatch.setattr(crf, "BILATERAL_WEIGHT", 0.0)
    monkeypatch.setattr(crf, "SPATIAL_XY_STD", std)
    p, photo = smooth_probabilities(3, 12, 17), photo_of("noise", 12, 17)
    np.testing.assert_allclose(refine(p, photo), oracle(p, photo), atol=2e-3)


@pytest.mark.parametrize("dimensions", [1, 2, 3, 5])
def test_lattice_is_a_gaussian_filter(dimensions: int) -> None:
    rng = np.random.default_rng(dimensions)
    features = rng.uniform(0, 4, (400, dimensions))
    lattice, x = Lattice(features), rng.random((2, 400)).astype(np.float32)
    scale = 1 / np.sqrt(lattice(np.ones((1, 400), np.float32)))
    filtered, expected = scale * lattice(scale * x), x @ exact(features)
    assert np.abs(filtered - expected).mean() < 0.03 * expected.mean()


@given(st.integers(0, 2**31), st.integers(1, 5), st.floats(0.01, 300))
@settings(max_examples=25)
def test_lattice_is_linear_and_symmetric_and_keeps_no_negative(
    seed: int, dimensions: int, spread: float
) -> None:
    rng = np.random.default_rng(seed)
    features = rng.uniform(-spread, spread, (30, dimensions))
    lattice = Lattice(features)
    x, y = rng.random((2, 1, 30)).astype(np.float32)
    both = lattice(np.concatenate([x, y, 2 * x + y]))
    np.testing.assert_allclose(both[2], 2 * both[0] + both[1], rtol=1e-4, atol=1e-6)
    assert (both > 0).all()  # a point keeps some of its own
    np.testing.assert_allclose(lattice(x), both[:1], rtol=1e-5)


def test_borders_move_to_the_edges_of_the_photo() -> None:
    photo = np.full((48, 64, 3), 50, np.uint8)
    photo[:, 30:] = [180, 160, 90]  # the edge
    u = np.arange(64) + 0.5
    left = 1 / (1 + np.exp((u - 36) / 4))  # the network says: at 36, and is unsure
    p = np.broadcast_to(np.stack([left, 1 - left])[:, None], (2, 48, 64)).astype(np.float32)
    labels = refine(p, photo).argmax(0)
    assert (p.argmax(0)[:, 30:36] == 0).all()
    assert (labels == (u > 30)).all()
