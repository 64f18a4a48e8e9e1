"""Training: a generator of events over a state; it prints nothing and draws nothing."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import DataError, OutOfMemory, RunError
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.levels import check_level, write_level
from sagesplat.raster import Backend, device_of
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.segment.masks import Masks
from sagesplat.train import densify, mcmc
from sagesplat.train.checkpoint import latest_checkpoint, previous, write_checkpoint
from sagesplat.train.early_stopping import ActiveTiles, label_quality, measured_views, trainable_rows
from sagesplat.train.gradient_freezing import GradientFreezing
from sagesplat.train.group import ALONE, Group
from sagesplat.train.lr_schedule import lr_schedule
from sagesplat.train.photo_loader import PhotoLoader
from sagesplat.train.state import MCMC_OPACITY, MCMC_SCALE, TrainState, from_points, initial_state
from sagesplat.train.stepper import Stepper

CHECKPOINT = "checkpoint.npz"
_LESS = "lower --train.max-gaussians, or begin a run with --downscale 2"
LOOK_EVERY = 100  # steps between two looks at the loss on a GPU


@dataclass(frozen=True)
class Resumed:
    """Training goes on from a checkpoint."""

    step: int
    damage: str = ""  # what was wrong with the newest one, if this is the one before


@dataclass(frozen=True)
class Step:
    """One optimiser step was taken."""

    step: int
    loss: float
    num_gaussians: int
    drawn: float = 1.0  # share of the tiles that this process drew


@dataclass(frozen=True)
class LevelSaved:
    """A level was recorded (`path` is None where nothing is written)."""

    step: int
    path: Path | None
    counts: dict[int, int]
    recovering: bool
    gaussians: Gaussians  # on the training device; the next step changes them in place


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
    group: Group = ALONE,
) -> Iterator[Event]:
    """Train 3D Gaussians on the training views of a scene: a generator of events.

    Loss, learning rates and densification are those of 3DGS (Kerbl et al. 2023), or of 3DGS-MCMC with
    `config.strategy="mcmc"`. With `config.freeze_at`, the SSIM of each category is measured whenever a level
    is recorded. A category that reaches the target keeps every bit from then on, and training ends when all
    have.

    Args:
        scene: The capture; `scene.train_ids` are used.
        photos: Its photos, uint8 [H, W, 3] by row of `scene.views`.
        label_ids: int16 [P], category of each SfM point; -1: unlabelled. Clones and splits inherit it.
        config: Steps, learning rates, densification and levels.
        masks: Label images; needed for `config.freeze_at`.
        seed: Of all random numbers. The same seed gives the same bits on the CPU.
        backend: Rasteriser, see `rasterize`; decides the device.
        folder: Levels and a checkpoint are written here (levels/, checkpoint.npz); None: nothing is written.
        settings: A checkpoint in `folder` is resumed if it was written with the same text.
        group: Processes that train one model together. All call this with the same arguments.

    Yields:
        `Resumed` first where a checkpoint was found, `Step` at every step, `LevelSaved`, `LabelFrozen`, and
        `Trained` last, with the Gaussians on the CPU.

    Raises:
        RunError: If the loss is not finite, memory runs out, a GPU fails, or a setting is impossible.

    Example:
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from sagesplat import TrainConfig, load_scene, train_gaussians
        >>> from sagesplat.scene.images import Photos
        >>> scene = load_scene(Path("captures/garden"), downscale=4)  # doctest: +SKIP
        >>> labels = np.full(len(scene.points.xyz), -1, np.int16)  # doctest: +SKIP
        >>> for event in train_gaussians(scene, Photos(scene.views), labels, TrainConfig()):  # doctest: +SKIP
        ...     print(event)
    """
    _check(config, masks)
    state: TrainState | None = None
    with named_failures(lambda: _where(state, folder)):
        for event, state in _train(  # noqa: B007 - the last state is asked for where training fails
            scene, photos, label_ids, config, masks, seed, backend, folder, settings, group
        ):
            yield event


@contextmanager
def named_failures(where: Callable[[], str]) -> Iterator[None]:
    """RunError where memory runs out or a GPU fails; `where` says how far training came."""
    try:
        yield
    except (torch.OutOfMemoryError, OutOfMemory, MemoryError) as error:
        raise RunError(f"{where()}: out of memory; {_LESS}") from error
    except RuntimeError as error:
        if "CUDA error" not in str(error):
            raise
        reason = str(error).splitlines()[0]
        raise RunError(f"{where()}: the GPU failed ({reason}); look at nvidia-smi, then run again") from error


def finite(loss: Tensor, step: int) -> float:
    """The loss as a number; RunError where it is none. A GPU is waited for."""
    value = float(loss)
    if not math.isfinite(value):
        raise RunError(f"the loss became {value} at step {step}; lower the learning rates and train again")
    return value


def _where(state: TrainState | None, folder: Path | None) -> str:
    """How far training came, and where the next one begins."""
    if state is None:
        return "training did not begin"
    kept = f", {folder / CHECKPOINT} is kept" if folder and (folder / CHECKPOINT).exists() else ""
    return f"training stopped at step {state.step} with {len(state.gaussians):,} Gaussians{kept}"


def _train(
    scene: Scene,
    photos: Photos,
    label_ids: np.ndarray,
    config: TrainConfig,
    masks: Masks | None,
    seed: int,
    backend: Backend,
    folder: Path | None,
    settings: str,
    group: Group,
) -> Iterator[tuple[Event, TrainState]]:
    """The events of `train`, each with the state that it comes from."""
    plan = densify.schedule(config)
    some = scene.train_ids[:: max(1, len(scene.train_ids) // 8)]
    schedule_of_run = lr_schedule(
        config, scene.extent, [photos[i] for i in some] if config.lr_schedule == "fast" else []
    )
    device = device_of(backend, group.rank)
    begin = (MCMC_OPACITY, MCMC_SCALE) if config.strategy == "mcmc" else ()
    state = initial_state(from_points(scene.points, label_ids, config.sh_degree, *begin), seed).to(device)
    state.sort()
    checkpoint = folder / CHECKPOINT if folder else None
    if checkpoint and checkpoint.exists():
        state, damage = latest_checkpoint(checkpoint, settings)
        state = state.to(device)
        if not group.leads:  # the first has what all had seen
            state.clear_statistics()
        else:
            _check_levels(checkpoint, state.step)
        yield Resumed(state.step, damage), state
    folder = folder if group.leads else None
    active_tiles = ActiveTiles(scene, masks, frozenset(state.frozen), device)
    gradient_freezing = (
        GradientFreezing(config.gradient_freeze_share) if config.gradient_freeze_share else None
    )
    stepper = Stepper(
        PhotoLoader(scene, photos, device), config, active_tiles, backend, group, gradient_freezing
    )
    trainable = trainable_rows(state.gaussians, state.frozen)
    looked_at = measured_views(scene, masks) if config.freeze_at is not None and masks is not None else {}
    awake, learning, value = trainable, bool(trainable.any()), 0.0
    while state.step < config.max_steps and learning:
        step = state.step + 1
        last = step == config.max_steps
        records = step % plan.level_every == 0 or last
        refining = plan.refine_start < step < plan.refine_stop
        degree, factor = _sh_degree(step - 1, config, plan), schedule_of_run.factor(step)
        observing = config.strategy == "default" and step < plan.refine_stop
        sgld_noise = schedule_of_run.sgld_noise(step) if config.strategy == "mcmc" else 0.0
        loss = stepper(
            state, degree, schedule_of_run.learning_rates(step), awake, factor, observing, sgld_noise
        )
        if device.type == "cpu" or records or step % LOOK_EVERY == 0:  # looking waits for a GPU
            value = finite(loss, step)
        yield Step(step, value, len(state.gaussians), stepper.drawn), state
        resets = refining and config.strategy == "default" and step % plan.reset_every == 0
        late = resets and config.levels_after_reset
        if records and not late:
            yield _save_level(state, config, plan, folder), state
        if records and config.freeze_at is not None and masks is not None:
            degree = _sh_degree(step, config, plan)
            quality = label_quality(
                state.gaussians, stepper.active_tiles, stepper.photo_loader, looked_at, config, degree,
                backend=backend, workspace=stepper.workspace, group=group,
            )  # fmt: skip
            for event in _freeze(state, quality, config.freeze_at):
                yield event, state
            if len(state.frozen) > len(stepper.active_tiles.frozen):
                stepper.active_tiles = ActiveTiles(scene, masks, frozenset(state.frozen), device)
            awake = trainable = trainable_rows(state.gaussians, state.frozen)
            learning = bool(trainable.any())
        if refining and step % config.refine_every == 0:
            _refine(state, config, plan, scene, trainable, group, schedule_of_run.factor(step))
            awake = trainable = trainable_rows(state.gaussians, state.frozen)
        if gradient_freezing and step % config.refine_every == 0:
            awake = gradient_freezing.turn(trainable)
        if resets:
            densify.reset_opacities(state, config, trainable)
        if records and late:
            yield _save_level(state, config, plan, folder), state
        if records:
            group.collect(state.grad_sum, state.grad_count)
        if folder and records:
            write_checkpoint(folder / CHECKPOINT, state, settings)
    if folder:
        previous(folder / CHECKPOINT).unlink(missing_ok=True)  # nobody goes on from here
    yield Trained(state.gaussians.to("cpu"), state.step, state.frozen), state


def _check_levels(checkpoint: Path, step: int) -> None:
    """RunError where a level up to a step is damaged: training goes on after it and records it no more."""
    for path in sorted((checkpoint.parent / "levels").glob("[0-9]*.npz")):
        if int(path.stem) > step:
            continue
        try:
            check_level(path)
        except DataError as error:
            reason = str(error).partition("; ")[0]
            raise RunError(
                f"{reason}; delete it to go on without that level, or {checkpoint} to train from the start"
            ) from None


def _refine(
    state: TrainState,
    config: TrainConfig,
    plan: densify.Schedule,
    scene: Scene,
    trainable: Tensor,
    group: Group,
    factor: int,
) -> None:
    """Let Gaussians come and go, as the strategy has it; photos of the moment are `factor` times smaller."""
    camera, num_points = scene.views[0].camera, len(scene.points.xyz)
    num_pixels = camera.width * camera.height
    if config.strategy == "mcmc":
        most = densify.cap(config, num_pixels, num_points)
        refinements = (plan.refine_stop - plan.refine_start) // config.refine_every
        mcmc.relocate(state, config, trainable)
        mcmc.add(state, config, most, trainable, mcmc.growth(most, num_points, refinements))
    else:
        most = densify.budget(config, plan, state.step, num_pixels, num_pixels // factor**2, num_points)
        group.add(state.grad_sum, state.grad_count)
        densify.refine(state, config, scene.extent, densify.room(state, most, trainable), trainable)
    state.sort()


def _check(config: TrainConfig, masks: Masks | None) -> None:
    counts = (("max_steps", 1, 10**9), ("level_every", 0, 10**9), ("sh_degree", 0, 3), ("batch", 1, 10**6))
    for name, low, high in counts:
        value = getattr(config, name)
        if not low <= value <= high:
            raise RunError(
                f"--train.{name.replace('_', '-')} {value} is impossible; choose {low} to {high:,}"
            )
    target = config.freeze_at
    if target is not None and not 0 < target <= 1:
        raise RunError(f"--train.freeze-at {target} is no SSIM to reach; choose a number such as 0.8")
    if not 0 <= config.gradient_freeze_share < 1:
        raise RunError(
            f"--train.rest-share {config.gradient_freeze_share} is no share; choose a number such as 0.5"
        )
    if target is not None and masks is None:
        raise RunError("--train.freeze-at needs label images to measure categories on; bring masks")


def _freeze(state: TrainState, quality: dict[int, float], target: float) -> Iterator[LabelFrozen]:
    """Stop the categories that have reached the target."""
    counts = state.gaussians.counts()
    for label, ssim in quality.items():
        if label not in state.frozen and ssim >= target:
            state.frozen[label] = state.step
            yield LabelFrozen(state.step, label, ssim, counts.get(label, 0))


def _save_level(
    state: TrainState, config: TrainConfig, plan: densify.Schedule, folder: Path | None
) -> LevelSaved:
    recovering = state.last_reset >= 0 and state.step - state.last_reset <= plan.recovery
    path = None
    if folder:
        degree = _sh_degree(state.step, config, plan)
        path = write_level(
            folder / "levels", state.step, state.gaussians.to("cpu"), recovering=recovering, sh_degree=degree
        )
    return LevelSaved(state.step, path, state.gaussians.counts(), recovering, state.gaussians)


def _sh_degree(step: int, config: TrainConfig, plan: densify.Schedule) -> int:
    """The degree of the harmonics in use after a step."""
    return min(config.sh_degree, step // plan.raise_sh_every)
