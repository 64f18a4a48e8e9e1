"""Adam over rows: one fused, parallel pass; rows outside the mask keep parameter and moments untouched."""

from collections.abc import Mapping

import numpy as np
import torch
from numba import prange
from torch import Tensor

from sagesplat.core.gaussians import PARAMETERS
from sagesplat.core.sh import num_bases
from sagesplat.kernels.jit import njit
from sagesplat.kernels.simd import LANES, load, sqrt, store
from sagesplat.train.state import SECOND, TrainState

_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-15
_CHUNK = 4096


@njit(error_model="numpy", forceinline=True, cache=True)
def _new_moments(grad, g_at, exp_avg, exp_avg_sq, at):
    b1, b2 = np.float32(_BETA1), np.float32(_BETA2)
    new1, new2 = np.float32(1 - _BETA1), np.float32(1 - _BETA2)
    g = load(grad, g_at)
    return b1 * load(exp_avg, at) + new1 * g, b2 * load(exp_avg_sq, at) + new2 * g * g


@njit(error_model="numpy", forceinline=True, cache=True)
def _moved(parameter, at, m, v, rate, correction):
    return load(parameter, at) - rate * m / (sqrt(v) * correction + np.float32(_EPS))


@njit(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", forceinline=True, cache=True)
def _update(parameter, at, grad, g_at, exp_avg, exp_avg_sq, rate, correction, length):
    """Values from `at` on, by their gradients from `g_at` on."""
    if length < LANES:
        b1, b2, eps = np.float32(_BETA1), np.float32(_BETA2), np.float32(_EPS)
        new1, new2 = np.float32(1 - _BETA1), np.float32(1 - _BETA2)
        for k in range(length):
            g = grad[g_at + k]
            m = b1 * exp_avg[at + k] + new1 * g
            v = b2 * exp_avg_sq[at + k] + new2 * g * g
            exp_avg[at + k] = m
            exp_avg_sq[at + k] = v
            parameter[at + k] -= rate * m / (np.sqrt(v) * correction + eps)
        return
    last = length - LANES  # the last vector overlaps the one before: read first, written last
    m_last, v_last = _new_moments(grad, g_at + last, exp_avg, exp_avg_sq, at + last)
    p_last = _moved(parameter, at + last, m_last, v_last, rate, correction)
    for k in range(0, last, LANES):
        m, v = _new_moments(grad, g_at + k, exp_avg, exp_avg_sq, at + k)
        store(parameter, at + k, _moved(parameter, at + k, m, v, rate, correction))
        store(exp_avg, at + k, m)
        store(exp_avg_sq, at + k, v)
    store(parameter, at + last, p_last)
    store(exp_avg, at + last, m_last)
    store(exp_avg_sq, at + last, v_last)


@njit(parallel=True, error_model="numpy", cache=True)
def _update_rows(parameter, grad, exp_avg, exp_avg_sq, rate, correction, trainable, columns):
    """Flat arrays of N * width values; runs of trainable rows are updated together."""
    n = len(trainable)
    width = len(parameter) // n
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        row, end = chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)
        while row < end:
            stop = row
            while stop < end and trainable[stop]:
                stop += 1
            if columns < width:
                for r in range(row, stop):
                    at = r * width
                    _update(parameter, at, grad, at, exp_avg, exp_avg_sq, rate, correction, columns)
            elif stop > row:
                at, length = row * width, (stop - row) * width
                _update(parameter, at, grad, at, exp_avg, exp_avg_sq, rate, correction, length)
            row = stop + 1


@njit(parallel=True, error_model="numpy", cache=True)
def _update_drawn(parameter, grad, exp_avg, exp_avg_sq, rate, correction, trainable, columns, drawn):
    """The same for the rows `drawn` alone, of which `grad` has one each."""
    width = len(parameter) // len(trainable)
    for i in prange(len(drawn)):
        if trainable[drawn[i]]:
            at = drawn[i] * width
            _update(parameter, at, grad, i * width, exp_avg, exp_avg_sq, rate, correction, columns)


def adam_step(
    parameter: np.ndarray,  # [N, ...] float32, changed in place
    grad: np.ndarray,  # the same, or [M, ...] of the rows `drawn`
    exp_avg: np.ndarray,  # moments, changed in place
    exp_avg_sq: np.ndarray,
    *,
    lr: float,
    step: int,  # 1 for the first
    trainable: np.ndarray,  # bool [N]
    columns: int | None = None,
    drawn: np.ndarray | None = None,  # indices of M rows
) -> None:
    """One Adam step (Kingma and Ba, betas 0.9 and 0.999, eps 1e-15 as 3DGS).

    `columns`: update only this many values at the start of each row; the others never had a gradient.
    `drawn`: the other rows keep parameter and moments, as those that are not `trainable`.
    """
    if not parameter.size or columns == 0:
        return
    rate = np.float32(lr / (1 - _BETA1**step))
    correction = np.float32((1 - _BETA2**step) ** -0.5)
    grad = np.ascontiguousarray(grad).reshape(-1)
    flat = parameter.reshape(-1), grad, exp_avg.reshape(-1), exp_avg_sq.reshape(-1), rate, correction
    width = parameter.size // len(parameter)
    columns = width if columns is None else columns
    if drawn is None:
        _update_rows(*flat, trainable, columns)
    else:
        _update_drawn(*flat, trainable, columns, drawn)


def update(
    state: TrainState,
    grads: Mapping[str, Tensor],
    rates: Mapping[str, float],
    degree: int,
    trainable: Tensor,
    second_weights: Tensor | None = None,
    drawn: Tensor | None = None,
) -> None:
    """Adam's step number `state.step` on all parameters, on the device that they are on.

    `second_weights`: [N], of the second opacities in what was drawn; where 0, these stay as they are.
    `drawn`: indices of the rows that the gradients are of; the others stay as they are. None: all.
    """
    for name in PARAMETERS:
        columns = 3 * (num_bases(degree) - 1) if name == "shN" else None
        own = getattr(state.gaussians, name)
        _update_one(state, name, own, grads, rates[name], trainable, columns, drawn)
    if state.second_opacities is not None and second_weights is not None:
        own, rows = state.second_opacities, trainable & (second_weights > 0)
        _update_one(state, SECOND, own, grads, rates["logit_opacities"], rows, None, drawn)


def _update_one(
    state: TrainState,
    name: str,
    parameter: Tensor,
    grads: Mapping[str, Tensor],
    lr: float,
    trainable: Tensor,
    columns: int | None,
    drawn: Tensor | None,
) -> None:
    grad, moments = grads[name], (state.exp_avg[name], state.exp_avg_sq[name])
    how = {"lr": lr, "step": state.step, "columns": columns}
    if trainable.is_cuda:
        from sagesplat.train import adam_triton

        if drawn is not None:
            grad, trainable = _spread(grad, drawn, trainable)
        adam_triton.adam_step(parameter, grad, *moments, trainable=trainable, **how)
    else:
        arrays = (t.detach().numpy() for t in (parameter, grad, *moments))
        rows = None if drawn is None else drawn.numpy()
        adam_step(*arrays, trainable=trainable.numpy(), drawn=rows, **how)


def _spread(grad: Tensor, rows: Tensor, trainable: Tensor) -> tuple[Tensor, Tensor]:
    """The gradient of some rows among zeros for all, and the trainable ones among these rows."""
    spread = grad.new_zeros(len(trainable), *grad.shape[1:])
    spread[rows] = grad
    there = torch.zeros_like(trainable)
    there[rows] = trainable[rows]
    return spread, there
