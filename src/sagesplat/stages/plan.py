"""Makes plans from the quality models: a level per category, for the scene, for views, within a budget."""

from dataclasses import asdict

from sagesplat.adapt.plan import Plan, write_plans
from sagesplat.core.config import PlanConfig
from sagesplat.core.errors import RunError
from sagesplat.run.job import Job
from sagesplat.run.records import settings_of
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import run_stage
from sagesplat.stages.methods import method_of
from sagesplat.stages.results import budget_plan_of, plans_of
from sagesplat.stages.shared import label_image_inputs


def make_plan(job: Job, config: PlanConfig) -> None:
    """Choose the levels: for the scene at each target, for every view at the main one, for a budget."""
    run, method = job.run, method_of(job)
    method.check(config)

    def make() -> list[str]:
        scene_plans = [method.plan_scene(target, config.share) for target in config.targets]
        view_plans = [method.plan_view(row, config.target_ssim) for row in range(len(job.scene.views))]
        within = method.plan_budget(config) if config.budget else None
        write_plans(run.plan, scene_plans, view_plans, within)
        lines = [f"SSIM {p.target:g}: {method.amount(p)}, {p.status}" for p in scene_plans]
        if within:
            asked = f"budget {config.budget:,g} {config.budget_unit}"
            lines.append(f"{asked}: {method.amount(within)}, {within.status}")
        return lines

    inputs = [run.scene, run.labels, *label_image_inputs(run), *method.files, run.observations]
    inputs += [run.provenance("observe"), run.provenance("fit")]
    settings = asdict(config) | {"targets": config.targets}
    run_stage(job, "plan", settings, inputs, [run.plan], make)


def main_target(run: RunDir) -> float:
    """The target that the run's plan was made for."""
    return float(settings_of(run, "plan")["target_ssim"])


def scene_plan(job: Job, target: float) -> Plan:
    """The scene's plan for one of the run's targets."""
    plans = {plan.target: plan for plan in plans_of(job)}
    if target not in plans:
        known = ", ".join(f"{t:g}" for t in plans)
        raise RunError(
            f"{job.run.plan}: no plan for SSIM {target:g}, only for {known}; "
            "run `sagesplat plan` with --force"
        )
    return plans[target]


def main_plan(job: Job) -> Plan:
    """What the run composes: the plan for its budget, if it has one, else for its main target."""
    return budget_plan_of(job) or scene_plan(job, main_target(job.run))
