"""Makes the levels: trains 3DGS from the labelled points and records snapshots."""

import shutil
from dataclasses import asdict
from functools import partial
from pathlib import Path

from sagesplat.core.config import TrainConfig
from sagesplat.core.events import Training, Warned
from sagesplat.io.files import read_json, write_json
from sagesplat.run.job import Job
from sagesplat.run.records import checkpoint_key
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import run_stage
from sagesplat.segment.display_names import titles
from sagesplat.train import memory
from sagesplat.train.checkpoint import can_resume, remove_checkpoints
from sagesplat.train.events import LabelFrozen, LevelSaved, Resumed, Step, Trained
from sagesplat.train.parallel import train_together
from sagesplat.train.trainer import train


def train_levels(job: Job, config: TrainConfig, seed: int) -> None:
    """Train 3DGS from the labelled points and record the levels."""
    run = job.run
    # the photos of a step decide the result, not the processes that compute it
    settings = {**asdict(config), "batch": max(config.batch, job.processes), "seed": seed}
    inputs = train_inputs(run, config)

    def make() -> list[str]:
        key = checkpoint_key(run, settings, inputs)
        place = _place(job, key)
        resuming = place.checkpoint.exists() and (not job.force or can_resume(place.checkpoint, key))
        fitted, cap = _fit_memory(job, place, config, resuming)  # before anything is given up
        if not resuming:
            remove_checkpoints(place.checkpoint)
            shutil.rmtree(place.levels, ignore_errors=True)
        place.path.mkdir(exist_ok=True)
        write_json(place.cap, {"cap": cap, "settings": settings})
        counts: dict[str, int] = {}
        names = titles(job.names())
        start = partial(train_together, job.processes, job.threads) if job.processes > 1 else train
        events = start(
            job.scene, job.photos, job.point_labels, fitted,
            masks=job.masks if config.freeze_at is not None else None,
            seed=seed, backend=job.backend, folder=place.path, settings=key,
        )  # fmt: skip
        lines = []
        for event in events:
            match event:
                case Resumed(step, damage):
                    before = f", the checkpoint before the newest: {damage}" if damage else ""
                    job.emit(Warned(f"resuming from step {step}{before}"))
                case Step(step, loss, num, _):
                    job.emit(Training(step, config.max_steps, loss, counts, num))
                case LevelSaved():
                    counts = {names[i]: n for i, n in event.counts.items()}
                case LabelFrozen(step, label, ssim, count):
                    name = names[label]
                    job.emit(
                        Warned(f"{name} stops at step {step} with SSIM {ssim:.3f} and {count:,} Gaussians")
                    )
                case Trained(gaussians, step, frozen):
                    write_json(place.frozen, {str(label): at for label, at in frozen.items()})
                    lines = [f"{len(gaussians):,} Gaussians after {step} steps"]
        if place != run:
            _swap(run, place)
        return lines

    outputs = [run.levels, run.checkpoint]
    run_stage(job, "train", settings, inputs, outputs, make, swaps=True)


def train_inputs(run: RunDir, config: TrainConfig) -> list[Path]:
    """What a training reads besides photos: label images only where categories may stop early."""
    return [run.scene, run.labels, *([run.provenance("masks")] if config.freeze_at is not None else [])]


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
    if made.levels.exists():
        old = made.path / "old-levels"
        shutil.rmtree(old, ignore_errors=True)
        if run.levels.exists():
            run.levels.rename(old)
        made.levels.rename(run.levels)
    remove_checkpoints(run.checkpoint)
    for new, place in ((made.frozen, run.frozen), (made.cap, run.cap), (made.checkpoint, run.checkpoint)):
        if new.exists():
            new.replace(place)
    shutil.rmtree(made.path)


def _fit_memory(job: Job, place: RunDir, config: TrainConfig, resuming: bool) -> tuple[TrainConfig, int]:
    """The settings with a cap that fits into memory, and that cap (0: none needed).

    A training that resumes keeps the cap it began with.
    """
    if job.backend == "cuda":  # Gaussians are not in the machine's memory
        return config, 0
    began = int(read_json(place.cap)["cap"]) if resuming and place.cap.exists() else 0
    fitted = memory.fit(job.scene, config, job.memory_limit, processes=job.processes, began=began)
    job.emit(Warned(str(fitted)))
    return fitted.config, fitted.lowered
