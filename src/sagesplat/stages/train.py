"""Makes the levels: trains 3DGS from the labelled points and records them."""

import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Progress, Training, Warned
from sagesplat.core.limits import LabelId, StepNumber
from sagesplat.io.files import write_json
from sagesplat.io.typed import read_json_as
from sagesplat.run.job import Job
from sagesplat.run.records import checkpoint_key
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import run_stage
from sagesplat.scene.scene import Scene
from sagesplat.segment.display_names import titles
from sagesplat.stages.outliers import write_inliers
from sagesplat.stages.refine import write_cameras
from sagesplat.stages.shared import existing
from sagesplat.train import memory
from sagesplat.train.checkpoint import can_resume, remove_checkpoints
from sagesplat.train.events import Found, LabelFrozen, LevelSaved, Resumed, Step, Trained
from sagesplat.train.parallel import train_together
from sagesplat.train.sky import Sky, find_sky, sky_labels, write_sky
from sagesplat.train.trainer import train


def train_levels(job: Job, config: TrainConfig, seed: int) -> None:
    """Train 3DGS from the labelled points and record the levels."""
    run = job.run
    # the photos of a step decide the result, not the processes that compute it
    settings = {**asdict(config), "batch": max(config.batch, job.processes), "seed": seed}
    inputs = train_inputs(job, config)

    def make() -> list[str]:
        key = checkpoint_key(run, settings, inputs)
        place = _place(job, key)
        rows = job.given_scene.train_ids.tolist()
        job.photos.fetch(
            rows, job.threads, lambda done, total: job.emit(Progress("train", done, total, "photos"))
        )
        resuming = place.checkpoint.exists() and (not job.force or can_resume(place.checkpoint, key))
        sky, scene, label_ids = _with_sky(job, config)
        fitted, cap = _fit_memory(job, scene, place, config, resuming)  # before anything is given up
        if not resuming:
            remove_checkpoints(place.checkpoint)
            shutil.rmtree(place.levels, ignore_errors=True)
            _forget_cleaning(place)
        place.path.mkdir(exist_ok=True)
        write_cap(place.cap, cap, settings)
        place.sky.unlink(missing_ok=True)
        if sky:
            write_sky(place.sky, sky)
        counts: dict[str, int] = {}
        names = titles(job.names())
        start = partial(train_together, job.processes, job.threads) if job.processes > 1 else train
        events = start(
            scene, job.photos, label_ids, fitted,
            masks=job.masks if config.freeze_at is not None else None, valid=job.valid,
            seed=seed, backend=job.backend, folder=place.path, settings=key,
            shell=sky.shell if sky else None,
        )  # fmt: skip
        lines = []
        for event in events:
            match event:
                case Resumed(step, damage):
                    before = f", the checkpoint before the newest: {damage}" if damage else ""
                    job.emit(Warned(f"resuming from step {step}{before}"))
                case Found(text):
                    job.emit(Warned(text))
                case Step(step, loss, num, _):
                    job.emit(Training(step, config.max_steps, loss, counts, num))
                case LevelSaved():
                    counts = {names[i]: n for i, n in event.counts.items()}
                case LabelFrozen(step, label, ssim, count):
                    name = names[label]
                    job.emit(
                        Warned(f"{name} stops at step {step} with SSIM {ssim:.3f} and {count:,} Gaussians")
                    )
                case Trained(gaussians, step, frozen) as trained:
                    write_frozen(place.frozen, frozen)
                    lines = [f"{len(gaussians):,} Gaussians after {step} steps"]
                    if sky:
                        on_shell = int(sky.shell.holds(gaussians.means).sum())
                        lines.append(
                            f"sky: {on_shell:,} of them on a sphere {sky.shell.scale:.0f} scene extents away"
                        )
                    lines += write_cameras(job, place, config, trained)
                    lines += write_inliers(job, place, config, gaussians)
        if place != run:
            _swap(run, place)
        return lines

    # with exposure auto it depends on the photos: what was refined once must be there
    refines = config.poses or config.exposure == "affine" or run.refined.exists()
    outputs = [run.levels, run.checkpoint, *([run.cameras, run.refined] if refines else [])]
    outputs += [run.inliers] if config.outliers else []
    run_stage(job, "train", settings, inputs, outputs, make, swaps=True)


