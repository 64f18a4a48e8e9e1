"""What the nodes of a test's cluster do; light, since each of their processes imports it."""

import os
import signal
import time
from pathlib import Path

import ray

from sagesplat.core.errors import RunError
from sagesplat.core.events import Progress, Warned


def where(number: int, emit) -> tuple[int, str]:
    emit(Progress("inner", 1, 2))
    emit(Warned("same of all"))
    time.sleep(0.5)
    emit(Progress("inner", 2, 2))
    return number, ray.get_runtime_context().get_node_id()


def fail(number: int, folder: Path, emit) -> None:
    if number == 0:
        raise RunError(f"{folder}: mend it")
    time.sleep(20)
    (folder / str(number)).touch()


def divide(number: int, emit) -> float:
    return 1 / number


def die(folder: Path, times: int, emit) -> int:
    """End the process as the system does where memory is short, so many times."""
    tries = len(list(folder.glob("try-*")))
    (folder / f"try-{tries}").touch()
    if tries < times:
        os.kill(os.getpid(), signal.SIGKILL)
    return tries


def hold(folder: Path, emit) -> str:
    """Wait for the file "go"; the node comes back, and our process is the content of a file of its name."""
    node = ray.get_runtime_context().get_node_id()
    (folder / f"new-{node}").write_text(str(os.getpid()))
    (folder / f"new-{node}").rename(folder / f"on-{node}")
    end = time.monotonic() + 60
    while not (folder / "go").exists() and time.monotonic() < end:
        time.sleep(0.05)
    return node
