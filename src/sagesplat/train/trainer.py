"""Training: a generator of events over a state; it prints nothing and draws nothing."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from sagesplat.config import TrainConfig
from sagesplat.errors import RunError
from sagesplat.gaussians import Gaussians
from sagesplat.metrics import photometric_loss
from sagesplat.raster import Backend, Workspace, rasterize
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.sh import num_bases
from sagesplat.train import densify
from sagesplat.train.checkpoint import read_checkpoint, write_checkpoint
from sagesplat.train.levels import write_level
from sagesplat.train.optim import adam_step
from sagesplat.train.pace import Pace, pace, smaller
from sagesplat.train.state import TrainState, from_points, initial_state


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
class Trained:
    """The end."""

    gaussians: Gaussians


Event = Resumed | Step | LevelSaved | Trained


def train(
    scene: Scene,
    photos: Photos,
    label_ids: np.ndarray,  # int16 [P], category of each SfM point
    config: TrainConfig,
    *,
    seed: int = 0,
    backend: Backend = "auto",
    folder: Path | None = None,
    settings: str = "",
) -> Iterator[Event]:
    """Train on the training views; levels and the checkpoint go into `folder` (levels/, checkpoint.npz).

    A checkpoint found there that belongs to the same `settings` is continued. Raises `RunError` where the
    loss stops being finite.
    """
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
    workspace = Workspace()
    while state.step < config.max_steps:
        loss = _step(state, scene, photos, config, plan, run_pace, backend, workspace)
        yield Step(state.step, loss, len(state.gaussians))
        step, last = state.step, state.step == config.max_steps
        if step % plan.level_every == 0 or last:
            yield _save_level(state, config, plan, folder)
        if plan.refine_start < step < plan.refine_stop:
            trainable = torch.ones(len(state.gaussians), dtype=torch.bool)
            if step % config.refine_every == 0:
                pixels = num_pixels // run_pace.factor(step) ** 2
                most = densify.budget(config, plan, step, num_pixels, pixels, len(scene.points.xyz))
                densify.refine(state, config, extent, most - len(state.gaussians), trainable)
                state.sort()
                trainable = torch.ones(len(state.gaussians), dtype=torch.bool)
            if step % plan.reset_every == 0:
                densify.reset_opacities(state, config, trainable)
        if checkpoint and (step % plan.level_every == 0 or last):
            write_checkpoint(checkpoint, state, settings)
    yield Trained(state.gaussians)


def _save_level(
    state: TrainState, config: TrainConfig, plan: densify.Schedule, folder: Path | None
) -> LevelSaved:
    recovering = state.last_reset >= 0 and state.step - state.last_reset < plan.recovery
    path = None
    if folder:
        degree = _sh_degree(state, config, plan)
        path = write_level(
            folder / "levels", state.step, state.gaussians, recovering=recovering, sh_degree=degree
        )
    return LevelSaved(state.step, path, state.gaussians.counts(), recovering)


def _sh_degree(state: TrainState, config: TrainConfig, plan: densify.Schedule) -> int:
    """The degree of the harmonics in use."""
    return min(config.sh_degree, state.step // plan.raise_sh_every)


def _next_view(state: TrainState, scene: Scene) -> int:
    """Views in random order, each once a round."""
    if not state.queue:
        state.queue = state.rng.permutation(scene.train_ids).tolist()
    return state.queue.pop()


def _step(
    state: TrainState,
    scene: Scene,
    photos: Photos,
    config: TrainConfig,
    plan: densify.Schedule,
    run_pace: Pace,
    backend: Backend,
    workspace: Workspace,
) -> float:
    """Render one view, compare it with its photo, move the Gaussians."""
    view = _next_view(state, scene)
    factor = run_pace.factor(state.step + 1)
    pixels, camera = smaller(photos[view], scene.views[view].camera, factor)
    photo = torch.from_numpy(pixels).float() / 255
    degree = _sh_degree(state, config, plan)
    leaves = {name: p.detach().requires_grad_() for name, p in state.gaussians.parameters().items()}
    render = rasterize(
        replace(state.gaussians, **leaves),
        camera,
        sh_degree=degree,
        antialiased=config.antialiased,
        workspace=workspace,
        backend=backend,
    )
    loss = photometric_loss(render.rgb, photo, config.ssim_weight, workspace)
    value = float(loss.detach())
    if not np.isfinite(value):
        raise RunError(
            f"the loss became {value} at step {state.step + 1}; lower the learning rates and train again"
        )
    loss.backward()
    state.step += 1
    trainable = torch.ones(len(state.gaussians), dtype=torch.bool)
    if state.step < plan.refine_stop:
        densify.observe_gradients(state, render, camera.width, camera.height, trainable)
    rates = run_pace.rates(state.step)
    in_use = 3 * (num_bases(degree) - 1)
    for name, leaf in leaves.items():
        assert leaf.grad is not None
        adam_step(
            leaf.detach().numpy(),
            leaf.grad.numpy(),
            state.first[name].numpy(),
            state.second[name].numpy(),
            lr=rates[name],
            step=state.step,
            trainable=trainable.numpy(),
            columns=in_use if name == "shN" else None,
        )
    return value
