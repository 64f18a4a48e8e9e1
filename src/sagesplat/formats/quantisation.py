"""Quantisation: SPZ's, for quantisation-aware training of nested levels, and what formats of bytes share."""

from dataclasses import replace

import numpy as np
import torch
from numba import prange
from torch import Tensor

from sagesplat.core.gaussians import Gaussians
from sagesplat.kernels.jit import njit

PER_COLOUR = 0.15 * 255  # SPZ units (of a byte) per unit of sh0
PER_LOG_SCALE = 16  # SPZ units per unit of log scale
COLOUR_STEP = 2  # SPZ units, in coarse files
SCALE_STEP = 2


OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # components other than the largest


def logits_of_bytes(alphas: np.ndarray) -> np.ndarray:
    """Opacity logits, float32 and finite: 0 and 255 count as a quarter of a step further inside."""
    opacities = alphas.clip(0.25, 254.75) / 255
    return np.log(opacities / (1 - opacities)).astype(np.float32)


def largest_restored(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Unit quaternions [N, 4] from the index of the largest component, positive, and the others [N, 3]."""
    q = np.empty((len(others), 4))
    np.put_along_axis(q, OTHERS[largest], others, axis=1)
    q[np.arange(len(q)), largest] = np.sqrt((1 - (others**2).sum(1)).clip(0))
    return q


def in_steps(values: Tensor, step: float) -> Tensor:
    """`values` rounded to multiples of `step`."""
    return torch.round(values / step) * step


def sh_steps(shN: Tensor, bits: tuple[int, int]) -> Tensor:
    """Steps [K, 1] that SH coefficients [N, K, 3] are rounded to; `bits` for degree 1, and for 2 and 3."""
    return shN.new_tensor([2.0 ** (1 - bits[0])] * 3 + [2.0 ** (1 - bits[1])] * 12)[: shN.shape[1], None]


def in_buckets(shN: Tensor, bits: tuple[int, int]) -> Tensor:
    """SH coefficients [N, K, 3] in multiples of 2^(1 - bits); see `sh_steps`."""
    steps = sh_steps(shN, bits)
    return torch.round(shN.clamp(-1, 1) / steps) * steps


def rounded(g: Gaussians, sh_bits: tuple[int, int], rows: Tensor | None = None) -> Gaussians:
    """`g`, or those of some `rows` (indices), with sh0, log scales and shN quantised as in coarse SPZ files.

    Positions, opacities and rotations stay as they are: their quantisation costs almost no quality. The
    result has no graph: training takes gradients by the rounded values (straight-through estimator).
    """
    g = g.detach()
    if g.means.is_cuda:
        g = g if rows is None else g.select(rows)
        sh0 = (in_steps(g.sh0 * PER_COLOUR + 127.5, COLOUR_STEP) - 127.5) / PER_COLOUR
        log_scales, shN = in_steps(g.log_scales, SCALE_STEP / PER_LOG_SCALE), in_buckets(g.shN, sh_bits)
        return replace(g, sh0=sh0, log_scales=log_scales, shN=shN)
    index = np.arange(len(g)) if rows is None else rows.numpy()
    steps = np.repeat(sh_steps(g.shN, sh_bits)[:, 0].numpy(), 3)
    flat = (g.sh0.flatten(1), g.log_scales, g.shN.flatten(1))
    found = _rounded_rows(*(values.numpy() for values in flat), index, steps)
    sh0, log_scales, shN = map(torch.from_numpy, found)
    values = {"sh0": sh0[:, None], "log_scales": log_scales}
    values["shN"] = shN.reshape(len(index), *g.shN.shape[1:])
    if rows is not None:
        others = (g.means, g.quats, g.logit_opacities, g.label_ids)
        gathered = map(torch.from_numpy, _gathered(*(t.numpy() for t in others), index))
        values |= zip(("means", "quats", "logit_opacities", "label_ids"), gathered, strict=True)
    return replace(g, **values)


@njit(parallel=True, cache=True)
def _gathered(means, quats, logits, labels, rows):
    """The rows of each: one pass, where torch gathers each by itself."""
    n = len(rows)
    to_means, to_quats = np.empty((n, 3), means.dtype), np.empty((n, 4), quats.dtype)
    to_logits, to_labels = np.empty(n, logits.dtype), np.empty(n, labels.dtype)
    for i in prange(n):
        row = rows[i]
        for k in range(3):
            to_means[i, k] = means[row, k]
        for k in range(4):
            to_quats[i, k] = quats[row, k]
        to_logits[i] = logits[row]
        to_labels[i] = labels[row]
    return to_means, to_quats, to_logits, to_labels


@njit(parallel=True, cache=True, error_model="numpy")
def _rounded_rows(sh0, log_scales, shN, rows, steps):
    """Gathered and rounded in one pass over memory; the same bits as `in_steps` and `in_buckets`."""
    n = len(rows)
    colours = np.empty((n, 3), np.float32)
    scales = np.empty((n, 3), np.float32)
    harmonics = np.empty((n, len(steps)), np.float32)
    per, half = np.float32(PER_COLOUR), np.float32(127.5)
    colour_step, scale_step = np.float32(COLOUR_STEP), np.float32(SCALE_STEP / PER_LOG_SCALE)
    one = np.float32(1)
    inverse = one / steps  # exact: powers of two
    for i in prange(n):
        row = rows[i]
        for c in range(3):
            in_units = np.rint((sh0[row, c] * per + half) / colour_step) * colour_step
            colours[i, c] = (in_units - half) / per
            scales[i, c] = np.rint(log_scales[row, c] / scale_step) * scale_step
        values = shN[row]
        for k in range(len(steps)):
            harmonics[i, k] = np.rint(min(max(values[k], -one), one) * inverse[k]) * steps[k]
    return colours, scales, harmonics
