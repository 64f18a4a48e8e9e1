"""The whole flow, from photos and label images to the report."""

import time
from pathlib import Path

from sagesplat import stages
from sagesplat.config import PlanConfig, RunConfig, TrainConfig
from sagesplat.demo.capture import cached_capture
from sagesplat.events import Progress, StageDone, StageStarted
from sagesplat.job import Job

# the built-in capture, within minutes on two cores
DEMO = RunConfig(train=TrainConfig(max_steps=2000, level_every=100), plan=PlanConfig(target_ssim=0.7))


def run_all(job: Job, scene: Path, config: RunConfig) -> None:
    """Every stage on one capture; those whose result is there already are skipped."""
    stages.open_scene(job, scene, config.scene)
    stages.make_masks(job, config.masks)
    stages.lift_labels(job, config.lift)
    stages.train_levels(job, config.train, config.seed)
    stages.observe_levels(job, config.fit)
    stages.fit_ladder(job, config.fit)
    stages.make_plan(job, config.plan, config.fit)
    stages.compose_plan(job)
    stages.evaluate_plans(job, config.fit)
    stages.make_report(job)


def run_demo(job: Job) -> None:
    """Make the built-in capture (once) and run everything on it."""
    job.emit(StageStarted("capture"))
    begin = time.perf_counter()
    capture = cached_capture(lambda done, total: job.emit(Progress("capture", done, total)))
    job.emit(StageDone("capture", time.perf_counter() - begin, (f"the built-in scene, in {capture}",)))
    run_all(job, capture, DEMO)
