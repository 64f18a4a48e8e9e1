"""Adam over rows: one fused, parallel pass; rows outside the mask keep parameter and moments untouched."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numba import prange
from torch import Tensor

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


@njit(error_model="numpy", cache=True)
def _update_chunk(chunk, parameter, grad, exp_avg, exp_avg_sq, rate, correction, trainable, columns):
    """Rows of a chunk; runs of trainable ones are updated together."""
    width = len(parameter) // len(trainable)
    row, end = chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(trainable))
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


@njit(error_model="numpy", cache=True)
def _update_drawn_chunk(
    chunk, parameter, grad, exp_avg, exp_avg_sq, rate, correction, trainable, columns, drawn
):  # fmt: skip
    """The same for a chunk of the rows `drawn`, of which `grad` has one each."""
    width = len(parameter) // len(trainable)
    for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(drawn))):
        if trainable[drawn[i]]:
            at = drawn[i] * width
            _update(parameter, at, grad, i * width, exp_avg, exp_avg_sq, rate, correction, columns)


@njit(parallel=True, error_model="numpy", cache=True)
def _update_rows(parameters, grads, exp_avg, exp_avg_sq, rates, correction, trainable, columns, drawn):
    """Tuples of flat arrays of N * width values: to start threads takes as long as a small one of them.

    Of the rows `drawn` alone, or where there are none of all.
    """
    count = len(drawn) if len(drawn) else len(trainable)
    chunks, several = (count + _CHUNK - 1) // _CHUNK, len(parameters)
    for job in prange(chunks * several):
        k, chunk = job % several, job // several
        # chunks by functions of their own: to take an array out of a tuple costs as much as a row
        arrays = parameters[k], grads[k], exp_avg[k], exp_avg_sq[k]
        how = rates[k], correction, trainable, columns[k]
        if columns[k] and len(drawn):
            _update_drawn_chunk(chunk, *arrays, *how, drawn)
        elif columns[k]:
            _update_chunk(chunk, *arrays, *how)


def adam_steps(
    *arrays: Sequence[np.ndarray],
    rates: Sequence[float],
    step: int,  # 1 for the first
    trainable: np.ndarray,  # bool [N]
    columns: Sequence[int | None],
    drawn: np.ndarray | None = None,  # indices of M rows
) -> None:
    """One Adam step of several parameters (Kingma and Ba, betas 0.9 and 0.999, eps 1e-15 as 3DGS).

    `arrays`: the parameters, [N, ...] float32; their gradients, the same or [M, ...] of the rows `drawn`;
    both moments. Parameters and moments are changed in place. `columns`: update only as many values at the
    start of each row; the others never had a gradient. `drawn`: the other rows keep parameter and moments, as
    those that are not `trainable`.
    """
    n = len(trainable)
    if not n or (drawn is not None and not len(drawn)):
        return
    in_use = [a.size // n if c is None else c for a, c in zip(arrays[0], columns, strict=True)]
    per_step = np.array([lr / (1 - _BETA1**step) for lr in rates], np.float32)
    correction = np.float32((1 - _BETA2**step) ** -0.5)
    flat = [tuple(np.ascontiguousarray(a).reshape(-1) for a in several) for several in arrays]
    drawn = np.empty(0, np.int64) if drawn is None else drawn
    _update_rows(*flat, per_step, correction, trainable, np.array(in_use), drawn)


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
    own = state.gaussians.parameters()
    columns = {"shN": 3 * (num_bases(degree) - 1)}
    _update_some(state, own, grads, rates, trainable, columns, drawn)
    if state.second_opacities is not None and second_weights is not None:
        own, rows = {SECOND: state.second_opacities}, trainable & (second_weights > 0)
        _update_some(state, own, grads, {SECOND: rates["logit_opacities"]}, rows, {}, drawn)


def _update_some(
    state: TrainState,
    parameters: Mapping[str, Tensor],
    grads: Mapping[str, Tensor],
    rates: Mapping[str, float],
    trainable: Tensor,
    columns: Mapping[str, int],
    drawn: Tensor | None,
) -> None:
    tensors = parameters, grads, state.exp_avg, state.exp_avg_sq
    if not trainable.is_cuda:
        of_name = ([t[name].detach().numpy() for name in parameters] for t in tensors)
        adam_steps(
            *of_name, rates=[rates[name] for name in parameters], step=state.step,
            trainable=trainable.numpy(), columns=[columns.get(name) for name in parameters],
            drawn=None if drawn is None else drawn.numpy(),
        )  # fmt: skip
        return
    from sagesplat.train import adam_triton

    for name in parameters:
        parameter, grad, *moments = (t[name] for t in tensors)
        rows = trainable
        if drawn is not None:
            grad, rows = _spread(grad, drawn, trainable)
        how = {"lr": rates[name], "step": state.step, "columns": columns.get(name)}
        adam_triton.adam_step(parameter, grad, *moments, trainable=rows, **how)


def _spread(grad: Tensor, rows: Tensor, trainable: Tensor) -> tuple[Tensor, Tensor]:
    """The gradient of some rows among zeros for all, and the trainable ones among these rows."""
    spread = grad.new_zeros(len(trainable), *grad.shape[1:])
    spread[rows] = grad
    there = torch.zeros_like(trainable)
    there[rows] = trainable[rows]
    return spread, there
