"""Training: an iterator of events over a state; it prints nothing."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import DataError, OutOfMemory, RunError
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.memory import ran_out
from sagesplat.formats.levels import check_level, write_level
from sagesplat.io.typed import check_limits
from sagesplat.raster import Backend, device_of
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.scene.vignetting_fit import estimate_vignetting
from sagesplat.segment.masks import Masks
from sagesplat.segment.valid import ALL_VALID, ValidPixels
from sagesplat.train.checkpoint import Pace, latest_checkpoint, previous
from sagesplat.train.early_stopping import ActiveTiles, label_quality, measured_views, trainable_rows
from sagesplat.train.events import Event, Found, LabelFrozen, LevelSaved, Resumed, Step, Trained
from sagesplat.train.exposure import ExposureUpdate, exposure_update
from sagesplat.train.group import ALONE, Group
from sagesplat.train.lr_schedule import LrSchedule, lr_schedule
from sagesplat.train.outliers import OutlierSchedule
from sagesplat.train.photo_loader import PhotoLoader
from sagesplat.train.poses import pose_update
from sagesplat.train.sky import Shell
from sagesplat.train.state import TrainState, from_points, initial_state
from sagesplat.train.stepper import Stepper
from sagesplat.train.strategy import Densification, make_strategy
from sagesplat.train.view_parameters import ViewParameters, ViewUpdate

CHECKPOINT = "checkpoint.npz"
_LESS = "lower --train.max-gaussians, or begin a run with --downscale 2"
LOOK_EVERY = 100  # steps between two checks of the loss on a GPU
_SAVE_EVERY, _SMALL = 500, 10_000  # steps between two checkpoints, unless of so few Gaussians: always


def train(
    scene: Scene,
    photos: Photos,
    label_ids: np.ndarray,  # int16 [P], category of each SfM point
    config: TrainConfig,
    *,
    masks: Masks | None = None,
    valid: ValidPixels = ALL_VALID,
    seed: int = 0,
    backend: Backend = "auto",
    folder: Path | str | None = None,
    settings: str = "",
    group: Group = ALONE,
    shell: Shell | None = None,
    start: Gaussians | None = None,
) -> Iterator[Event]:
    """Train 3D Gaussians on the training views of a scene: a generator of events.

    Loss, learning rates and densification are those of 3DGS (Kerbl et al. 2023), or of 3DGS-MCMC with
    `config.strategy="mcmc"`. With `config.freeze_at`, the SSIM of each category is measured whenever a level
    is recorded. A category that reaches the target keeps every bit from then on, and training ends when all
    have.

    Args:
        scene: The capture; `scene.train_ids` are used.
        photos: Its photos, uint8 [H, W, 3] by row of `scene.views`.
        label_ids: int16 [P], category of each SfM point; -1: unlabelled, -2 (`IGNORED`): no Gaussian begins
            there. Clones and splits inherit it.
        config: Steps, learning rates, densification and levels.
        masks: Label images; needed for `config.freeze_at`.
        valid: The pixels that count; nothing is learnt from the others.
        seed: Of all random numbers. The same seed gives the same bits on the CPU.
        backend: Rasteriser, see `rasterize`; decides the device.
        folder: Levels and a checkpoint are written here (levels/, checkpoint.npz); None: nothing is written.
        settings: A checkpoint in `folder` is resumed if it was written with the same text.
        group: Processes that train one model together. All call this with the same arguments.
        shell: Gaussians that lie on it stay on it (see `train.sky`).
        start: Gaussians to begin with; None: one at each SfM point.

    Yields:
        `Resumed` first where a checkpoint was found, `Found`, `Step` at every step, `LevelSaved`,
        `LabelFrozen`, and `Trained` last, with the Gaussians on the CPU.

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
    check_limits(config, "train.")
    if config.freeze_at is not None and masks is None:
        raise RunError("--train.freeze-at needs label images to measure categories on; bring masks")
    folder = None if folder is None else Path(folder)
    training: Training | None = None
    with named_failures(lambda: _where(training.state if training else None, folder)):
        training = begin(
            scene, photos, label_ids, config,
            masks=masks, valid=valid, seed=seed, backend=backend, folder=folder, settings=settings,
            group=group, shell=shell, start=start,
        )  # fmt: skip
        yield from training.run()


