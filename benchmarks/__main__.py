"""`python -m benchmarks step SCENE` and `python -m benchmarks agreement`; each ends with one line of JSON."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import tyro
from tyro.conf import Positional

from sagesplat.config import TrainConfig
from sagesplat.gaussians import PARAMETERS, Gaussians
from sagesplat.metrics import photometric_loss
from sagesplat.raster import Backend, rasterize, set_threads
from sagesplat.scene import load_scene
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera
from sagesplat.train.state import from_points
from sagesplat.train.trainer import Step, train

OPENSPLAT_STEP_MS = 1830  # its CPU path (1.1.5) on garden at 512 px from 42,599 points, on a two-core machine

app = tyro.extras.SubcommandApp()


def _milliseconds(call, repeats: int) -> float:  # type: ignore[no-untyped-def]
    """Median time of a call, after three to warm up."""
    times = []
    for _ in range(3 + repeats):
        begin = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(times[3:]))


@app.command
def step(scene: Positional[Path], downscale: int = 1, threads: int = 0, repeats: int = 40) -> None:
    """Training steps from the initial points of a capture: the whole step and its parts."""
    used = set_threads(threads)
    capture = load_scene(scene, downscale=downscale)
    photos = Photos(capture.views)
    labels = np.full(len(capture.points.xyz), -1, np.int16)
    events = train(capture, photos, labels, TrainConfig(max_steps=30_000, level_every=30_000))
    whole = _milliseconds(lambda: next(e for e in events if isinstance(e, Step)), repeats)

    g = from_points(capture.points, labels, 3)
    leaves = {name: p.requires_grad_() for name, p in g.parameters().items()}
    camera = capture.views[1].camera
    photo = torch.from_numpy(photos[1]).float() / 255

    def forward():  # type: ignore[no-untyped-def]
        return rasterize(replace(g, **leaves), camera, sh_degree=0)

    def both() -> None:
        forward().rgb.sum().backward()

    result = {
        "scene": capture.name,
        "size": [camera.width, camera.height],
        "gaussians": len(g),
        "threads": used,
        "step_ms": whole,
        "forward_ms": _milliseconds(forward, repeats),
        "forward_backward_ms": _milliseconds(both, repeats),
        "loss_ms": _milliseconds(lambda: photometric_loss(photo * 0.9, photo), repeats),
    }
    if (capture.name, camera.width, len(g)) == ("garden", 512, 42_599):
        result["times_faster_than_opensplat_cpu"] = OPENSPLAT_STEP_MS / whole
    print(json.dumps({k: round(v, 2) if isinstance(v, float) else v for k, v in result.items()}))


@app.command
def agreement(count: int = 400, width: int = 120, height: int = 90, seeds: int = 5) -> None:
    """Largest differences of the cpu backend to the float64 reference; gradients relative to the largest."""
    worst: dict[str, float] = {}
    for seed in range(seeds):
        images, grads = zip(
            *(_gradients(b, count, width, height, seed) for b in ("reference", "cpu")), strict=True
        )
        errors = {"image": float((images[0] - images[1]).abs().max())}
        for name in grads[0]:
            exact, fast = grads[0][name].double(), grads[1][name].double()
            errors[name] = float((exact - fast).abs().max() / exact.abs().max())
        worst = {name: max(worst.get(name, 0.0), error) for name, error in errors.items()}
    for name, error in worst.items():
        print(f"{name:16} {error:.2e}")
    print(json.dumps(worst))


def _gradients(backend: Backend, count: int, width: int, height: int, seed: int):  # type: ignore[no-untyped-def]
    """Image, and gradients of a random weighting of image, alpha and four features."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    g = Gaussians(
        means=normal(count, 3) * torch.tensor([1.2, 0.9, 0.9]) + torch.tensor([0.0, 0.0, 4.0]),
        quats=normal(count, 4),
        log_scales=normal(count, 3) * 0.5 - 2.3,
        logit_opacities=normal(count) * 1.5,
        sh0=normal(count, 1, 3) * 0.5,
        shN=normal(count, 15, 3) * 0.1,
        label_ids=torch.zeros(count, dtype=torch.int16),
    )
    K = np.array([[0.9 * width, 0, 0.45 * width], [0, 0.9 * width, 0.55 * height], [0, 0, 1]], np.float32)
    camera = Camera(np.eye(4, dtype=np.float32), K, width, height)
    features = torch.rand(count, 4, generator=generator).requires_grad_()
    leaves = {name: p.requires_grad_() for name, p in g.parameters().items()}
    render = rasterize(replace(g, **leaves), camera, features=features, backend=backend)
    assert render.features is not None
    loss = torch.zeros(())
    for output in (render.rgb, render.alpha, render.features):
        loss = loss + (output * normal(*output.shape)).sum()
    loss.backward()
    grads = {name: getattr(g, name).grad for name in PARAMETERS} | {"features": features.grad}
    return render.rgb.detach(), grads | {"means2d": render.means2d.grad}


if __name__ == "__main__":
    app.cli(prog="python -m benchmarks")
