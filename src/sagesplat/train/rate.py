"""What harmonics cost in a coded stream, as a loss: the rate of rate-distortion optimisation.

A coefficient of q steps takes about log2(1 + |q|) bits. With a small weight of that in the loss, harmonics
that show little become zero. HAC and ContextGS do it with learned entropy models; here the estimate is fixed.
"""

import math

import numpy as np
from jaxtyping import Float32
from numba import prange
from torch import Tensor

from sagesplat.formats.quantisation import sh_steps
from sagesplat.kernels.jit import njit
from sagesplat.kernels.simd import LANES, load, maximum, splat, store, where

_LOG_2 = math.log(2)


def add_gradient(
    grad: Float32[Tensor, "M K 3"],
    shN: Float32[Tensor, "N K 3"],
    sh_bits: tuple[int, int],
    weight: float,
    rows: Tensor | None = None,
) -> None:
    """Add the gradient of `weight` times the mean bits of the harmonics of some Gaussians, in place.

    `sh_bits`: as in `formats.quantisation`. `rows`: indices [M] of those in `shN` that `grad` is of; None:
    all. Where a coefficient is 0 it is 0.
    """
    weight /= max(len(grad), 1) * _LOG_2
    if grad.is_cuda:
        own = shN if rows is None else shN[rows]
        grad += weight * own.sign() / (sh_steps(own, sh_bits) + own.abs())
        return
    index = np.arange(len(grad)) if rows is None else rows.numpy()
    steps = np.repeat(sh_steps(shN, sh_bits)[:, 0].numpy(), 3)
    grads, values = (a.detach().numpy().reshape(-1) for a in (grad, shN))
    _add(grads, values, steps, np.float32(weight), index)


@njit(parallel=True, cache=True, error_model="numpy")
def _add(grad, values, steps, weight, rows):
    """Flat arrays of rows of `len(steps)` values, LANES at a time; 0 where a value is 0."""
    width = len(steps)
    last = width - LANES
    for i in prange(len(rows)):
        at, to = rows[i] * width, i * width
        if last < 0:
            for k in range(width):
                value = values[at + k]
                slope = weight / (steps[k] + abs(value))
                grad[to + k] += slope if value > 0 else (-slope if value < 0 else np.float32(0))
            continue
        # the last vector overlaps the one before: read first, written last
        at_end = _with_slope(grad, to + last, values, at + last, steps, last, weight)
        for k in range(0, last, LANES):
            store(grad, to + k, _with_slope(grad, to + k, values, at + k, steps, k, weight))
        store(grad, to + last, at_end)


@njit(error_model="numpy", forceinline=True, cache=True)
def _with_slope(grad, to, values, at, steps, k, weight):
    value, zero = load(values, at), np.float32(0)
    slope = splat(weight) / (load(steps, k) + maximum(value, -value))
    return load(grad, to) + where(value > zero, slope, where(value < zero, -slope, zero))