@contextmanager
def named_failures(where: Callable[[], str]) -> Iterator[None]:
    """RunError where memory runs out or a GPU fails; `where` says how far training came."""
    try:
        yield
    except (torch.OutOfMemoryError, OutOfMemory, MemoryError) as error:
        raise RunError(f"{where()}: out of memory; {_LESS}") from error
    except RuntimeError as error:
        if ran_out(error):
            raise RunError(f"{where()}: out of memory; {_LESS}") from error
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
    """How far training came, and what is kept of it."""
    if state is None or not state.step:
        return "training did not begin"
    kept = f", {folder / CHECKPOINT} is kept" if folder and (folder / CHECKPOINT).exists() else ""
    return f"training stopped at step {state.step} with {len(state.gaussians):,} Gaussians{kept}"


@dataclass(eq=False)
class Training:
    """A training in progress: the state, and what changes it in each step."""

    config: TrainConfig
    state: TrainState
    stepper: Stepper
    strategy: Densification
    rates: LrSchedule
    measured: dict[int, list[int]]  # rows of the views on which each category is measured, for early stopping
    folder: Path | None  # None: this process writes nothing
    settings: str
    resumed: Resumed | None
    found: list[str]  # about the photos, in words
    loss: float = 0.0  # when it was last looked at

    def __post_init__(self) -> None:
        self.trainable = trainable_rows(self.state.gaussians, self.state.frozen)
        self.unfinished = bool(self.trainable.any())
        self._saved, self._pace = self.state.step, Pace()

    def run(self) -> Iterator[Event]:
        """Train to the end; the events of `train`."""
        if self.resumed:
            yield self.resumed
        yield from map(Found, self.found)
        while self.state.step < self.config.max_steps and self.unfinished:
            yield self._step()
            yield from self._after_step()
        if self.folder:
            previous(self.folder / CHECKPOINT).unlink(missing_ok=True)  # nobody resumes from here
        done = self.state.to(torch.device("cpu"))
        yield Trained(done.gaussians, done.step, done.frozen, done.per_view)

    def _step(self) -> Step:
        """One optimiser step."""
        step = self.state.step + 1
        loss = self.stepper(
            self.state, self._sh_degree(step - 1), self.rates.learning_rates(step), self.trainable,
            self.rates.factor(step),
        )  # fmt: skip
        on_cpu = not loss.is_cuda
        if on_cpu or self._records(step) or step % LOOK_EVERY == 0:  # reading it waits for a GPU
            self.loss = finite(loss, step)
        return Step(step, self.loss, len(self.state.gaussians), self.stepper.drawn)

    def _after_step(self) -> Iterator[Event]:
        """Record a level, stop categories, densify, and save a checkpoint, as is due."""
        step = self.state.step
        records = self._records(step)
        if records:
            yield self._save_level()
        if records and self.config.freeze_at is not None:
            yield from self._stop_categories(self.config.freeze_at)
        if self.strategy.step_post(self.state):
            self._update_trainable()
        if records:
            self.stepper.group.collect(self.state.grad_sum, self.state.grad_count)
            self._save_checkpoint()

    def _records(self, step: int) -> bool:
        """Whether a level is recorded after a step."""
        return step % self.strategy.schedule.level_every == 0 or step == self.config.max_steps

    def _sh_degree(self, step: int) -> int:
        """The degree of the harmonics in use after a step."""
        return min(self.config.sh_degree, step // self.strategy.schedule.raise_sh_every)

    def _update_trainable(self) -> None:
        self.trainable = trainable_rows(self.state.gaussians, self.state.frozen)

    def _save_level(self) -> LevelSaved:
        state, path = self.state, None
        since_reset = state.step - state.last_reset
        recovering = state.last_reset >= 0 and since_reset <= self.strategy.schedule.recovery
        if self.folder:
            path = write_level(
                self.folder / "levels", state.step, state.gaussians.to("cpu"),
                recovering=recovering, sh_degree=self._sh_degree(state.step),
            )  # fmt: skip
        return LevelSaved(state.step, path, state.gaussians.counts(), recovering)

    def _save_checkpoint(self) -> None:
        """Save the state, unless it is large and was saved not long ago: that takes as long as some steps."""
        state = self.state
        ends = state.step == self.config.max_steps or not self.unfinished
        small = len(state.gaussians) <= _SMALL
        later = state.step - self._saved >= _SAVE_EVERY and self._pace.due()
        if self.folder and (ends or small or later):
            self._pace.write(self.folder / CHECKPOINT, state, self.settings)
            self._saved = state.step

    def _stop_categories(self, target: float) -> Iterator[LabelFrozen]:
        """Early stopping: measure the categories and stop those that have reached the target SSIM."""
        state, stepper = self.state, self.stepper
        quality = label_quality(
            state.gaussians, stepper.active_tiles, stepper.photo_loader, self.measured, self.config,
            self._sh_degree(state.step),
            backend=stepper.backend, workspace=stepper.workspace, group=stepper.group,
            camera_of=partial(stepper.camera, state),
        )  # fmt: skip
        counts = state.gaussians.counts()
        for label, ssim in quality.items():
            if label not in state.frozen and ssim >= target:
                state.frozen[label] = state.step
                yield LabelFrozen(state.step, label, ssim, counts.get(label, 0))
        stepper.stop(state.frozen)
        self._update_trainable()
        self.unfinished = bool(self.trainable.any())


def begin(
    scene: Scene,
    photos: Photos,
    label_ids: np.ndarray,  # int16 [P]
    config: TrainConfig,
    *,
    masks: Masks | None = None,
    valid: ValidPixels = ALL_VALID,
    seed: int = 0,
    backend: Backend = "auto",
    folder: Path | None = None,
    settings: str = "",
    group: Group = ALONE,
    shell: Shell | None = None,
    start: Gaussians | None = None,
) -> Training:
    """A training at its start, or at the checkpoint in `folder`; the arguments are those of `train`."""
    rows = scene.train_ids[:: max(1, len(scene.train_ids) // 8)]
    rates = lr_schedule(
        config, scene.extent, [photos[i] for i in rows] if config.lr_schedule == "fast" else []
    )
    device = device_of(backend, group.rank)
    strategy = make_strategy(config, scene, rates, group, shell)
    g = start or from_points(
        scene.points, label_ids, config.sh_degree, strategy.initial_opacity, strategy.initial_scale,
    )  # fmt: skip
    batched = replace(config, batch=max(config.batch, group.size))
    updates, found = view_updates(scene, photos, batched)
    state, resumed = initial_state(g, seed).to(device), None
    for name, update in updates.items():
        parameters = ViewParameters.zeros(len(scene.views), update.size)
        if isinstance(update, ExposureUpdate):
            parameters.values += update.start
        state.per_view[name] = parameters.to(device)
    state.sort()
    if folder and (folder / CHECKPOINT).exists():
        state, damage = latest_checkpoint(folder / CHECKPOINT, settings)
        state, resumed = state.to(device), Resumed(state.step, damage)
        if group.leads:
            _check_levels(folder / CHECKPOINT, state.step)
        else:
            state.clear_statistics()  # the first process has those of all
    tiles = ActiveTiles(scene, masks, frozenset(state.frozen), device, valid)
    outliers = OutlierSchedule.of(config.max_steps, batched.batch, len(scene.train_ids))
    stepper = Stepper(
        PhotoLoader(scene, photos, device, valid), config, tiles, backend, group, strategy,
        view_updates=updates, outliers=outliers if config.outliers else None, shell=shell,
    )  # fmt: skip
    measured = measured_views(scene, masks) if config.freeze_at is not None and masks is not None else {}
    folder = folder if group.leads else None
    return Training(config, state, stepper, strategy, rates, measured, folder, settings, resumed, found)


def view_updates(
    scene: Scene, photos: Photos, config: TrainConfig
) -> tuple[dict[str, ViewUpdate], list[str]]:
    """What a training refines of the cameras, by kind ("pose", "exposure"), and lines about it."""
    updates: dict[str, ViewUpdate] = {}
    if config.poses:
        updates["pose"] = pose_update(scene, config.max_steps, config.batch)
    exposure, found = exposure_update(scene, photos, config)
    if exposure:
        updates["exposure"] = exposure
    return updates, [line for line in (found, _of_lens(scene, photos, config)) if line]


def _of_lens(scene: Scene, photos: Photos, config: TrainConfig) -> str:
    """What photos that nobody corrected show of their lens, in words; nothing where they show nothing."""
    if config.exposure == "off" or any(view.vignetting for view in scene.views):
        return ""
    found = estimate_vignetting(scene, photos)
    return (
        f"the lens loses {found.lost:.0%} of the light in the corners;"
        " `sagesplat run CAPTURE NEW_RUN --vignetting` corrects the photos"
        if found
        else ""
    )


def _check_levels(checkpoint: Path, step: int) -> None:
    """RunError where a level up to a step is damaged: a resumed training does not record it again."""
    for path in sorted((checkpoint.parent / "levels").glob("[0-9]*.npz")):
        if int(path.stem) > step:
            continue
        try:
            check_level(path)
        except DataError as error:
            reason = str(error).partition("; ")[0]
            raise RunError(
                f"{reason}; delete it to resume without that level, or {checkpoint} to train from the start"
            ) from None
