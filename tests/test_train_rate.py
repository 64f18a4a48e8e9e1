"""Bits of harmonics as a loss: the gradient, what it does, and rows that are left alone."""

import numpy as np
import pytest
import torch
from conftest import random_gaussians

from sagesplat.formats.quantisation import in_buckets, sh_steps
from sagesplat.train.rate import add_gradient

BITS = (5, 4)


def estimated_bits(shN: torch.Tensor, sh_bits: tuple[int, int]) -> torch.Tensor:
    """Bits of the harmonics of each Gaussian [N], about."""
    return torch.log2(1 + shN.abs() / sh_steps(shN, sh_bits)).flatten(1).sum(1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("some", [False, True])
def test_the_gradient_is_that_of_the_mean_of_estimated_bits(degree, some):
    shN = random_gaussians(200, degree=degree).shN.clone()
    shN[::3] = 0  # no gradient there
    rows = torch.from_numpy(np.random.default_rng(0).permutation(200)[:70]) if some else None
    leaf = (shN if rows is None else shN[rows]).clone().requires_grad_()
    (0.7 * estimated_bits(leaf, BITS).mean()).backward()
    before = torch.randn_like(leaf)
    grad = before.clone()
    add_gradient(grad, shN, BITS, 0.7, rows)
    assert leaf.grad is not None
    torch.testing.assert_close(grad - before, leaf.grad, rtol=1e-4, atol=1e-6)


def test_bits_are_nothing_for_zeros_and_one_more_for_twice_as_many_steps():
    none, one, seven = (torch.full((1, 15, 3), value) for value in (0.0, 2.0**-3, 7 * 2.0**-3))
    assert estimated_bits(none, BITS) == 0
    assert estimated_bits(one, (4, 4)) == 45
    assert estimated_bits(seven, (4, 4)) == 3 * 45


def test_descent_makes_zeros_of_what_shows_little():
    """Least squares: what is far from zero stays near its target, what is near becomes zero."""
    target = torch.zeros(50, 15, 3)
    target[:, 0], target[:, 5] = 0.5, 0.07
    shN = target.clone()
    for _ in range(400):
        grad = 2 * (shN - target) / len(shN)
        add_gradient(grad, shN, BITS, 0.02)
        shN -= 0.5 * grad
    sent = in_buckets(shN, BITS)
    assert (in_buckets(target, BITS)[:, 5] != 0).all()
    assert (sent[:, 5] == 0).all()
    assert ((sent[:, 0] - 0.5).abs() <= 2.0**-4).all()
    assert (sent[:, 1] == 0).all()
