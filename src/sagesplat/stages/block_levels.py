"""Makes the nested levels of a large scene: of each block, tuned along the boundaries, then merged."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from sagesplat.adapt.cells import read_cells
from sagesplat.adapt.ladder import read_ladder, read_prefixes
from sagesplat.core.config import NestConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Emit, Progress, named
from sagesplat.io.typed import check_limits
from sagesplat.run.executor import Task, results
from sagesplat.run.job import Job, JobSpec
from sagesplat.run.stage import run_stage
from sagesplat.scene.blocks import Blocks, graph_colouring, read_blocks, read_division
from sagesplat.stages.blocks import share_masks
from sagesplat.stages.boundaries import measure_borders
from sagesplat.stages.nest import nest_levels, write_ladder
from sagesplat.stages.scene import check_not_adopted
from sagesplat.stages.shared import label_image_inputs, train_config
from sagesplat.train import nested
from sagesplat.train.boundaries import BlockLevels, around, boundary_views, merged, read_block, write_block
from sagesplat.train.cells import cells_wanted
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
        specs = [job.block_spec(number) for number in every]
        for spec in specs:
            share_masks(job, spec.open(job.emit))
        configs = [replace(nest, cells=cells) for cells in _cells_of_blocks(job, nest)]
        parts = zip(every, specs, configs, strict=True)
        tasks = [Task(f"block {i}", nest_block, (spec, file, i, of, seed), job.gpus) for i, spec, of in parts]
        results(job.executor, tasks, job.emit)
        files = [run.block(number).interior for number in every]
        if steps:
            files = _tune(job, blocks, replace(nest, steps=steps), seed)
        else:  # the table of blocks would show the seconds of an earlier tuning
            for number in every:
                run.block(number).provenance("boundaries").unlink(missing_ok=True)
        whole = merged([read_block(path) for path in files])
        lines = write_ladder(job, whole.gaussians, dict(whole.sizes), whole.label_of, nest, whole.second)
        return [*lines, f"{len(blocks)} blocks, {steps} steps of boundary tuning each"]

    inputs = [run.scene, run.labels, run.levels, run.provenance("train"), *label_image_inputs(run), file]
    run_stage(job, "nest", settings, inputs, [run.prefixes, run.cells, run.increments], make, swaps=True)
    measure_borders(job)


def _cells_of_blocks(job: Job, nest: NestConfig) -> list[int]:
    """The cells that each block is split into: of all that are wanted its share, by its Gaussians."""
    blocks = [job.run.block(number) for number in range(len(read_blocks(job.run.division)))]
    counts = [sum(read_ladder(block.levels).files[-1].counts.values()) for block in blocks]
    in_all = sum(job.last_level.counts.values())  # blocks overlap
    wanted = cells_wanted(in_all, nest.cells)
    return [round(wanted * count / sum(counts)) for count in counts]


def nest_block(
    spec: JobSpec, partition: Path, number: int, config: NestConfig, seed: int, emit: Emit
) -> None:
    """Make the nested levels of one block, and its interior: the Gaussians inside the block's border."""
    job = spec.open(named(emit, f"block {number}"))
    run = job.run
    blocks = read_blocks(partition)

    def inside(means: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
        return blocks.of(means) == number

    nest_levels(job, config, seed, inside)

    def make() -> list[str]:
        ladder, label_of = read_prefixes(run.prefixes), read_cells(run.cells).label_of
        full = BlockLevels(ladder.gaussians, ladder.sizes, label_of, ladder.second)
        own = full.select(inside(full.gaussians.means.numpy()))
        if not own.sizes:
            raise RunError(f"{run.path}: no Gaussians inside the block; choose fewer with --blocks.count")
        write_block(run.interior, own, config.steps)
        return [f"{len(own.gaussians):,} of {len(full.gaussians):,} Gaussians are inside the block"]

    inputs = [run.prefixes, run.cells, partition]
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
        blocks, own = read_blocks(partition), read_block(run.interior)
        views = boundary_views(job.scene, blocks, number)
        near = blocks.to_border(own.gaussians.means.numpy()) < blocks.margin
        tuned = _tuned(job, own, near, others, views, config, seed) if views and near.any() else own
        write_block(run.tuned_interior, tuned, config.steps)
        return [f"{int(near.sum()):,} of {len(near):,} Gaussians, {len(views)} views of several blocks"]

    inputs = [run.scene, run.provenance("train"), run.interior, partition, *others]
    run_stage(job, "boundaries", settings, inputs, [run.tuned_interior], make)


def _tuned(
    job: Job,
    own: BlockLevels,
    near: np.ndarray,
    others: list[Path],
    views: list[int],
    config: NestConfig,
    seed: int,
) -> BlockLevels:
    """The block's levels after the training."""
    scene = job.scene
    seen = around(own, others, scene, views)
    g, of_others = seen.gaussians, len(seen.gaussians) - len(near)
    movable = np.concatenate([near, np.zeros(of_others, bool)])
    kept = frozenset(view.name for row, view in enumerate(scene.views) if row not in set(views))
    narrowed = replace(scene, test_names=kept)
    ladder = Nested(g, np.zeros(len(g), bool), None if seen.second is None else seen.second.logits)
    for event in nested.nest(
        ladder, narrowed, job.photos, train_config(job), config,
        valid=job.valid, seed=seed, backend=job.backend, movable=movable, label_of=seen.label_of,
    ):  # fmt: skip
        if isinstance(event, NestStep):
            job.emit(Progress("boundaries", event.step, config.steps, f"loss {event.loss:.3f}"))
        elif isinstance(event, Nested):
            mine = torch.isin(event.gaussians.label_ids, torch.unique(g.label_ids[: len(near)]))
            tuned = replace(event.gaussians.select(mine), label_ids=own.gaussians.label_ids)
            second, logits = own.second, event.second_opacities
            if second is not None and logits is not None:
                second = replace(second, logits=logits[mine])
            return replace(own, gaussians=tuned, second=second)
    raise AssertionError("training ends with a Nested event")
