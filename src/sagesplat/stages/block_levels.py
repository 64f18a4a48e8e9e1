"""Makes the nested levels of a large scene: of each block, tuned along the boundaries, then merged."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sagesplat.adapt.ladder import read_prefixes
from sagesplat.core.config import NestConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Emit, Progress, named
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.formats.levels import read_sizes, write_set
from sagesplat.io.typed import check_limits
from sagesplat.run.executor import Task, results
from sagesplat.run.job import Job, JobSpec
from sagesplat.run.stage import run_stage
from sagesplat.scene.blocks import Blocks, graph_colouring, read_blocks, read_division
from sagesplat.segment.block_categories import BlockCategories
from sagesplat.segment.masks import Taxonomy
from sagesplat.stages.blocks import share_masks
from sagesplat.stages.boundaries import measure_borders
from sagesplat.stages.nest import nest_levels, write_ladder
from sagesplat.stages.scene import check_not_adopted
from sagesplat.stages.shared import label_image_inputs, train_config
from sagesplat.train import nested
from sagesplat.train.boundaries import (
    around,
    boundary_views,
    interior,
    interior_opacities,
    interior_sizes,
    read_nested,
    together,
)
from sagesplat.train.nested import Nested, NestStep

_BOUNDARY = 8  # steps of the levels for each step of boundary tuning


def nest_scene(job: Job, nest: NestConfig, seed: int) -> None:
    """Make the nested levels of the scene as one, or of its blocks: tuned along the boundaries and merged."""
    check_not_adopted(job.run)
    if not job.has_blocks:
        return nest_levels(job, nest, seed)
    run, file = job.run, job.run.division
    check_limits(nest, "nest.")
    blocks = read_blocks(file)
    settings = {**asdict(nest), "seed": seed}
    steps = nest.steps // _BOUNDARY

    def make() -> list[str]:
        every = range(len(blocks))
        for number in every:
            spec = job.block_spec(number)
            share_masks(job, spec.open(job.emit))
        tasks = [
            Task(f"block {i}", nest_block, (job.block_spec(i), file, i, nest, seed), job.gpus) for i in every
        ]
        results(job.executor, tasks, job.emit)
        files = [run.block(number).interior for number in every]
        if steps:
            files = _tune(job, blocks, replace(nest, steps=steps), seed)
        else:  # the table of blocks would show the seconds of an earlier tuning
            for number in every:
                run.block(number).provenance("boundaries").unlink(missing_ok=True)
        merged = together(files)
        one_each = {part: part for part in merged.sizes}
        lines = write_ladder(job, merged.gaussians, merged.sizes, one_each, nest, merged.second)
        return [*lines, f"{len(blocks)} blocks, {steps} steps of boundary tuning each"]

    inputs = [run.scene, run.labels, run.levels, run.provenance("train"), *label_image_inputs(run), file]
    run_stage(job, "nest", settings, inputs, [run.prefixes, run.cells, run.increments], make, swaps=True)
    measure_borders(job)


def nest_block(
    spec: JobSpec, partition: Path, number: int, config: NestConfig, seed: int, emit: Emit
) -> None:
    """Make the nested levels of one block, and its interior: the Gaussians inside the block's border."""
    job = spec.open(named(emit, f"block {number}"))
    run = job.run
    labels = (run.instances if job.run.has_instances else run.masks) / "labels.json"
    nest_levels(job, replace(config, cells=0), seed)  # a part of a category in a block is a cell

    def make() -> list[str]:
        blocks = read_blocks(partition)
        parts = BlockCategories(Taxonomy.read(labels), len(blocks))
        full = read_prefixes(run.prefixes)
        g, inside = interior(full.gaussians, blocks, parts, number)
        if not len(g):
            raise RunError(f"{run.path}: no Gaussians inside the block; choose fewer with --blocks.count")
        sizes = interior_sizes(full.gaussians.label_ids.numpy(), inside, full.sizes, parts, number)
        second = full.second and interior_opacities(full.second, inside, sizes, parts, number)
        write_set(run.interior, g, config.steps, sizes, second=second)
        return [f"{len(g):,} of {len(full.gaussians):,} Gaussians are inside the block"]

    inputs = [run.prefixes, labels, partition]
    run_stage(job, "interior", {}, inputs, [run.interior], make)


def _tune(job: Job, blocks: Blocks, nest: NestConfig, seed: int) -> list[Path]:
    """Tune the blocks along their boundaries, neighbours one after the other; the files with the results."""
    run, every = job.run, range(len(blocks))
    files = [run.block(number).interior for number in every]
    colour, sees = graph_colouring(blocks.neighbours()), read_division(run.division).sees
    for now in range(int(colour.max()) + 1):
        mine = [number for number in every if colour[number] == now]
        tasks = []
        for number in mine:
            others = [files[other] for other in sees[number] if other != number]
            what = (job.block_spec(number), run.division, number, others, nest, seed)
            tasks.append(Task(f"boundaries of block {number}", tune_boundaries, what, job.gpus))
        results(job.executor, tasks, job.emit)
        for number in mine:
            files[number] = run.block(number).tuned_interior
    return files


def tune_boundaries(
    spec: JobSpec, partition: Path, number: int, others: list[Path], config: NestConfig, seed: int, emit: Emit
) -> None:
    """Train a block's Gaussians near its border on compositions with visible Gaussians of other blocks."""
    job = spec.open(named(emit, f"block {number}"))
    run = job.run
    settings = {**asdict(config), "seed": seed}

    def make() -> list[str]:
        blocks, sizes = read_blocks(partition), read_sizes(run.interior)
        g, second = own = read_nested(run.interior)
        views = boundary_views(job.scene, blocks, number)
        near = blocks.to_border(g.means.numpy()) < blocks.margin
        if views and near.any():
            g, logits = _tuned(job, own, near, others, views, config, seed)
            second = second if second is None or logits is None else replace(second, logits=logits)
        write_set(run.tuned_interior, g, config.steps, sizes, second=second)
        return [f"{int(near.sum()):,} of {len(near):,} Gaussians, {len(views)} views of several blocks"]

    inputs = [run.scene, run.provenance("train"), run.interior, partition, *others]
    run_stage(job, "boundaries", settings, inputs, [run.tuned_interior], make)


def _tuned(
    job: Job,
    own: tuple[Gaussians, SecondOpacities | None],
    near: np.ndarray,
    others: list[Path],
    views: list[int],
    config: NestConfig,
    seed: int,
) -> tuple[Gaussians, Tensor | None]:
    """The block's Gaussians after the training, and their second opacities."""
    scene = job.scene
    g, second = around(own, others, scene, views)
    n = len(g)
    movable = np.concatenate([near, np.zeros(n - len(near), bool)])
    kept = frozenset(view.name for row, view in enumerate(scene.views) if row not in set(views))
    narrowed = replace(scene, test_names=kept)
    ladder = Nested(g, np.zeros(n, bool), second)
    for event in nested.nest(
        ladder, narrowed, job.photos, train_config(job), config,
        valid=job.valid, seed=seed, backend=job.backend, movable=movable,
    ):  # fmt: skip
        if isinstance(event, NestStep):
            job.emit(Progress("boundaries", event.step, config.steps, f"loss {event.loss:.3f}"))
        elif isinstance(event, Nested):
            mine = torch.isin(event.gaussians.label_ids, torch.unique(own[0].label_ids))
            second = event.second_opacities
            return event.gaussians.select(mine), None if second is None else second[mine]
    raise AssertionError("training ends with a Nested event")
