"""The stages of a run's training snapshots, made with the settings of its nested levels."""

from dataclasses import replace
from typing import Any

from sagesplat.core.config import FitConfig, PlanConfig
from sagesplat.run.job import Job
from sagesplat.run.recorded import recorded_settings
from sagesplat.stages.fit import fit_ladder
from sagesplat.stages.observe import observe_levels
from sagesplat.stages.plan import make_plan
from sagesplat.stages.scene import check_not_adopted


def observe_snapshots(job: Job) -> None:
    """Measure the training snapshots of a run, as its levels were measured; `job` is one on the snapshots."""
    check_not_adopted(job.run)
    observe_levels(job, _recorded(job).get("fit", FitConfig()))


def adapt_snapshots(job: Job) -> None:
    """Measure, model and plan the training snapshots of a run, with the settings that it was made with.

    `job` is one on the snapshots. Stages that are done are skipped.
    """
    observe_snapshots(job)
    known = _recorded(job)
    fit_ladder(job, known.get("fit", FitConfig()))
    plan: PlanConfig = known.get("plan", PlanConfig())
    others = plan.other_targets if plan.quality == "ssim" else None  # snapshots have no fidelity
    make_plan(job, replace(plan, target_fidelity=None, other_targets=others, budget=0.0, weights={}))


def _recorded(job: Job) -> dict[str, Any]:
    """What the run records of its snapshots, else of its nested levels."""
    return recorded_settings(replace(job.run, ladder="nested")) | recorded_settings(job.run)
