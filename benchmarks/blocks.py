"""A large scene trained in blocks and as one: quality along borders and elsewhere, time and memory."""

import multiprocessing
import resource
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sagesplat.adapt.ladder import read_prefixes
from sagesplat.core.config import BlocksConfig, RunConfig
from sagesplat.core.events import Emit, StageDone, StageStarted, named
from sagesplat.output.table import Table
from sagesplat.raster import set_threads
from sagesplat.run.executor import Local, Task
from sagesplat.run.job import Job, JobSpec
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.blocks import read_blocks
from sagesplat.stages import blocks
from sagesplat.stages.boundaries import balance_table, border_table
from sagesplat.stages.label import lift_labels, make_masks
from sagesplat.stages.nest import nest_levels
from sagesplat.stages.pipeline import train
from sagesplat.stages.scene import open_scene
from sagesplat.train.boundaries import together

_MIB = 2**10  # kB, as getrusage counts


@dataclass(eq=False)
class Fresh(Local):
    """Does each task in a process of its own, and notes its time and peak memory."""

    threads: int
    measured: list[tuple[str, float, float]] = field(default_factory=list)  # name, seconds, MiB

    def run(self, tasks: Sequence[Task], emit: Emit) -> Iterator[tuple[int, Any]]:
        """See `sagesplat.run.executor.Executor`."""
        for number, task in enumerate(tasks):
            begin = time.perf_counter()
            result, peak = in_fresh_process(task, self.threads)
            self.measured.append((task.name, time.perf_counter() - begin, peak))
            yield number, result


def in_fresh_process(task: Task, threads: int) -> tuple[Any, float]:
    """A task's result and the peak memory of the process that did it, MiB."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(task, threads, theirs))
    process.start()
    theirs.close()
    try:
        found = ours.recv()
    except EOFError:
        process.join()
        raise RuntimeError(f"{task.name}: its process ended with {process.exitcode}") from None
    process.join()
    return found


def _work(task: Task, threads: int, answer: Any) -> None:
    set_threads(threads)
    result = task.function(*task.arguments, tell)
    answer.send((result, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _MIB))


def tell(event: Any) -> None:
    """Print what has ended."""
    if isinstance(event, StageDone):
        print(f"{event.name}: {event.seconds:.0f} s, {'; '.join(event.lines)}", flush=True)
    elif isinstance(event, StageStarted):
        print(f"{event.name} ...", flush=True)


def label(spec: JobSpec, scene: Path, config: RunConfig, emit: Emit) -> None:
    """What comes before training."""
    job = spec.open(emit)
    open_scene(job, scene, config.scene)
    make_masks(job, config.masks, config.labels)
    lift_labels(job)


def as_one(spec: JobSpec, config: RunConfig, emit: Emit) -> None:
    """Train and nest the scene as one."""
    job = spec.open(named(emit, "as one"))
    train(job, config.train, config.blocks, config.seed)
    nest_levels(job, config.nest, config.seed)


def compare(
    scene: Path, out: Path, in_blocks: RunConfig, whole: RunConfig, threads: int = 1
) -> tuple[list[Table], dict[str, Any]]:
    """Train `scene` both ways below `out`; tables, and what was measured."""
    set_threads(threads)
    fresh = Fresh(threads)
    job = Job(RunDir(out / "blocks"), tell, "cpu", threads, executor=fresh)
    other = Job(RunDir(out / "one"), tell, "cpu", threads)
    for each in (job, other):
        label(each.spec, scene, in_blocks, tell)
    blocks.train_blocks(job, in_blocks.blocks, in_blocks.train, in_blocks.seed)
    blocks.label_block_categories(job)
    blocks.nest_blocks(job, in_blocks.blocks, in_blocks.nest, in_blocks.seed)
    list(fresh.run([Task("as one", as_one, (other.spec, replace(whole, blocks=BlocksConfig())))], tell))
    partition = read_blocks(job.run.blocks / "blocks.json")
    files = [job.run.block(number).interior for number in range(len(partition))]
    sets = {
        "blocks, put together": together(files).full,
        "blocks, tuned": read_prefixes(job.run.prefixes).gaussians,
        "as one": read_prefixes(other.run.prefixes).gaussians,
    }
    memory = Table("Peak memory and time of each task", ("task", "seconds", "MiB"), ("", ".0f", ".0f"), [])
    memory.rows.extend(fresh.measured)
    tables = [
        balance_table(job, partition),
        border_table(job, partition, sets),
        memory,
    ]
    return tables, {table.title: [table.header, *table.rows] for table in tables}
