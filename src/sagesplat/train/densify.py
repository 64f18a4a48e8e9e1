"""Adaptive density control of 3DGS (Kerbl et al. 2023, section 5): clone, split, prune, reset."""

from dataclasses import replace

import numpy as np
import torch
from numba import prange
from torch import Tensor

from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import PARAMETERS, Gaussians, concat
from sagesplat.kernels.jit import njit
from sagesplat.raster.reference import rotation_matrices
from sagesplat.raster.render import Render
from sagesplat.train.schedule import Schedule
from sagesplat.train.sky import Shell
from sagesplat.train.state import TrainState

# Thresholds of 3DGS: Gaussians larger than the first fraction of the scene extent are split, smaller ones
# cloned; fainter ones than `PRUNE_OPACITY` go, after the first opacity reset (`published` alone has any) also
# those that are larger than the last fraction.
_GROW_SCALE, PRUNE_OPACITY, _PRUNE_SCALE = 0.01, 5e-3, 0.1
_SPLIT_SHRINK = 1.6


def observe_gradients(state: TrainState, render: Render, width: int, height: int, trainable: Tensor) -> None:
    """Add a view's screen-space gradients, in half images as 3DGS measures them."""
    grad, radii = render.means2d.grad, render.radii
    assert grad is not None
    if grad.is_cuda:
        seen = (radii > 0) & trainable
        state.grad_sum += torch.hypot(grad[:, 0] * (width / 2), grad[:, 1] * (height / 2)) * seen
        state.grad_count += seen
        return
    _observe(
        grad.numpy(), radii.numpy(), trainable.numpy(), np.float32(width / 2), np.float32(height / 2),
        state.grad_sum.numpy(), state.grad_count.numpy(),
    )  # fmt: skip


@njit(parallel=True, cache=True)
def _observe(grad, radii, trainable, half_width, half_height, grad_sum, grad_count):
    for i in prange(len(radii)):
        if radii[i] > 0 and trainable[i]:
            x, y = grad[i, 0] * half_width, grad[i, 1] * half_height
            grad_sum[i] += np.sqrt(x * x + y * y)
            grad_count[i] += np.float32(1)


def budget(
    config: TrainConfig, plan: Schedule, step: int, num_pixels: int, pixels_now: int, num_points: int
) -> int:
    """How many Gaussians there may be after a step: from the points to the cap in a straight line.

    Room that opens bit by bit goes to where the error is largest at the time, and gives levels of every
    size. The cap is as set, or what photos of `num_pixels` can tell apart; the photos of the moment, of
    `pixels_now`, set one too.
    """

    most = cap(config, num_pixels, num_points)
    share = min(1.0, (step - plan.refine_start) / max(1, plan.refine_stop - plan.refine_start))
    now = max(_distinct(pixels_now, num_points), int(most * pixels_now / num_pixels))
    return min(num_points + int(share * (most - num_points)), now)


def cap(config: TrainConfig, num_pixels: int, num_points: int) -> int:
    """How many Gaussians there may be at most: as set, or what photos of `num_pixels` can tell apart."""
    return config.max_gaussians or _distinct(num_pixels, num_points)


def _distinct(pixels: int, num_points: int) -> int:
    return max(int(1.5 * pixels), 2 * num_points)


def room(state: TrainState, most: int, trainable: Tensor) -> int:
    """How many Gaussians may come now; what stopped categories would have got goes to nobody."""
    free = max(0, most - len(state.gaussians) - state.withheld)
    given = round(free * float(trainable.float().mean()))
    state.withheld += free - given
    return given


def refine(
    state: TrainState,
    config: TrainConfig,
    extent: float,
    room: int,
    trainable: Tensor,
    shell: Shell | None = None,
) -> None:
    """Clone small, split large Gaussians with high gradients; prune faint and, after a reset, huge ones."""
    g = state.gaussians
    size = g.log_scales.exp().amax(-1)
    if shell:  # on it as seen from within
        size = torch.where(shell.holds(g.means), size / shell.scale, size)
    grows = (state.grad_sum / state.grad_count.clamp_min(1) > config.grow_grad) & trainable
    if int(grows.sum()) > room:
        strength = torch.where(grows, state.grad_sum / state.grad_count.clamp_min(1), -1.0)
        grows = torch.zeros_like(grows)
        grows[torch.topk(strength, max(room, 0)).indices] = True
    small = size <= _GROW_SCALE * extent
    clones = g.select(grows & small)
    halves = _split(g.select(grows & ~small), state.rng, shell)
    faint = g.logit_opacities.sigmoid() < PRUNE_OPACITY
    if state.last_reset >= 0:
        faint |= size > _PRUNE_SCALE * extent
    state.replace_rows(~(grows & ~small) & ~(faint & trainable), concat([clones, halves]))


def _split(g: Gaussians, rng: np.random.Generator, shell: Shell | None = None) -> Gaussians:
    """Two smaller Gaussians drawn from each."""
    both = concat([g, g])
    normal = torch.from_numpy(rng.standard_normal((len(both), 3), np.float32)).to(both.means.device)
    noise = normal * both.log_scales.exp()
    shift = (rotation_matrices(both.quats) @ noise[..., None]).squeeze(-1)
    means = both.means + shift
    if shell:
        means = torch.where(shell.holds(both.means)[:, None], shell.place(means), means)
    return replace(both, means=means, log_scales=both.log_scales - float(np.log(_SPLIT_SHRINK)))


def reset_opacities(state: TrainState, trainable: Tensor) -> None:
    """Lower opacities to twice the pruning threshold; their moments start again."""
    ceiling = float(np.log(2 * PRUNE_OPACITY / (1 - 2 * PRUNE_OPACITY)))
    name = PARAMETERS[3]
    logits = getattr(state.gaussians, name)
    logits[trainable] = logits[trainable].clamp_max(ceiling)
    for moments in (state.exp_avg[name], state.exp_avg_sq[name]):
        moments[trainable] = 0
    state.last_reset = state.step
