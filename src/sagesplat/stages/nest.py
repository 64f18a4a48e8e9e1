"""Makes the nested levels and their increments, from the trained Gaussians: orders them, trains prefixes."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace

import numpy as np
from jaxtyping import Bool, Float

from sagesplat.adapt.cells import describe_cells, write_cells
from sagesplat.adapt.observe import as_unit, measure_total, render_rgb
from sagesplat.core.config import NestConfig
from sagesplat.core.events import Progress, Warned
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.formats.levels import read_header, read_level, write_set
from sagesplat.formats.stream_increments import read_streams, write_streams
from sagesplat.io.typed import check_limits
from sagesplat.run.job import Job
from sagesplat.run.records import checkpoint_key
from sagesplat.run.stage import run_stage
from sagesplat.stages.memory import check_nest
from sagesplat.stages.shared import existing, inlier_inputs, label_image_inputs, train_config
from sagesplat.train import nested
from sagesplat.train.base_model import merged_start
from sagesplat.train.cells import cells_wanted
from sagesplat.train.checkpoint import can_resume, remove_checkpoints
from sagesplat.train.early_stopping import VIEWS, spread
from sagesplat.train.events import Resumed, Step, Trained
from sagesplat.train.nested import NestStep

_ROUNDED = 0.01  # SSIM that rounding may cost without a word


def nest_levels(
    job: Job,
    config: NestConfig,
    seed: int,
    inside: Callable[[Float[np.ndarray, "N 3"]], Bool[np.ndarray, " N"]] | None = None,
) -> None:
    """Order the trained Gaussians and train their prefixes; write the ladder and its chunks.

    `inside` says by their positions which Gaussians of a block's decide its cells; None: all.
    """
    run = job.run
    check_limits(config, "nest.")
    settings = {**asdict(config), "seed": seed}

    def make() -> list[str]:
        count = sum(read_header(job.trained).counts.values())
        check_nest(job, count, train_config(job).sh_degree)
        full = read_level(job.trained)
        base = read_level(run.base_model) if config.base_share else None
        masks, sky = job.level_masks, job.sky
        shell = sky.shell if sky else None
        ordered = nested.order(
            full, job.scene, masks,
            base=base, valid=job.inliers, antialiased=job.antialiased, shell=shell,
        )  # fmt: skip
        wanted = cells_wanted(len(ordered.gaussians), config.cells)
        within = None if inside is None else inside(ordered.gaussians.means.numpy())
        ordered, label_of = nested.in_cells(ordered, wanted, within)
        key = checkpoint_key(run, settings, inputs)
        if job.force and not can_resume(run.nest_checkpoint, key):
            remove_checkpoints(run.nest_checkpoint)
        trained = ordered
        for event in nested.nest(
            ordered, job.scene, job.photos, train_config(job), config,
            valid=job.inliers, seed=seed, backend=job.backend, checkpoint=run.nest_checkpoint, settings=key,
            shell=shell, label_of=label_of,
        ):  # fmt: skip
            if isinstance(event, NestStep):
                job.emit(Progress("nest", event.step, config.steps, f"loss {event.loss:.3f}"))
            elif isinstance(event, Resumed):
                before = f"the checkpoint before the newest: {event.damage}"
                job.emit(Warned(f"resuming from step {event.step}, {before}"))
            else:
                trained = event
        sizes = {cell: nested.level_sizes(n, config) for cell, n in trained.gaussians.counts().items()}
        second = trained.second_opacities
        second = None if second is None else SecondOpacities.of_levels(second, sizes)
        lines = write_ladder(job, trained.gaussians, sizes, label_of, config, second)
        remove_checkpoints(run.nest_checkpoint)
        return lines

    made = [run.provenance("train"), *label_image_inputs(run), *existing(run.sky, run.cleaned)]
    inputs = [*run.scene_files, run.labels, run.levels, *made]
    if config.base_share:
        _make_base_model(job, config, seed)
        inputs.append(run.base_model)
    run_stage(job, "nest", settings, inputs, [run.prefixes, run.cells, run.increments], make, swaps=True)


def _make_base_model(job: Job, config: NestConfig, seed: int) -> None:
    """Train the small model that the ladder begins with: a stage, so that a killed run has it already."""
    run, made = job.run, train_config(job)
    full = job.recorded.size(job.last_level.step)  # with floaters: the size is that of what is trained
    cap = max(1, round(config.base_share * full))
    settings = {**asdict(nested.capped_config(made, cap, config.base_steps)), "seed": seed, "start": "merged"}

    inputs = [*run.scene_files, run.labels, run.levels, *inlier_inputs(run), *existing(run.cleaned, run.sky)]

    def make() -> list[str]:
        views = job.inliers.rows(job.scene, job.scene.train_ids)
        start = merged_start(
            read_level(job.trained), job.scene, views, cap,
            antialiased=job.antialiased, shell=job.sky.shell if job.sky else None,
        )  # fmt: skip
        g = train_capped(job, "base", cap, config.base_steps, seed, start)
        write_set(run.base_model, g, config.base_steps)
        return [f"{len(g):,} Gaussians"]

    run_stage(job, "base", settings, inputs, [run.base_model], make)


def train_capped(
    job: Job, stage: str, cap: int, steps: int, seed: int, start: Gaussians | None = None
) -> Gaussians:
    """3DGS-MCMC of at most `cap` Gaussians, otherwise trained as the run; progress goes to `stage`.

    It begins with the Gaussians `start`; None: with the SfM points.
    """
    for event in nested.train_capped(
        job.scene, job.photos, job.initial_labels, train_config(job), cap, steps,
        valid=job.inliers, seed=seed, backend=job.backend, sky=job.sky, start=start,
    ):  # fmt: skip
        if isinstance(event, Step):
            text = f"loss {event.loss:.3f}, {event.num_gaussians:,} Gaussians"
            job.emit(Progress(stage, event.step, steps, text))
        elif isinstance(event, Trained):
            return event.gaussians
    raise AssertionError("a training ends with what it trained")


def write_ladder(
    job: Job,
    g: Gaussians,
    sizes: dict[int, tuple[int, ...]],
    label_of: Mapping[int, int],
    config: NestConfig,
    second: SecondOpacities | None = None,
) -> list[str]:
    """Write Gaussians in their order, with levels of `sizes` by cell id, as the run's ladder and increments.

    `second` is kept beside them. Gaussians that are hardly to be seen are left out. Returns lines that sum
    it up.
    """
    job.run.provenance("nest").unlink(missing_ok=True)  # from here on the earlier ladder is gone
    made = write_streams(
        job.run.increments, g, sizes, job.names(), label_of=label_of, second=second,
        antialiased=job.antialiased,
    )  # fmt: skip
    # what is measured, planned and written from here on is what a viewer gets
    sent, seconds = read_streams(job.run.increments, made.increments)
    write_set(job.run.prefixes, sent, config.steps, made.sizes, second=seconds)
    write_cells(job.run.cells, describe_cells(sent, {cell: label_of[cell] for cell in made.sizes}))
    size, n = sum(one.nbytes for one in made.increments), len(sent)
    decoded, unrounded = _quality(job, sent, seconds), _quality(job, g, second)
    if unrounded - decoded > _ROUNDED:
        job.emit(
            Warned(
                f"rounding the levels costs {unrounded - decoded:.3f} of SSIM; Gaussians that lie far off "
                "make the steps of positions large"
            )
        )
    return [
        f"{config.levels} levels of {len(made.sizes)} cells, {len(g):,} Gaussians",
        f"{n:,} of them to be seen, in coded streams of {size / 1e6:.2f} MB, "
        f"{size / n:.1f} bytes a Gaussian; "
        f"training views: SSIM {decoded:.4f} as decoded, {unrounded:.4f} before rounding",
    ]


def _quality(job: Job, g: Gaussians, second: SecondOpacities | None) -> float:
    """Mean SSIM of the full model over some of the training views."""
    g = g if second is None else replace(g, logit_opacities=second.logits)
    found = []
    for row in spread(job.valid.rows(job.scene, job.scene.train_ids), VIEWS):
        view = job.scene.views[row]
        image = render_rgb(g, view.camera, backend=job.backend, antialiased=job.antialiased)
        found.append(measure_total(image, as_unit(job.photos[row]), job.valid[view])["ssim"])
    return float(np.mean(found))
