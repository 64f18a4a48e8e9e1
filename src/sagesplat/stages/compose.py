"""Makes the composed scene, from the levels that the plan chose."""

from pathlib import Path

from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.offsets import write_offset
from sagesplat.formats.ply import write_ply
from sagesplat.raster.classic import for_classic, for_playcanvas
from sagesplat.run.job import Job
from sagesplat.run.records import settings_of
from sagesplat.run.stage import run_stage
from sagesplat.scene.scene import Camera
from sagesplat.stages.methods import method_of
from sagesplat.stages.plan import main_plan
from sagesplat.stages.shared import label_image_inputs, train_config
from sagesplat.train.early_stopping import spread
from sagesplat.train.stepper import tune

_VIEWS = 32  # training views that tell how Gaussians are drawn


def tune_composition(job: Job, g: Gaussians, steps: int) -> Gaussians:
    """A composition trained as a whole, with the settings of the run's training; as it is for 0 steps."""
    if steps <= 0:
        return g
    seed = settings_of(job.run, "train")["seed"]
    config = train_config(job)
    return tune(
        g, job.scene, job.photos, config, steps,
        valid=job.inliers, seed=seed, backend=job.backend, shell=job.sky.shell if job.sky else None,
    )  # fmt: skip


def classic(job: Job, g: Gaussians) -> Gaussians:
    """`g` for viewers that draw without antialiasing, whatever the run was trained with."""
    if not job.antialiased:
        return g
    return for_classic(g, _cameras(job))


def for_engine(job: Job, g: Gaussians) -> Gaussians:
    """`g` for PlayCanvas's engine with its own settings, whatever the run was trained with."""
    return for_playcanvas(classic(job, g), _cameras(job))


def _cameras(job: Job) -> list[Camera]:
    rows = spread(job.scene.train_ids.tolist(), _VIEWS)
    return [job.scene.views[row].camera for row in rows]


def compose_plan(job: Job) -> None:
    """Write the scene that the plan chose, for the usual viewers of PLY files: they do not antialias."""
    run = job.run

    def make() -> list[str]:
        plan = main_plan(job)
        g = plan.compose(job.ladder)
        write_ply(run.composed, classic(job, g), job.names(), parents=job.parents_by_id)
        write_offset(run.composed, job.scene.offset)
        size = f"{plan.nbytes / 1e6:.1f} MB at 248 bytes each"
        if plan.transfer_bytes is not None:
            size = f"{plan.transfer_bytes / 1e6:.2f} MB to send ({run.composed.name}: {size})"
        return [f"{len(g):,} Gaussians, {size}"]

    run_stage(job, "compose", {}, compose_inputs(job), [run.composed], make)


def compose_inputs(job: Job) -> list[Path]:
    """What a plan's composition is made from."""
    run = job.run
    made = [run.provenance("plan"), run.provenance("train"), *label_image_inputs(run)]
    return [*run.scene_files, run.plan, *method_of(job).level_files[:2], *made]
