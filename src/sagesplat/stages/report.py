"""Makes the HTML report, from a finished run."""

from urllib.parse import urlsplit

from sagesplat.adapt.observe import TOTAL
from sagesplat.core.errors import RunError, short
from sagesplat.core.events import RunDone
from sagesplat.formats.ply import read_ply
from sagesplat.output.tables import MB, bytes_of, last_counts, mean
from sagesplat.run.job import Job
from sagesplat.run.records import is_made_from
from sagesplat.run.stage import run_stage
from sagesplat.stages.methods import method_of
from sagesplat.stages.noticed import noticed
from sagesplat.stages.plan import main_plan, main_target, scene_plan
from sagesplat.stages.results import budget_plan_of, evaluation_of


def make_report(job: Job, url: str = "") -> None:
    """Write the report; it links to `url`, where the run's bundle was published, with a QR code."""
    # loads matplotlib, for which no training has to wait
    from sagesplat.output.report import write_report
    from sagesplat.stages.report_data import links, report_data, stage_records

    if url and (urlsplit(url).scheme not in ("http", "https") or not urlsplit(url).netloc):
        raise RunError(f"--url {short(repr(url))}: no address; give one such as https://example.org/place/")
    run, found = job.run, noticed(job)
    for stage in ("compose", "evaluate"):
        if not is_made_from(run, stage, run.plan):
            raise RunError(f"{run.path}: planned anew; run `sagesplat {stage} {run.path}` before the report")

    def make() -> list[str]:
        quality, target = main_target(run)
        # the page leads with a target: what was composed for a budget is not what it is about; and what was
        # written for other viewers is not drawn as the run draws
        other = budget_plan_of(job) is not None or job.antialiased
        plan = scene_plan(job, quality, target)
        composed = plan.compose(job.ladder) if other else read_ply(run.composed)
        write_report(run.report, report_data(job, composed, quality, target, found, url))
        return []

    settings = {"url": url, "links": links(run)}  # the page changes where another one appears
    inputs = [run.observations, run.models, run.plan, run.evaluation, *stage_records(run)]
    run_stage(job, "report", settings, inputs, [run.report / "index.html"], make)
    folder = str(run.path)
    follows = ("view", folder) if method_of(job).streams else ("export", folder, "scene.spz")
    job.emit(RunDone(run.report / "index.html", follows, found, _outcome(job)))


def _outcome(job: Job) -> str:
    """What a run composes in one line: bytes, and quality at views that nothing was fitted to."""
    plan = main_plan(job)
    sizes = method_of(job).bytes_to_send
    nbytes, counts = sum(map(bytes_of, plan.choices)), last_counts(job.ladder.counts)
    if sizes:
        size = f"{nbytes / MB:.2f} MB of {sum(last_counts(sizes).values()) / MB:.2f} MB"
    else:
        size = f"{plan.count:,} of {sum(counts.values()):,} Gaussians"
    rows = evaluation_of(job).of(plan)
    rows = rows.select(rows.label_id == TOTAL)
    if not len(rows):
        return f"{size} for {plan.asked}"
    fidelity = f"fidelity {mean(rows.fidelity):.3f}, " if plan.quality == "fidelity" else ""
    quality = f"{fidelity}SSIM {mean(rows.ssim):.3f}, {mean(rows.psnr):.2f} dB"
    return f"{size}; {quality} at {len(rows)} unseen views"
