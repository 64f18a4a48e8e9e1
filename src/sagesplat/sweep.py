"""A sweep: every scene, variant of the settings and seed of one small file, summed up as mean and spread."""

import math
import re
import shutil
import statistics
import time
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

from sagesplat import pipeline
from sagesplat.adapt.evaluate import read_evaluation
from sagesplat.adapt.observe import TOTAL
from sagesplat.adapt.plan import read_plans
from sagesplat.config import RunConfig
from sagesplat.errors import DataError, RunError, SageError, short
from sagesplat.events import Emit, Progress, StageDone, StageStarted, TableMade, Warned, named
from sagesplat.executor import LOCAL, Executor, Local, Task
from sagesplat.files import link, read_json, write_text
from sagesplat.job import Job, JobSpec
from sagesplat.output.tables import MB, Table, mean, promise_kept
from sagesplat.raster import Backend
from sagesplat.run_dir import RunDir

MAX_LENGTH = 2**20  # characters of a file
MAX_DOTS = 64  # in one line of it
MAX_RUNS = 10_000
BUILT_IN = "demo"  # as a scene's path: the built-in capture
# columns of numbers, with their formats: SSIM and PSNR (dB) are of whole test views, `error` is the mean
# error of a category's promise there; a training that went on after a kill tells the seconds since then
MEASURES = {
    "Gaussians": ",.0f", "of 3DGS": ".1%", "MB": ".2f", "SSIM": ".3f", "3DGS SSIM": ".3f",
    "PSNR": ".2f", "3DGS PSNR": ".2f", "promised": ".1f", "kept": ".1f", "share kept": ".1%",
    "error": ".3f", "training s": ".1f",
}  # fmt: skip
SHOWN = ("of 3DGS", "SSIM", "share kept")  # what 80 characters have room for
_SET_BY = {"seed": "seeds", "target_ssim": "targets", "other_targets": "targets"}
_NEEDED = {
    bool: "true or false", int: "a whole number", float: "a finite number", str: "text in quotes",
    Path: "a path in quotes", tuple: "a list", dict: "a table",
}  # fmt: skip
Config = TypeVar("Config")  # a frozen dataclass of settings
Row = tuple[str | int | float, ...]


@dataclass(frozen=True)
class Cell:
    """One training of a sweep, with all targets planned on it."""

    scene: str
    variant: str  # empty where the file names none
    capture: Path | None  # None: the built-in one
    config: RunConfig  # with seed and targets

    @property
    def name(self) -> str:
        """Name of its run folder."""
        return "-".join(part for part in (self.scene, self.variant, f"seed{self.config.seed}") if part)


Sweep = tuple[Cell, ...]


@dataclass(frozen=True)
class _File:
    """What a sweep file may hold."""

    targets: tuple[float, ...] = ()
    seeds: tuple[int, ...] = ()
    settings: RunConfig = field(default_factory=RunConfig)
    scenes: dict[str, str] = field(default_factory=dict)
    variants: dict[str, dict[str, Any]] = field(default_factory=dict)


