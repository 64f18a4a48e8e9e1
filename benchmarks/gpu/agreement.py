"""The tests of the kernels on the device, and whether frozen rows keep every bit."""

import importlib.metadata
import importlib.util
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.common import ROOT
from benchmarks.gpu.base import Bench, Outcome
from sagesplat.core.config import TrainConfig
from sagesplat.train import densify
from sagesplat.train.early_stopping import ActiveTiles, trainable_rows
from sagesplat.train.lr_schedule import LrSchedule
from sagesplat.train.photo_loader import PhotoLoader
from sagesplat.train.state import TrainState, from_points, initial_state
from sagesplat.train.stepper import Stepper
from sagesplat.train.strategy import make_strategy

TESTS = ("test_raster_cuda", "test_raster_cpu", "test_metrics_ssim_triton", "test_train_adam_triton")


def agreement(bench: Bench) -> Outcome:
    """The tests of the kernels (against the float64 reference, on a GPU only); frozen rows bit for bit."""
    kept = frozen_kept(bench, 40 if bench.small else 200)
    tested = pytest_summary() if bench.device.type == "cuda" else {"summary": "not run"}
    line = (
        f"{kept['rows']:,} frozen rows {'kept' if kept['kept'] else 'CHANGED'} over {kept['steps']} steps; "
        f"tests: {tested['summary']}"
    )
    well = kept["kept"] and not tested.get("failed")
    return Outcome("ok" if well else "FAILED", line, {"frozen": kept, "tests": tested})


def frozen_kept(bench: Bench, steps: int) -> dict[str, Any]:
    """Train beside a frozen category, with densification and a reset: do its rows keep every bit?"""
    every = steps // 5
    config = TrainConfig(
        max_steps=steps,
        lr_schedule="published",
        refine_every=every,
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
        return {"summary": "no pytest or no tests here", "failed": True}
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
