"""Pieces of a stage's work, done here or by other processes."""

import json
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from sagesplat.core.errors import RunError
from sagesplat.core.events import Emit
from sagesplat.run.executor import Local, Task
from sagesplat.run.job import Job, JobSpec

Part = TypeVar("Part")
Result = TypeVar("Result")


def work(
    job: Job, name: str, function: Callable[[Job, Part], Result], parts: Sequence[Part]
) -> Iterator[tuple[int, Result]]:
    """`function(job, part)` of each part, with the part's number, as they come (see `Executor.run`).

    `function` is one of a module. Where the executor is another process's, it gets a job opened there.
    """
    if isinstance(job.executor, Local):
        for number, part in enumerate(parts):
            yield number, function(job, part)
    else:
        spec, gpus = job.spec, job.gpus
        tasks = [Task(name, _piece, (spec, function, part), gpus) for part in parts]
        yield from job.executor.run(tasks, job.emit)


def work_all(
    job: Job, name: str, function: Callable[[Job, Part], Result], parts: Sequence[Part]
) -> list[Result]:
    """What `work` finds, in the order of the parts."""
    found = dict(work(job, name, function, parts))
    return [found[number] for number in range(len(parts))]


def _piece(spec: JobSpec, function: Callable[[Job, Any], Any], part: Any, emit: Emit) -> Any:
    """A task: one part, in a process that may have had others of the same scene."""
    kept = _kept(replace(spec, force=False), spec.run.scene.read_bytes())
    return function(spec.open(emit, kept), part)


@lru_cache(maxsize=1)
def _kept(spec: JobSpec, scene: bytes) -> Job:
    """A job whose scene and photos serve one task after the other; `scene`: content of scene.json."""
    capture = Path(json.loads(scene)["path"])
    if not capture.exists():
        raise RunError(
            f"{capture}: {socket.gethostname()} does not see the capture; all nodes need it under this path, "
            "on a disk that they share"
        )
    return spec.open(lambda event: None)
