"""The command line: one short function per command, each loads, calls and saves."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NoReturn

import tyro
from tyro.conf import Positional, arg

from sagesplat import __version__
from sagesplat.config import (
    CompareConfig,
    FitConfig,
    LabelsConfig,
    LiftConfig,
    MasksConfig,
    NestConfig,
    PaperConfig,
    PlanConfig,
    PosesConfig,
    RunConfig,
    SceneConfig,
    TrainConfig,
)
from sagesplat.errors import RunError, SageError

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
    force: bool = False
    """Make results again that were made with other settings."""


LadderKind = Literal["nested", "snapshots"]
_CAPTURE = "capture: a COLMAP workspace, transforms.json, photos or a video"
Scene = Positional[Annotated[Path, arg(metavar="SCENE", help=_CAPTURE)]]
Run = Positional[Annotated[Path, arg(metavar="RUN", help="run folder")]]
Flat = arg(name="")


@contextmanager
def _job(run: Path, machine: Machine, ladder: LadderKind = "nested") -> Iterator["Job"]:
    """A job on a run folder, shown on the console."""
    from sagesplat.console import Console
    from sagesplat.job import Job
    from sagesplat.run_dir import RunDir

    backend, threads = _prepare(machine)
    with Console() as console:
        if backend == "cuda":
            console.out.print("[dim]· computing on the GPU[/]")
        yield Job(
            RunDir(run, ladder), console, backend, threads, machine.force, machine.processes, machine.device
        )


def _prepare(machine: Machine) -> "tuple[Backend, int]":
    """The backend that this machine computes with, and its CPU threads."""
    from sagesplat.raster import cuda, resolve_backend, set_threads

    if machine.processes < 1:
        raise RunError(f"--processes {machine.processes} is impossible; choose 1 or more")
    device, backend = machine.device, machine.backend
    if (device, backend) == ("auto", "auto") and cuda.missing() is None:
        device = "cuda"
    return resolve_backend(backend, device), set_threads(machine.threads)


@command
def info(scene: Scene, scene_config: Annotated[SceneConfig, Flat] = SceneConfig()) -> None:
    """Print what a capture holds."""
    from sagesplat.scene import describe, load_scene

    rows = describe(load_scene(scene, **asdict(scene_config)))
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(f"{name:{width}}  {value}")


@command
def run(
    scene: Scene,
    run: Run,
    scene_config: Annotated[SceneConfig, Flat] = SceneConfig(),
    poses: PosesConfig = PosesConfig(),
    masks: Annotated[MasksConfig, Flat] = MasksConfig(),
    labels: LabelsConfig = LabelsConfig(),
    lift: LiftConfig = LiftConfig(),
    train: TrainConfig = TrainConfig(),
    nest: NestConfig = NestConfig(),
    fit: FitConfig = FitConfig(),
    plan: Annotated[PlanConfig, Flat] = PlanConfig(),
    fuse: bool = False,
    ladder: LadderKind = "nested",
    machine: Annotated[Machine, Flat] = Machine(),
    seed: int = 0,
) -> None:
    """Everything: photos in, levels, models, a plan and a report out.

    Poses are found where the photos have none, and label images made where there are none.
    """
    from sagesplat import pipeline

    config = RunConfig(scene_config, poses, masks, labels, lift, train, nest, fit, plan, fuse, ladder, seed)
    with _job(run, machine, ladder) as job:
        pipeline.run_all(job, scene, config)


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
    poses: PosesConfig = PosesConfig(),
    masks: Annotated[MasksConfig, Flat] = MasksConfig(),
    labels: LabelsConfig = LabelsConfig(),
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Begin a run: read the capture (poses are found if there are none) and bring label images in."""
    from sagesplat import labelling, stages

    with _job(run, machine) as job:
        stages.open_scene(job, scene, scene_config, poses)
        labelling.make_masks(job, masks, labels)


