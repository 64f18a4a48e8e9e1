"""Commands that compare methods, scenes, settings and viewpoints."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from sagesplat.cli.base import (
    Compute,
    Device,
    Flat,
    Ladder,
    Machine,
    Parallel,
    Run,
    command,
    computing,
    open_job,
)
from sagesplat.cli.say import say
from sagesplat.core.config import CompareConfig, MeasureConfig
from sagesplat.core.limits import SomeShare


@command
def crossview(run: Run, ladder: Ladder = "nested", machine: Annotated[Compute, Flat] = Compute()) -> None:
    """Plan every test view by itself; measure the prediction error, the coverage and the regret."""
    from sagesplat.studies.paper.run import cross_views

    with open_job(run, machine, ladder) as job:
        cross_views(job)


@command
def transfer(
    run_a: Positional[Annotated[Path, arg(metavar="RUN_A")]],
    run_b: Positional[Annotated[Path, arg(metavar="RUN_B")]],
    out: Path | None = None,
    targets: tuple[SomeShare, ...] = (),
    lpips: Path | None = None,
    machine: Annotated[Parallel, Flat] = Parallel(),
) -> None:
    """Predict the quality of run B with the models of run A (cross-scene).

    Both runs are compared by their training snapshots, whose stages are run first where they are missing.

    Args:
        run_a: run folder whose quality models predict
        run_b: run folder whose quality is predicted
        out: folder for tables and figures (default: RUN_B/transfer)
        targets: SSIM targets (default: those that B was planned for)
        lpips: folder with the LPIPS weights (default: where `sagesplat download lpips` puts them)
    """
    from sagesplat.stages.scene import check_not_adopted
    from sagesplat.studies.paper.snapshots import adapt_snapshots
    from sagesplat.studies.transfer.run import transfer as evaluate_transfer

    out = out or run_b / "transfer"
    with open_job(run_a, machine, "snapshots") as job_a, open_job(run_b, machine, "snapshots") as job_b:
        for job in (job_a, job_b):  # before the work
            check_not_adopted(job.run)
        adapt_snapshots(job_a)
        adapt_snapshots(job_b)
        table, line = evaluate_transfer(job_a, job_b, out, targets, lpips)
        table = table.only("split", "predictor", "ssim error", "iteration error", "hit", "regret share")
        job_b.emit(table.event)
    say(line, out)


@command
def early_stopping(
    stopped: Positional[Annotated[Path, arg(metavar="RUN_STOPPED")]],
    full: Positional[Annotated[Path, arg(metavar="RUN_FULL")]],
    out: Path | None = None,
    machine: Annotated[Parallel, Flat] = Parallel(),
) -> None:
    """Compare early stopping per category (--train.freeze-at) with composing snapshots of a full training.

    Args:
        stopped: run folder trained with --train.freeze-at
        full: run folder trained with the same settings, but without it; its snapshots are measured if they
            are not yet
        out: folder for the tables (default: RUN_STOPPED/early_stopping)
    """
    from sagesplat.stages.scene import check_not_adopted
    from sagesplat.studies.early_stopping import check_runs, compare_early_stopping
    from sagesplat.studies.paper.snapshots import observe_snapshots

    out = out or stopped / "early_stopping"
    with (
        open_job(stopped, machine, "snapshots") as job_stopped,
        open_job(full, machine, "snapshots") as job_full,
    ):
        check_not_adopted(job_stopped.run)
        check_runs(job_stopped, job_full)  # before the work
        observe_snapshots(job_full)
        table, _ = compare_early_stopping(job_stopped, job_full, out)
        job_stopped.emit(table.event)
    say(out)


@command
def compare(
    run: Run,
    compare: Annotated[CompareConfig, Flat] = CompareConfig(),
    json: Path | None = None,
    machine: Annotated[Compute, Flat] = Compute(),
) -> None:
    """Compare the nested levels with baselines: 3DGS, SAGE, 3DGS pruned and tuned, 3DGS-MCMC.

    Args:
        run: run folder, finished with the nested levels; trained baselines are kept in RUN/compare
        json: file to write every measurement to, as JSON
    """
    from sagesplat.stages.scene import check_not_adopted
    from sagesplat.studies.compare.run import compare as compare_methods
    from sagesplat.studies.lpips import load_metrics

    with open_job(run, machine) as job:
        check_not_adopted(job.run)
        load_metrics(job.emit, compare.lpips)  # what is missing is said before the work
        compare_methods(job, compare, json)


@command
def measure(
    reference: Positional[Annotated[Path, arg(metavar="REFERENCE")]],
    levels: Positional[Annotated[tuple[Path, ...], arg(metavar="LEVELS")]] = (),
    out: Path = Path("measure"),
    measure: Annotated[MeasureConfig, Flat] = MeasureConfig(),
    device: Annotated[Device, Flat] = Device(),
) -> None:
    """Measure levels of detail against their scene: SSIM, PSNR and LPIPS over Gaussians and bytes.

    Splats of any format, streamed SOG, bundles and run folders. Of several levels in one path, the finest is
    the reference.

    Args:
        reference: the full scene; or, without LEVELS, a lod-meta.json, a bundle or a run with its levels
        levels: what is measured against it; every level of each
        out: folder for tables, curves and a contact sheet of the viewpoints
    """
    from sagesplat.cli.console import Console
    from sagesplat.studies.measure.run import measure_levels

    with Console() as console:
        measure_levels(reference, levels, out, measure, on_event=console, **asdict(device))
    say(out)


@command
def sweep(
    file: Positional[Annotated[Path, arg(metavar="FILE.toml")]],
    out: Positional[Annotated[Path, arg(metavar="OUT")]],
    machine: Annotated[Machine, Flat] = Machine(),
) -> None:
    """Run the scenes, settings, targets and seeds listed in a file; summarise by mean and spread.

    Args:
        file: what to run, in TOML; examples/sweep.toml is an example
        out: folder for the runs and the summary; finished runs in it are kept
    """
    from sagesplat.cli.console import Console
    from sagesplat.studies.sweep.file import read_sweep
    from sagesplat.studies.sweep.run import run_sweep

    cells = read_sweep(file)
    with computing(machine, out / "runs") as (backend, threads, executor), Console() as console:
        run_sweep(cells, out, console, backend, threads, machine.force, executor)
    say(out / "summary.md")
