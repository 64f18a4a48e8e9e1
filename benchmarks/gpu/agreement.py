"""The cuda backend against the float64 reference, frozen rows, and the tests of the kernels."""

import importlib.metadata
import importlib.util
import math
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.common import ROOT
from benchmarks.gpu.base import Bench, Outcome
from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.raster import Backend, cuda, rasterize
from sagesplat.scene.scene import Camera
from sagesplat.train import densify
from sagesplat.train.early_stopping import ActiveTiles, trainable_rows
from sagesplat.train.lr_schedule import LrSchedule
from sagesplat.train.photo_loader import PhotoLoader
from sagesplat.train.state import TrainState, from_points, initial_state
from sagesplat.train.stepper import Stepper
from sagesplat.train.strategy import make_strategy

TESTS = ("test_raster_cuda", "test_raster_cpu", "test_metrics_ssim_triton", "test_train_adam_triton")
TOLERANCES = {"cuda": (1e-4, 1e-3), "cpu": (3e-6, 1e-5)}  # of images, of gradients: those of the tests


def agreement(bench: Bench) -> Outcome:
    """The backend against the float64 reference; frozen rows bit for bit; the tests of the kernels."""
    worst: dict[str, float] = {}
    for packed in (False, True) if bench.device.type == "cuda" else (False,):
        cuda.PACKED = packed  # type: ignore
        try:
            for name, options in cases():
                for part, error in compared(bench, options).items():
                    key = f"{name}{', packed' * packed}: {part}"
                    worst[key] = error
        finally:
            cuda.PACKED = False
    images = max(error for name, error in worst.items() if name.endswith(": image"))
    gradients = max(error for name, error in worst.items() if not name.endswith(": image"))
    limits = TOLERANCES[bench.device.type]
    fits = images < limits[0] and gradients < limits[1]
    kept = frozen_kept(bench, 40 if bench.small else 200)
    tested = pytest_summary() if bench.device.type == "cuda" else {"summary": "not run"}
    line = (
        f"image {images:.1e}, gradients {gradients:.1e} (at most {limits[0]:.0e}, {limits[1]:.0e}); "
        f"{kept['rows']:,} frozen rows {'kept' if kept['kept'] else 'CHANGED'} over {kept['steps']} steps; "
        f"tests: {tested['summary']}"
    )
    well = fits and kept["kept"] and not tested.get("failed")
    figures = {"worst": worst, "frozen": kept, "tests": tested}
    return Outcome("ok" if well else "FAILED", line, figures)


def cases() -> list[tuple[str, dict[str, Any]]]:
    """Names and options of renderings that are compared: those of the tests."""
    tiles = torch.tensor([[1, 0, 1, 0], [0, 1, 1, 0], [1, 1, 0, 1]], dtype=torch.bool)
    trainable = torch.arange(80) % 3 > 0
    return [
        ("plain", {}),
        ("degree 1", {"sh_degree": 1}),
        ("antialiased", {"antialiased": True}),
        ("5 channels", {"features": 5}),
        ("40 channels", {"features": 40}),
        ("tile mask", {"features": 5, "tile_mask": tiles}),
        ("trainable", {"features": 5, "trainable": trainable, "tile_mask": tiles}),
    ]


def compared(bench: Bench, options: dict[str, Any], count: int = 80) -> dict[str, float]:
    """Largest absolute error of images, and of each gradient relative to its largest value."""
    generator = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    g = Gaussians(
        means=normal(count, 3) * torch.tensor([1.0, 0.8, 0.8]) + torch.tensor([0.0, 0.0, 4.0]),
        quats=normal(count, 4), log_scales=normal(count, 3) * 0.5 - 2.2,
        logit_opacities=normal(count) * 1.5, sh0=normal(count, 1, 3) * 0.5, shN=normal(count, 15, 3) * 0.1,
        label_ids=torch.zeros(count, dtype=torch.int16),
    )  # fmt: skip
    K = np.array([[48, 0, 27], [0, 46, 22], [0, 0, 1]], np.float32)
    camera = Camera(np.eye(4, dtype=np.float32), K, 57, 40)
    features = normal(count, options["features"]) if "features" in options else None
    weights = [normal(40, 57, c) for c in (3, 1, 0 if features is None else features.shape[1])]

    def drawn(backend: Backend, device: torch.device) -> tuple[Tensor, dict[str, Tensor]]:
        def leaf(values: Tensor) -> Tensor:
            return values.detach().to(device, copy=True).requires_grad_()

        leaves = {name: leaf(p) for name, p in g.parameters().items()}
        there: dict[str, Any] = {n: o.to(device) if isinstance(o, Tensor) else o for n, o in options.items()}
        if features is not None:
            there["features"] = leaves["features"] = leaf(features)
        moving = replace(g.to(device), **{name: leaves[name] for name in PARAMETERS})
        background = torch.tensor([0.2, 0.3, 0.4], device=device)
        render = rasterize(moving, camera, backend=backend, background=background, **there)
        image = torch.cat([render.rgb, render.alpha[..., None]], -1)
        image = image if render.features is None else torch.cat([image, render.features], -1)
        (image * torch.cat(weights, -1).to(device)).sum().backward()
        grads = {name: leaf.grad for name, leaf in leaves.items()} | {"means2d": render.means2d.grad}
        found = {name: grad.double().cpu() for name, grad in grads.items() if grad is not None}
        return image.detach().double().cpu(), found

    expected, wanted = drawn("reference", torch.device("cpu"))
    actual, grads = drawn(bench.backend, bench.device)
    errors = {"image": float((actual - expected).abs().max())}
    for name, want in wanted.items():
        errors[name] = float((grads[name] - want).abs().max() / want.abs().max().clamp_min(1e-30))
    if any(math.isnan(error) for error in errors.values()):
        raise ValueError(f"NaN with {options}")
    return errors


