"""A task of a Ray cluster, as it runs in a process of a node."""

import os
import socket
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError

from sagesplat import __version__
from sagesplat.core.errors import RunError, SageError
from sagesplat.core.events import Event, Progress, Training
from sagesplat.run.executor import Task

ANSWER = 5.0  # seconds that an actor may take to answer
_POLL = 0.1  # seconds between two checks for a file
_OFTEN = 0.2  # seconds between two reports of progress of a task
_VISIBLE = 10.0  # seconds until a file that was written here is seen on another node


@dataclass(frozen=True)
class Failed:
    """A task that ended with an error that the user can fix."""

    error: SageError


@dataclass(frozen=True)
class WorkerEnvironment:
    """What a task needs on its node."""

    marker: Path  # a file of ours in the folder that all nodes share
    cwd: Path  # what relative paths are relative to
    version: str = __version__


def run_task(
    task: Task, environment: WorkerEnvironment, post: Any, run: str, number: int, threads: int
) -> Any:
    """A task, in a process of its node; `Failed` for an error that the user can fix."""
    tell = _Tell(post, run, number)
    try:
        _check(environment)
        with suppress(OSError):
            os.chdir(environment.cwd)
        _set_threads(threads)
        return task.function(*task.arguments, tell)
    except SageError as error:
        return Failed(error)
    finally:
        tell.flush()


def checks_tokens() -> bool:
    """Whether the cluster that this process belongs to asks whoever connects for its token."""
    return os.environ.get("RAY_AUTH_MODE", "").lower() not in ("", "disabled")


def _check(environment: WorkerEnvironment) -> None:
    """RunError on a node that does not see the run folder, or has another version of this package."""
    host = socket.gethostname()
    if environment.version != __version__:
        raise RunError(
            f"{host} has sagesplat {__version__}, not {environment.version}; install the same on all nodes"
        )
    end = time.monotonic() + _VISIBLE
    while not environment.marker.exists():
        if time.monotonic() > end:
            raise RunError(
                f"{environment.marker.parent}: {host} does not see this folder; all nodes need it under this "
                "path, on a disk that they share"
            )
        time.sleep(_POLL)


def _set_threads(threads: int) -> None:
    """As the job asks, where the task's module has kernels at all: loading them takes seconds."""
    if "sagesplat.raster" in sys.modules:
        sys.modules["sagesplat.raster"].set_threads(threads)


class _Tell:
    """Sends the events of a task, progress not more often than anybody can look."""

    def __init__(self, post: Any, run: str, number: int):
        self._post, self._run, self._number = post, run, number
        self._held: Event | None = None  # progress that came too soon after the last
        self._sent = 0.0
        self._last: Any = None
        self._send(socket.gethostname())

    def __call__(self, event: Event) -> None:
        now, self._held = time.monotonic(), None
        if isinstance(event, Progress | Training):
            if now - self._sent < _OFTEN:
                self._held = event
                return
            self._sent = now
        self._send(event)

    def _send(self, event: Event | str) -> None:
        self._last = self._post.tell.remote(self._run, self._number, event)

    def flush(self) -> None:
        """Wait until all has arrived, so that it is heard before the result."""
        if self._held:
            self._send(self._held)
        with suppress(RayError):
            ray.get(self._last, timeout=ANSWER)
