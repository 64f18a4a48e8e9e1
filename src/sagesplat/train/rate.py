"""What harmonics cost in a coded stream, as a loss: the rate of rate-distortion optimisation.

A coefficient of q steps takes about log2(1 + |q|) bits. With a small weight of that in the loss, harmonics
that show little become zero. HAC and ContextGS do it with learned entropy models; here the estimate is fixed.
"""

import math

import numpy as np
import torch
from jaxtyping import Float32
from numba import prange
from torch import Tensor

from sagesplat.formats.quantisation import sh_steps
from sagesplat.kernels.jit import njit

_LOG_2 = math.log(2)


def estimated_bits(shN: Float32[Tensor, "N K 3"], sh_bits: tuple[int, int]) -> Tensor:
    """Bits of the harmonics of each Gaussian [N], about; `sh_bits` as in `formats.quantisation`."""
    return torch.log2(1 + shN.abs() / sh_steps(shN, sh_bits)).flatten(1).sum(1)


def add_gradient(
    grad: Float32[Tensor, "M K 3"],
    shN: Float32[Tensor, "N K 3"],
    sh_bits: tuple[int, int],
    weight: float,
    rows: Tensor | None = None,
) -> None:
    """Add the gradient of `weight` times the mean of `estimated_bits` over some rows, in place.

    `rows`: indices [M] of those in `shN` that `grad` is of; None: all. Where a coefficient is 0 it is 0.
    """
    weight /= max(len(grad), 1) * _LOG_2
    if grad.is_cuda:
        own = shN if rows is None else shN[rows]
        grad += weight * own.sign() / (sh_steps(own, sh_bits) + own.abs())
        return
    index = np.arange(len(grad)) if rows is None else rows.numpy()
    steps = np.repeat(sh_steps(shN, sh_bits)[:, 0].numpy(), 3)
    grads, values = (a.detach().numpy().reshape(len(a), len(steps)) for a in (grad, shN))
    _add(grads, values, steps, np.float32(weight), index)


@njit(parallel=True, cache=True, error_model="numpy")
def _add(grad, values, steps, weight, rows):
    zero = np.float32(0)
    for i in prange(len(rows)):
        row = values[rows[i]]
        for k in range(len(steps)):  # without branches: vectors
            value = row[k]
            slope = weight / (steps[k] + abs(value))
            grad[i, k] += slope if value > zero else (-slope if value < zero else zero)
