"""The nested ladder of a run: its training, its costs, and what is promised of it."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace

import numpy as np
import torch

from sagesplat.adapt.model import Samples, SsimModel, fit_model, samples
from sagesplat.adapt.observe import Observations, as_unit, large_enough, measure, render_rgb
from sagesplat.adapt.promise import ViewModel, among_neighbours, fit_promises, read_promises
from sagesplat.adapt.promised import Costs, Quality, plan_for_view, quality_at
from sagesplat.config import FitConfig, NestConfig, TrainConfig
from sagesplat.events import Progress, Warned
from sagesplat.executor import split
from sagesplat.gaussians import Gaussians
from sagesplat.job import Job, distances, fusion, label_images, run_stage, work_all
from sagesplat.metrics import ssim_map
from sagesplat.output.chunks import packed, read_chunks, read_index, totals, write_chunks
from sagesplat.raster import Workspace
from sagesplat.run_dir import file_hash, settings_of
from sagesplat.segment.masks import UNLABELLED
from sagesplat.train import nested
from sagesplat.train.checkpoint import remove_checkpoints
from sagesplat.train.freeze import VIEWS, spread
from sagesplat.train.levels import read_level, write_set
from sagesplat.train.nested import NestStep
from sagesplat.train.trainer import Resumed, Step, Trained

_TARGETS = tuple(np.arange(0.5, 0.96, 0.05).round(2).tolist())  # SSIM of the compositions that are looked at


def train_config(job: Job) -> TrainConfig:
    """How the run was trained."""
    made = settings_of(job.run, "train")
    return TrainConfig(**{f.name: made[f.name] for f in fields(TrainConfig) if f.name in made})


def nest_levels(job: Job, config: NestConfig, seed: int) -> None:
    """Order the trained Gaussians and train their prefixes; write the ladder and its chunks."""
    run = job.run
    nested.check(config)
    settings = {**asdict(config), "seed": seed}

    def make() -> list[str]:
        full = job.snapshots.load(job.snapshots.levels[-1])
        seeds = read_level(run.seeds) if config.seed_share else None
        masks = job.best_masks
        ordered = nested.order(full, job.scene, masks, config, seeds=seeds, antialiased=job.antialiased)
        belongs = json.dumps({**settings, "scene": file_hash(run.scene), "levels": file_hash(run.levels)})
        if job.force:
            remove_checkpoints(run.nest_checkpoint)
        trained = ordered
        for event in nested.nest(
            ordered, job.scene, job.photos, train_config(job), config,
            seed=seed, backend=job.backend, checkpoint=run.nest_checkpoint, settings=belongs,
        ):  # fmt: skip
            if isinstance(event, NestStep):
                job.emit(Progress("nest", event.step, config.steps, f"loss {event.loss:.3f}"))
            elif isinstance(event, Resumed):
                before = f"the checkpoint before the newest: {event.damage}"
                job.emit(Warned(f"going on from step {event.step}, {before}"))
            else:
                trained = event
        counts, across = trained.gaussians.counts(), trained.boundary
        sizes = {label: nested.level_sizes(n, config, across.get(label, 0)) for label, n in counts.items()}
        lines = write_ladder(job, trained.gaussians, sizes, config, trained.clarity)
        lines[0] += f", {sum(across.values()):,} of them across borders and in every level"
        remove_checkpoints(run.nest_checkpoint)
        return lines

    inputs = [run.scene, run.labels, run.levels, *fusion(run)]
    if config.seed_share:
        _make_seeds(job, config, seed)
        inputs.append(run.seeds)
    run_stage(job, "nest", settings, inputs, [run.prefixes, run.chunks], make)


def _make_seeds(job: Job, config: NestConfig, seed: int) -> None:
    """Train the small model that the ladder begins with: a stage, so that a killed run has it already."""
    run, made = job.run, train_config(job)
    full = job.snapshots.size(job.snapshots.levels[-1])
    cap = max(1, round(config.seed_share * full))
    settings = {**asdict(nested.capped_config(made, cap, config.seed_steps)), "seed": seed}

    def make() -> list[str]:
        g = train_capped(job, "seeds", cap, config.seed_steps, seed)
        write_set(run.seeds, g, config.seed_steps)
        return [f"{len(g):,} Gaussians"]

    run_stage(job, "seeds", settings, [run.scene, run.labels], [run.seeds], make)


def train_capped(job: Job, stage: str, cap: int, steps: int, seed: int) -> Gaussians:
    """3DGS-MCMC of at most `cap` Gaussians, otherwise trained as the run; progress goes to `stage`."""
    for event in nested.train_capped(
        job.scene, job.photos, job.point_labels, train_config(job), cap, steps, seed=seed, backend=job.backend
    ):
        if isinstance(event, Step):
            text = f"loss {event.loss:.3f}, {event.num_gaussians:,} Gaussians"
            job.emit(Progress(stage, event.step, steps, text))
        elif isinstance(event, Trained):
            return event.gaussians
    raise AssertionError("a training ends with what it trained")


def write_ladder(
    job: Job, g: Gaussians, sizes: dict[int, tuple[int, ...]], config: NestConfig, clarity: np.ndarray
) -> list[str]:
    """Write Gaussians in their order, with levels of `sizes` by label id, as the run's ladder and its chunks.

    `clarity` [N] of `Nested` is kept beside them.
    """
    rows = packed(g, sizes, sh_bits=config.sh_bits)
    ordered = g.select(torch.from_numpy(rows))
    chunks = write_chunks(
        job.run.chunks, ordered, sizes, job.names(), sh_bits=config.sh_bits, antialiased=job.antialiased
    )
    # what is measured, planned and written from here on is what a viewer gets
    sent = read_chunks(job.run.chunks, chunks)
    write_set(job.run.prefixes, sent, config.steps, sizes, clarity=clarity[rows])
    size, n = sum(chunk.nbytes for chunk in chunks), len(g)
    lost = _quality(job, ordered) - _quality(job, sent)
    return [
        f"{config.levels} levels, {n:,} Gaussians",
        f"{size / 1e6:.2f} MB in {len(chunks)} SPZ files, {size / n:.1f} bytes a Gaussian; "
        f"encoding costs {lost:.4f} of SSIM",
    ]


def _quality(job: Job, g: Gaussians) -> float:
    """Mean SSIM over some of the training views."""
    found = []
    for row in spread(job.scene.train_ids.tolist(), VIEWS):
        camera = job.scene.views[row].camera
        image = render_rgb(g, camera, backend=job.backend, antialiased=job.antialiased)
        found.append(ssim_map(image, as_unit(job.photos[row])).mean())
    return float(np.mean(found))


def fit_curves(job: Job, table: Observations) -> dict[tuple[int, int], SsimModel]:
    """Eq. 3 of every category at every level, from the training views."""
    parts = split(samples(table, job.scene.train_ids), job.pieces)
    found = [model for part in work_all(job, "fit", _fit_some, parts) for model in part]
    return {(model.label_id, model.level): model for model in found}


def _fit_some(job: Job, part: Sequence[Samples]) -> list[SsimModel]:
    return [fit_model(*found) for found in part]


def fit_viewpoints(
    job: Job, table: Observations, config: FitConfig, curves: Mapping[tuple[int, int], SsimModel]
) -> dict[int, ViewModel]:
    """Promises for every category but the unlabelled pixels, which nobody asks for: they are shipped whole.

    `table`: observations of views that show enough of a category; `curves`: Eq. 3 of them. Levels
    are measured with everything at the same one; what a category gains or loses among neighbours at others
    is measured on compositions planned for the calibration views (some training views where there are none).
    """
    table = table.select(table.label_id != UNLABELLED)
    promises = fit_promises(table, job.scene, config.confidence, curves)
    far, costs = distances(job, config.distance), costs_of(job)
    quality = quality_at(costs, promises, far, [view.camera for view in job.scene.views])
    keys = zip(table.label_id.tolist(), table.level.tolist(), table.view.tolist(), strict=True)
    alone = dict(zip(keys, table.ssim.tolist(), strict=True))
    changes: dict[int, list[float]] = {}
    rows = job.scene.calibration_ids.tolist() or spread(job.scene.train_ids.tolist(), VIEWS)
    planned = []
    for row in rows:
        plans = [plan_for_view(quality, costs, target, row).levels for target in _TARGETS]
        planned.append((row, list({tuple(plan.items()): plan for plan in plans}.values())))
    parts = [(some, config) for some in split(planned, job.pieces)]
    for some in work_all(job, "fit", _measure_compositions, parts):
        for label, level, row, ssim in some:
            key = label, level, row
            if key in alone:
                changes.setdefault(label, []).append(ssim - alone[key])
    return among_neighbours(promises, {label: np.array(change) for label, change in changes.items()})


def _measure_compositions(
    job: Job, part: tuple[Sequence[tuple[int, list[dict[int, int]]]], FitConfig]
) -> list[tuple[int, int, int, float]]:
    """(label id, its level, row, SSIM) of compositions (levels by label id) in some views (rows)."""
    planned, config = part
    name = "ssim_eroded" if config.region == "eroded" else "ssim"
    masks, workspace = label_images(job, config.masks), Workspace()
    rows = []
    for done, (row, compositions) in enumerate(planned, 1):
        view = job.scene.views[row]
        for levels in compositions:
            image = render_rgb(
                job.ladder.compose(levels), view.camera,
                backend=job.backend, antialiased=job.antialiased, workspace=workspace,
            )  # fmt: skip
            found = measure(image, as_unit(job.photos[row]), masks[view])
            rows += [(label, levels.get(label, -1), row, values[name]) for label, values in found.items()]
        job.emit(Progress("fit", done, len(planned)))
    return rows


def costs_of(job: Job) -> Costs:
    """What the levels of the run's nested ladder cost."""
    labels = sorted({label for label, _ in job.ladder.counts})
    levels = len(job.ladder.levels)
    chunks = read_index(job.run.chunks)
    count, sent, gpu = (totals(chunks, labels, levels, name) for name in ("count", "nbytes", "gpu_bytes"))
    return Costs(tuple(labels), count, sent, gpu)


def promised_quality(job: Job) -> tuple[Costs, Quality]:
    """What the levels cost, and what the run's promises say of them in every view of the scene."""
    costs, promises = costs_of(job), read_promises(job.run.promises)
    cameras = [view.camera for view in job.scene.views]
    return costs, quality_at(costs, promises, distances(job, job.fit_config.distance), cameras)


def pixels_of(table: Observations, job: Job, labels: tuple[int, ...], views: np.ndarray) -> np.ndarray:
    """Pixels of each category in each view, float64 [V, L]; 0 for other views and for small shares."""
    table = large_enough(table, job.scene, job.fit_config.min_share)
    table = table.select((table.level == table.level.max(initial=0)) & np.isin(table.view, views))
    pixels = np.zeros((len(job.scene.views), len(labels)))
    for i, label in enumerate(labels):
        mine = table.select(table.label_id == label)
        pixels[mine.view, i] = mine.num_pixels
    return pixels


def eroded(table: Observations, region: str) -> Observations:
    """The table with SSIM as `FitConfig.region` measures it."""
    return replace(table, ssim=table.ssim_eroded) if region == "eroded" else table
