"""Densification of "3D Gaussian Splatting as Markov Chain Monte Carlo" (Kheradmand et al., NeurIPS 2024).

Gaussians are samples of a Markov chain: SGLD noise moves them, transparent ones most; dead ones are relocated
to living ones, and new ones are added in the same way. Nothing is cloned, split, pruned or reset. All random
numbers come from `state.rng`.
"""

import math

import numpy as np
import torch
from numba import prange
from torch import Tensor

from sagesplat.kernels.jit import njit
from sagesplat.raster.reference import rotation_matrices
from sagesplat.train import densify
from sagesplat.train.densify import PRUNE_OPACITY
from sagesplat.train.state import TrainState

REFINE_STOP = 25_000  # step of 30,000 at which refinement ends, as published
MOST = 51  # Gaussians that may share a place; larger counts are treated as 51
OPACITY_WEIGHT, SCALE_WEIGHT = 0.01, 0.01  # of the mean opacity and scale in the loss, as published
# Steps of a training that has these: in a few thousand they cost 0.2 to 1 dB (docs/developers/nested.md).
REGULARISED_FROM = 15_000
_GROWTH = 0.05  # of the present count, at each refinement, as published
_GROWN_BY = 0.5  # share of the refinements after which even a short run has reached its cap
_SHARPNESS, _FAINT = 100.0, 0.005  # k and 1 - t of equation 8: the noise fades around this opacity
_QUIET = 0.2  # above this opacity the noise is below 1e-8 of that of transparent ones: it is skipped

# row N, column k - 1: binomial(N, k) (-1)^(k - 1) / sqrt(k). The sum over i of equation 9 is done:
# sum_{i=k}^{N} binomial(i - 1, k - 1) = binomial(N, k).
_SERIES = torch.tensor(
    [[math.comb(n, k) * (-1) ** (k - 1) / math.sqrt(k) for k in range(1, MOST + 1)] for n in range(MOST + 1)],
    dtype=torch.float64,
)


