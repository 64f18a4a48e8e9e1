"""Times, rates and memory of the training kernels."""

import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import torch
from numba import njit, prange

from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.sh import num_bases
from sagesplat.kernels.planes import padded
from sagesplat.kernels.simd import fma, splat16, total
from sagesplat.metrics.image import photometric_loss
from sagesplat.raster import Workspace, blend, cpu, rasterize
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera, Scene
from sagesplat.train.events import Step
from sagesplat.train.optim import adam_step
from sagesplat.train.trainer import train

# operations that the blending loops cost per pixel and Gaussian (docs/performance.md)
FORWARD_OPERATIONS, BACKWARD_OPERATIONS = 34, 75


def milliseconds(call: Callable[[], Any], repeats: int, *, best: bool = False) -> float:
    """Median (or best) time of a call, after up to three to warm up."""
    times, warm = [], min(3, repeats)
    for _ in range(warm + repeats):
        begin = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - begin))
    return float(np.min(times[warm:]) if best else np.median(times[warm:]))


@njit(parallel=True, cache=True)
def _multiply_add(count, out):
    for job in prange(len(out)):
        x, y = splat16(np.float32(0.999999)), splat16(np.float32(1e-7))
        a = b = c = d = e = f = g = h = i = j = splat16(np.float32(1))
        for _ in range(count):
            a, b, c, d, e = fma(a, x, y), fma(b, x, y), fma(c, x, y), fma(d, x, y), fma(e, x, y)
            f, g, h, i, j = fma(f, x, y), fma(g, x, y), fma(h, x, y), fma(i, x, y), fma(j, x, y)
        out[job] = total(a + b + c + d + e + f + g + h + i + j)


def peak_gflops() -> float:
    """What the machine's threads can multiply and add, right now: the calibration of everything else."""
    out, count = np.zeros(numba.get_num_threads(), np.float32), 2_000_000
    best = milliseconds(lambda: _multiply_add(count, out), 3, best=True)
    return count * len(out) * 10 * 16 * 2 / best / 1e6


@njit(cache=True)
def _count_pairs(records, starts, ends, ids, tiles_x):
    """Pairs of a pixel and a Gaussian that blending evaluates."""
    batch, rows = blend.new_batch()  # pyright: ignore[reportCallIssue]
    pairs = 0
    for tile in range(len(ends)):
        x0, y0 = np.float32(tile % tiles_x * blend.TILE), np.float32(tile // tiles_x * blend.TILE)
        for first in range(starts[tile], ends[tile], 16):
            last = min(first + 16, ends[tile])
            blend.gather_batch(records, ids, first, last, x0, y0, batch, rows)  # pyright: ignore[reportCallIssue]
            for j in range(last - first):
                for band in range(blend.BANDS):
                    pairs += max(0, int(rows[band, 1, j]) - int(rows[band, 0, j])) * blend.LANES
    return pairs


def blending(g: Gaussians, camera: Camera, repeats: int) -> dict[str, float]:
    """The two blending loops alone: milliseconds, and pairs a second."""
    records, radii, found = cpu.intersections(g, camera, Workspace())
    num = len(found.starts) - 1
    ends, black, rows = np.zeros(num, np.int64), np.zeros(3, np.float32), len(found.ids)
    left = np.zeros((camera.height, padded(camera.width)), np.float32)
    image, none = np.zeros((3, *left.shape), np.float32), left[:0]
    grad = np.random.default_rng(0).normal(size=image.shape).astype(np.float32)
    grad[..., camera.width :] = 0
    sums, reached = np.zeros((rows, blend.SUMS), np.float32), np.zeros(rows, np.bool_)
    forward = milliseconds(
        lambda: blend.forward(
            records, found.starts, found.ids, found.row_order, camera.width, camera.height, black, image,
            left, ends,
        ),
        repeats, best=True,
    )  # fmt: skip
    backward = milliseconds(
        lambda: blend.backward(
            records, radii, found.starts, ends, found.ids, found.slots, found.row_order, camera.width,
            image, left, grad, none, reached, sums, None,
        ),
        repeats, best=True,
    )  # fmt: skip
    pairs = _count_pairs(records, found.starts, ends, found.ids, -(-camera.width // blend.TILE))
    peak = peak_gflops()
    return {
        "pairs": pairs,
        "intersections": len(found.ids),
        "blend_forward_ms": forward,
        "blend_backward_ms": backward,
        "pairs_per_s_forward": pairs / forward * 1e3,
        "pairs_per_s_backward": pairs / backward * 1e3,
        "share_of_peak_forward": pairs / forward * FORWARD_OPERATIONS / 1e6 / peak,
        "share_of_peak_backward": pairs / backward * BACKWARD_OPERATIONS / 1e6 / peak,
        "peak_gflops": peak,
    }


def parts(g: Gaussians, camera: Camera, photo: torch.Tensor, degree: int, repeats: int) -> dict[str, float]:
    """A training step in four parts, each timed alone, and as a whole."""
    space = Workspace()
    first, second = ({n: torch.zeros_like(p) for n, p in g.parameters().items()} for _ in range(2))
    in_use = 3 * (num_bases(degree) - 1)
    leaves: dict[str, torch.Tensor] = {}

    def forward() -> torch.Tensor:
        leaves.update({n: p.detach().requires_grad_() for n, p in g.parameters().items()})
        return rasterize(replace(g, **leaves), camera, sh_degree=degree, workspace=space).rgb

    slope = torch.rand(camera.height, camera.width, 3) * 1e-6
    image = forward().detach().clone().requires_grad_()

    def adam() -> None:
        for name, leaf in leaves.items():
            assert leaf.grad is not None
            adam_step(
                leaf.detach().numpy(), leaf.grad.numpy(), first[name].numpy(), second[name].numpy(),
                lr=1e-9, step=100, trainable=np.ones(len(g), bool), columns=in_use if name == "shN" else None,
            )  # fmt: skip

    def step() -> None:
        photometric_loss(forward(), photo, workspace=space).backward()
        adam()

    forward_ms = milliseconds(forward, repeats)
    return {
        "step_ms": milliseconds(step, repeats),
        "forward_ms": forward_ms,
        "backward_ms": milliseconds(lambda: forward().backward(slope), repeats) - forward_ms,
        "ssim_ms": milliseconds(lambda: photometric_loss(image, photo, workspace=space).backward(), repeats),
        "adam_ms": milliseconds(adam, repeats),
    }


def steps_side_by_side(scene: Scene, configs: Mapping[str, TrainConfig], count: int) -> dict[str, float]:
    """Median milliseconds of a training step with each of several settings, which take turns: second half."""
    labels, photos = np.full(len(scene.points.xyz), -1, np.int16), Photos(scene.views)
    runs = {name: train(scene, photos, labels, config) for name, config in configs.items()}
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(count):
        for name, run in runs.items():
            begin = time.perf_counter()
            next(event for event in run if isinstance(event, Step))
            times[name].append(1e3 * (time.perf_counter() - begin))
    return {name: float(np.median(found[count // 2 :])) for name, found in times.items()}


def peak_mib() -> float:
    """Most memory that this process ever had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
