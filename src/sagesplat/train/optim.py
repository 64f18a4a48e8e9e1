"""Adam over rows: one fused, parallel pass; rows outside the mask keep parameter and moments untouched."""

from collections.abc import Mapping

import numpy as np
import torch
from numba import prange
from torch import Tensor

from sagesplat.core.gaussians import PARAMETERS
from sagesplat.core.sh import num_bases
from sagesplat.kernels.jit import njit
from sagesplat.train.state import SECOND, TrainState

_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-15
_CHUNK = 4096


@njit(fastmath={"contract", "nsz", "arcp"}, error_model="numpy", cache=True)
def _update(parameter, grad, exp_avg, exp_avg_sq, rate, correction):
    b1, b2, eps = np.float32(_BETA1), np.float32(_BETA2), np.float32(_EPS)
    new1, new2 = np.float32(1 - _BETA1), np.float32(1 - _BETA2)
    for i in range(np.uint64(len(parameter))):
        g = grad[i]
        m = b1 * exp_avg[i] + new1 * g
        v = b2 * exp_avg_sq[i] + new2 * g * g
        exp_avg[i] = m
        exp_avg_sq[i] = v
        parameter[i] -= rate * m / (np.sqrt(v) * correction + eps)


@njit(parallel=True, cache=True)
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
                    a, b = r * width, r * width + columns
                    _update(parameter[a:b], grad[a:b], exp_avg[a:b], exp_avg_sq[a:b], rate, correction)
            elif stop > row:
                a, b = row * width, stop * width
                _update(parameter[a:b], grad[a:b], exp_avg[a:b], exp_avg_sq[a:b], rate, correction)
            row = stop + 1


@njit(parallel=True, cache=True)
def _update_drawn(parameter, grad, exp_avg, exp_avg_sq, rate, correction, trainable, columns, drawn):
    """The same for the rows `drawn` alone, ascending, of which `grad` has one each."""
    width = len(parameter) // len(trainable)
    for chunk in prange((len(drawn) + _CHUNK - 1) // _CHUNK):
        i, end = chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(drawn))
        while i < end:
            begin, row = i, drawn[i]
            i += 1
            if not trainable[row]:
                continue
            if columns == width:  # rows that follow each other are updated together
                while i < end and drawn[i] == row + i - begin and trainable[drawn[i]]:
                    i += 1
            a, b = row * width, (row + i - begin - 1) * width + columns
            own = grad[begin * width : begin * width + b - a]
            _update(parameter[a:b], own, exp_avg[a:b], exp_avg_sq[a:b], rate, correction)


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
