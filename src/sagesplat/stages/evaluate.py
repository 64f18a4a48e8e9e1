"""Makes the evaluation: the plans measured on the test views."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sagesplat.adapt.evaluate import OTHERS, Evaluation, Similarity, evaluate
from sagesplat.adapt.observe import TOTAL
from sagesplat.adapt.plan import Plan
from sagesplat.core.events import Progress
from sagesplat.metrics.flip import flip_map
from sagesplat.metrics.lpips import load_lpips, weights_path
from sagesplat.metrics.ms_ssim import ms_ssim
from sagesplat.output import tables
from sagesplat.run.job import Job
from sagesplat.run.records import file_hash
from sagesplat.run.stage import run_stage
from sagesplat.segment.display_names import titles
from sagesplat.stages.compose import compose_inputs
from sagesplat.stages.methods import method_of
from sagesplat.stages.plan import main_target, scene_plan
from sagesplat.stages.results import budget_plan_of, plans_of


def evaluate_plans(job: Job) -> None:
    """Measure the compositions on the test views, beside what was promised and the full model."""
    run, method = job.run, method_of(job)

    lpips = weights_path("alex")

    def make() -> list[str]:
        within = budget_plan_of(job)
        plans = [*plans_of(job), *([within] if within else [])]
        table = evaluate(
            job.scene, job.photos, job.level_masks, job.ladder, plans, method.predicted,
            others=_others(lpips), uniform=_levels_beside(job, plans),
            full=job.came_in, valid=job.valid,
            backend=job.backend, antialiased=job.antialiased,
            progress=lambda done, total: job.emit(Progress("evaluate", done, total)),
        )  # fmt: skip
        table.write_csv(run.evaluation)
        if len(table):
            plan = scene_plan(job, *main_target(run))
            job.emit(tables.outcome_table(plan, job.ladder.counts, table, titles(job.names())).event)
        exposed = any(job.scene.views[row].camera.exposure is not None for row in job.scene.test_ids)
        return [line for plan in plans for line in _lines(plan, table.of(plan), exposed)]

    fitted = [run.provenance("observe"), run.provenance("fit")]
    inputs = [run.labels, *method.files, *fitted, *compose_inputs(job)]
    settings = {"lpips": file_hash(lpips) if lpips.is_file() else None}
    run_stage(job, "evaluate", settings, inputs, [run.evaluation], make)


def _others(lpips: Path) -> dict[str, Similarity]:
    """MS-SSIM and FLIP; LPIPS where its weights were downloaded."""
    found: dict[str, Similarity] = {
        "ms_ssim": ms_ssim,
        "flip": lambda image, photo: float(flip_map(image, photo).mean()),
    }
    if lpips.is_file():
        found["lpips"] = load_lpips("alex", lpips)
    return found


def _levels_beside(job: Job, plans: Sequence[Plan]) -> list[int]:
    """The levels whose sizes are next to those of plans for fidelity: what such plans are compared with."""
    levels = job.ladder.levels
    sizes = np.array([job.ladder.size(level) for level in levels])
    above = [int(np.searchsorted(sizes, plan.count)) for plan in plans if plan.quality == "fidelity"]
    near = {min(max(i, 0), len(levels) - 1) for at in above for i in (at - 1, at)}
    return [levels[i] for i in sorted(near)]


def _lines(plan: Plan, rows: Evaluation, exposed: bool) -> list[str]:
    """What test views measure of a plan, in words; `exposed`: with colours fitted to their photos."""
    at = rows.select(rows.label_id == TOTAL)
    if not len(at):
        return []
    asked = "within the budget" if plan.budget is not None else f"{plan.asked} asked"
    fidelity = f"fidelity {at.fidelity.mean():.3f}, " if plan.quality == "fidelity" else ""
    return [
        f"{asked}: test views {fidelity}{at.ssim.mean():.3f} / {at.psnr.mean():.2f} dB "
        f"(full model {at.full_ssim.mean():.3f} / {at.full_psnr.mean():.2f} dB)"
        f"{', with colours fitted to their photos' if exposed else ''}",
        *_further(at),
        *([_colours(at)] if exposed else []),
    ]


def _further(at: Evaluation) -> list[str]:
    """What else was measured of the same images, of the plan and of the full model; no line without any."""
    told = [
        f"{title} {tables.mean(getattr(at, name)):.3f} ({tables.mean(getattr(at, 'full_' + name)):.3f})"
        for name, title in zip(OTHERS, ("MS-SSIM", "FLIP", "LPIPS"), strict=True)
        if np.isfinite(getattr(at, name)).any()
    ]
    return [f"  {', '.join(told)}"] if told else []


def _colours(at: Evaluation) -> str:
    """The same views without that fit: plain, and colour-corrected."""
    plan, full = (
        f"plain {plain.mean():.2f} dB, cc_ssim {ssim.mean():.3f} / cc_psnr {decibels.mean():.2f} dB"
        for plain, ssim, decibels in (
            (at.plain_psnr, at.cc_ssim, at.cc_psnr),
            (at.full_plain_psnr, at.full_cc_ssim, at.full_cc_psnr),
        )
    )
    return f"  {plan} (full model {full})"
