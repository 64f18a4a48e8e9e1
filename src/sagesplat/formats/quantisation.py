"""Values rounded as the files of a nested ladder hold them, so that training can get used to it."""

from dataclasses import replace

import torch
from torch import Tensor

from sagesplat.core.gaussians import Gaussians

PER_COLOUR = 0.15 * 255  # bytes of SPZ a unit of sh0
PER_LOG_SCALE = 16
COLOUR_STEP = 2  # bytes
SCALE_STEP = 2


def in_steps(values: Tensor, step: float) -> Tensor:
    """The nearest multiples of `step`."""
    return torch.round(values / step) * step


def in_buckets(shN: Tensor, bits: tuple[int, int]) -> Tensor:
    """Harmonics [N, K, 3] as SPZ stores them: multiples of 2^(1 - bits), of degree 1 and of those above."""
    steps = shN.new_tensor([2.0 ** (1 - bits[0])] * 3 + [2.0 ** (1 - bits[1])] * 12)[: shN.shape[1], None]
    return torch.round(shN.clamp(-1, 1) / steps) * steps


def rounded(g: Gaussians, sh_bits: tuple[int, int]) -> Gaussians:
    """Colours, scales and harmonics as `output.spz` writes them, gradients passing as if they were not.

    Positions, opacities and rotations lose nothing that is worth the time.
    """
    sent = {
        "sh0": (in_steps(g.sh0 * PER_COLOUR + 127.5, COLOUR_STEP) - 127.5) / PER_COLOUR,
        "log_scales": in_steps(g.log_scales, SCALE_STEP / PER_LOG_SCALE),
        "shN": in_buckets(g.shN, sh_bits),
    }
    now = g.parameters()
    return replace(g, **{name: now[name] + (value - now[name]).detach() for name, value in sent.items()})