def read_sweep(path: Path) -> Sweep:
    """The cells that a sweep file asks for, by scene, variant and seed. DataError where it is not one."""
    try:
        text = path.read_text(encoding="utf-8")
        _need(len(text) <= MAX_LENGTH, f"{path}: {len(text)} characters, more than a sweep has; split it")
        # The parser keeps every prefix of a key of many parts.
        dots = max(line.count(".") for line in text.split("\n"))
        _need(dots <= MAX_DOTS, f"{path}: a line with {dots} dots; write lists and tables on several lines")
        document = tomllib.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(
            f"{path}: not readable as TOML ({short(error)}); examples/sweep.toml shows one"
        ) from None
    folder = path.parent
    file = _set(_File(), document, f"{path}: ", folder)
    targets = sorted(round(target, 6) for target in file.targets)
    for key, values in (("scenes", list(file.scenes)), ("targets", targets), ("seeds", file.seeds)):
        _need(values, f"{path}: {key}: missing or empty; give at least one")
        _need(len(set(values)) == len(values), f"{path}: {key}: two are equal; leave one out")
    _need(targets[0] > 0 and targets[-1] <= 1, f"{path}: targets: an SSIM is above 0 and at most 1")
    _need(min(file.seeds) >= 0, f"{path}: seeds: {min(file.seeds)} is negative; take 0 or more")
    for name in (*file.scenes, *file.variants):
        fine = re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,99}", name)
        _need(fine, f"{path}: the name {short(repr(name))} makes no folder; use letters, digits, _ . + and -")
    count = len(file.scenes) * max(1, len(file.variants)) * len(file.seeds)
    _need(count <= MAX_RUNS, f"{path}: {count} runs, at most {MAX_RUNS} are possible; split the sweep")
    main = targets.pop(len(targets) // 2)
    cells = []
    for scene, to in file.scenes.items():
        capture = None if to == BUILT_IN else folder / to
        _need(
            not capture or _is_folder(capture),
            f"{path}: scenes.{scene}: no folder {short(capture)}; mend the path",
        )
        for variant, changes in (file.variants or {"": {}}).items():
            config = _set(file.settings, changes, f"{path}: variants.{variant}.", folder)
            plan = replace(config.plan, target_ssim=main, other_targets=tuple(targets))
            cells += [Cell(scene, variant, capture, replace(config, plan=plan, seed=s)) for s in file.seeds]
    names = [cell.name.lower() for cell in cells]  # some disks know no capitals
    for name, times in Counter(names).items():
        _need(times == 1, f"{path}: two runs would be called {name}; rename a scene or a variant")
    return tuple(cells)


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:  # a name that no disk has, e.g. too long
        return False


def _need(fine: object, message: str) -> None:
    if not fine:
        raise DataError(message)


def _set(config: Config, table: Any, where: str, folder: Path) -> Config:
    """Settings with those of a TOML table in place; `where` is the path and key for errors."""
    _need(isinstance(table, dict), f"{where.rstrip('.')}: {short(repr(table))} given, a table is needed")
    hints = get_type_hints(type(config))
    values = {}
    for name, value in table.items():
        key = f"{where}{name}"
        _need(name not in _SET_BY, f"{key}: set by the list `{_SET_BY.get(name)}`; leave it out here")
        _need(name in hints, f"{where}{short(repr(name))}: no such key; there are {', '.join(hints)}")
        inner = getattr(config, name)
        if is_dataclass(inner):
            values[name] = _set(inner, value, f"{key}.", folder)
        else:
            values[name] = _value(hints[name], value, key, folder)
    return replace(config, **values)  # pyright: ignore[reportArgumentType]


def _value(hint: Any, value: Any, key: str, folder: Path) -> Any:
    """A value of a TOML file as the type that a setting has; paths are relative to `folder`."""
    kind, of = get_origin(hint) or hint, get_args(hint)
    if kind is UnionType:  # X | None, and TOML has no null
        return _value(of[0], value, key, folder)
    if kind is Any or (kind is Literal and value in of):
        return value
    if kind is tuple and isinstance(value, list):
        return tuple(_value(of[0], v, f"{key}[{i}]", folder) for i, v in enumerate(value))
    if kind is dict and isinstance(value, dict):
        return {name: _value(of[1], v, f"{key}.{name}", folder) for name, v in value.items()}
    if kind is Path and isinstance(value, str):
        return folder / value
    if kind is float and type(value) in (int, float) and abs(value) < 1e300:  # neither NaN nor infinite
        return float(value)
    if kind in (bool, int, str) and type(value) is kind:
        return value
    needed = " or ".join(map(repr, of)) if kind is Literal else _NEEDED[kind]
    raise DataError(f"{key}: {short(repr(value))} given, {needed} is needed")


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
        _write(out, [row for at in sorted(rows) for row in rows[at]])
    shown = readable(summarise([row for at in sorted(rows) for row in rows[at]]), SHOWN)
    emit(TableMade(shown.title, shown.header, tuple(map(tuple, shown.cells()))))
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
        pipeline.demo_capture(job.emit)  # once, not in every process
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
        pipeline.run_all(job, cell.capture or pipeline.demo_capture(job.emit), cell.config)
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
        return of.scene, c.scene, c.poses, c.masks, c.labels, c.lift, c.train, c.blocks, c.seed

    return next((c for c in earlier if trained(c) == trained(cell)), None)


def _share_training(runs: Path, like: Cell | None, cell: Cell) -> None:
    """Begin with what an earlier cell has trained."""
    new = RunDir(runs / cell.name)
    if like is None or new.path.exists() or not RunDir(runs / like.name).provenance("train").exists():
        return
    old = RunDir(runs / like.name)
    if old.capture.exists() or old.blocks.exists():  # these are named in there
        return
    # links take no room; nothing in a run is changed in place
    for path in (old.segmented, old.masks, old.levels):
        shutil.copytree(path, new.path / path.name, copy_function=lambda a, b: link(Path(a), Path(b)))
    stages = [old.provenance(stage) for stage in ("scene", "segment", "masks", "lift", "train")]
    for path in (old.scene, old.labels, old.checkpoint, old.frozen, *stages):
        link(path, new.path / path.relative_to(old.path))


def _measure(cell: Cell, job: Job) -> Iterator[Row]:
    """What a finished run says of each target, as a row of cells.csv."""
    full = job.ladder.size(job.ladder.levels[-1])
    evaluation = read_evaluation(job.run.evaluation)
    seconds = float(read_json(job.run.provenance("train"))["seconds"])
    for plan in read_plans(job.run.plan)[0]:
        here = evaluation.select(evaluation.target == np.float32(plan.target))
        whole = here.select(here.label_id == TOTAL)
        kept = promise_kept(here)
        quality = map(mean, (whole.ssim, whole.full_ssim, whole.psnr, whole.full_psnr))
        yield (
            cell.scene, cell.variant, cell.config.seed, plan.target, plan.count, plan.count / max(1, full),
            plan.nbytes / MB, *quality, kept.promised, kept.kept, kept.share,
            mean(np.abs(here.predicted - here.ssim)), seconds, plan.status,
        )  # fmt: skip


def summarise(rows: Sequence[Row]) -> Table:
    """Rows of cells.csv as mean and sample standard deviation over the seeds: NaN of nothing, and of one.

    `n` counts the runs that did not fail, `ok` those whose plan met the target.
    """
    groups: dict[Row, list[Row]] = {}
    for scene, variant, _, target, *measured in rows:
        groups.setdefault((scene, variant, target), []).append(tuple(measured))
    body = []
    for key, runs in groups.items():
        *columns, status = zip(*runs, strict=True)
        known = [[value for value in column if not math.isnan(value)] for column in columns]
        spreads = []
        for values in known:
            spreads.append(statistics.fmean(values) if values else math.nan)
            spreads.append(statistics.stdev(values) if len(values) > 1 else math.nan)
        body.append((*key, len(known[0]), status.count("ok"), *spreads))
    header = ("scene", "variant", "target", "n", "ok", *(f"{m}{sd}" for m in MEASURES for sd in ("", " sd")))
    formats = ("", "", "g", "d", "d", *(spec for spec in MEASURES.values() for _ in range(2)))
    return Table("Mean ± sample standard deviation over n seeds", header, formats, body)


def readable(summary: Table, measures: Sequence[str]) -> Table:
    """Some measures of a summary, each mean and spread in one cell."""
    first = summary.header.index("ok") + 1
    body: list[Row] = []
    for row in summary.cells():
        cells = dict(zip(summary.header, row, strict=True))
        spreads = ("±".join(v for v in (cells[m], cells[f"{m} sd"]) if v != "–") or "–" for m in measures)
        body.append((*row[:first], *spreads))
    header = (*summary.header[:first], *measures)
    return Table(summary.title, header, ("",) * len(header), body)


def _write(out: Path, rows: list[Row]) -> None:
    header = ("scene", "variant", "seed", "target", *MEASURES, "status")
    Table("Runs", header, ("", "", "d", "g", *MEASURES.values(), ""), rows).write_csv(out / "cells.csv")
    summary = summarise(rows)
    summary.write_csv(out / "summary.csv")
    write_text(out / "summary.md", f"{summary.title}\n\n{readable(summary, tuple(MEASURES)).markdown()}")
