"""What all commands share."""

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from msgspec import Meta
from tyro.conf import Positional, arg

from sagesplat.core.config import LadderKind
from sagesplat.core.errors import BackendUnavailable, RunError
from sagesplat.core.extras import install
from sagesplat.core.limits import Seed as SeedNumber

if TYPE_CHECKING:
    from sagesplat.cli.console import Console
    from sagesplat.raster import Backend
    from sagesplat.run.executor import Executor
    from sagesplat.run.job import Job
    from sagesplat.run.run_dir import RunDir

COMMANDS: dict[str, Callable[..., None]] = {}


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Make a function a command of its name. Only the one that is called gets a parser: that takes time."""
    COMMANDS[function.__name__.replace("_", "-")] = function  # type: ignore
    return function


@dataclass(frozen=True)
class Redo:
    """Earlier results."""

    force: bool = False
    """Replace results that were made with other settings or inputs, and what depends on them; those that
    match are kept. Says first what is replaced and how long it took to make, and asks on a terminal."""
    yes: bool = False
    """Do not ask before replacing."""


@dataclass(frozen=True)
class Device:
    """Device."""

    threads: Annotated[int, Meta(ge=0, le=4096)] = 0
    """CPU threads (0: all cores)."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """auto: a CUDA GPU if one works (see `sagesplat doctor`), else the CPU."""


@dataclass(frozen=True)
class Compute(Device, Redo):
    """Device and earlier results, of commands that compute."""


@dataclass(frozen=True)
class Parallel(Compute):
    """Tasks of a command, on one machine or a cluster."""

    executor: str = "local"
    """Where independent tasks run. local: in this process, one after the other; ray: on the Ray cluster of
    RAY_ADDRESS, or one that is started on this machine; ray:HOST:PORT: on that cluster. All nodes need the
    run folder and the capture under the same paths."""


@dataclass(frozen=True)
class Machine(Parallel):
    """Training processes and memory."""

    processes: Annotated[int, Meta(ge=1, le=4096)] = 1
    """Training processes, one per GPU. Each step uses at least one photo per process."""
    memory_limit: Annotated[float, Meta(ge=0, le=2**20)] = 0.0
    """Memory limit of training, GiB; the maximum number of Gaussians is lowered to fit (0: 90 % of the
    memory of the machine or container)."""


_CAPTURE = "capture: a COLMAP workspace, transforms.json, photos or a video"
Scene = Positional[Annotated[Path, arg(metavar="SCENE", help=_CAPTURE)]]
Run = Positional[Annotated[Path, arg(metavar="RUN", help="run folder")]]
Ladder = Annotated[LadderKind, arg(help="Levels: nested (prefixes of one model) or the training snapshots.")]
Seed = Annotated[SeedNumber, arg(help="Seed of the random numbers.")]
Flat = arg(name="")


@contextmanager
def open_job(
    run: Path, options: Redo | Device, ladder: LadderKind = "nested", *, begins: bool = False
) -> Iterator["Job"]:
    """A job on a run folder, shown on the console; options that a command does not have are the defaults.

    RunError, before anything is done, where there is no run; with `begins`, where none can begin.
    """
    from sagesplat.cli.console import Console
    from sagesplat.run.job import Job
    from sagesplat.run.run_dir import RunDir, check_links, check_run

    check_links(run)
    folder = RunDir(run, ladder)
    if not begins:
        check_run(folder)
    elif run.is_file():
        raise RunError(f"{run}: a file; name a new folder for the run")
    machine = Machine(**vars(options))
    limit = int(machine.memory_limit * 2**30)
    with computing(machine, run) as (backend, threads, executor), Console() as console, ExitStack() as locks:
        if backend == "cuda":
            console.note("computing on the GPU")
        if machine.executor != "local":
            tasks = "1 task" if executor.parallel == 1 else f"{executor.parallel} tasks"
            console.note(f"on a Ray cluster, {tasks} at once")
        yield Job(
            folder, console, backend, threads, machine.force, machine.processes, machine.device,
            limit, locks, executor, before_redo=_approval(folder, console, machine.yes),
        )  # fmt: skip


def _approval(run: "RunDir", console: "Console", yes: bool) -> Callable[[str, str], None]:
    """Says once what --force redoes, and how long that took; on a terminal it is asked whether to."""
    from sagesplat.core.durations import duration
    from sagesplat.run.recorded import stage_seconds
    from sagesplat.run.stage_table import following

    asked = False

    def approve(stage: str, difference: str) -> None:
        nonlocal asked
        if asked:
            return
        asked = True
        took = stage_seconds(run)
        later = [name for name in following(stage) if name in took]
        text = f"--force: {difference}; {stage} is redone (it took {duration(took.get(stage, 0.0))})"
        if later:
            seconds = duration(sum(took[name] for name in later))
            text += f"; made from it, in {seconds}: {', '.join(later)}"
        console.say(text)
        if not yes and sys.stdin.isatty() and console.out.is_terminal and not console.ask("Redo?"):
            raise RunError(f"{run.path}: nothing was redone; leave out --force to keep what is there")

    return approve


@contextmanager
def computing(machine: Machine, folder: Path) -> "Iterator[tuple[Backend, int, Executor]]":
    """Backend and CPU threads of this process, and what does the tasks; `folder`: what they write into.

    On a cluster with GPUs, tasks of `--device auto` use them, though this machine has
    none: what this process itself computes, it computes on its CPU then.
    """
    from sagesplat.run.executor import LOCAL

    kind, _, address = machine.executor.partition(":")
    if kind not in ("local", "ray") or (kind == "local" and address):
        raise RunError(f"--executor {machine.executor}: not known; use local, ray or ray:HOST:PORT")
    backend, threads = prepare(machine)
    if kind == "local":
        yield backend, threads, LOCAL
        return
    if find_spec("ray") is None:
        raise BackendUnavailable(f"--executor ray: Ray is missing; {install('sagesplat[ray]')}")
    from sagesplat.run.ray_cluster import connected
    from sagesplat.run.ray_executor import RayExecutor

    with connected(address) as resources:
        elsewhere: Literal["cuda"] | None = (
            "cuda" if machine.device == "auto" and backend == "cpu" and resources.get("GPU") else None
        )
        gpus = float("cuda" in (backend, elsewhere))
        with closing(RayExecutor(folder, threads, elsewhere, gpus)) as executor:
            yield backend, threads, executor


def prepare(machine: Machine) -> "tuple[Backend, int]":
    """The backend that this machine computes with, and its CPU threads."""
    from sagesplat.raster import prepared

    return prepared(machine.device, threads=machine.threads)
