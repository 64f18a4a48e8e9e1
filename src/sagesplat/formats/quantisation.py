"""Quantisation: SPZ's, for quantisation-aware training of nested levels, and what formats of bytes share."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from sagesplat.core.gaussians import Gaussians

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


def in_buckets(shN: Tensor, bits: tuple[int, int]) -> Tensor:
    """SH coefficients [N, K, 3] in multiples of 2^(1 - bits); `bits` for degree 1, and for 2 and 3."""
    steps = shN.new_tensor([2.0 ** (1 - bits[0])] * 3 + [2.0 ** (1 - bits[1])] * 12)[: shN.shape[1], None]
    return torch.round(shN.clamp(-1, 1) / steps) * steps


def rounded(g: Gaussians, sh_bits: tuple[int, int]) -> Gaussians:
    """`g` with sh0, log scales and shN quantised as in coarse SPZ files (straight-through gradients).

    Positions, opacities and rotations stay as they are: their quantisation costs almost no quality.
    """
    quantised = {
        "sh0": (in_steps(g.sh0 * PER_COLOUR + 127.5, COLOUR_STEP) - 127.5) / PER_COLOUR,
        "log_scales": in_steps(g.log_scales, SCALE_STEP / PER_LOG_SCALE),
        "shN": in_buckets(g.shN, sh_bits),
    }
    now = g.parameters()
    return replace(g, **{name: now[name] + (value - now[name]).detach() for name, value in quantised.items()})
