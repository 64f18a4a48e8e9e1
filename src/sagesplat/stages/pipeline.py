"""Runs all stages in order, from a capture to the report."""

import math
import time
from dataclasses import replace
from pathlib import Path

from sagesplat.core.config import (
    AdoptConfig,
    BlocksConfig,
    LabelsConfig,
    NestConfig,
    PlanConfig,
    RunConfig,
    SampleConfig,
    TrainConfig,
)
from sagesplat.core.errors import RunError
from sagesplat.core.events import Emit, Progress, StageDone, StageStarted
from sagesplat.demo.capture import cached_capture
from sagesplat.demo.wild import EVERYTHING, NOTHING, Wild
from sagesplat.io.lock import locked
from sagesplat.io.typed import check_limits
from sagesplat.run.job import Job
from sagesplat.run.recorded import write_begun
from sagesplat.stages import blocks
from sagesplat.stages.adopt import open_splat
from sagesplat.stages.adopt_levels import make_levels
from sagesplat.stages.block_levels import nest_scene
from sagesplat.stages.clean import clean_levels
from sagesplat.stages.compose import compose_plan
from sagesplat.stages.estimate import tell_duration
from sagesplat.stages.evaluate import evaluate_plans
from sagesplat.stages.fit import fit_ladder
from sagesplat.stages.instances import find_photo_instances, make_instances
from sagesplat.stages.label import fuse_masks, lift_labels, make_masks
from sagesplat.stages.methods import method_of
from sagesplat.stages.observe import observe_levels
from sagesplat.stages.plan import check_targets, make_plan
from sagesplat.stages.preflight import check_segmenter, check_training
from sagesplat.stages.report import make_report
from sagesplat.stages.sample import sample_levels
from sagesplat.stages.scene import check_not_adopted, open_scene

# the built-in capture, within minutes on two cores
DEMO = RunConfig(
    train=TrainConfig(max_steps=1200, level_every=60),
    nest=NestConfig(steps=600, levels=12, base_steps=250),
    # twice as many as so short a training has: plans for a view take 5 to 14 % fewer bytes
    sample=SampleConfig(views=100, calibration_views=92),
    plan=PlanConfig(target_fidelity=0.9),
)
WILD_DEMO = replace(
    DEMO,
    scene=replace(DEMO.scene, vignetting=True),
    labels=LabelsConfig(ignore="person"),
    train=replace(DEMO.train, poses=True),
)


def run_all(job: Job, scene: Path, config: RunConfig) -> None:
    """Run every stage on one capture (see `sagesplat.run_scene`), but for those whose results are there.

    Results for the paper's levels or for the nested ladder go to folders of their own: `job.run.ladder`.
    """
    check_not_adopted(job.run)
    if job.run.path.exists() and not job.run.path.is_dir():
        raise RunError(f"{job.run.path}: not a folder; name another run folder")
    _check_limits(config)  # before hours of training
    check_targets(config.plan, config.ladder)
    if config.labels.instances and not method_of(job).has_instances:
        raise RunError("--labels.instances: these levels have no instances; use --ladder nested")
    blocks.check(config.blocks, config.train)
    check_segmenter(job, scene, config.masks)
    open_scene(job, scene, config.scene, config.poses, config.masks, config.labels)
    _remember(job, config)
    if config.blocks.count == 1:
        check_training(job, config.train)
    make_masks(job, config.masks, config.labels)
    if config.labels.instances:
        find_photo_instances(job, config.masks, config.labels)
    lift_labels(job)
    tell_duration(job, config)
    blocks.train_scene(job, config.train, config.blocks, config.seed)
    if config.fuse:
        fuse_masks(job)
    elif job.run.fused.exists():
        raise RunError(f"{job.run.fused}: label images were fused; add --fuse, or delete that folder")
    make_instances(job, config.masks, config.labels)
    if job.run.ladder == "nested":
        if not job.has_blocks:
            clean_levels(job, config.clean)
        nest_scene(job, config.nest, config.seed)
    measure_and_plan(job, config)
    job.run.begun.unlink(missing_ok=True)


def adopt(job: Job, source: Path, adopted: AdoptConfig, config: RunConfig) -> None:
    """Make a run of a splat that somebody else trained: levels, promises, a plan and a report.

    `source`: the splat file, or the folder of a SOG. Of `config` training and nesting are not used.
    """
    _check_limits(config)
    check_targets(config.plan, "nested")
    open_splat(job, source, adopted, config.scene, config.masks, config.labels)
    _remember(job, config, adopted)
    method_of(job).check(config.plan)
    make_levels(job, adopted)
    measure_and_plan(job, config)
    job.run.begun.unlink(missing_ok=True)


def _remember(job: Job, config: RunConfig, adopted: AdoptConfig | None = None) -> None:
    """Keep settings for stages that a killed run does not reach; the records of a finished one have them."""
    if job.force or not job.run.provenance("report").exists():
        with locked(job.run.path, job.lock_wait):
            write_begun(job.run, config, adopted)


def _check_limits(config: RunConfig) -> None:
    """RunError, naming the option, for a setting that is not within its limits."""
    for unprefixed in (config.scene, config.masks, config.plan):
        check_limits(unprefixed)
    check_limits(config)


def measure_and_plan(job: Job, config: RunConfig) -> None:
    """From the levels to the report."""
    observe_levels(job, config.fit)
    sample_levels(job, config.sample, config.fit)
    fit_ladder(job, config.fit)
    make_plan(job, config.plan)
    compose_plan(job)
    evaluate_plans(job)
    make_report(job)


def demo_capture(emit: Emit, places: tuple[int, int] = (1, 1), wild: Wild = NOTHING) -> Path:
    """The built-in capture's folder, made on the first call; `places` makes a grid of courtyards."""
    emit(StageStarted("capture"))
    begin = time.perf_counter()
    capture = cached_capture(lambda done, total: emit(Progress("capture", done, total)), places, wild)
    emit(StageDone("capture", time.perf_counter() - begin, (f"the built-in scene, in {capture}",)))
    return capture


def run_demo(job: Job, places: tuple[int, int] = (1, 1), wild: bool = False) -> None:
    """Make the built-in capture (once) and run everything on it; a grid of courtyards in as many blocks.

    With `wild` the capture is disturbed, and run with the options that such a capture needs.
    """
    disturbances, config = (EVERYTHING, WILD_DEMO) if wild else (NOTHING, DEMO)
    capture = demo_capture(job.emit, places, disturbances)
    run_all(job, capture, replace(config, blocks=BlocksConfig(math.prod(places))))