@command
def lift(run: Run, lift: LiftConfig = LiftConfig(), machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Vote the label images onto the points."""
    from sagesplat import labelling

    with _job(run, machine) as job:
        labelling.lift_labels(job, lift)


@command
def fuse(run: Run, machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Let all views vote on the label images by way of the trained Gaussians; what follows uses them."""
    from sagesplat import labelling

    with _job(run, machine) as job:
        labelling.fuse_masks(job)


@command
def train(
    run: Run, train: TrainConfig = TrainConfig(), machine: Annotated[Machine, Flat] = Machine(), seed: int = 0
) -> None:
    """Train 3DGS and record the levels; a killed training goes on."""
    from sagesplat import stages

    with _job(run, machine) as job:
        stages.train_levels(job, train, seed)


@command
def nest(
    run: Run, nest: NestConfig = NestConfig(), machine: Annotated[Machine, Flat] = Machine(), seed: int = 0
) -> None:
    """Make the nested ladder: order the trained Gaussians, train their prefixes, write the chunks."""
    from sagesplat import nesting

    with _job(run, machine) as job:
        nesting.nest_levels(job, nest, seed)


@command
def observe(
    run: Run,
    fit: FitConfig = FitConfig(),
    ladder: LadderKind = "nested",
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Measure every category at every level in every view."""
    from sagesplat import stages

    with _job(run, machine, ladder) as job:
        stages.observe_levels(job, fit)


@command
def fit(
    run: Run,
    fit: FitConfig = FitConfig(),
    ladder: LadderKind = "nested",
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Fit SSIM over distance for every category and level."""
    from sagesplat import stages

    with _job(run, machine, ladder) as job:
        stages.fit_ladder(job, fit)


@command
def plan(
    run: Run,
    plan: Annotated[PlanConfig, Flat] = PlanConfig(),
    ladder: LadderKind = "nested",
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Choose the cheapest levels that keep a target SSIM."""
    from sagesplat import stages

    with _job(run, machine, ladder) as job:
        stages.make_plan(job, plan)


@command
def compose(run: Run, ladder: LadderKind = "nested", machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Write the planned scene as composed.ply."""
    from sagesplat import stages

    with _job(run, machine, ladder) as job:
        stages.compose_plan(job)


@command
def evaluate(run: Run, ladder: LadderKind = "nested", machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Measure the plans on the test views, beside what was promised."""
    from sagesplat import stages

    with _job(run, machine, ladder) as job:
        stages.evaluate_plans(job)


@command
def report(
    run: Run,
    paper: bool = False,
    settings: Annotated[PaperConfig, Flat] = PaperConfig(),
    ladder: LadderKind = "nested",
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Write the report; with --paper, every table and figure of the paper.

    Args:
        run: run folder.
        paper: cross-view, equal occupancy, and the paper's tables and figures, from its ladder of snapshots.
        settings: what they look at.
        ladder: the ladder to report on.
        machine: where and how to compute.
    """
    from sagesplat import stages

    with _job(run, machine, "snapshots" if paper else ladder) as job:
        if paper:
            from sagesplat.paper import paper_report

            paper_report(job, settings)
        else:
            stages.make_report(job)


@command
def crossview(run: Run, ladder: LadderKind = "nested", machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Plan every unseen view by itself, and measure promise, error and regret."""
    from sagesplat.paper import cross_views

    with _job(run, machine, ladder) as job:
        cross_views(job)


@command
def transfer(
    run_a: Positional[Annotated[Path, arg(metavar="RUN_A")]],
    run_b: Positional[Annotated[Path, arg(metavar="RUN_B")]],
    out: Path | None = None,
    targets: tuple[float, ...] = (),
    lpips: Path | None = None,
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Predict run B with the quality models of run A (cross-scene).

    Args:
        run_a: run folder whose models are used.
        run_b: run folder that they are used on.
        out: folder for tables and figures (default: RUN_B/transfer).
        targets: SSIM targets (default: those that B was planned for).
        lpips: folder with the weights of LPIPS (default: where `sagesplat download lpips` puts them).
        machine: where and how to compute.
    """
    from sagesplat.events import TableMade
    from sagesplat.transfer import transfer as evaluate_transfer

    out = out or run_b / "transfer"
    with _job(run_a, machine, "snapshots") as job_a, _job(run_b, machine, "snapshots") as job_b:
        table, line = evaluate_transfer(job_a, job_b, out, targets, lpips)
        table = table.only("split", "predictor", "ssim error", "iteration error", "hit", "regret share")
        job_b.emit(TableMade(table.title, table.header, tuple(map(tuple, table.cells()))))
    print(f"{line}\n{out}")


@command
def online(
    stopped: Positional[Annotated[Path, arg(metavar="RUN_STOPPED")]],
    full: Positional[Annotated[Path, arg(metavar="RUN_FULL")]],
    out: Path | None = None,
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """A run with --train.freeze-at beside snapshots of the same run without, composed for that target.

    Args:
        stopped: run folder trained with --train.freeze-at.
        full: run folder trained alike, but without.
        out: folder for the tables (default: RUN_STOPPED/online).
        machine: where and how to compute.
    """
    from sagesplat.events import TableMade
    from sagesplat.online import compare_online

    out = out or stopped / "online"
    with _job(stopped, machine, "snapshots") as job_online, _job(full, machine, "snapshots") as job_full:
        table, _ = compare_online(job_online, job_full, out)
        job_online.emit(TableMade(table.title, table.header, tuple(map(tuple, table.cells()))))
    print(out)


@command
def compare(
    run: Run,
    compare: Annotated[CompareConfig, Flat] = CompareConfig(),
    json: Path | None = None,
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """The nested ladder beside its baselines: 3DGS, SAGE, 3DGS pruned and tuned, 3DGS-MCMC.

    Args:
        run: run folder, finished with the nested ladder.
        compare: which baselines; those that are trained are kept in RUN/compare.
        json: write all that was measured here as well.
        machine: where and how to compute.
    """
    from sagesplat.compare import compare as compare_methods

    with _job(run, machine) as job:
        compare_methods(job, compare, json)


@command
def sweep(
    file: Positional[Annotated[Path, arg(metavar="FILE.toml")]],
    out: Positional[Annotated[Path, arg(metavar="OUT")]],
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Run scenes, variants of settings, targets and seeds of one small file; mean and spread come out.

    Args:
        file: what to run; examples/sweep.toml shows one.
        out: folder for the runs and the summary; what is finished there is kept.
        machine: where and how to compute.
    """
    from sagesplat.console import Console
    from sagesplat.sweep import read_sweep, run_sweep

    cells = read_sweep(file)
    backend, threads = _prepare(machine)
    with Console() as console:
        run_sweep(cells, out, console, backend, threads, machine.force)
    print(out / "summary.md")


@command
def download(
    what: Positional[Annotated[str, arg(metavar="WHAT")]] = "",
    folder: Positional[Annotated[Path | None, arg(metavar="FOLDER")]] = None,
    scale: int | None = None,
    show: Annotated[bool, arg(name="list")] = False,
) -> None:
    """Fetch a scene of the field, or weights that are not part of the package.

    Of a scene only its own photos and model are transferred out of the official archive. What is there
    already is kept, so a download that was cut goes on when the command is given again.

    Args:
        what: a scene, such as mipnerf360/garden; or lpips, the weights of the perceptual metric (761 MB are
            fetched, 69 MB kept).
        folder: where to put it (default: the folder you are in; of weights the cache, ~/.cache/sagesplat).
        scale: photos so many times smaller, as the archive has them (default: what papers evaluate on).
        show: list the scenes.
    """
    from sagesplat.console import Console
    from sagesplat.download import download_lpips
    from sagesplat.download_scenes import download_scene, find_scene, list_scenes
    from sagesplat.events import Progress, StageStarted

    if show:
        for scene in list_scenes():
            size = f"of a {scene.archive_gb:g} GB archive" if scene.archive_gb else ""
            print(f"{scene.name:24} {scene.photos:4} photos {size:24} {scene.page}")
        return
    if not what:
        raise RunError("nothing to download; name a scene (see `sagesplat download --list`) or lpips")

    with Console() as console:
        console(StageStarted("download"))

        def progress(name: str, done: int, total: int) -> None:
            console(Progress("download", done, max(total, done, 1), name))

        if what == "lpips":
            found = download_lpips(folder, on_progress=progress)
        else:
            print(find_scene(what).licence, file=sys.stderr)
            found = [download_scene(what, folder or Path(), scale=scale, on_progress=progress)]
    print("\n".join(map(str, found)))
    if what != "lpips" and (factor := scale or find_scene(what).scale) > 1:
        print(f"train with --downscale {factor}", file=sys.stderr)


@command
def doctor(build: bool = False, json: bool = False) -> None:
    """Say what this machine can do, and what more needs.

    Args:
        build: compile gsplat's CUDA kernels now (about a minute), rather than at their first use.
        json: print it for machines.
    """
    from sagesplat.doctor import as_json, examine, is_well, print_findings

    findings = examine(build=build)
    if json:
        print(as_json(findings))
    else:
        print_findings(findings)
    if not is_well(findings):
        raise SystemExit(1)


@command
def export(
    run: Run,
    out: Positional[Annotated[Path, arg(metavar="OUT")]],
    level: int | None = None,
    labels: tuple[str, ...] = (),
    target_ssim: float | None = None,
    chunks: Literal["spz", "ply"] | None = None,
    ladder: LadderKind = "nested",
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Write Gaussians as a PLY: the plan's composition, or one level; or all chunks of the nested ladder.

    Args:
        run: run folder.
        out: PLY to write, or a folder for chunks.
        level: a level by its number (of snapshots: training step), instead of the composition.
        labels: names of the categories to take.
        target_ssim: the composition for this planned target (default: the budget's or the main one).
        chunks: a file for what each level of each category adds, in this format.
        ladder: the ladder to take them from.
        machine: where and how to compute.
    """
    from sagesplat import pipeline

    with _job(run, machine, ladder) as job:
        if chunks:
            count = pipeline.export_chunks(job, out, chunks)
        else:
            count = pipeline.export_ply(job, out, level=level, labels=labels, target=target_ssim)
    print(f"{out}: {count:,} {'chunks' if chunks else 'Gaussians'}")


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
