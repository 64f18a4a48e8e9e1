"""Cross-scene evaluation of two finished runs: `sagesplat transfer RUN_A RUN_B`."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sagesplat.adapt import transfer as compare
from sagesplat.adapt.model import read_models
from sagesplat.adapt.observe import large_enough, read_observations
from sagesplat.adapt.plan import check_target
from sagesplat.adapt.transfer import FittedRun
from sagesplat.errors import RunError
from sagesplat.job import Job
from sagesplat.output import transfer_report
from sagesplat.output.figures import save_figure
from sagesplat.output.tables import Table
from sagesplat.run_dir import settings_of


def transfer(job_a: Job, job_b: Job, out: Path, targets: Sequence[float] | None = None) -> tuple[Table, str]:
    """Predict run B with the models of run A; the summary comes back, and a line on its SSIM errors.

    Writes `out`/transfer.* and summary.* (csv, md, tex) and figures/transfer.*; the runs are only read.
    `targets` are those that B was planned for unless given. RunError where a run is not fitted, where the two
    were measured differently or share no category, and for an impossible target.
    """
    a, b = load_fitted(job_a), load_fitted(job_b)
    targets = targets or list[float](settings_of(job_b.run, "plan")["targets"])
    for target in targets:
        check_target(target)
    for name in ("distance", "masks", "region"):
        there, here = (getattr(job.fit_config, name) for job in (job_a, job_b))
        if there != here:
            raise RunError(
                f"{b.name}: measured with --fit.{name} {here}, {a.name} with {there}; run one of them again "
                "like the other"
            )
    scores = compare.transfer(a, b, targets)
    summary = transfer_report.summary_table(scores)
    transfer_report.transfer_table(scores).write(out / "transfer")
    summary.write(out / "summary")
    save_figure(transfer_report.transfer_figure(a, b), out / "figures" / "transfer")
    return summary, transfer_report.headline(summary)


def load_fitted(job: Job) -> FittedRun:
    """What transfer needs of a run; RunError where its models are not fitted yet."""
    run, scene = job.run, job.scene
    for path in (run.labels, run.observations, run.models):
        if not path.exists():
            raise RunError(f"{path}: missing; finish this run with `sagesplat run`")
    rows = large_enough(read_observations(run.observations), scene, job.fit_config.min_share)
    if job.fit_config.region == "eroded":
        rows = replace(rows, ssim=rows.ssim_eroded)
    return FittedRun(
        name=str(run.path),
        names=job.names(),
        observations=rows,
        models=read_models(run.models),
        counts=job.ladder.counts,
        recovering=job.ladder.recovering,
        train_views=scene.train_ids,
        test_views=scene.test_ids,
        extent=scene.extent or math.nan,
        focals=np.sqrt([float(v.camera.K[0, 0]) * float(v.camera.K[1, 1]) for v in scene.views]),
        spacings=compare.point_spacings(scene.points.xyz, job.point_labels),
    )
