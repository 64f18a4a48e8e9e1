"""Commands that compare: methods, scenes, settings, viewpoints."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from sagesplat.cli.base import Flat, LadderKind, Machine, Run, command, computing, open_job
from sagesplat.core.config import CompareConfig


@command
def crossview(run: Run, ladder: LadderKind = "nested", machine: Annotated[Machine, Flat] = Machine()) -> None:
    """Plan every unseen view by itself, and measure promise, error and regret."""
    from sagesplat.studies.paper.run import cross_views

    with open_job(run, machine, ladder) as job:
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
    from sagesplat.core.events import TableMade
    from sagesplat.studies.transfer.run import transfer as evaluate_transfer

    out = out or run_b / "transfer"
    with open_job(run_a, machine, "snapshots") as job_a, open_job(run_b, machine, "snapshots") as job_b:
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
    from sagesplat.core.events import TableMade
    from sagesplat.studies.early_stopping import compare_early_stopping

    out = out or stopped / "online"
    with (
        open_job(stopped, machine, "snapshots") as job_online,
        open_job(full, machine, "snapshots") as job_full,
    ):
        table, _ = compare_early_stopping(job_online, job_full, out)
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
    from sagesplat.studies.compare.run import compare as compare_methods

    with open_job(run, machine) as job:
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
    from sagesplat.cli.console import Console
    from sagesplat.studies.sweep.file import read_sweep
    from sagesplat.studies.sweep.run import run_sweep

    cells = read_sweep(file)
    with computing(machine, out / "runs") as (backend, threads, executor), Console() as console:
        run_sweep(cells, out, console, backend, threads, machine.force, executor)
    print(out / "summary.md")
