"""Makes the evaluation: the plans measured on the test views."""

import numpy as np

from sagesplat.adapt.evaluate import evaluate
from sagesplat.adapt.observe import TOTAL
from sagesplat.core.events import Progress
from sagesplat.output import tables
from sagesplat.run.job import Job
from sagesplat.run.records import settings_of
from sagesplat.run.stage import run_stage
from sagesplat.segment.display_names import titles
from sagesplat.stages.compose import compose, compose_inputs
from sagesplat.stages.methods import method_of
from sagesplat.stages.plan import main_target, scene_plan
from sagesplat.stages.results import budget_plan_of, plans_of
from sagesplat.stages.shared import _show, label_images


def evaluate_plans(job: Job) -> None:
    """Measure the compositions on the test views, beside what was promised and the full model."""
    run, method = job.run, method_of(job)

    def make() -> list[str]:
        fitted, within = job.fit_config, budget_plan_of(job)
        plans = [*plans_of(job), *([within] if within else [])]
        table = evaluate(
            job.scene, job.photos, label_images(job, fitted.masks), job.ladder, plans, method.predicted,
            region=fitted.region, compose=lambda plan: compose(job, plan),
            backend=job.backend, antialiased=job.antialiased,
            progress=lambda done, total: job.emit(Progress("evaluate", done, total)),
        )  # fmt: skip
        table.write_csv(run.evaluation)
        if len(table):
            plan = scene_plan(job, main_target(run))
            _show(job, tables.outcome_table(plan, job.ladder.counts, table, titles(job.names())))
        whole = table.select(table.label_id == TOTAL)
        lines = []
        for target in np.unique(whole.target):
            within_budget = np.isnan(target)
            at = whole.select(np.isnan(whole.target) if within_budget else whole.target == target)
            asked = "within the budget" if within_budget else f"SSIM {target:g} asked"
            lines.append(
                f"{asked}: test views {at.ssim.mean():.3f} / {at.psnr.mean():.2f} dB "
                f"(full model {at.full_ssim.mean():.3f} / {at.full_psnr.mean():.2f} dB)"
            )
        return lines

    fitted = [run.provenance("observe"), run.provenance("fit")]
    inputs = [run.labels, *method.files, *fitted, *compose_inputs(job)]
    settings = {"tune_steps": settings_of(run, "plan").get("tune_steps", 0)}
    run_stage(job, "evaluate", settings, inputs, [run.evaluation], make)
