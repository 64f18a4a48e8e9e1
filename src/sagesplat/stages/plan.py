"""Makes plans: a level per category, for the scene, for views, within a budget."""

from dataclasses import asdict, replace

from sagesplat.adapt.plan import Plan, quality_title
from sagesplat.adapt.plan_files import write_plans
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.core.config import LadderKind, PlanConfig
from sagesplat.core.errors import RunError
from sagesplat.io.typed import check_limits
from sagesplat.output.tables import plan_table
from sagesplat.run.job import Job
from sagesplat.run.records import settings_of
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import run_stage
from sagesplat.segment.display_names import titles
from sagesplat.stages.methods import method_for, method_of
from sagesplat.stages.results import budget_plan_of, plans_of
from sagesplat.stages.shared import label_image_inputs, label_named

PAPER_TARGETS = (0.6, 0.7, 0.8)  # SSIM, where a run has no such target of its own


def check_targets(config: PlanConfig, ladder: LadderKind) -> PlanConfig:
    """The settings with their targets filled in; RunError where these levels cannot be planned for them."""
    check_limits(config)
    method = method_for(ladder)
    if config.target_fidelity is None and config.target_ssim is None:
        config = replace(config, **method.default_target)
    if config.target_fidelity is not None and not method.has_fidelity:
        raise RunError("--target-fidelity needs the nested ladder; give --target-ssim")
    return config


def make_plan(job: Job, config: PlanConfig) -> None:
    """Choose the levels: for the scene at each target, for every view at the main one, for a budget."""
    run, method = job.run, method_of(job)
    config = check_targets(config, run.ladder)
    method.check(config)
    for name in config.weights:  # before an earlier plan is given up
        label_named(job, name)

    def make() -> list[str]:
        scene_plans = method.plan_scenes(config.all_targets, config.share)
        view_plans = [
            method.plan_view(row, config.target, config.quality) for row in range(len(job.scene.views))
        ]
        within = method.plan_budget(config) if config.budget else None
        write_plans(run.plan, scene_plans, view_plans, within)
        plans = [*scene_plans, *([within] if within else [])]
        return [f"{plan.asked}: {method.amount(plan)}, {plan.verdict}" for plan in plans]

    inputs = [*run.scene_files, run.labels, *label_image_inputs(run), *method.files, run.observations]
    inputs += [run.provenance("observe"), run.provenance("fit")]
    inputs += [run.provenance("sample")] if method.sample_files else []
    settings = asdict(config) | {"targets": config.targets}
    run_stage(job, "plan", settings, inputs, [run.plan], make)


def show_plan(job: Job) -> None:
    """Show what the run composes, category by category, and the plan for SSIM beside one for fidelity."""
    plans, (quality, _) = [main_plan(job)], main_target(job.run)
    ssim = settings_of(job.run, "plan")["target_ssim"]
    if quality == "fidelity" and ssim is not None:
        plans.append(scene_plan(job, "ssim", ssim))
    for plan in plans:
        table = plan_table(plan, job.ladder.counts, titles(job.names()))
        columns = ("category", "level", "Gaussians", "of full model")
        counted = plan.budget is None and method_of(job).streams
        reached = ("reached in", "from", "to", "views") if counted else ()
        job.emit(table.only(*columns, *reached, "status").event)


def main_target(run: RunDir) -> tuple[QualityKind, float]:
    """The quality and the target that the run's plan was made for."""
    made = settings_of(run, "plan")
    fidelity = made["target_fidelity"]
    return ("ssim", float(made["target_ssim"])) if fidelity is None else ("fidelity", float(fidelity))


def ssim_targets(run: RunDir) -> list[float]:
    """Targets for studies of SSIM against photos: those of the run, else the paper's."""
    made = settings_of(run, "plan")
    if made["target_fidelity"] is None:
        return list(made["targets"])
    return list(
        PAPER_TARGETS if made["target_ssim"] is None else PlanConfig(target_ssim=made["target_ssim"]).targets
    )


def ssim_target(run: RunDir) -> float:
    """The main one of `ssim_targets`."""
    own = settings_of(run, "plan")["target_ssim"]
    return PAPER_TARGETS[1] if own is None else float(own)


def scene_plan(job: Job, quality: QualityKind, target: float) -> Plan:
    """The scene's plan for one of the run's targets."""
    plans = {(plan.quality, plan.target): plan for plan in plans_of(job)}
    if found := plans.get((quality, round(target, 6))):
        return found
    known = ", ".join(plan.asked for plan in plans.values())
    raise RunError(
        f"{job.run.plan}: no plan for {quality_title(quality)} {target:g}, only for {known}; "
        f"run `sagesplat plan {job.run.path} --target-{quality} {target:g} --force`"
    )


def main_plan(job: Job) -> Plan:
    """What the run composes: the plan for its budget, if it has one, else for its main target."""
    return budget_plan_of(job) or scene_plan(job, *main_target(job.run))
