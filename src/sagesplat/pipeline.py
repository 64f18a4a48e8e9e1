"""The whole flow, from photos and label images to the report."""

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sagesplat import blocks, borders, labelling, nesting, stages
from sagesplat.adapt.ladder import read_prefixes
from sagesplat.adapt.plan import check_target
from sagesplat.config import BlocksConfig, NestConfig, PlanConfig, RunConfig, TrainConfig
from sagesplat.demo.capture import cached_capture
from sagesplat.errors import RunError
from sagesplat.events import Emit, Progress, StageDone, StageStarted
from sagesplat.job import Job
from sagesplat.output.chunks import INDEX, Format, write_chunks
from sagesplat.output.ply import write_ply
from sagesplat.run_dir import settings_of
from sagesplat.train import nested

# the built-in capture, within minutes on two cores
DEMO = RunConfig(
    train=TrainConfig(max_steps=1200, level_every=60),
    nest=NestConfig(steps=600, levels=12, seed_steps=600),
    plan=PlanConfig(target_ssim=0.7),
)


def run_all(job: Job, scene: Path, config: RunConfig) -> None:
    """Every stage on one capture; those whose result is there already are skipped."""
    for target in config.plan.targets:  # before hours of training
        check_target(target)
    nested.check(config.nest)
    blocks.check(config.blocks)
    stages.open_scene(job, scene, config.scene, config.poses)
    labelling.make_masks(job, config.masks, config.labels)
    labelling.lift_labels(job, config.lift)
    train(job, config.train, config.blocks, config.seed)
    if config.fuse:
        labelling.fuse_masks(job)
    elif job.run.fused.exists():
        raise RunError(f"{job.run.fused}: label images were fused; add --fuse, or delete that folder")
    if job.has_blocks:
        blocks.make_parts(job)
    if job.run.ladder == "nested":
        nest(job, config.nest, config.blocks, config.seed)
    stages.observe_levels(job, config.fit)
    stages.fit_ladder(job, config.fit)
    stages.make_plan(job, config.plan)
    stages.compose_plan(job)
    stages.evaluate_plans(job)
    stages.make_report(job)


def train(job: Job, config: TrainConfig, of_blocks: BlocksConfig, seed: int) -> None:
    """Train the scene as one, or in blocks."""
    if of_blocks.count > 1:
        blocks.train_blocks(job, of_blocks, config, seed)
    elif job.has_blocks:
        raise RunError(f"{job.run.blocks}: this run is in blocks; add --blocks.count, or begin another run")
    else:
        stages.train_levels(job, config, seed)


def nest(job: Job, config: NestConfig, of_blocks: BlocksConfig, seed: int) -> None:
    """Make the nested ladder of a trained scene, or of its blocks."""
    if job.has_blocks:
        blocks.nest_blocks(job, of_blocks, config, seed)
        borders.measure_borders(job)
    else:
        nesting.nest_levels(job, config, seed)


def demo_capture(emit: Emit, places: tuple[int, int] = (1, 1)) -> Path:
    """The built-in capture's folder, made on the first call; `places` makes a grid of courtyards."""
    emit(StageStarted("capture"))
    begin = time.perf_counter()
    capture = cached_capture(lambda done, total: emit(Progress("capture", done, total)), places)
    emit(StageDone("capture", time.perf_counter() - begin, (f"the built-in scene, in {capture}",)))
    return capture


def run_demo(job: Job, places: tuple[int, int] = (1, 1)) -> None:
    """Make the built-in capture (once) and run everything on it; a grid of courtyards in as many blocks."""
    run_all(job, demo_capture(job.emit, places), replace(DEMO, blocks=BlocksConfig(math.prod(places))))


def export_chunks(job: Job, folder: Path, kind: Format) -> int:
    """Write what each level of each category adds as files of their own; returns how many."""
    if job.run.ladder != "nested":
        raise RunError(f"{job.run.path}: snapshots have no chunks; leave out --ladder snapshots")
    if folder.exists() and not (job.force and (folder / INDEX).exists()):
        raise RunError(f"{folder}: exists; choose a new folder (--force replaces one of chunks)")
    ladder, made = read_prefixes(job.run.prefixes), settings_of(job.run, "nest")
    chunks = write_chunks(
        folder, ladder.gaussians, ladder.sizes, job.names(), kind=kind,
        sh_bits=tuple(made["sh_bits"]), antialiased=job.antialiased,
    )  # fmt: skip
    return len(chunks)


def export_ply(
    job: Job, path: Path, *, level: int | None, labels: Sequence[str], target: float | None
) -> int:
    """Write a level or a composition, whole or some categories, as a PLY; returns the number of Gaussians."""
    if path.exists() and not job.force:
        raise RunError(f"{path}: exists; add --force to replace it")
    wanted = [stages.label_named(job, name) for name in labels] or list(job.names())
    if level is not None:
        g = job.ladder.load(level, wanted)
    else:
        plan = stages.main_plan(job.run) if target is None else stages.scene_plan(job.run, target)
        g = stages.compose(job, plan).of_labels(wanted)
    write_ply(path, g, job.names())
    return len(g)
