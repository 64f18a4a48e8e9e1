"""Makes plans from the quality models: a level per category, for the scene, for views, within a budget."""

from collections.abc import Callable
from dataclasses import asdict

import numpy as np

from sagesplat.adapt.bound_plans import Costs, Quality, plan_for_scene, plan_for_view, plan_within, quality_at
from sagesplat.adapt.eq3 import read_models
from sagesplat.adapt.observe import Observations, large_enough, read_observations
from sagesplat.adapt.plan import Plan, plan_scene, plan_view, read_budget_plan, read_plans, write_plans
from sagesplat.adapt.viewpoint import read_promises
from sagesplat.core.config import PlanConfig
from sagesplat.core.errors import RunError
from sagesplat.formats.increments import read_index, totals
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir, settings_of
from sagesplat.run.stage import run_stage
from sagesplat.stages import plan as nesting
from sagesplat.stages.shared import distances, label_named, ladder_files


def costs_of(job: Job) -> Costs:
    """What the levels of the run's nested ladder cost."""
    labels = sorted({label for label, _ in job.ladder.counts})
    levels = len(job.ladder.levels)
    chunks = read_index(job.run.increments)
    count, transfer_bytes, gpu = (
        totals(chunks, labels, levels, name) for name in ("count", "nbytes", "gpu_bytes")
    )
    return Costs(tuple(labels), count, transfer_bytes, gpu)


def promised_quality(job: Job) -> tuple[Costs, Quality]:
    """What the levels cost, and what the run's promises say of them in every view of the scene."""
    costs, promises = costs_of(job), read_promises(job.run.promises)
    cameras = [view.camera for view in job.scene.views]
    return costs, quality_at(costs, promises, distances(job, job.fit_config.distance), cameras)


def pixels_of(table: Observations, job: Job, labels: tuple[int, ...], views: np.ndarray) -> np.ndarray:
    """Pixels of each category in each view, float64 [V, L]; 0 for other views and for small shares."""
    table = large_enough(table, job.scene, job.fit_config.min_share)
    table = table.select((table.level == table.level.max(initial=0)) & np.isin(table.view, views))
    pixels = np.zeros((len(job.scene.views), len(labels)))
    for i, label in enumerate(labels):
        mine = table.select(table.label_id == label)
        pixels[mine.view, i] = mine.num_pixels
    return pixels


def make_plan(job: Job, config: PlanConfig) -> None:
    """Choose the levels: for the scene at each target, for every view at the main one."""
    run = job.run

    def from_promises() -> list[str]:
        costs, quality = nesting.promised_quality(job)
        shown = nesting.pixels_of(read_observations(run.observations), job, costs.labels, job.scene.train_ids)
        scene_plans = [
            plan_for_scene(quality, costs, target, config.share, shown) for target in config.targets
        ]
        view_plans = [
            plan_for_view(quality, costs, config.target_ssim, row) for row in range(len(job.scene.views))
        ]
        within = None
        if config.budget:
            weights = {label_named(job, name): weight for name, weight in config.weights.items()}
            within = plan_within(quality, costs, config.budget, config.budget_unit, shown, weights)
        write_plans(run.plan, scene_plans, view_plans, within)
        full = int(costs.transfer_bytes[:, -1].sum())
        lines = [
            f"SSIM {p.target:g}: {p.transfer_bytes / 1e6:.2f} of {full / 1e6:.2f} MB, {p.count:,} Gaussians, "
            f"{p.status}"
            for p in scene_plans
            if p.transfer_bytes is not None
        ]
        if within and within.transfer_bytes is not None:
            lines.append(
                f"budget {config.budget:,g} {config.budget_unit}: {within.transfer_bytes / 1e6:.2f} MB, "
                f"{within.count:,} Gaussians, {within.status}"
            )
        return lines

    def from_models() -> list[str]:
        models, ladder = read_models(run.models), job.ladder
        table = large_enough(read_observations(run.observations), job.scene, job.fit_config.min_share)
        table = table.select(table.level == ladder.levels[-1])
        seen = table.select(np.isin(table.view, job.scene.train_ids))
        labels = {label for label, _ in ladder.counts}
        by_label = {label: seen.distance[seen.label_id == label] for label in labels}
        scene_plans = [
            plan_scene(models, ladder.counts, by_label, target, config.share, recovering=ladder.recovering)
            for target in config.targets
        ]
        view_plans = []
        for row in range(len(job.scene.views)):
            here = table.select(table.view == row)
            distances = dict(zip(here.label_id.tolist(), here.distance.tolist(), strict=True))
            view_plans.append(
                plan_view(
                    models, ladder.counts, distances, config.target_ssim, row, recovering=ladder.recovering
                )
            )
        write_plans(run.plan, scene_plans, view_plans)
        full = ladder.size(ladder.levels[-1])
        return [f"SSIM {p.target:g}: {p.count:,} of {full:,} Gaussians, {p.status}" for p in scene_plans]

    nested = run.ladder == "nested"
    if config.budget and not nested:
        raise RunError("--budget needs the nested ladder; leave out --ladder snapshots")
    inputs = [run.scene, *ladder_files(run), run.observations]
    settings = asdict(config) | {"targets": config.targets}
    run_stage(job, "plan", settings, inputs, [run.plan], from_promises if nested else from_models)


def main_target(run: RunDir) -> float:
    """The target that the run's plan was made for."""
    return float(settings_of(run, "plan")["target_ssim"])


def scene_plan(run: RunDir, target: float) -> Plan:
    """The scene's plan for one of the run's targets."""
    plans = {plan.target: plan for plan in read_plans(run.plan)[0]}
    if target not in plans:
        known = ", ".join(f"{t:g}" for t in plans)
        raise RunError(f"{run.plan}: no plan for SSIM {target:g}, only for {known}; run `sagesplat plan`")
    return plans[target]


def main_plan(run: RunDir) -> Plan:
    """What the run composes: the plan for its budget, if it has one, else for its main target."""
    return read_budget_plan(run.plan) or scene_plan(run, main_target(run))


def view_planner(job: Job) -> Callable[[int, float], Plan]:
    """Plans single views (row of Scene.views, target SSIM), seen or not."""
    if job.run.ladder == "nested":
        costs, quality = nesting.promised_quality(job)
        return lambda row, target: plan_for_view(quality, costs, target, row)
    far, ladder = distances(job, job.fit_config.distance), job.ladder
    models = read_models(job.run.models)

    def plan(row: int, target: float) -> Plan:
        here = {label: float(d[row]) for label, d in far.items()}
        return plan_view(models, ladder.counts, here, target, row, recovering=ladder.recovering)

    return plan


def promised(job: Job) -> Callable[[int, int, int], float]:
    """SSIM promised of a (label id, level) in a view (row of Scene.views); NaN where nothing is."""
    if job.run.ladder == "nested":
        costs, quality = nesting.promised_quality(job)
        row_of = {label: i for i, label in enumerate(costs.labels)}
        return lambda label, level, row: float(quality.bound[row, row_of[label], level - 1])
    far, models = distances(job, job.fit_config.distance), read_models(job.run.models)

    def by_distance(label: int, level: int, row: int) -> float:
        known = (label, level) in models and label in far
        return float(models[label, level](float(far[label][row]))) if known else np.nan

    return by_distance
