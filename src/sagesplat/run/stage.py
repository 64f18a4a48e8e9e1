"""A stage done once: skipped where its result is there already, recorded where it is new."""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sagesplat.core.errors import RunError
from sagesplat.core.events import StageDone, StageSkipped, StageStarted
from sagesplat.io.files import named_full_disk, remove_temporary, sync_changed
from sagesplat.io.lock import locked
from sagesplat.run.job import NO_RUN, Job
from sagesplat.run.run_dir import is_done, record

_CLOCK_STEP = 2.0  # seconds: some disks keep no finer time


@dataclass(frozen=True)
class Stage:
    """What is done once: its settings and inputs decide its outputs."""

    name: str
    settings: dict[str, Any]
    inputs: Sequence[Path]
    outputs: Sequence[Path]


def run_stage(
    job: Job, name: str, settings: dict[str, Any], inputs: Sequence[Path], outputs: Sequence[Path],
    make: Callable[[], Sequence[str]],
) -> None:  # fmt: skip
    """Do a stage unless its result is there already.

    Nobody else writes into the run folder meanwhile. A stage counts as done only once its files are on the
    disk, and not while it is done anew. RunError where another process works on the folder, or the disk is
    full: then what was finished stays, and the same command goes on.
    """
    run_stages(job, [Stage(name, settings, inputs, outputs)], lambda _: iter([(0, make())]))


def run_stages(
    job: Job,
    stages: Sequence[Stage],
    make: Callable[[Sequence[int]], Iterator[tuple[int, Sequence[str]]]],
) -> None:
    """Like `run_stage` for several that do not depend on each other, side by side.

    `make` gets the numbers of those that are to be done, and gives each with its lines as soon as it is.
    """
    stages = [replace(s, settings=json.loads(json.dumps(s.settings, default=str))) for s in stages]
    missing = [number for number, stage in enumerate(stages) if not _is_done(job, stage)]
    if not missing:
        return
    with ExitStack() as own, named_full_disk(job.run.path):
        (job.locks or own).enter_context(locked(job.run.path, job.lock_wait))
        remove_temporary(job.run.path, but="bundle")  # a viewer writes those, without the lock
        for number in missing:
            job.run.provenance(stages[number].name).unlink(missing_ok=True)
            job.emit(StageStarted(stages[number].name))
        begin, since = time.perf_counter(), time.time() - _CLOCK_STEP
        for number, lines in make(missing):
            stage = stages[number]
            seconds = time.perf_counter() - begin
            sync_changed(job.run.path, since)
            record(job.run, stage.name, stage.settings, stage.inputs, seconds)
            job.emit(StageDone(stage.name, seconds, tuple(lines)))


def _is_done(job: Job, stage: Stage) -> bool:
    """Whether a stage is to be skipped, which is said; RunError where it cannot be done."""
    if stage.name not in ("poses", "scene") and not job.run.scene.exists():
        raise RunError(f"{job.run.path}: {NO_RUN}")
    for path in stage.inputs:
        if not path.exists():
            command = stage.name.replace("_", "-")
            raise RunError(f"{path}: missing; run the stage before `sagesplat {command}`, or `sagesplat run`")
    done = is_done(job.run, stage.name, stage.settings, stage.inputs, stage.outputs, job.force)
    if done:
        job.emit(StageSkipped(stage.name))
    return done