def frozen_kept(bench: Bench, steps: int) -> dict[str, Any]:
    """Train beside a frozen category, with densification and a reset: do its rows keep every bit?"""
    every = steps // 5
    config = TrainConfig(
        max_steps=steps,
        lr_schedule="published",
        refine_every=every,
        refine_start=1,
        refine_stop=60_000,
        grow_grad=0,
    )  # fmt: skip
    scene, labels = bench.scene, bench.labels
    if len(np.unique(labels)) < 2:
        labels = (scene.points.xyz[:, 0] > np.median(scene.points.xyz[:, 0])).astype(np.int16)
    label = Counter(labels.tolist()).most_common(1)[0][0]
    state = initial_state(from_points(scene.points, labels, 3), 0).to(bench.device)
    state.frozen = {label: 0}
    work = ActiveTiles(scene, bench.masks, frozenset(state.frozen), bench.device)
    schedule = LrSchedule(config, scene.extent)
    strategy = make_strategy(config, scene, schedule)
    feed = PhotoLoader(scene, bench.photos, bench.device)
    stepper = Stepper(feed, config, work, bench.backend, strategy=strategy)
    rates, before, begun = schedule.learning_rates, rows_of(state, label), len(state.gaussians)
    trainable = trainable_rows(state.gaussians, state.frozen)
    for step in range(1, steps + 1):
        stepper(state, min(3, step // every), rates(step), trainable)
        if step == 3 * every:
            densify.reset_opacities(state, trainable)
        if step % every == 0:
            strategy.refine(state, trainable)
            state.sort()
            trainable = trainable_rows(state.gaussians, state.frozen)
    after = rows_of(state, label)
    kept = before.shape == after.shape and bool((before == after).all())
    return {"kept": kept, "rows": len(before), "steps": steps, "others_grew": len(state.gaussians) - begun}


def rows_of(state: TrainState, label: int) -> np.ndarray:
    """All values of a category's Gaussians, [M] of raw bytes, sorted: rows may change places."""
    g = state.gaussians.select(state.gaussians.label_ids == label).to("cpu")
    values = torch.cat([p.flatten(1) if p.ndim > 1 else p[:, None] for p in g.parameters().values()], 1)
    rows = np.ascontiguousarray(values.numpy())
    return np.sort(rows.view(f"S{rows.shape[1] * 4}")[:, 0]) if len(rows) else rows


def pytest_summary() -> dict[str, Any]:
    """The tests of the GPU kernels, in a process of their own."""
    paths = [str(ROOT / "tests" / f"{name}.py") for name in TESTS]
    if importlib.util.find_spec("pytest") is None or not all(Path(path).exists() for path in paths):
        return {"summary": "no pytest or no tests here"}
    words = [sys.executable, "-m", "pytest", "-q", "-o", "filterwarnings=default", *paths]
    words += ["-k", "device or triton"]  # the others need no GPU
    try:
        done = subprocess.run([*words, "-p", "no:cacheprovider"], cwd=ROOT, capture_output=True, text=True,
                              timeout=150, check=False)  # fmt: skip
    except subprocess.TimeoutExpired:
        return {"summary": "no end after 150 s", "failed": True}
    lines = (done.stdout.strip() or done.stderr.strip() or "nothing printed").splitlines()
    failed = [line for line in lines if line.startswith(("FAILED", "ERROR"))][:20]
    return {"summary": lines[-1].strip("= "), "failed": done.returncode != 0, "which": failed}
