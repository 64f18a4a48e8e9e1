"""The command line: one short function per command, each loads, calls and saves."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NoReturn

import tyro
from tyro.conf import Positional, arg

from sagesplat import __version__
from sagesplat.config import (
    FitConfig,
    LiftConfig,
    MasksConfig,
    PlanConfig,
    RunConfig,
    SceneConfig,
    TrainConfig,
)
from sagesplat.errors import SageError

if TYPE_CHECKING:
    from sagesplat.job import Job

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
    backend: Literal["auto", "cpu", "reference"] = "auto"
    """Rasteriser; reference is float64 and slow."""
    force: bool = False
    """Make results again that were made with other settings."""


Scene = Positional[Annotated[Path, arg(metavar="SCENE", help="capture: a COLMAP workspace")]]
Run = Positional[Annotated[Path, arg(metavar="RUN", help="run folder")]]
Flat = arg(name="")


@contextmanager
def _job(run: Path, machine: Machine) -> Iterator["Job"]:
    """A job on a run folder, shown on the console."""
    from sagesplat.console import Console
    from sagesplat.job import Job
    from sagesplat.raster import resolve_backend, set_threads
    from sagesplat.run_dir import RunDir

    backend = resolve_backend(machine.backend, machine.device)
    threads = set_threads(machine.threads)
    with Console() as console:
        yield Job(RunDir(run), console, backend, threads, machine.force)


@command
def info(scene: Scene, scene_config: Annotated[SceneConfig, Flat] = SceneConfig()) -> None:
    """Print what a capture holds."""
    from sagesplat.scene import describe, load_scene

    rows = describe(load_scene(scene, downscale=scene_config.downscale, test_every=scene_config.test_every))
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(f"{name:{width}}  {value}")


@command
def run(
    scene: Scene,
    run: Run,
    scene_config: Annotated[SceneConfig, Flat] = SceneConfig(),
    masks: Annotated[MasksConfig, Flat] = MasksConfig(),
    lift: LiftConfig = LiftConfig(),
    train: TrainConfig = TrainConfig(),
    fit: FitConfig = FitConfig(),
    plan: Annotated[PlanConfig, Flat] = PlanConfig(),
    machine: Annotated[Machine, Flat] = Machine(),
    seed: int = 0,
) -> None:
    """Everything: photos and label images in, levels, models, a plan and a report out."""
    from sagesplat import pipeline

    with _job(run, machine) as job:
        pipeline.run_all(job, scene, RunConfig(scene_config, masks, lift, train, fit, plan, seed))


@command
def demo(run: Path = Path("runs/demo"), machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Make the built-in capture, run the main job on it and say where to look."""
    from sagesplat import pipeline

    with _job(run, machine) as job:
        pipeline.run_demo(job)


@command
def masks(
    scene: Scene,
    run: Run,
    scene_config: Annotated[SceneConfig, Flat] = SceneConfig(),
    masks: Annotated[MasksConfig, Flat] = MasksConfig(),
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Begin a run: read the capture and bring its label images in."""
    from sagesplat import stages

    with _job(run, machine) as job:
        stages.open_scene(job, scene, scene_config)
        stages.make_masks(job, masks)


@command
def lift(run: Run, lift: LiftConfig = LiftConfig(), machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Vote the label images onto the points."""
    from sagesplat import stages

    with _job(run, machine) as job:
        stages.lift_labels(job, lift)


@command
def train(
    run: Run, train: TrainConfig = TrainConfig(), machine: Annotated[Machine, Flat] = Machine(), seed: int = 0
) -> None:
    """Train 3DGS and record the levels; a killed training goes on."""
    from sagesplat import stages

    with _job(run, machine) as job:
        stages.train_levels(job, train, seed)


@command
def observe(run: Run, fit: FitConfig = FitConfig(), machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Measure every category at every level in every view."""
    from sagesplat import stages

    with _job(run, machine) as job:
        stages.observe_levels(job, fit)


@command
def fit(run: Run, fit: FitConfig = FitConfig(), machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Fit SSIM over distance for every category and level."""
    from sagesplat import stages

    with _job(run, machine) as job:
        stages.fit_ladder(job, fit)


@command
def plan(
    run: Run,
    plan: Annotated[PlanConfig, Flat] = PlanConfig(),
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Choose the cheapest levels that keep a target SSIM."""
    from sagesplat import stages

    with _job(run, machine) as job:
        stages.make_plan(job, plan)


@command
def compose(run: Run, machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Write the planned scene as composed.ply."""
    from sagesplat import stages

    with _job(run, machine) as job:
        stages.compose_plan(job)


@command
def evaluate(run: Run, machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Measure the plans on the test views, beside what was promised."""
    from sagesplat import stages

    with _job(run, machine) as job:
        stages.evaluate_plans(job)


@command
def report(run: Run, machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Write the report."""
    from sagesplat import stages

    with _job(run, machine) as job:
        stages.make_report(job)


@command
def export(
    run: Run,
    ply: Positional[Annotated[Path, arg(metavar="OUT.ply")]],
    level: int | None = None,
    labels: tuple[str, ...] = (),
    target_ssim: float | None = None,
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Write Gaussians as a PLY: the plan's composition, or one level; all categories or some.

    Args:
        run: run folder.
        ply: file to write.
        level: a level by its training step, instead of the composition.
        labels: names of the categories to take.
        target_ssim: the composition for this planned target (default: the main one).
    """
    from sagesplat import pipeline

    with _job(run, machine) as job:
        count = pipeline.export_ply(job, ply, level=level, labels=labels, target=target_ssim)
    print(f"{ply}: {count:,} Gaussians")


def main() -> None:
    """Run a command; errors that a user can cause are one line and exit code 2."""
    name, *words = sys.argv[1:] or ["--help"]
    if name in ("-h", "--help", "--version"):
        print(f"sagesplat {__version__}" if name == "--version" else _overview())
        return
    if name not in COMMANDS:
        _fail(f"no command {name!r}; there are {', '.join(COMMANDS)}")
    try:
        tyro.cli(COMMANDS[name], prog=f"sagesplat {name}", args=words)
    except SageError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        _fail("interrupted; what is finished is kept: run the same command again to go on")
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        where = error.filename or "input/output"
        _fail(f"{where}: {error.strerror or error}; check the path, its rights and the disk")


def _overview() -> str:
    """What `sagesplat --help` prints."""
    lines = ["usage: sagesplat COMMAND ...", "", "Semantic-driven adaptive Gaussian splatting.", ""]
    for name, function in COMMANDS.items():
        lines.append(f"  {name:10}{(function.__doc__ or '').splitlines()[0]}")
    return "\n".join([*lines, "", "`sagesplat COMMAND --help` lists the settings of a command."])


def _fail(message: str) -> NoReturn:
    print(f"sagesplat: {' '.join(message.split())}", file=sys.stderr)
    raise SystemExit(2)
