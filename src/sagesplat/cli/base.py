"""What all commands share."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from sagesplat.errors import RunError

if TYPE_CHECKING:
    from sagesplat.job import Job
    from sagesplat.raster import Backend

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
    from sagesplat.console import Console
    from sagesplat.job import Job
    from sagesplat.run_dir import RunDir

    backend, threads = prepare(machine)
    if not machine.memory_limit >= 0:
        raise RunError(f"--memory-limit {machine.memory_limit} is impossible; choose GiB, such as 8")
    limit = int(machine.memory_limit * 2**30)
    with Console() as console, ExitStack() as locks:
        if backend == "cuda":
            console.out.print("[dim]· computing on the GPU[/]")
        yield Job(
            RunDir(run, ladder), console, backend, threads, machine.force, machine.processes, machine.device,
            limit, locks,
        )  # fmt: skip


def prepare(machine: Machine) -> "tuple[Backend, int]":
    """The backend that this machine computes with, and its CPU threads."""
    from sagesplat.raster import cuda, resolve_backend, set_threads

    if machine.processes < 1:
        raise RunError(f"--processes {machine.processes} is impossible; choose 1 or more")
    device, backend = machine.device, machine.backend
    if (device, backend) == ("auto", "auto") and cuda.missing() is None:
        device = "cuda"
    return resolve_backend(backend, device), set_threads(machine.threads)
