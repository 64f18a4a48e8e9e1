"""Makes the levels and nested levels of a large scene, from blocks trained independently and merged.

A block has its own run folder, RUN/blocks/NNN, whose capture is a part of the scene. It is trained and nested
like any other run, on any node, and resumes after a kill. In the merged scene every (block, category) pair is
a category of its own (`segment.block_categories`), and later stages treat it as any other category.
"""

import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sagesplat.adapt.ladder import read_ladder, read_prefixes
from sagesplat.adapt.observe import RenderedLabels
from sagesplat.core.config import BlocksConfig, NestConfig, TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Emit, Progress, named
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.formats.levels import read_level, read_sizes, write_level, write_set
from sagesplat.io.files import link, write_json
from sagesplat.io.typed import check_limits
from sagesplat.run.capture import Hashes, fingerprint, photo_hashes
from sagesplat.run.executor import Task, results
from sagesplat.run.job import Job, JobSpec
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import run_stage
from sagesplat.scene.blocks import (
    Blocks,
    assigned_views,
    graph_colouring,
    read_blocks,
    read_division,
    split,
    training_scene,
    visible_shares,
    write_blocks,
)
from sagesplat.scene.scene import Scene
from sagesplat.scene.stored import write_scene
from sagesplat.segment.block_categories import BlockCategories
from sagesplat.segment.lift import LiftedLabels
from sagesplat.segment.masks import Taxonomy, mask_path, prepare_folder, write_labels, write_mask
from sagesplat.stages.nest import nest_levels, write_ladder
from sagesplat.stages.shared import label_image_inputs, train_config
from sagesplat.stages.train import read_frozen, train_inputs, train_levels, write_frozen
from sagesplat.train import memory, nested
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

_SEEN = 0.01  # share of a photo's visible points from which on it sees a block


def check(config: BlocksConfig, train: TrainConfig) -> None:
    """RunError for settings out of range, or that do not go together."""
    check_limits(config, "blocks.")
    if config.count > 1 and train.poses:  # a photo of several blocks would get several poses
        raise RunError("--train.poses does not go with --blocks.count; leave out one of them")
    if config.count > 1 and train.exposure == "affine":
        raise RunError("--train.exposure affine does not go with --blocks.count; leave out one of them")
    if config.count > 1 and train.outliers:  # a block does not explain all of a photo
        raise RunError("--train.outliers does not go with --blocks.count; leave out one of them")


def _division(config: BlocksConfig) -> dict[str, float]:
    """The settings that decide what a block is trained on."""
    return {name: value for name, value in asdict(config).items() if name != "boundary_steps"}


def divide(job: Job, config: BlocksConfig, seed: int) -> Blocks:
    """Split the scene, and create a run folder for each block with its part of the capture."""
    run, file = job.run, job.run.blocks / "blocks.json"
    settings = {**_division(config), "seed": seed}

    def make() -> list[str]:
        scene = job.scene
        blocks = split(scene, config.count)
        of_points = blocks.of(scene.points.xyz)
        shares = visible_shares(scene, of_points, len(blocks))
        assigned = assigned_views(scene, blocks, shares)
        training = np.isin(np.arange(len(scene.views)), scene.train_ids)
        labels = LiftedLabels.read(run.labels, len(scene.points.xyz))
        photos = photo_hashes(run.photo_hashes, scene)
        sees: list[list[int]] = []
        for number in range(len(blocks)):
            rows = np.flatnonzero(assigned[:, number] & training).tolist()
            sees.append(np.flatnonzero((shares[rows] >= _SEEN).any(0)).tolist())
            part, kept = training_scene(scene, blocks, number, rows, seed)
            _begin(run.block(number), part, labels, kept, photos)
        for old in run.blocks.glob("[0-9]*"):
            if int(old.name) >= len(blocks):
                shutil.rmtree(old)
        job.photos.check()  # blocks record the photos that are there now
        views = (assigned & training[:, None]).sum(0)
        points = np.bincount(of_points, minlength=len(blocks))
        write_blocks(file, blocks, views=views.tolist(), points=points.tolist(), sees=sees)
        return [
            f"{len(blocks)} blocks of {points.min():,} to {points.max():,} points and {views.min()} to "
            f"{views.max()} training views, {views.sum() / max(training.sum(), 1):.2f} blocks a view"
        ]

    inputs = [run.scene, run.labels, run.provenance("masks")]
    run_stage(job, "blocks", settings, inputs, [file], make)
    return read_blocks(file)


