"""Means over labels and decibels."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sagesplat.metrics.image import (
    means_by_label,
    pasted,
    photometric_loss,
    psnr,
    squared_error_map,
    ssim_map,
)


@settings(max_examples=40, derandomize=True)
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


def test_the_loss_does_not_look_at_pixels_that_do_not_count():
    """Whatever the photo shows there: the same bits; no gradient there, and the usual one far from there."""
    rng = np.random.default_rng(0)
    image, photo = torch.from_numpy(rng.random((2, 40, 60, 3)).astype(np.float32))
    valid = torch.ones(40, 60, dtype=torch.bool)
    valid[8:24, 16:40] = False

    def loss_and_gradient(photo, valid):
        rgb = image.clone().requires_grad_()
        loss = photometric_loss(rgb, photo, valid=valid)
        loss.backward()
        assert rgb.grad is not None
        return float(loss.detach()), rgb.grad

    loss, grad = loss_and_gradient(photo, valid)
    other = torch.where(valid[..., None], photo, torch.rand(40, 60, 3))
    again, grad_again = loss_and_gradient(other, valid)
    assert loss == again
    assert torch.equal(grad, grad_again)
    assert (grad[~valid] == 0).all()
    assert (grad[valid] != 0).all()
    whole, of_whole = loss_and_gradient(photo, None)
    assert loss < whole
    torch.testing.assert_close(grad[36:], of_whole[36:])  # beyond the windows
    nothing, none = loss_and_gradient(photo, torch.zeros_like(valid))
    assert nothing == pytest.approx(0, abs=1e-6)
    assert (none == 0).all()


def test_the_gradient_beside_pixels_that_do_not_count_is_that_of_the_loss():
    """Central differences, with the pixels that do not count held fast in both images."""
    rng = np.random.default_rng(1)
    image, photo = rng.random((2, 16, 16, 3)).astype(np.float32)
    valid = np.ones((16, 16), bool)
    valid[:, 9:] = False
    rgb = torch.from_numpy(image).requires_grad_()
    photometric_loss(rgb, torch.from_numpy(photo), valid=torch.from_numpy(valid)).backward()
    assert rgb.grad is not None
    there = pasted(photo, image, valid)
    for at in ((4, 8, 0), (7, 5, 1)):
        values = []
        for step in (1e-2, -1e-2):
            moved = image.copy()
            moved[at] += step
            values.append(float(photometric_loss(torch.from_numpy(moved), torch.from_numpy(there))))
        assert float(rgb.grad[at]) == pytest.approx((values[0] - values[1]) / 2e-2, rel=0.05)


def test_photos_as_bytes_are_pasted_as_others():
    image = torch.rand(20, 20, 3)
    photo, valid = torch.randint(0, 256, (20, 20, 3), dtype=torch.uint8), torch.rand(20, 20) < 0.7
    both = [photometric_loss(image, p, valid=valid) for p in (photo, photo.float() / 255)]
    assert both[0] == both[1]


def test_means_over_valid_pixels():
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    label_ids, valid = np.array([[3, 3, -1], [3, -1, -1]]), np.array([[1, 0, 1], [1, 0, 0]], bool)
    assert means_by_label(values, label_ids, valid) == {-1: (2.0, 1), 3: (1.5, 2)}
    assert means_by_label(values, label_ids, np.zeros_like(valid)) == {}


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
