"""Runs all stages in order, from a capture to the report."""

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from sagesplat.core.config import (
    AdoptConfig,
    BlocksConfig,
    CleanConfig,
    FitConfig,
    LabelsConfig,
    MasksConfig,
    NestConfig,
    PlanConfig,
    RunConfig,
    TrainConfig,
)
from sagesplat.core.errors import RunError
from sagesplat.core.events import Emit, Progress, StageDone, StageStarted
from sagesplat.demo.capture import cached_capture
from sagesplat.demo.wild import EVERYTHING, NOTHING, Wild
from sagesplat.io.typed import check_limits
from sagesplat.run.job import Job
from sagesplat.run.recorded import recorded_settings
from sagesplat.run.run_dir import RunDir
from sagesplat.stages import blocks
from sagesplat.stages.adopt import open_splat
from sagesplat.stages.adopt_levels import make_levels
from sagesplat.stages.boundaries import measure_borders
from sagesplat.stages.clean import clean_levels
from sagesplat.stages.compose import compose_plan
from sagesplat.stages.estimate import tell_duration
from sagesplat.stages.evaluate import evaluate_plans
from sagesplat.stages.fit import fit_ladder
from sagesplat.stages.instances import find_photo_instances, fold_back, make_instances
from sagesplat.stages.label import fuse_masks, lift_labels, make_masks
from sagesplat.stages.methods import method_of
from sagesplat.stages.nest import nest_levels
from sagesplat.stages.observe import observe_levels
from sagesplat.stages.plan import check_targets, make_plan
from sagesplat.stages.preflight import check_segmenter, check_training
from sagesplat.stages.report import make_report
from sagesplat.stages.sample import sample_levels
from sagesplat.stages.scene import check_not_adopted, open_scene
from sagesplat.stages.train import train_levels

# the built-in capture, within minutes on two cores
DEMO = RunConfig(
    train=TrainConfig(max_steps=1200, level_every=60),
    nest=NestConfig(steps=600, levels=12, base_steps=250, full_share=0.3),
    plan=PlanConfig(target_fidelity=0.9),
)
WILD_DEMO = replace(
    DEMO,
    scene=replace(DEMO.scene, vignetting=True),
    labels=LabelsConfig(ignore="person"),
    train=replace(DEMO.train, poses=True),
)


def run_all(job: Job, scene: Path, config: RunConfig) -> None:
    """Run every stage on one capture. Stages whose results are there already are skipped.

    Args:
        job: The run folder, and where events go. Results for the paper's levels or for the nested ladder go
            to folders of their own: `job.run.ladder`.
        scene: The capture.
        config: Settings of all stages.

    Raises:
        SageError: For anything wrong with the capture, the settings, the run folder or the machine. Settings
            are checked before hours of training.

    Example:
        `sagesplat.run_scene` opens a job and calls this.
    """
    check_not_adopted(job.run)
    check_limits(config)  # before hours of training
    check_targets(config.plan, config.ladder)
    check_instances(config)
    blocks.check(config.blocks, config.train)
    check_segmenter(job, scene, config.masks)
    open_scene(job, scene, config.scene, config.poses, config.masks, config.labels)
    if config.blocks.count == 1:
        check_training(job, config.train)
    make_masks(job, config.masks, config.labels)
    if config.labels.instances:
        find_photo_instances(job, config.masks, config.labels)
    lift_labels(job)
    tell_duration(job, config)
    train(job, config.train, config.blocks, config.seed)
    if config.fuse:
        fuse_masks(job)
    elif job.run.fused.exists():
        raise RunError(f"{job.run.fused}: label images were fused; add --fuse, or delete that folder")
    if job.has_blocks:
        blocks.label_block_categories(job)
    instances(job, config.labels, config.masks)
    if job.run.ladder == "nested":
        if not job.has_blocks:
            clean(job, config.clean)
        nest(job, config.nest, config.blocks, config.seed)
    _promise(job, config)