def _begin(run: RunDir, scene: Scene, labels: LiftedLabels, rows: np.ndarray, photos: Hashes) -> None:
    """Create a block's run folder with the inputs of training."""
    run.path.mkdir(parents=True, exist_ok=True)
    capture = run.path / "capture.npz"
    write_scene(capture, scene)
    labels.select(rows).write(run.labels)
    mine = photos.of({view.name for view in scene.views})
    stored = {"path": str(capture.resolve()), "settings": {}, "fingerprint": fingerprint(scene)}
    stored |= {"photos": mine.sha256, "extent": scene.extent, "points": len(rows), "views": []}
    write_json(run.scene, stored)
    mine.keep(run.photo_hashes)


def _share_masks(job: Job, block: Job) -> None:
    """Give a block the label images of its views, and the records of who made them, as links.

    Links of what the run has no more are removed: the block would take fused label images that were deleted.
    """
    of, run = job.run, block.run
    for stage, source, target in (
        ("masks", of.masks, run.masks),
        ("fuse", of.fused, run.fused),
        ("instances", of.instances, run.instances),
    ):
        shutil.rmtree(target, ignore_errors=True)
        run.provenance(stage).unlink(missing_ok=True)
        if not (source / "labels.json").exists() or not of.provenance(stage).exists():
            continue
        for path in [*(mask_path(source, view) for view in block.scene.views), source / "labels.json"]:
            link(path, target / path.relative_to(source))
        link(of.provenance(stage), run.provenance(stage))
    shutil.rmtree(run.valid, ignore_errors=True)
    for view in block.scene.views:
        if (path := mask_path(of.valid, view)).exists():
            link(path, mask_path(run.valid, view))


def _spec(job: Job, number: int) -> JobSpec:
    return replace(job.spec, run=job.run.block(number))


def _job_of(job: Job, number: int) -> Job:
    return _spec(job, number).open(job.emit)


def _needed(block: Job, config: TrainConfig) -> int:
    """Predicted host memory of a block's training, bytes (0 on a GPU)."""
    if block.gpus:
        return 0
    return memory.fit(block.scene, config, block.memory_limit, processes=block.processes).needed


def train_blocks(job: Job, config: BlocksConfig, train: TrainConfig, seed: int) -> None:
    """Split the scene, train its blocks as tasks, and merge their levels."""
    check(config, train)
    # a photo of several blocks would get several exposures, and every block a sky around the others
    train = replace(train, exposure="off", sky="off")
    run = job.run
    settings = {**asdict(train), "batch": max(train.batch, job.processes), "seed": seed}
    settings["blocks"] = _division(config)
    blocks = divide(job, config, seed)
    parts = BlockCategories(job.masks.taxonomy, len(blocks))

    def make() -> list[str]:
        tasks = []
        for number in range(len(blocks)):
            block = _job_of(job, number)
            _share_masks(job, block)
            what = (_spec(job, number), number, train, seed)
            tasks.append(Task(f"block {number}", train_block, what, job.gpus, _needed(block, train)))
        results(job.executor, tasks, job.emit)
        run.provenance("train").unlink(missing_ok=True)  # from here on the earlier levels are gone
        merged = _merge_levels(run, blocks, parts)
        return [f"{merged:,} Gaussians of {len(blocks)} blocks"]

    inputs = [*train_inputs(job, train), run.blocks / "blocks.json", run.provenance("blocks")]
    run_stage(job, "train", settings, inputs, [run.levels], make, swaps=True)


def train_block(spec: JobSpec, number: int, config: TrainConfig, seed: int, emit: Emit) -> None:
    """Train one block in its run folder."""
    train_levels(spec.open(named(emit, f"block {number}")), config, seed)


def _merge_levels(run: RunDir, blocks: Blocks, parts: BlockCategories) -> int:
    """Write merged levels from the interiors of all blocks; the number of Gaussians in the last one."""
    ladders = [read_ladder(run.block(number).levels) for number in range(len(blocks))]
    shutil.rmtree(run.levels, ignore_errors=True)
    count = 0
    for step in sorted({level for ladder in ladders for level in ladder.levels}):
        # blocks in which all categories stopped early have fewer levels
        files = [[f for f in ladder.files if f.step <= step][-1:] for ladder in ladders]
        interiors = [
            interior(read_level(f.path), blocks, parts, number)[0]
            for number, newest in enumerate(files)
            for f in newest
        ]
        flat = [f for newest in files for f in newest]
        g = concat(interiors)
        write_level(
            run.levels, step, g, recovering=any(f.recovering for f in flat),
            sh_degree=max(f.sh_degree for f in flat),
        )  # fmt: skip
        count = len(g)
    frozen = {}
    for number in range(len(blocks)):
        for label, step in read_frozen(run.block(number).frozen).items():
            frozen[int(parts.ids(np.array(label), number))] = step
    write_frozen(run.frozen, frozen)
    return count


