"""Parts of a stage, computed in this process or by those of an executor."""

import os
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, TypeVar

from sagesplat.core.errors import RunError
from sagesplat.core.events import Emit
from sagesplat.run.capture import read_capture
from sagesplat.run.executor import Local, Task
from sagesplat.run.job import Job, JobSpec

Part = TypeVar("Part")
Result = TypeVar("Result")


def work(
    job: Job, name: str, function: Callable[[Job, Part], Result], parts: Sequence[Part]
) -> Iterator[tuple[int, Result]]:
    """Yield (number of the part, `function(job, part)`) as results arrive (see `Executor.run`).

    `function` must be a module's, so that it can be pickled. In another process it gets a job opened there.
    """
    if isinstance(job.executor, Local):
        for number, part in enumerate(parts):
            yield number, function(job, part)
    else:
        spec, gpus = job.spec, job.gpus
        tasks = [Task(name, run_part, (spec, function, part), gpus) for part in parts]
        yield from job.executor.run(tasks, job.emit)


def work_all(
    job: Job, name: str, function: Callable[[Job, Part], Result], parts: Sequence[Part]
) -> list[Result]:
    """The results of `work`, in the order of the parts."""
    results = dict(work(job, name, function, parts))
    return [results[number] for number in range(len(parts))]


def run_part(spec: JobSpec, function: Callable[[Job, Any], Any], part: Any, emit: Emit) -> Any:
    """A task: one part, in a process that may have computed others of the same scene."""
    kept = _kept(replace(spec, force=False), spec.run.scene.read_bytes())
    return function(spec.open(emit, kept), part)


@lru_cache(maxsize=1)
def _kept(spec: JobSpec, scene: bytes) -> Job:
    """A job whose scene and photos successive tasks share; `scene`: content of scene.json."""
    capture = read_capture(spec.run.scene).path
    if not os.path.exists(capture):  # Path.exists fails for names that no disk can hold
        raise RunError(
            f"{capture}: {socket.gethostname()} does not see the capture; all nodes need it under this path, "
            "on a disk that they share"
        )
    return spec.open(lambda event: None)