def write_cap(path: Path, cap: int, settings: Mapping[str, Any]) -> None:
    """Write down what a training begins with: its cap of Gaussians (0: none needed) and its settings."""
    write_json(path, {"cap": cap, "settings": dict(settings)})


@dataclass(frozen=True)
class _Cap:
    cap: StepNumber


def read_cap(path: Path) -> int:
    """The cap that `write_cap` wrote; RunError for anything else."""
    cure = "delete it, and run the same command again"
    return read_json_as(path, _Cap, "a cap of Gaussians", cure, RunError).cap


def write_frozen(path: Path, steps: Mapping[int, int]) -> None:
    """Write the steps at which categories stopped, by label id."""
    write_json(path, {str(label): step for label, step in steps.items()})


def read_frozen(path: Path) -> dict[int, int]:
    """The steps that `write_frozen` wrote; RunError for anything else."""
    what, cure = "the steps at which categories stopped", "write {} into it if no category stopped early"
    return read_json_as(path, dict[LabelId, StepNumber], what, cure, RunError)


def train_inputs(job: Job, config: TrainConfig) -> list[Path]:
    """What a training reads besides photos: label images where categories may stop early, or one is sky."""
    run = job.run
    labelled = config.sky == "auto" and (run.masks / "labels.json").exists()
    look = config.freeze_at is not None or (labelled and sky_labels(job.masks.taxonomy))
    return [run.scene, run.labels, *([run.provenance("masks")] if look else []), *existing(run.valid)]


def _place(job: Job, key: str) -> RunDir:
    """Where to train: in the run folder, or beside a finished training, which stays until this one ends."""
    run, aside = job.run, job.run.replacement
    if can_resume(aside.checkpoint, key):
        return aside
    shutil.rmtree(aside.path, ignore_errors=True)
    finished = run.provenance("train").exists() and run.levels.exists()
    return aside if finished else run


def _swap(run: RunDir, made: RunDir) -> None:
    """Put a finished training in the place of the earlier one.

    The checkpoint comes last: where this is killed, training finds it, ends at once and swaps what is left.
    """
    run.provenance("train").unlink(missing_ok=True)
    _forget_cleaning(run)
    if made.levels.exists():
        old = made.path / "old-levels"
        shutil.rmtree(old, ignore_errors=True)
        if run.levels.exists():
            run.levels.rename(old)
        made.levels.rename(run.levels)
    remove_checkpoints(run.checkpoint)
    for earlier in (run.cameras, run.refined, run.sky):
        earlier.unlink(missing_ok=True)
    shutil.rmtree(run.inliers, ignore_errors=True)
    kinds = ("frozen", "cap", "cameras", "refined", "sky", "inliers", "checkpoint")
    for new, place in ((getattr(made, kind), getattr(run, kind)) for kind in kinds):
        if new.exists():
            new.replace(place)
    shutil.rmtree(made.path)


def _forget_cleaning(run: RunDir) -> None:
    """Remove what was made of another training's last level."""
    for path in (run.provenance("clean"), run.cleaned, run.floaters, run.floaters_picture):
        path.unlink(missing_ok=True)


def _with_sky(job: Job, config: TrainConfig) -> tuple[Sky | None, Scene, np.ndarray]:
    """The sky, if there is one, and the scene and the labels of its points (int16 [P]) with it."""
    scene, label_ids, sky = job.given_scene, job.initial_labels, None
    if config.sky == "auto":
        sky = find_sky(scene, job.photos, job.masks, label_ids, job.valid)
    return (sky, *sky.begin(scene, label_ids)) if sky else (None, scene, label_ids)


def _fit_memory(
    job: Job, scene: Scene, place: RunDir, config: TrainConfig, resuming: bool
) -> tuple[TrainConfig, int]:
    """The settings with a cap that fits into memory, and that cap (0: none needed).

    A training that resumes keeps the cap it began with.
    """
    if job.backend == "cuda":  # Gaussians are not in the machine's memory
        return config, 0
    began = read_cap(place.cap) if resuming and place.cap.exists() else 0
    fitted = memory.fit(scene, config, job.memory_limit, processes=job.processes, began=began)
    job.emit(Warned(str(fitted)))
    return fitted.config, fitted.lowered
