"""Cross-scene evaluation of two finished runs: `sagesplat transfer RUN_A RUN_B`."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sagesplat.adapt.eq1 import plan_view
from sagesplat.adapt.plan import check_target
from sagesplat.core.errors import RunError
from sagesplat.output.figures import save_figure
from sagesplat.output.table import Table
from sagesplat.run.job import Job
from sagesplat.run.records import settings_of
from sagesplat.stages.results import models_of
from sagesplat.stages.shared import observed
from sagesplat.studies.lpips import load_metrics
from sagesplat.studies.paper.report import Picture, panel, take_pictures
from sagesplat.studies.transfer import score
from sagesplat.studies.transfer.report import headline, summary_table, transfer_figure, transfer_table
from sagesplat.studies.transfer.score import FittedRun


def transfer(
    job_a: Job,
    job_b: Job,
    out: Path,
    targets: Sequence[float] | None = None,
    lpips: Path | None = None,
) -> tuple[Table, str]:
    """Predict run B with the models of run A; the summary comes back, and a line on its SSIM errors.

    Writes `out`/transfer.* and summary.* (csv, md, tex) and figures/transfer.*; the runs are only read.
    `targets` are those that B was planned for unless given. RunError where a run is not fitted, where the two
    were measured differently or share no category, and for an impossible target.
    """
    a, b = load_fitted(job_a), load_fitted(job_b)
    targets = targets or list[float](settings_of(job_b.run, "plan")["targets"])
    for target in targets:
        check_target(target)
    there, here = (job.fit_config.distance for job in (job_a, job_b))
    if there != here:
        raise RunError(
            f"{b.name}: measured with --fit.distance {here}, {a.name} with {there}; run one of them again "
            "like the other"
        )
    scores = score.transfer(a, b, targets)
    summary = summary_table(scores)
    transfer_table(scores).write(out / "transfer")
    summary.write(out / "summary")
    save_figure(transfer_figure(a, b), out / "figures" / "transfer")
    save_figure(panel(_pictures(job_b, a, b, targets, lpips)), out / "figures" / "panel")
    return summary, headline(summary)


def _pictures(
    job: Job, a: FittedRun, b: FittedRun, targets: Sequence[float], lpips: Path | None
) -> list[Picture]:
    """Fig. 5: a view of B composed as A's models say (distances over the extent), B's own for the rest."""
    rows = b.test_views if len(b.test_views) else b.train_views
    row = int(rows[len(rows) // 2])
    seen = job.distances(job.fit_config.distance)
    here = {label: float(d[row]) for label, d in seen.items()}
    metric = load_metrics(job.emit, lpips, ["alex"]).get("lpips_alex")
    full = job.ladder.load(job.ladder.levels[-1])
    sets = {f"3DGS, {len(full):,}": full}
    for target in sorted(targets):
        own = plan_view(b.models, b.counts, here, target, row, recovering=b.recovering).levels
        g = job.ladder.compose(own | score.transferred_levels(a, b, row, here, target, "extent"))
        sets[f"t={target:g}, {len(g):,}"] = g
    return take_pictures(job, row, sets, metric)


def load_fitted(job: Job) -> FittedRun:
    """What transfer needs of a run; RunError where its models are not fitted yet."""
    run, scene = job.run, job.scene
    for path in (run.labels, run.observations, run.models):
        if not path.exists():
            raise RunError(f"{path}: missing; finish this run with `sagesplat run`")
    return FittedRun(
        name=str(run.path),
        names=job.names(),
        observations=observed(job),
        models=models_of(job),
        counts=job.ladder.counts,
        recovering=job.ladder.recovering,
        train_views=scene.train_ids,
        test_views=scene.test_ids,
        extent=scene.extent or math.nan,
        focals=np.sqrt([float(v.camera.K[0, 0]) * float(v.camera.K[1, 1]) for v in scene.views]),
        spacings=score.point_spacings(scene.points.xyz, job.point_labels),
    )
