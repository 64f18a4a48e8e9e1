"""Makes the levels: trains 3DGS from the labelled points and records snapshots."""

import json
import shutil
from dataclasses import asdict
from functools import partial

from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Training, Warned
from sagesplat.io.files import read_json, write_json
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir, file_hash
from sagesplat.run.stage import run_stage
from sagesplat.train import memory
from sagesplat.train.checkpoint import latest_checkpoint, remove_checkpoints
from sagesplat.train.parallel import train_together
from sagesplat.train.trainer import LabelFrozen, LevelSaved, Resumed, Step, Trained, train


def train_levels(job: Job, config: TrainConfig, seed: int) -> None:
    """Train 3DGS from the labelled points and record the levels."""
    run = job.run
    # what a step looks at decides the result, not who does the work
    settings = {**asdict(config), "batch": max(config.batch, job.processes), "seed": seed}

    def make() -> list[str]:
        checkpoint_key = json.dumps(
            {**settings, "scene": file_hash(run.scene), "labels": file_hash(run.labels)}
        )
        resuming = run.checkpoint.exists() and (not job.force or _continues(run, checkpoint_key))
        fitted, cap = _fit_memory(job, config, resuming)  # before anything is given up
        if not resuming:
            remove_checkpoints(run.checkpoint)
            shutil.rmtree(run.levels, ignore_errors=True)
        write_json(run.cap, {"cap": cap})
        counts: dict[str, int] = {}
        names = job.names()
        start = partial(train_together, job.processes, job.threads) if job.processes > 1 else train
        events = start(
            job.scene, job.photos, job.point_labels, fitted,
            masks=job.masks if config.freeze_at is not None else None,
            seed=seed, backend=job.backend, folder=run.path, settings=checkpoint_key,
        )  # fmt: skip
        for event in events:
            match event:
                case Resumed(step, damage):
                    before = f", the checkpoint before the newest: {damage}" if damage else ""
                    job.emit(Warned(f"going on from step {step}{before}"))
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
                    write_json(run.frozen, {str(label): at for label, at in frozen.items()})
                    return [f"{len(gaussians):,} Gaussians after {step} steps"]
        return []

    run_stage(job, "train", settings, [run.scene, run.labels], [run.levels, run.checkpoint], make)


def _fit_memory(job: Job, config: TrainConfig, resuming: bool) -> tuple[TrainConfig, int]:
    """The settings with a cap that fits into memory, and that cap (0: none needed).

    A training that goes on keeps the cap it began with.
    """
    if job.backend == "cuda":  # Gaussians are not in the machine's memory
        return config, 0
    began = int(read_json(job.run.cap)["cap"]) if resuming and job.run.cap.exists() else 0
    fitted = memory.fit(job.scene, config, job.memory_limit, processes=job.processes, began=began)
    job.emit(Warned(str(fitted)))
    return fitted.config, fitted.lowered


def _continues(run: RunDir, checkpoint_key: str) -> bool:
    try:
        latest_checkpoint(run.checkpoint, checkpoint_key)
    except RunError:
        return False
    return True
