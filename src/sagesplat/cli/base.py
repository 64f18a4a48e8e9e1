"""What all commands share."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from sagesplat.core.errors import BackendUnavailable, RunError

if TYPE_CHECKING:
    from sagesplat.raster import Backend
    from sagesplat.run.executor import Executor
    from sagesplat.run.job import Job

COMMANDS: dict[str, Callable[..., None]] = {}


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Make a function a command of its name. Only the one that is called gets a parser: that takes time."""
    COMMANDS[function.__name__] = function
    return function


@dataclass(frozen=True)
class Machine:
    """Where and how a command computes."""

    threads: int = 0
    """CPU threads (0: all cores)."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """auto: a CUDA GPU where there is one that works (see `sagesplat doctor`), else the CPU."""
    backend: Literal["auto", "cpu", "cuda", "reference"] = "auto"
    """Rasteriser; reference is float64 and slow."""
    processes: int = 1
    """Train in so many processes, one per GPU; a step then looks at a photo each."""
    memory_limit: float = 0.0
    """GiB that training may use: the cap of Gaussians lowers itself to it (0: nine tenths of what the machine
    or its container has)."""
    executor: str = "local"
    """Where pieces of work are computed that do not depend on each other: local (this process, one after the
    other), ray (the Ray cluster that runs here or that RAY_ADDRESS names, else one of this machine) or
    ray:HOST:PORT. All nodes need the run folder and the capture under the same paths."""
    force: bool = False
    """Make results again that were made with other settings."""


LadderKind = Literal["nested", "snapshots"]
_CAPTURE = "capture: a COLMAP workspace, transforms.json, photos or a video"
Scene = Positional[Annotated[Path, arg(metavar="SCENE", help=_CAPTURE)]]
Run = Positional[Annotated[Path, arg(metavar="RUN", help="run folder")]]
Flat = arg(name="")


@contextmanager
def open_job(run: Path, machine: Machine, ladder: LadderKind = "nested") -> Iterator["Job"]:
    """A job on a run folder, shown on the console."""
    from sagesplat.cli.console import Console
    from sagesplat.run.job import Job
    from sagesplat.run.run_dir import RunDir

    if not machine.memory_limit >= 0:
        raise RunError(f"--memory-limit {machine.memory_limit} is impossible; choose GiB, such as 8")
    limit = int(machine.memory_limit * 2**30)
    with computing(machine, run) as (backend, threads, executor), Console() as console, ExitStack() as locks:
        if backend == "cuda":
            console.out.print("[dim]· computing on the GPU[/]")
        if machine.executor != "local":
            console.out.print(f"[dim]· on a Ray cluster, {executor.parallel} tasks at once[/]")
        yield Job(
            RunDir(run, ladder), console, backend, threads, machine.force, machine.processes, machine.device,
            limit, locks, executor,
        )  # fmt: skip


@contextmanager
def computing(machine: Machine, folder: Path) -> "Iterator[tuple[Backend, int, Executor]]":
    """Backend and CPU threads of this process, and what does the tasks; `folder`: what they write into.

    On a cluster with GPUs, tasks of `--device auto` and `--backend auto` use them, though this machine has
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
        raise BackendUnavailable("--executor ray: Ray is missing; pip install 'sagesplat[ray]'")
    from sagesplat.run.ray_executor import RayExecutor, connected

    with connected(address) as resources:
        auto = (machine.device, machine.backend) == ("auto", "auto")
        elsewhere: Literal["cuda"] | None = (
            "cuda" if auto and backend == "cpu" and resources.get("GPU") else None
        )
        gpus = float("cuda" in (backend, elsewhere))
        with closing(RayExecutor(folder, threads, elsewhere, gpus)) as executor:
            yield backend, threads, executor


def prepare(machine: Machine) -> "tuple[Backend, int]":
    """The backend that this machine computes with, and its CPU threads."""
    from sagesplat.raster import cuda, resolve_backend, set_threads

    if machine.processes < 1:
        raise RunError(f"--processes {machine.processes} is impossible; choose 1 or more")
    device, backend = machine.device, machine.backend
    if (device, backend) == ("auto", "auto") and cuda.missing() is None:
        device = "cuda"
    return resolve_backend(backend, device), set_threads(machine.threads)
