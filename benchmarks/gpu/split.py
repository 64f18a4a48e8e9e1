"""Where the time of a training step goes on a GPU."""

import re
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from benchmarks.gpu.base import Bench, Outcome, between, mark, milliseconds, wait
from benchmarks.kernels import BACKWARD_OPERATIONS, FORWARD_OPERATIONS
from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.core.sh import num_bases
from sagesplat.metrics.image import photometric_loss
from sagesplat.raster import Workspace, cuda, rasterize
from sagesplat.train import densify, optim
from sagesplat.train.photo_loader import PhotoLoader
from sagesplat.train.state import initial_state

# what a kernel belongs to, by its name; the first that fits
KERNELS = (
    ("projection", r"projection|spherical_harmonics|quat_scale"),
    ("tiles and sort", r"intersect|radixsort|radix_sort|devicescan"),
    ("raster backward", r"rasterize_to_pixels.*bwd"),
    ("raster forward", r"rasterize_to_pixels.*fwd"),
    ("ssim", r"^_(blur|compare|gradient)"),
    ("adam", r"^_update|adam"),
)


def split(bench: Bench) -> Outcome:
    """Where the time of a step goes, and how near each part is to what the device can do."""
    g, repeats = grown(bench), 3 if bench.small else 50
    figures: dict[str, Any] = {"gaussians": len(g), "stages": stages(bench, g, repeats=repeats)}
    limits = figures["limits"] = ceilings(bench.device)
    isects = 0
    camera = bench.scene.views[int(bench.scene.train_ids[0])].camera
    if not bench.small:
        with torch.no_grad():
            isects = len(cuda.Tiles(cuda.splat(g, camera, 3, False), camera, None).ids)
    least = traffic(len(g), isects, camera.width * camera.height, num_bases(3))
    parts = figures["kernels"] = kernels(bench, g, min(repeats, 20))
    for name, part in parts.items():
        if name in least and part["ms"]:
            amount, unit = least[name]
            limit = limits["bytes_per_s" if unit == "bytes" else "flop_per_s"]
            part |= {unit: amount, f"share_of_{unit}": amount / (part["ms"] / 1e3) / limit}
    whole = figures["stages"]["step"]
    # what is missing to 1 the device waits for the host
    busy = figures["busy"] = sum(part["ms"] for part in parts.values()) / whole
    shares = (f"{name} {part['ms']:.2f}" for name, part in parts.items())
    return Outcome("ok", f"step {whole:.2f} ms; device busy {busy:.0%}: {', '.join(shares)} ms", figures)


def grown(bench: Bench) -> Gaussians:
    """The model that was trained, or one as large as training may make it, on the device."""
    if bench.trained is not None:
        return bench.trained.to(bench.device)
    g, camera = bench.initial(), bench.scene.views[0].camera
    most = densify.cap(TrainConfig(), camera.width * camera.height, len(g))
    g = g.select(torch.arange(most, device=bench.device) % len(g))
    moved = g.means + g.log_scales.exp() * torch.randn_like(g.means)
    return replace(g, means=moved, log_scales=g.log_scales - 0.5, shN=torch.randn_like(g.shN) * 0.02)


def stages(bench: Bench, g: Gaussians, repeats: int) -> dict[str, float]:
    """Milliseconds of the parts of a training step, in a row as the trainer has them, over several views."""
    step = stepping(bench, g)
    for turn in range(min(repeats, 10)):
        step(turn)
    wait(bench.device)
    begin = time.perf_counter()
    marks = [step(turn) for turn in range(repeats)]
    wait(bench.device)
    whole = 1e3 * (time.perf_counter() - begin) / repeats
    names = ("forward", "loss", "backward", "adam")
    found = {
        name: float(np.mean([between(mark[i], mark[i + 1]) for mark in marks]))
        for i, name in enumerate(names)
    }
    return found | {"step": whole}