def shares(logits: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Logit opacity and log scale factor of each of N equal Gaussians in the place of one (equation 9).

    `logits` [M], `counts` [M] int, N >= 1, above 51 as 51. Both results are float64 [M]. At the centre the N
    together are exactly as opaque as the one was, and so they are summed over a line through it.
    """
    counts = counts.clamp_max(MOST)
    spared = torch.nn.functional.logsigmoid(-logits.double()) / counts  # log(1 - o_new)
    opacity = -torch.expm1(spared)
    powers = opacity[:, None].expand(-1, MOST).cumprod(1)
    line = (powers * _SERIES.to(logits.device)[counts]).sum(1)
    return opacity.log() - spared, logits.double().sigmoid().log() - line.log()


def relocate(state: TrainState, trainable: Tensor) -> int:
    """Move dead Gaussians, opacity at most `PRUNE_OPACITY`, onto living ones; returns how many.

    Hosts are drawn by opacity and keep their moments. A relocated Gaussian copies its host, label included;
    its moments begin anew. Rows that are not `trainable` (bool [N]) are neither moved nor hosts: a stopped
    category keeps its dead ones. Without a living Gaussian nothing moves. Changes tensors in place.
    """
    alive = state.gaussians.logit_opacities.sigmoid() > PRUNE_OPACITY
    dead = (trainable & ~alive).nonzero().squeeze(1)
    hosts = _land(state, trainable & alive, len(dead))
    if len(hosts):
        labels = state.gaussians.label_ids
        labels[dead] = labels[hosts]
        for name, p in state.gaussians.parameters().items():
            p[dead] = p[hosts]
            state.exp_avg[name][dead] = 0
            state.exp_avg_sq[name][dead] = 0
    return len(hosts)


def growth(most: int, num_points: int, refinements: int) -> float:
    """By what share of the present count the set grows at each refinement: 5 %, more in short runs."""
    return max(_GROWTH, (most / max(num_points, 1)) ** (1 / max(1.0, _GROWN_BY * refinements)) - 1)


def add(state: TrainState, most: int, trainable: Tensor, growth: float = _GROWTH) -> int:
    """Add a share of the present count, never beyond `most` in all, in places drawn by opacity; returns how
    many.

    What stopped categories would have got of it is withheld (see `densify.room`). New rows come last, so
    `trainable` (bool [N]) must be made anew.
    """
    n = len(state.gaussians)
    living = trainable & (state.gaussians.logit_opacities.sigmoid() > PRUNE_OPACITY)
    # withheld places count as taken, so they are no part of this growth
    room = densify.room(state, min(most, n + state.withheld + math.ceil(growth * n)), trainable)
    hosts = _land(state, living, room)
    if len(hosts):
        keep = torch.ones(n, dtype=torch.bool, device=hosts.device)
        state.replace_rows(keep, state.gaussians.select(hosts))
    return len(hosts)


def _land(state: TrainState, living: Tensor, count: int) -> Tensor:
    """Hosts [count] of as many Gaussians, already with the opacity and scales of their share.

    Their moments stay, unlike as published: late in a training Adam's first steps after a reset are three
    times too long, and many are hosts at every refinement.
    """
    g, rows = state.gaussians, living.nonzero().squeeze(1)
    if not count or not len(rows):
        return rows[:0]
    # summed on the CPU, in order: a sum on a GPU need not repeat itself
    bounds = g.logit_opacities[rows].cpu().double().sigmoid().cumsum(0)
    drawn = torch.searchsorted(bounds, torch.from_numpy(state.rng.random(count)) * bounds[-1], right=True)
    hosts = rows[drawn.clamp_max(len(rows) - 1).to(rows.device)]
    places, landed = hosts.unique(return_counts=True)
    logits, log_factors = shares(g.logit_opacities[places], 1 + landed)
    lowest = float(torch.logit(torch.tensor(PRUNE_OPACITY)))  # a share no fainter, as in gsplat
    g.logit_opacities[places] = logits.clamp_min(lowest).float()
    g.log_scales[places] += log_factors[:, None].float()
    return hosts


def perturb(state: TrainState, rate: float, trainable: Tensor) -> None:
    """Add SGLD noise (equation 8): mean += rate * sigmoid(100 (0.005 - opacity)) * covariance @ normal.

    `rate` is the step's learning rate of the means times `SGLD_NOISE`, in 1 / world units, since a covariance
    is in square ones. Only rows that are `trainable` (bool [N]) move. Draws one number from `state.rng`; on a
    CPU the result does not depend on the number of threads. Changes the means in place.
    """
    g, seed = state.gaussians, int(state.rng.integers(1 << 63))
    if g.means.is_cuda:
        generator = torch.Generator(g.means.device).manual_seed(seed)
        normal = torch.randn(g.means.shape, generator=generator, device=g.means.device)
        sgld_noise(g.means, g.quats, g.log_scales, g.logit_opacities, trainable, rate, normal)
    else:
        _perturb(
            g.means.numpy(), g.quats.numpy(), g.log_scales.numpy(), g.logit_opacities.numpy(),
            trainable.numpy(), np.float32(rate), np.uint64(seed),
        )  # fmt: skip


def sgld_noise(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logits: Tensor,
    trainable: Tensor,
    rate: float,
    normal: Tensor,
) -> None:
    """`perturb` on any device, with given standard normal numbers [N, 3]."""
    size = rate * torch.sigmoid(_SHARPNESS * (_FAINT - logits.sigmoid())) * trainable
    rotation = rotation_matrices(quats)
    local = (rotation.mT @ normal[..., None]) * (2 * log_scales).exp()[..., None]
    means += size[:, None] * (rotation @ local).squeeze(-1)


@njit(cache=True)
def _mix(x):
    """The finaliser of SplitMix64 (Steele et al. 2014): 64 random bits for each number."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@njit(cache=True)
def _normal(seed, count):
    """An approximately standard normal number that depends on its arguments alone.

    It is the number of set bits among 64 random ones, plus a fraction.

    Mean and variance are exact, the fourth moment is 2.97; Langevin noise needs no more, and logarithms and
    sines would take longer than everything else in the kernel.
    """
    x = _mix(seed + count * np.uint64(0x9E3779B97F4A7C15))
    fraction = np.float32(_mix(x) >> np.uint64(40)) * np.float32(2.0**-24)
    x -= (x >> np.uint64(1)) & np.uint64(0x5555555555555555)
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    bits = np.float32((x * np.uint64(0x0101010101010101)) >> np.uint64(56))
    return (bits + fraction - np.float32(32.5)) * np.float32((16 + 1 / 12) ** -0.5)


@njit(parallel=True, error_model="numpy", cache=True)
def _perturb(means, quats, log_scales, logits, trainable, rate, seed):
    one, two = np.float32(1), np.float32(2)
    quiet = np.float32(np.log(_QUIET / (1 - _QUIET)))
    for i in prange(len(means)):
        if trainable[i] and logits[i] < quiet:
            opacity = one / (one + np.exp(-logits[i]))
            size = rate / (one + np.exp(np.float32(_SHARPNESS) * (opacity - np.float32(_FAINT))))
            w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
            s = two / (w * w + x * x + y * y + z * z)
            r00, r01, r02 = one - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)
            r10, r11, r12 = s * (x * y + w * z), one - s * (x * x + z * z), s * (y * z - w * x)
            r20, r21, r22 = s * (x * z - w * y), s * (y * z + w * x), one - s * (x * x + y * y)
            k = np.uint64(3 * i)
            n0, n1, n2 = _normal(seed, k), _normal(seed, k + np.uint64(1)), _normal(seed, k + np.uint64(2))
            a = size * np.exp(two * log_scales[i, 0]) * (r00 * n0 + r10 * n1 + r20 * n2)
            b = size * np.exp(two * log_scales[i, 1]) * (r01 * n0 + r11 * n1 + r21 * n2)
            c = size * np.exp(two * log_scales[i, 2]) * (r02 * n0 + r12 * n1 + r22 * n2)
            means[i, 0] += r00 * a + r01 * b + r02 * c
            means[i, 1] += r10 * a + r11 * b + r12 * c
            means[i, 2] += r20 * a + r21 * b + r22 * c


def add_regularisation_gradients(
    state: TrainState, grads: dict[str, Tensor], opacity: float, scale: float, trainable: Tensor
) -> None:
    """Add the gradients of opacity * mean(opacities) + scale * mean(scales), the paper's regularisers.

    `grads` are the loss's gradients by parameter name, changed in place. The means are over all N Gaussians
    and their 3 N scales in world units, but only rows that are `trainable` (bool [N]) get a gradient.
    `scale` is in 1 / world units.
    """
    g = state.gaussians
    o, pull = g.logit_opacities.sigmoid(), trainable / max(1, len(g))
    grads["logit_opacities"] += opacity * pull * o * (1 - o)
    grads["log_scales"] += (scale / 3) * pull[:, None] * g.log_scales.exp()
