"""A sweep: every scene, variant of the settings and seed of one small file, summed up as mean and spread."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sagesplat.adapt.observe import TOTAL
from sagesplat.core.errors import RunError, SageError
from sagesplat.core.events import Emit, Progress, StageDone, StageStarted, Warned, named
from sagesplat.io.files import atomic_folder, link
from sagesplat.output.table import Table
from sagesplat.output.tables import MB, mean, promise_kept
from sagesplat.raster import Backend
from sagesplat.run.executor import LOCAL, Executor, Local, Task
from sagesplat.run.job import Job, JobSpec
from sagesplat.run.records import seconds_of
from sagesplat.run.run_dir import RunDir
from sagesplat.stages.pipeline import demo_capture, run_all
from sagesplat.stages.results import evaluation_of, plans_of
from sagesplat.studies.sweep.file import Cell, Sweep
from sagesplat.studies.sweep.report import MEASURES, SHOWN, Row, readable, summarise, write_tables


def run_sweep(
    sweep: Sweep,
    out: Path,
    emit: Emit,
    backend: Backend = "auto",
    threads: int = 1,
    force: bool = False,
    executor: Executor = LOCAL,
) -> Table:
    """Run the cells in `out`/runs, skip what is done, and return means and spreads for a terminal.

    cells.csv, summary.csv and summary.md in `out` are written after each cell, rows in the order of the
    cells. A cell that fails is recorded there and the others go on; RunError at the end says which did.
    """
    runs = out / "runs"
    if out.exists() and not runs.exists() and any(out.iterdir()):
        raise RunError(f"{out}: not empty and not the folder of a sweep; choose a new folder")
    runs.mkdir(parents=True, exist_ok=True)
    rows: dict[int, list[Row]] = {}
    failed: dict[int, str] = {}
    job = Job(RunDir(runs), emit, backend, threads, force, executor=executor)
    for number, done in _run_cells(sweep, job):
        rows[number] = done.rows
        name = sweep[number].name
        if done.failed:
            failed[number] = name
        else:
            emit(StageDone(name, done.seconds, (f"run {number + 1} of {len(sweep)}",)))
        write_tables(out, [row for at in sorted(rows) for row in rows[at]])
    shown = readable(summarise([row for at in sorted(rows) for row in rows[at]]), SHOWN)
    emit(shown.event)
    if failed:
        names = ", ".join(failed[number] for number in sorted(failed))
        raise RunError(
            f"{out}: {len(failed)} of {len(sweep)} runs failed ({names}); mend what `status` in "
            f"{out / 'cells.csv'} says and sweep again"
        )
    return shown


@dataclass(frozen=True)
class _Done:
    """What became of a cell."""

    rows: list[Row]
    seconds: float
    failed: bool


def _run_cells(sweep: Sweep, job: Job) -> Iterator[tuple[int, _Done]]:
    """The cells' results with their numbers, as they come; `job` is one on the folder of all runs.

    Elsewhere a cell that shares the training of an earlier one waits for it.
    """
    like = {number: _trained_alike(sweep[:number], cell) for number, cell in enumerate(sweep)}
    if isinstance(job.executor, Local):
        for number, cell in enumerate(sweep):
            yield number, _run_cell(cell, like[number], job)
        return
    if any(cell.capture is None for cell in sweep):
        demo_capture(job.emit)  # once, not in every process
    ended = 0
    job.emit(StageStarted("sweep"))
    for first in (True, False):
        numbers = [number for number, other in like.items() if (other is None) == first]
        cells = [replace(c, capture=c.capture and c.capture.absolute()) for c in (sweep[n] for n in numbers)]
        spec, gpus = job.spec, job.gpus
        tasks = [Task("sweep", _cell, (c, like[n], spec), gpus) for c, n in zip(cells, numbers, strict=True)]
        for i, done in job.executor.run(tasks, job.emit):
            yield numbers[i], done
            ended += 1
            job.emit(StageStarted("sweep"))  # a bar of its own, below what was said of the cell
            job.emit(Progress("sweep", ended, len(sweep)))


def _cell(cell: Cell, like: Cell | None, spec: JobSpec, emit: Emit) -> _Done:
    """A task: one cell; what it warns of is passed on, its progress is not."""
    return _run_cell(cell, like, spec.open(lambda event: emit(event) if isinstance(event, Warned) else None))


def _run_cell(cell: Cell, like: Cell | None, of: Job) -> _Done:
    """Run a cell with the settings of a job on the folder of all runs."""
    begin = time.perf_counter()
    runs = of.run.path
    job = replace(of, run=RunDir(runs / cell.name, cell.config.ladder), emit=named(of.emit, cell.name))
    try:
        _share_training(runs, like, cell)
        run_all(job, cell.capture or demo_capture(job.emit), cell.config)
        return _Done(list(_measure(cell, job)), time.perf_counter() - begin, False)
    except SageError as error:
        job.emit(Warned(str(error)))
        nothing = [math.nan] * len(MEASURES)
        keys = [(cell.scene, cell.variant, cell.config.seed, target) for target in cell.config.plan.targets]
        rows: list[Row] = [(*key, *nothing, f"failed: {error}") for key in keys]
        return _Done(rows, time.perf_counter() - begin, True)


def _trained_alike(earlier: Sequence[Cell], cell: Cell) -> Cell | None:
    """The first cell with the same settings up to the training."""

    def trained(of: Cell) -> tuple:
        c = of.config
        return of.scene, c.scene, c.poses, c.masks, c.labels, c.train, c.clean, c.blocks, c.seed

    return next((c for c in earlier if trained(c) == trained(cell)), None)


def _share_training(runs: Path, like: Cell | None, cell: Cell) -> None:
    """Begin with all that an earlier cell has made up to its training: later stages read any of it."""
    new = RunDir(runs / cell.name)
    if like is None or new.path.exists() or not RunDir(runs / like.name).provenance("train").exists():
        return
    old = RunDir(runs / like.name)
    if old.capture.exists() or old.blocks.exists():  # these are named in there
        return
    stages = ("scene", "given", "segment", "photo_instances", "masks", "lift", "train", "clean")
    made = [old.scene, old.geometry, old.given, old.segmented, old.photo_instances, old.masks, old.valid]
    made += [old.labels, old.levels, old.checkpoint, old.cap, old.frozen, old.cameras, old.refined, old.sky]
    made += [old.inliers, old.cleaned, old.floaters, old.floaters_picture]
    made += map(old.provenance, stages)
    with atomic_folder(new.path) as fresh:
        # links take no room; nothing in a run is changed in place
        for path in (p for p in made if p.exists()):
            for file in [p for p in path.rglob("*") if p.is_file()] if path.is_dir() else [path]:
                link(file, fresh / file.relative_to(old.path))


def _measure(cell: Cell, job: Job) -> Iterator[Row]:
    """What a finished run says of each target, as a row of cells.csv."""
    full = job.ladder.size(job.ladder.levels[-1])
    evaluation = evaluation_of(job)
    seconds = seconds_of(job.run, "train")
    for plan in plans_of(job):
        here = evaluation.of(plan).of_own_quality()
        whole = here.select(here.label_id == TOTAL)
        kept = promise_kept(here)
        quality = map(mean, (whole.ssim, whole.full_ssim, whole.psnr, whole.full_psnr))
        yield (
            cell.scene, cell.variant, cell.config.seed, plan.target, plan.count, plan.count / max(1, full),
            plan.nbytes / MB, *quality, kept.promised, kept.kept, kept.share,
            mean(np.abs(here.predicted - here.ssim)), seconds, plan.status,
        )  # fmt: skip