def stepping(bench: Bench, g: Gaussians) -> Callable[[int], list[Any]]:
    """A function that takes a step, on the view of a turn, and returns marks of when each part was over."""
    state = initial_state(g.to("cpu"), 0).to(bench.device)
    state.gaussians = replace(g, **{name: p.detach().clone() for name, p in g.parameters().items()})
    everything = torch.ones(len(g), dtype=torch.bool, device=bench.device)
    feed, space, rows = (
        PhotoLoader(bench.scene, bench.photos, bench.device),
        Workspace(),
        bench.scene.train_ids,
    )
    rates: dict[str, float] = dict.fromkeys(PARAMETERS, 1e-9)

    def step(turn: int) -> list[Any]:
        photo, camera = feed(int(rows[turn % min(16, len(rows))]))
        leaves = {name: p.detach().requires_grad_() for name, p in state.gaussians.parameters().items()}
        marks = [mark(bench.device)]
        render = rasterize(replace(state.gaussians, **leaves), camera, workspace=space, backend=bench.backend)
        marks.append(mark(bench.device))
        loss = photometric_loss(render.rgb, photo, 0.2, None, space)
        marks.append(mark(bench.device))
        loss.backward()
        marks.append(mark(bench.device))
        densify.observe_gradients(state, render, camera.width, camera.height, everything)
        state.step += 1
        grads = {name: p.grad for name, p in leaves.items() if p.grad is not None}
        optim.update(state, grads, rates, 3, everything)
        marks.append(mark(bench.device))
        return marks

    return step


def ceilings(device: torch.device) -> dict[str, float]:
    """Bytes a second of a large copy (read and written), operations a second of a float32 product."""
    small = device.type == "cpu"
    x = torch.rand(2**22 if small else 2**29, device=device)
    y = torch.empty_like(x)
    a = torch.rand(512 if small else 8192, 512 if small else 8192, device=device)
    copy = milliseconds(device, lambda: y.copy_(x), 3 if small else 20)
    product = milliseconds(device, lambda: a @ a, 3 if small else 5)
    return {"bytes_per_s": 2e3 * x.nbytes / copy, "flop_per_s": 2e3 * float(len(a)) ** 3 / product}


def kernels(bench: Bench, g: Gaussians, repeats: int) -> dict[str, dict[str, float]]:
    """Milliseconds of kernels in a step by what they belong to, and the longest of the rest."""
    from torch.profiler import ProfilerActivity, profile

    step = stepping(bench, g)
    for turn in range(3):
        step(turn)
    wait(bench.device)
    device = ProfilerActivity.CPU if bench.small else ProfilerActivity.CUDA
    with profile(activities=[device]) as profiled:
        for turn in range(repeats):
            step(turn)
        wait(bench.device)
    parts: dict[str, dict[str, float]] = {name: {"ms": 0.0} for name, _ in KERNELS} | {"rest": {"ms": 0.0}}
    others: Counter[str] = Counter()
    for entry in profiled.key_averages():
        if bench.small:
            took = entry.self_cpu_time_total
        elif entry.device_type.name == "CUDA":
            took = entry.self_device_time_total
        else:
            continue
        group = group_of(entry.key)
        parts[group]["ms"] += took / 1e3 / repeats
        if group == "rest":
            others[entry.key[:80]] += took / 1e3 / repeats
    parts["rest"] |= dict(others.most_common(8))
    return parts


def group_of(kernel: str) -> str:
    """The part of a step that a kernel belongs to."""
    return next((name for name, of in KERNELS if re.search(of, kernel.lower())), "rest")


def traffic(gaussians: int, intersections: int, pixels: int, bases: int) -> dict[str, tuple[float, str]]:
    """The least that each part of a step must move (bytes), or what its loops compute at most (flop).

    Projection reads and writes each Gaussian once each way, colours with it; a radix sort moves keys and
    values of 12 bytes six times there and back; blending evaluates a pair of a pixel of a tile and a Gaussian
    at most; SSIM's four kernels read and write 282 bytes a pixel; Adam moves 28 a value.
    """
    values = 11 + 3 * bases
    return {
        "projection": (gaussians * (3 * 4 * values + 2 * 88.0), "bytes"),
        "tiles and sort": (intersections * 144.0, "bytes"),
        "raster forward": (intersections * 256.0 * FORWARD_OPERATIONS, "flop"),
        "raster backward": (intersections * 256.0 * BACKWARD_OPERATIONS, "flop"),
        "ssim": (pixels * 282.0, "bytes"),
        "adam": (gaussians * 28.0 * values, "bytes"),
    }