def adopt(job: Job, source: Path, adopted: AdoptConfig, config: RunConfig) -> None:
    """Make a run of a splat that somebody else trained: levels, promises, a plan and a report.

    Args:
        job: The run folder, and where events go.
        source: The splat file, or the folder of a SOG.
        adopted: Viewpoints and levels.
        config: Settings of the other stages; those of training and nesting are not used.

    Raises:
        SageError: For anything wrong with the file, the settings, the run folder or the machine.
    """
    check_limits(config)
    check_targets(config.plan, "nested")
    open_splat(job, source, adopted, config.scene, config.masks, config.labels)
    method_of(job).check(config.plan)
    make_levels(job, adopted)
    _promise(job, config)


def _promise(job: Job, config: RunConfig) -> None:
    """From the levels to the report."""
    observe_levels(job, config.fit)
    sample_levels(job, config.sample, config.fit)
    fit_ladder(job, config.fit)
    make_plan(job, config.plan)
    compose_plan(job)
    evaluate_plans(job)
    make_report(job)


def observe_snapshots(job: Job) -> None:
    """Measure the training snapshots of a run, as its levels were measured; `job` is one on the snapshots."""
    check_not_adopted(job.run)
    observe_levels(job, _recorded(job).get("fit", FitConfig()))


def adapt_snapshots(job: Job) -> None:
    """Measure, model and plan the training snapshots of a run, with the settings that it was made with.

    `job` is one on the snapshots. Stages that are done are skipped.
    """
    check_not_adopted(job.run)
    known = _recorded(job)
    fit: FitConfig = known.get("fit", FitConfig())
    observe_levels(job, fit)
    fit_ladder(job, fit)
    plan: PlanConfig = known.get("plan", PlanConfig())
    others = plan.other_targets if plan.quality == "ssim" else None  # snapshots have no fidelity
    make_plan(job, replace(plan, target_fidelity=None, other_targets=others, budget=0.0, weights={}))


def _recorded(job: Job) -> dict[str, Any]:
    """What the run records of its snapshots, else of its nested levels."""
    nested_levels = recorded_settings(RunDir(job.run.path, "nested"))
    return nested_levels | recorded_settings(RunDir(job.run.path, "snapshots"))


def train(job: Job, config: TrainConfig, of_blocks: BlocksConfig, seed: int) -> None:
    """Train the scene as one, or in blocks."""
    check_not_adopted(job.run)
    if of_blocks.count > 1:
        blocks.train_blocks(job, of_blocks, config, seed)
    elif job.has_blocks:
        raise RunError(f"{job.run.blocks}: this run is in blocks; add --blocks.count, or begin another run")
    else:
        train_levels(job, config, seed)


def instances(job: Job, labels: LabelsConfig, masks: MasksConfig) -> None:
    """Tell instances apart, or make those of an earlier command parts of their categories again."""
    check_not_adopted(job.run)
    if labels.instances:
        find_photo_instances(job, masks, labels)
        make_instances(job, labels)
    else:
        fold_back(job)


def check_instances(config: RunConfig) -> None:
    """RunError for settings that instances cannot be told apart with."""
    if not config.labels.instances:
        return
    if config.ladder == "snapshots":
        raise RunError("--labels.instances: snapshots have no instances; use --ladder nested")


def clean(job: Job, config: CleanConfig) -> None:
    """Remove floaters from the last level of a training."""
    check_not_adopted(job.run)
    if job.has_blocks:
        raise RunError(f"{job.run.blocks}: floaters are not removed from a scene in blocks; nest it as it is")
    clean_levels(job, config)


def nest(job: Job, config: NestConfig, of_blocks: BlocksConfig, seed: int) -> None:
    """Make the nested ladder of a trained scene, or of its blocks."""
    check_not_adopted(job.run)
    if job.has_blocks:
        blocks.nest_blocks(job, of_blocks, config, seed)
        measure_borders(job)
    else:
        nest_levels(job, config, seed)


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
