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
from sagesplat.core.memory import named_memory, return_freed
from sagesplat.io.files import named_full_disk, remove_temporary, sync_changed
from sagesplat.io.lock import locked
from sagesplat.run.job import Job
from sagesplat.run.records import is_done, read_record, record
from sagesplat.run.run_dir import check_run
from sagesplat.run.stage_table import command_of, needed_for, stage_kind

_CLOCK_STEP = 2.0  # seconds: some disks keep no finer time


@dataclass(frozen=True)
class Stage:
    """What is done once: its settings and inputs decide its outputs."""

    name: str
    settings: dict[str, Any]
    inputs: Sequence[Path]
    outputs: Sequence[Path]
    swaps: bool = False  # the old result and its record stay until `make` takes them away


def run_stage(
    job: Job, name: str, settings: dict[str, Any], inputs: Sequence[Path], outputs: Sequence[Path],
    make: Callable[[], Sequence[str]], *, swaps: bool = False,
) -> None:  # fmt: skip
    """Do a stage, unless its result is there already: made with the same settings from the same inputs.

    The run folder is locked meanwhile. A stage counts as done only once its files are on the disk, and not
    while it is redone.

    Args:
        job: The run folder, and where events go.
        name: Of the stage in `STAGES`; its record is provenance/NAME.json.
        settings: Everything that the result depends on, besides the inputs; JSON.
        inputs: Files and folders that it is made from; their hashes are recorded.
        outputs: Files and folders that it makes.
        make: Does the work and returns lines that sum up the result.
        swaps: The old result and its record stay until `make` removes them.

    Raises:
        RunError: If an input is missing, the result was made with other settings (without `job.force`),
            another process works on the folder, or the disk is full. What was finished stays: the same
            command resumes.
        OutOfMemory: If memory runs out; the same holds.
    """
    run_stages(job, [Stage(name, settings, inputs, outputs, swaps)], lambda _: iter([(0, make())]))


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
    where = f"{job.run.path}: {stages[missing[0]].name}"
    with ExitStack() as own, named_full_disk(job.run.path), named_memory(where):
        (job.locks or own).enter_context(locked(job.run.path, job.lock_wait))
        remove_temporary(job.run.path, but="bundle")  # a viewer writes those, without the lock
        for number in missing:
            if not stages[number].swaps:
                job.run.provenance(stages[number].name).unlink(missing_ok=True)
            job.emit(StageStarted(stages[number].name))
        return_freed()
        begin, since = time.perf_counter(), time.time() - _CLOCK_STEP
        for number, lines in make(missing):
            stage = stages[number]
            seconds = time.perf_counter() - begin
            sync_changed(job.run.path, since)
            record(job.run, stage.name, stage.settings, stage.inputs, seconds)
            job.emit(StageDone(stage.name, seconds, tuple(lines)))


def _is_done(job: Job, stage: Stage) -> bool:
    """Whether a stage is to be skipped, which is said; RunError where it cannot be done."""
    if "scene" in needed_for(stage.name):
        check_run(job.run)
    for path in stage.inputs:
        if not path.exists():
            after = command_of(stage.name)
            raise RunError(f"{path}: missing; run what comes before `{after}`, or `sagesplat run`")
    what = job.run, stage.name, stage.settings, stage.inputs, stage.outputs
    if is_done(*what, job.force or _follows(job, stage)):
        job.emit(StageSkipped(stage.name))
        return True
    if job.force and job.before_redo and not _follows(job, stage):
        try:
            is_done(*what, force=False)
        except RunError as refusal:
            job.before_redo(stage.name, str(refusal).partition("; ")[0])
    return False


def _follows(job: Job, stage: Stage) -> bool:
    """Whether a stage may be made again without --force (`StageKind.again`)."""
    again, record = stage_kind(stage.name).again, job.run.provenance(stage.name)
    if again != "inputs" or not record.exists():
        return again == "always"
    try:
        return read_record(record)["settings"] == stage.settings
    except RunError:  # a broken record is told where it is compared
        return False
