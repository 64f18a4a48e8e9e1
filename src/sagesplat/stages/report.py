"""Makes the HTML report, from a finished run."""

from sagesplat.core.events import RunDone
from sagesplat.formats.ply import read_ply
from sagesplat.run.job import Job
from sagesplat.run.stage import run_stage
from sagesplat.stages.compose import compose
from sagesplat.stages.methods import method_of
from sagesplat.stages.noticed import noticed
from sagesplat.stages.plan import main_target, scene_plan
from sagesplat.stages.results import budget_plan_of


def make_report(job: Job) -> None:
    """Write the report."""
    # loads matplotlib, for which no training has to wait
    from sagesplat.output.report import write_report
    from sagesplat.stages.report_data import report_data, stage_records

    run, found = job.run, noticed(job)

    def make() -> list[str]:
        quality, target = main_target(run)
        # the page leads with a target: what was composed for a budget is not what it is about; and what was
        # written for other viewers is not drawn as the run draws
        other = budget_plan_of(job) is not None or job.antialiased
        composed = compose(job, scene_plan(job, quality, target)) if other else read_ply(run.composed)
        write_report(run.report, report_data(job, composed, quality, target, found))
        return []

    inputs = [run.observations, run.models, run.plan, run.evaluation, *stage_records(run)]
    run_stage(job, "report", {}, inputs, [run.report / "index.html"], make)
    job.emit(RunDone(run.report / "index.html", run.path if method_of(job).streams else None, found))
