"""How long a run will take on this machine, told before training begins."""

import time
from dataclasses import replace

import numpy as np
import torch

from sagesplat.core.config import NestConfig, RunConfig, TrainConfig
from sagesplat.core.durations import duration
from sagesplat.core.events import Noted
from sagesplat.core.gaussians import Gaussians
from sagesplat.run.executor import Local
from sagesplat.run.job import Job
from sagesplat.scene.scene import Scene
from sagesplat.segment.lift import IGNORED
from sagesplat.train import memory
from sagesplat.train.early_stopping import ActiveTiles, trainable_rows
from sagesplat.train.lr_schedule import LrSchedule, lr_schedule
from sagesplat.train.photo_loader import PhotoLoader
from sagesplat.train.state import from_points, initial_state
from sagesplat.train.stepper import Stepper
from sagesplat.train.strategy import schedule_of

_WORTH_TELLING = 60.0  # seconds
_TIMED = 3  # steps, after one that compiles
_MOST_TIMED = 300_000  # Gaussians; what larger models take follows from a straight line
# Of a step on as many Gaussians, as measured: a nested step, which draws prefixes and rounds; a
# step of the base model, which is small half of the time; a render.
_NESTED, _BASE, _RENDER = 0.9, 0.8, 0.25
_DRAWN = 2.5  # renders at drawn viewpoints for each step of the training and of its levels
_PASSES = 12  # over all training views, to order Gaussians by importance


def tell_duration(job: Job, config: RunConfig) -> None:
    """Say about how long training, levels and measuring will take, where a CPU of this machine does them."""
    begun = job.run.checkpoint.exists() or job.run.provenance("train").exists()
    if begun or job.backend == "cuda" or config.blocks.count > 1 or not isinstance(job.executor, Local):
        return
    rows = job.valid.rows(job.given_scene, job.given_scene.train_ids)
    if not len(rows) or not (job.initial_labels != IGNORED).any():
        return  # nothing to learn from: training says so
    fitted = memory.fit(job.given_scene, config.train, job.memory_limit, processes=job.processes)
    fixed, each = step_seconds(job, fitted.config, fitted.lowered)
    train = training_seconds(job, fitted.config, fitted.lowered, fixed, each)
    nested = config.nest if job.run.ladder == "nested" else None
    parts = {"training": train}
    if nested:
        parts["levels"] = _levels_seconds(job.given_scene, nested, fixed, each * fitted.lowered)
    step = fixed + each * fitted.lowered
    parts["measuring"] = _measuring_seconds(job.given_scene, config.train, nested, step)
    if (total := sum(parts.values())) >= _WORTH_TELLING:
        each_part = ", ".join(f"{name} {duration(round(seconds, -1))}" for name, seconds in parts.items())
        job.emit(Noted(f"from here on about {duration(total)} on this machine: {each_part}"))


def step_seconds(job: Job, config: TrainConfig, most: int) -> tuple[float, float]:
    """Seconds of a training step on full-size photos: a part that is fixed, and one for each Gaussian."""
    scene = job.given_scene
    points = from_points(scene.points, job.initial_labels, config.sh_degree)
    count = max(min(most, _MOST_TIMED), 2 * len(points))
    few = _timed(job, config, points, degree=0)
    many = _timed(job, config, grown(points, count), degree=config.sh_degree)
    each = max(many - few, 0.0) / (count - len(points))
    return max(few - each * len(points), 0.0), each


def grown(g: Gaussians, count: int) -> Gaussians:
    """About as many Gaussians as `count` that cover what `g` does, as densification leaves them."""
    times = -(-count // len(g))
    rows = torch.arange(len(g)).repeat_interleave(times)[:count]
    shifts = torch.randn(len(rows), 3, generator=torch.Generator().manual_seed(0))
    means = g.means[rows] + shifts * torch.exp(g.log_scales[rows])
    return replace(g.select(rows), means=means, log_scales=g.log_scales[rows] - np.log(times) / 2)


def _timed(job: Job, config: TrainConfig, g: Gaussians, degree: int) -> float:
    """The shortest of a few steps, in seconds."""
    scene = job.given_scene
    state = initial_state(g, 0)
    state.sort()
    loader = PhotoLoader(scene, job.photos, torch.device("cpu"), job.valid)
    stepper = Stepper(loader, replace(config, batch=1, strategy="default"), ActiveTiles(scene, None), "cpu")
    rates = LrSchedule(config, scene.extent).learning_rates(1)
    trainable, found = trainable_rows(state.gaussians, {}), []
    for _ in range(1 + _TIMED):
        begin = time.perf_counter()
        stepper(state, degree, rates, trainable)
        found.append(time.perf_counter() - begin)
    return min(found[1:])


def training_seconds(job: Job, config: TrainConfig, most: int, fixed: float, each: float) -> float:
    """Seconds of a training that grows to `most` Gaussians in a straight line, small photos counted."""
    scene, plan = job.given_scene, schedule_of(config)
    rows = scene.train_ids[:: max(1, len(scene.train_ids) // 8)]
    photos = [job.photos[row] for row in rows] if config.lr_schedule == "fast" else []
    rates = lr_schedule(config, scene.extent, photos)
    steps = np.arange(1, config.max_steps + 1)
    share = np.clip((steps - plan.refine_start) / max(1, plan.refine_stop - plan.refine_start), 0, 1)
    points = len(scene.points.xyz)
    counts = points + share * (most - points)
    smaller = np.array([rates.factor(int(step)) for step in steps])
    batch = max(config.batch, job.processes)
    return float((fixed / smaller**2 + each * counts).sum()) * batch / job.processes


def _levels_seconds(scene: Scene, config: NestConfig, fixed: float, full: float) -> float:
    """Seconds of the base model, of ordering, and of training on compositions."""
    base = config.base_steps * _BASE * (fixed + config.base_share * full) if config.base_share else 0.0
    passes = _PASSES * len(scene.train_ids) * _RENDER * (fixed + full)
    return base + passes + config.steps * _NESTED * (fixed + full)


def _measuring_seconds(scene: Scene, train: TrainConfig, nested: NestConfig | None, step: float) -> float:
    """Seconds of observing levels in photos and, of nested ones, at drawn viewpoints, and of calibrating."""
    if nested is None:
        return len(scene.views) * (train.max_steps // schedule_of(train).level_every) * _RENDER * step
    renders = len(scene.views) * nested.levels
    renders += _DRAWN * (train.max_steps + nested.steps + nested.base_steps)
    return renders * _RENDER * step