def label_block_categories(job: Job) -> None:
    """Render label images for a scene split into blocks; every (block, category) pair is its own category.

    A pixel keeps its category and gets the block whose Gaussians contribute most to it.
    """
    run = job.run
    blocks, masks = read_blocks(run.blocks / "blocks.json"), job.category_masks
    parts = BlockCategories(masks.taxonomy, len(blocks))

    def make() -> list[str]:
        scene, names = job.scene, parts.names
        g = job.snapshots.load(job.snapshots.levels[-1])
        by_block = replace(g, label_ids=torch.from_numpy(parts.block_of(g.label_ids.numpy())))
        painted = RenderedLabels(by_block, job.backend, job.antialiased)
        shutil.rmtree(run.block_categories, ignore_errors=True)
        paths = prepare_folder(run.block_categories, scene.views)
        occurring = set(g.counts())
        for row, (view, path) in enumerate(zip(scene.views, paths, strict=True)):
            shown = painted[view]
            own = int(blocks.of(view.camera.position[None])[0])
            part_ids = parts.ids(masks[view], np.where(shown < 0, own, shown))
            write_mask(path, part_ids, names)
            occurring |= set(np.unique(part_ids).tolist())
            job.emit(Progress("block_categories", row + 1, len(scene.views)))
        lifted = LiftedLabels.read(run.labels, len(scene.points.xyz))
        ids = parts.ids(lifted.label_ids, blocks.of(scene.points.xyz))
        replace(lifted, label_ids=ids).write(run.block_categories / "labels.npz")
        write_labels(run.block_categories, names, occurring | set(np.unique(ids).tolist()))
        return [
            f"{len(occurring)} per-block categories of {len(masks.taxonomy.names)} in {len(blocks)} blocks"
        ]

    made = [run.provenance(stage) for stage in ("train", "masks")]
    inputs = [run.scene, run.labels, run.levels, run.blocks / "blocks.json", run.masks / "labels.json", *made]
    if masks.folder == run.fused:
        inputs.append(run.provenance("fuse"))
    outputs = [run.block_categories / "labels.json", run.block_categories / "labels.npz"]
    run_stage(job, "block_categories", {}, inputs, outputs, make)


def nest_blocks(job: Job, config: BlocksConfig, nest: NestConfig, seed: int) -> None:
    """Make the nested levels of the blocks, tune them along the boundaries, and merge them."""
    run, file = job.run, job.run.blocks / "blocks.json"
    check_limits(nest, "nest.")
    blocks = read_blocks(file)
    settings = {**asdict(nest), "seed": seed, "boundary_steps": config.boundary_steps}

    def make() -> list[str]:
        every = range(len(blocks))
        for number in every:
            _share_masks(job, _job_of(job, number))
        tasks = [
            Task(f"block {i}", nest_block, (_spec(job, i), file, i, nest, seed), job.gpus) for i in every
        ]
        results(job.executor, tasks, job.emit)
        files = [run.block(number).interior for number in every]
        if config.boundary_steps:
            files = _tune(job, blocks, config, nest, seed)
        else:  # the table of blocks would show the seconds of an earlier tuning
            for number in every:
                run.block(number).provenance("boundaries").unlink(missing_ok=True)
        merged = together(files)
        lines = write_ladder(job, merged.gaussians, merged.sizes, nest, merged.second)
        return [*lines, f"{len(blocks)} blocks, {config.boundary_steps} steps of boundary tuning each"]

    inputs = [run.scene, run.labels, run.levels, run.provenance("train"), *label_image_inputs(run), file]
    run_stage(job, "nest", settings, inputs, [run.prefixes, run.increments], make, swaps=True)


def nest_block(
    spec: JobSpec, partition: Path, number: int, config: NestConfig, seed: int, emit: Emit
) -> None:
    """Make the nested levels of one block, and its interior: the Gaussians inside the block's border."""
    job = spec.open(named(emit, f"block {number}"))
    run = job.run
    labels = (run.instances if job.has_instances else run.masks) / "labels.json"
    nest_levels(job, config, seed)

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


def _tune(job: Job, blocks: Blocks, config: BlocksConfig, nest: NestConfig, seed: int) -> list[Path]:
    """Tune the blocks along their boundaries, neighbours one after the other; the files with the results."""
    run, every = job.run, range(len(blocks))
    files = [run.block(number).interior for number in every]
    colour, sees = graph_colouring(blocks.neighbours()), read_division(run.blocks / "blocks.json").sees
    steps = replace(nest, steps=config.boundary_steps)
    for now in range(int(colour.max()) + 1):
        mine = [number for number in every if colour[number] == now]
        tasks = []
        for number in mine:
            others = [files[other] for other in sees[number] if other != number]
            what = (_spec(job, number), run.blocks / "blocks.json", number, others, steps, seed)
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
