"""The training kernels: a step on clouds of Gaussians or on a capture, in parts, and its share of the peak.

python -m benchmarks.kernels                            # clouds of 10 k and 100 k, sparse and dense
python -m benchmarks.kernels --scene CAPTURE --steps 2000
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from numba import njit

from benchmarks.common import finish, milliseconds, peak_gflops, peak_mib
from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.sh import num_bases
from sagesplat.kernels.planes import padded
from sagesplat.metrics.image import photometric_loss
from sagesplat.raster import Workspace, blend, cpu, rasterize, set_threads
from sagesplat.scene import load_scene
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera, Scene
from sagesplat.train.events import Step, Trained
from sagesplat.train.optim import adam_steps
from sagesplat.train.state import from_points
from sagesplat.train.trainer import train

# operations that the blending loops cost per pixel and Gaussian (docs/performance.md)
FORWARD_OPERATIONS, BACKWARD_OPERATIONS = 34, 75
# standard deviation on the image in pixels, and opacity
OVERLAPS = {"sparse": (2.0, 0.5), "dense": (20.0, 0.03)}


def main(
    scene: Path | None = None,
    downscale: int = 1,
    steps: int = 0,
    counts: tuple[int, ...] = (10_000, 100_000),
    size: tuple[int, int] = (800, 533),
    threads: int = 0,
    repeats: int = 20,
    write: bool = False,
) -> None:
    """A training step in parts, and its two blending loops alone.

    Args:
        scene: capture (default: clouds of Gaussians).
        downscale: of its photos.
        steps: of training before the step that is measured; 0: the points of the capture.
        counts: sizes of the clouds.
        size: width and height that clouds are drawn at.
        threads: of a capture; 0: one per core. Clouds are measured with one thread and with all.
        repeats: of each call, of which the median or the best is taken.
        write: keep the figures in benchmarks/results/cpu.
    """
    if scene is None:
        finish("kernels", {"rows": on_clouds(counts, size, repeats), "peak_mib": peak_mib()}, write)
        return
    used = set_threads(threads)
    capture = load_scene(scene, downscale=downscale)
    result: dict[str, Any] = {"scene": capture.name, "steps": steps, "threads": used}
    result |= on_capture(capture, steps, repeats)
    for name, value in result.items():
        print(f"{name:32} {value:,.4g}" if isinstance(value, float) else f"{name:32} {value}")
    finish(f"kernels_{capture.name}_{result['size'][0]}_{steps}", result, write)


def on_clouds(counts: tuple[int, ...], size: tuple[int, int], repeats: int) -> list[dict[str, Any]]:
    """A row for each cloud, sparse and dense, with one thread and with all."""
    view, rows = camera(*size), []
    photo = torch.rand(view.height, view.width, 3)
    for overlap in OVERLAPS:
        for count in counts:
            g = cloud(count, overlap, view)
            for threads in (1, 0):
                row: dict[str, Any] = {
                    "overlap": overlap,
                    "gaussians": count,
                    "threads": set_threads(threads),
                }
                row |= parts(g, view, photo, 3, repeats) | blending(g, view, repeats)
                rows.append(row)
                names = ("step_ms", "forward_ms", "backward_ms", "ssim_ms", "adam_ms")
                shown = " ".join(f"{name[:-3]} {row[name]:.1f}" for name in names)
                rates = f"{row['pairs_per_s_forward']:.2e} {row['pairs_per_s_backward']:.2e} pairs/s"
                print(f"{overlap} {count:>9,} threads {row['threads']}: {shown} ms; {rates}", flush=True)
    return rows


def on_capture(capture: Scene, steps: int, repeats: int) -> dict[str, Any]:
    """A step on the second view of a capture; from its points also that of the trainer, photo and all."""
    g = trained(capture, steps) if steps else initial(capture)
    view = capture.views[1].camera
    photo = torch.from_numpy(Photos(capture.views)[1]).float() / 255
    result: dict[str, Any] = {"size": [view.width, view.height], "gaussians": len(g)}
    result |= parts(g, view, photo, min(3, steps // 1000), repeats)
    if not steps:
        labels = np.full(len(g), -1, np.int16)
        config = TrainConfig(max_steps=30_000, level_every=30_000, lr_schedule="published")
        events = train(capture, Photos(capture.views), labels, config, start=g)
        result["step_ms"] = milliseconds(partial(next, (e for e in events if isinstance(e, Step))), 40)
    return result | blending(g, view, repeats) | {"peak_mib": peak_mib()}


def camera(width: int = 800, height: int = 533) -> Camera:
    """At the origin, looking along z with a focal length of the image's width."""
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], np.float32)
    return Camera(np.eye(4, dtype=np.float32), K, width, height)


def cloud(count: int, overlap: str, view: Camera, degree: int = 3, seed: int = 0) -> Gaussians:
    """Gaussians all over an image, between 3 and 5 units deep, round and of one size on the image."""
    sigma, opacity = OVERLAPS[overlap]
    rng = np.random.default_rng(seed)
    z = rng.uniform(3, 5, count)
    uv = rng.random((count, 2)) * [view.width, view.height] - [view.width / 2, view.height / 2]
    means = np.column_stack([uv * (z / view.width)[:, None], z])
    scales = np.log(sigma * z / view.width)[:, None] + rng.normal(0, 0.2, (count, 3))

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values.astype(np.float32))

    return Gaussians(
        means=tensor(means),
        quats=tensor(rng.normal(size=(count, 4))),
        log_scales=tensor(scales),
        logit_opacities=tensor(np.full(count, np.log(opacity / (1 - opacity)))),
        sh0=tensor(rng.normal(0, 0.5, (count, 1, 3))),
        shN=tensor(rng.normal(0, 0.1, (count, (degree + 1) ** 2 - 1, 3))),
        label_ids=torch.zeros(count, dtype=torch.int16),
    )


def initial(scene: Scene) -> Gaussians:
    """What training begins with."""
    return from_points(scene.points, np.full(len(scene.points.xyz), -1, np.int16), 3)


def trained(scene: Scene, steps: int) -> Gaussians:
    """The Gaussians after a short run of the fast pace."""
    config = TrainConfig(max_steps=steps, level_every=steps)
    labels = np.full(len(scene.points.xyz), -1, np.int16)
    for event in train(scene, Photos(scene.views), labels, config):
        if isinstance(event, Trained):
            return event.gaussians
    raise AssertionError("training ends with Trained")


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
            image, left, grad, none, reached, sums,
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
            tensors = leaf.detach(), leaf.grad, first[name], second[name]
            adam_steps(
                *([tensor.numpy()] for tensor in tensors), rates=[1e-9], step=100,
                trainable=np.ones(len(g), bool), columns=[in_use if name == "shN" else None],
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


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.kernels")
