"""Training: a generator of events over a state; it prints nothing and draws nothing."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sagesplat.config import TrainConfig
from sagesplat.errors import RunError
from sagesplat.gaussians import Gaussians
from sagesplat.raster import Backend
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.segment.masks import Masks
from sagesplat.train import densify
from sagesplat.train.checkpoint import read_checkpoint, write_checkpoint
from sagesplat.train.freeze import label_quality, trainable_rows
from sagesplat.train.levels import write_level
from sagesplat.train.pace import pace
from sagesplat.train.state import TrainState, from_points, initial_state
from sagesplat.train.stepper import Stepper


@dataclass(frozen=True)
class Resumed:
    """Training goes on from a checkpoint."""

    step: int


@dataclass(frozen=True)
class Step:
    """One optimiser step was taken."""

    step: int
    loss: float
    num_gaussians: int


@dataclass(frozen=True)
class LevelSaved:
    """A level was recorded (`path` is None where nothing is written)."""

    step: int
    path: Path | None
    counts: dict[int, int]
    recovering: bool


@dataclass(frozen=True)
class LabelFrozen:
    """A category has reached the quality asked for and stays as it is."""

    step: int
    label_id: int
    ssim: float  # mean over the training views measured
    count: int  # its Gaussians


@dataclass(frozen=True)
class Trained:
    """The end."""

    gaussians: Gaussians
    step: int
    frozen: dict[int, int]  # step from which on a category stayed as it was, by label id


Event = Resumed | Step | LevelSaved | LabelFrozen | Trained


def train(
    scene: Scene,
    photos: Photos,
    label_ids: np.ndarray,  # int16 [P], category of each SfM point
    config: TrainConfig,
    *,
    masks: Masks | None = None,
    seed: int = 0,
    backend: Backend = "auto",
    folder: Path | None = None,
    settings: str = "",
) -> Iterator[Event]:
    """Train on the training views; levels and the checkpoint go into `folder` (levels/, checkpoint.npz).

    With `config.freeze_at`, categories are measured on `masks` whenever a level is recorded; one that has
    reached it stays bit for bit as it is, and training ends when all have. A checkpoint found in `folder`
    that belongs to the same `settings` is continued. Raises `RunError` where the loss stops being finite,
    and for a `freeze_at` that is no SSIM.
    """
    _check(config, masks)
    plan = densify.schedule(config)
    extent, camera = scene.extent, scene.views[0].camera
    num_pixels = camera.width * camera.height
    some = scene.train_ids[:: max(1, len(scene.train_ids) // 8)]
    run_pace = pace(config, extent, [photos[i] for i in some] if config.pace == "fast" else [])
    state = initial_state(from_points(scene.points, label_ids, config.sh_degree), seed)
    state.sort()
    checkpoint = folder / "checkpoint.npz" if folder else None
    if checkpoint and checkpoint.exists():
        state = read_checkpoint(checkpoint, settings)
        yield Resumed(state.step)
    stepper = Stepper(scene, photos, config, backend)
    trainable = trainable_rows(state.gaussians, state.frozen)
    while state.step < config.max_steps and bool(trainable.any()):
        step = state.step + 1
        degree, factor = _sh_degree(step - 1, config, plan), run_pace.factor(step)
        loss, render = stepper(state, degree, run_pace.rates(step), trainable, factor)
        yield Step(step, loss, len(state.gaussians))
        if step < plan.refine_stop:
            height, width, _ = render.rgb.shape
            densify.observe_gradients(state, render, width, height, trainable)
        last = step == config.max_steps
        refining = plan.refine_start < step < plan.refine_stop
        records, resets = step % plan.level_every == 0 or last, refining and step % plan.reset_every == 0
        late = resets and config.levels_after_reset
        if records and not late:
            yield _save_level(state, config, plan, folder)
        if records and config.freeze_at is not None and masks is not None:
            degree = _sh_degree(step, config, plan)
            quality = label_quality(
                state.gaussians, scene, photos, masks, config, degree, backend, stepper.workspace
            )
            yield from _freeze(state, quality, config.freeze_at)
            trainable = trainable_rows(state.gaussians, state.frozen)
        if refining and step % config.refine_every == 0:
            pixels = num_pixels // run_pace.factor(step) ** 2
            most = densify.budget(config, plan, step, num_pixels, pixels, len(scene.points.xyz))
            room = densify.room(state, most, trainable)
            densify.refine(state, config, extent, room, trainable)
            state.sort()
            trainable = trainable_rows(state.gaussians, state.frozen)
        if resets:
            densify.reset_opacities(state, config, trainable)
        if records and late:
            yield _save_level(state, config, plan, folder)
        if checkpoint and records:
            write_checkpoint(checkpoint, state, settings)
    yield Trained(state.gaussians, state.step, state.frozen)


def _check(config: TrainConfig, masks: Masks | None) -> None:
    for name, low, high in (("max_steps", 1, 10**9), ("level_every", 0, 10**9), ("sh_degree", 0, 3)):
        value = getattr(config, name)
        if not low <= value <= high:
            raise RunError(
                f"--train.{name.replace('_', '-')} {value} is impossible; choose {low} to {high:,}"
            )
    target = config.freeze_at
    if target is not None and not 0 < target <= 1:
        raise RunError(f"--train.freeze-at {target} is no SSIM to reach; choose a number such as 0.8")
    if target is not None and masks is None:
        raise RunError("--train.freeze-at needs label images to measure categories on; bring masks")


def _freeze(state: TrainState, quality: dict[int, float], target: float) -> Iterator[LabelFrozen]:
    """Stop the categories that have reached the target."""
    counts = state.gaussians.counts()
    for label, ssim in quality.items():
        if label in counts and label not in state.frozen and ssim >= target:
            state.frozen[label] = state.step
            yield LabelFrozen(state.step, label, ssim, counts[label])


def _save_level(
    state: TrainState, config: TrainConfig, plan: densify.Schedule, folder: Path | None
) -> LevelSaved:
    recovering = state.last_reset >= 0 and state.step - state.last_reset <= plan.recovery
    path = None
    if folder:
        degree = _sh_degree(state.step, config, plan)
        path = write_level(
            folder / "levels", state.step, state.gaussians, recovering=recovering, sh_degree=degree
        )
    return LevelSaved(state.step, path, state.gaussians.counts(), recovering)


def _sh_degree(step: int, config: TrainConfig, plan: densify.Schedule) -> int:
    """The degree of the harmonics in use after a step."""
    return min(config.sh_degree, step // plan.raise_sh_every)
