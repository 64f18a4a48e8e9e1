"""Makes the levels of a scene: trained as one or, of a large scene, in blocks that are merged.

A block has its own run folder, RUN/blocks/NNN, whose capture is a part of the scene. It is trained and nested
like any other run, on any node, and resumes after a kill. In the merged scene a category has cells in each
block that it is in (`train.boundaries`), and later stages treat it as any other scene.
"""

import shutil
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch

from sagesplat.adapt.ladder import read_ladder
from sagesplat.core.config import BlocksConfig, TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Emit, named
from sagesplat.core.gaussians import concat
from sagesplat.formats.levels import read_level, write_level
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
    read_blocks,
    split,
    training_scene,
    visible_shares,
    write_blocks,
)
from sagesplat.scene.scene import Scene
from sagesplat.scene.stored import write_scene
from sagesplat.segment.lift import LiftedLabels
from sagesplat.segment.masks import mask_path
from sagesplat.stages.scene import check_not_adopted
from sagesplat.stages.train import read_frozen, train_inputs, train_levels, write_frozen
from sagesplat.train import memory

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


def divide(job: Job, config: BlocksConfig, seed: int) -> Blocks:
    """Split the scene, and create a run folder for each block with its part of the capture."""
    run, file = job.run, job.run.division
    settings = {**asdict(config), "seed": seed}

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
    stored: dict[str, Any] = {"path": str(capture.resolve()), "settings": {}}
    stored |= {"fingerprint": fingerprint(scene)}
    stored |= {"photos": mine.sha256, "extent": scene.extent, "points": len(rows), "views": []}
    write_json(run.scene, stored)
    mine.keep(run.photo_hashes)


def share_masks(job: Job, block: Job) -> None:
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


def _needed(block: Job, config: TrainConfig) -> int:
    """Predicted host memory of a block's training, bytes (0 on a GPU)."""
    if block.gpus:
        return 0
    return memory.fit(block.scene, config, block.memory_limit, processes=block.processes).needed


def train_scene(job: Job, train: TrainConfig, config: BlocksConfig, seed: int) -> None:
    """Train the scene: as one, or split into blocks, which are trained as tasks and merged."""
    check_not_adopted(job.run)
    if config.count == 1:
        if job.has_blocks:
            raise RunError(
                f"{job.run.blocks}: this run is in blocks; add --blocks.count, or begin another run"
            )
        return train_levels(job, train, seed)
    check(config, train)
    # a photo of several blocks would get several exposures, and every block a sky around the others
    train = replace(train, exposure="off", sky="off")
    run = job.run
    settings = {**asdict(train), "batch": max(train.batch, job.processes), "seed": seed}
    settings["blocks"] = asdict(config)
    blocks = divide(job, config, seed)

    def make() -> list[str]:
        tasks = []
        for number in range(len(blocks)):
            spec = job.block_spec(number)
            block = spec.open(job.emit)
            share_masks(job, block)
            what = (spec, number, train, seed)
            tasks.append(Task(f"block {number}", train_block, what, job.gpus, _needed(block, train)))
        results(job.executor, tasks, job.emit)
        run.provenance("train").unlink(missing_ok=True)  # from here on the earlier levels are gone
        merged = _merge_levels(run, blocks)
        return [f"{merged:,} Gaussians of {len(blocks)} blocks"]

    inputs = [*train_inputs(job, train), run.division, run.provenance("blocks")]
    run_stage(job, "train", settings, inputs, [run.levels], make, swaps=True)


def train_block(spec: JobSpec, number: int, config: TrainConfig, seed: int, emit: Emit) -> None:
    """Train one block in its run folder."""
    train_levels(spec.open(named(emit, f"block {number}")), config, seed)


def _merge_levels(run: RunDir, blocks: Blocks) -> int:
    """Write merged levels from the interiors of all blocks; the number of Gaussians in the last one."""
    ladders = [read_ladder(run.block(number).levels) for number in range(len(blocks))]
    shutil.rmtree(run.levels, ignore_errors=True)
    count = 0
    for step in sorted({level for ladder in ladders for level in ladder.levels}):
        # blocks in which all categories stopped early have fewer levels
        files = [[f for f in ladder.files if f.step <= step][-1:] for ladder in ladders]
        parts = [(number, read_level(f.path)) for number, newest in enumerate(files) for f in newest]
        interiors = [g.select(torch.from_numpy(blocks.of(g.means.numpy()) == number)) for number, g in parts]
        flat = [f for newest in files for f in newest]
        g = concat(interiors)
        write_level(
            run.levels, step, g, recovering=any(f.recovering for f in flat),
            sh_degree=max(f.sh_degree for f in flat),
        )  # fmt: skip
        count = len(g)
    stops = [read_frozen(run.block(number).frozen) for number in range(len(blocks))]
    frozen = {}
    for label in sorted(set().union(*stops)):  # a category has stopped where it has in all its blocks
        own = [of for of, ladder in zip(stops, ladders, strict=True) if label in ladder.files[-1].counts]
        if own and all(label in of for of in own):
            frozen[label] = max(of[label] for of in own)
    write_frozen(run.frozen, frozen)
    return count
