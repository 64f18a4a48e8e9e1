"""Makes the levels of an adopted splat: merged or trained lower ones, and prefixes of what came in."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch

from sagesplat.adapt.cells import describe_cells, write_cells
from sagesplat.adapt.ladder import NestedLadder, read_prefixes
from sagesplat.adapt.observe import as_unit, render_rgb
from sagesplat.adapt.renders import Renders
from sagesplat.core.config import AdoptConfig, NestConfig
from sagesplat.core.events import Progress, Warned
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.increments import full_scene, palettes_of, read_increments
from sagesplat.formats.levels import write_set
from sagesplat.formats.stream_header import AS_GIVEN, Precision, rounded
from sagesplat.formats.stream_increments import Streams, write_streams
from sagesplat.metrics.image import ssim_map
from sagesplat.raster import Workspace, device_of, each_view
from sagesplat.run.job import Job
from sagesplat.run.records import checkpoint_key
from sagesplat.run.stage import run_stage
from sagesplat.scene.images import Photos
from sagesplat.stages.memory import check_nest
from sagesplat.stages.shared import label_image_inputs, train_config
from sagesplat.train import nested
from sagesplat.train.cells import cells_wanted
from sagesplat.train.checkpoint import remove_checkpoints
from sagesplat.train.early_stopping import spread
from sagesplat.train.importance import importance
from sagesplat.train.lower_levels import (
    Assembled,
    Counts,
    Rung,
    Set,
    assemble,
    counts_of_first,
    first_of_all,
    in_cells,
    joined,
    merged_rungs,
    size_of,
    split_sets,
    trained_sets,
    usable_shares,
    whole,
)
from sagesplat.train.memory import photo_cache
from sagesplat.train.nested import Nested, NestStep
from sagesplat.train.refit import fit_to_renders, refit_coverage

_WEIGH = 32  # views that importance is measured in
_REFIT = 24  # views that merged sets are fitted to, and trained ones are ordered by
_TRAINED = 0.5  # largest share that is trained; larger ones are seldom closer merged
_SMALL = 0.1  # share up to which the fit takes more and larger steps: little is left as it was
KEPT = 0.999  # SSIM of the last level to what came in, from which it looks the same
_COMPARE = 8  # views that merged Gaussians and prefixes of the originals are compared in


def make_levels(job: Job, config: AdoptConfig) -> None:
    """Make the ladder of an adopted splat, and its increments."""
    run = job.run
    count = sum(job.last_level.counts.values())
    shares = usable_shares(config.shares, count)
    steps = config.steps if config.fit == "renders" else 0
    made_as = NestConfig(steps=steps, levels=len(shares), base_share=0, cells=config.cells, rate_weight=0.0)
    settings = asdict(made_as)
    settings |= {"fit": config.fit, "shares": shares, "lossless": config.lossless, "seed": config.seed}
    settings |= {"increments": "streams"}  # once they were SPZ files
    inputs = [run.scene, run.labels, run.levels, run.provenance("train"), *label_image_inputs(run)]

    def make() -> list[str]:
        if config.fit == "renders":
            check_nest(job, count, job.last_level.sh_degree)
        rows, space, g = spread(job.scene.train_ids.tolist(), _COMPARE), Workspace(), job.load_last_level()
        came_in = [(row, _image(job, g, row, space)) for row in rows]
        precision = None if config.lossless else _precision(job, g, came_in)
        del g, space  # of millions of Gaussians; so is what follows
        ladder, num_lower = _ladder(job, shares, config, checkpoint_key(run, settings, inputs), came_in)
        ladder, label_of = in_cells(ladder, cells_wanted(count, config.cells))
        made, replaces = _streams(job, ladder, label_of, precision), ladder.replaces
        del ladder  # what is read back takes as much
        lines = _prefixes(job, made, replaces, label_of, num_lower, came_in, settings)
        remove_checkpoints(run.nest_checkpoint)
        return lines

    run_stage(job, "nest", settings, inputs, [run.prefixes, run.cells, run.increments], make, swaps=True)


def _ladder(
    job: Job,
    shares: Sequence[float],
    config: AdoptConfig,
    key: str,
    came_in: Sequence[tuple[int, np.ndarray]],
) -> tuple[Assembled, int]:
    """All levels, and how many of them are not prefixes of the originals."""
    g, views = job.load_last_level(), spread(job.scene.train_ids.tolist(), _WEIGH)
    weights = importance(g, job.scene, views, "weight", antialiased=job.antialiased)
    order = importance(g, job.scene, views, "sensitivity", antialiased=job.antialiased)
    ordered = g.select(_best_order(job, g, (order, weights), shares, came_in))
    rungs = merged_rungs(g, weights, shares[:-1])
    del g
    targets = Renders(ordered, job.scene.views, job.backend, job.antialiased, photo_cache(job.memory_limit))
    sets = _lower_levels(job, targets, ordered, rungs, views, config, key)
    del rungs
    num_lower = sum(len(one.levels) for one in sets)
    least: Counts = sets[-1].levels[-1] if sets else {}
    levels = list[Counts]()
    for share in shares[num_lower:]:
        least = counts_of_first(ordered, share, least)
        levels.append(least)
    return assemble([*sets, Set(ordered, tuple(levels))]), num_lower


def _best_order(
    job: Job,
    g: Gaussians,
    importances: Sequence[np.ndarray],
    shares: Sequence[float],
    came_in: Sequence[tuple[int, np.ndarray]],
) -> torch.Tensor:
    """Rows by the importance whose largest level but the last is closest to what came in.

    Sensitivity is to first order: where many Gaussians overlap none of them is sensitive, and together they
    leave holes. Where there are many faint ones it is ahead of the blending weight.
    """
    orders = [torch.from_numpy(np.argsort(-one, kind="stable")) for one in importances]
    if len(shares) == 1:
        return orders[0]
    most = size_of(shares[-2], len(g))
    return max(orders, key=lambda rows: _ssim(job, g.select(rows[:most]), dict(came_in)))


def _lower_levels(
    job: Job,
    targets: Photos,
    ordered: Gaussians,
    rungs: list[Rung],
    views: Sequence[int],
    config: AdoptConfig,
    key: str,
) -> list[Set]:
    """The levels that are not prefixes of the originals, ascending.

    Trained ones start from whichever is closer to the originals: merged Gaussians, or as many of the most
    important ones. Of the larger ones, those that are closer merged stay merged.
    """
    rows = spread(job.scene.train_ids.tolist(), _COMPARE)
    compared = {row: as_unit(targets[row]) for row in rows}

    def pruned(number: int) -> Gaussians:
        least = rungs[number - 1].gaussians.counts() if number else {}
        return first_of_all(ordered, rungs[number].share, least)

    def closer_merged(number: int) -> bool:
        return _ssim(job, rungs[number].gaussians, compared) > _ssim(job, pruned(number), compared)

    likely = sum(rung.share <= _TRAINED for rung in rungs)
    rungs[:likely] = [_covering(job, rung, views) for rung in rungs[:likely]]
    merges = likely
    while merges and not closer_merged(merges - 1):
        merges -= 1
    while likely <= merges < len(rungs):
        rungs[merges] = _covering(job, rungs[merges], views)
        if not closer_merged(merges):
            break
        merges += 1
    small = rungs[:likely] if config.fit == "renders" else []
    starts = {
        rung.share: rung.gaussians if number < merges else pruned(number) for number, rung in enumerate(small)
    }
    sets = _trained(job, targets, starts, config, key) if starts else []
    return sets + [whole(g) for g in _fitted(job, targets, rungs[len(small) : merges])]


def _covering(job: Job, rung: Rung, views: Sequence[int]) -> Rung:
    covering = refit_coverage(rung.gaussians, rung.stands_for, job.scene, views, antialiased=job.antialiased)
    return replace(rung, gaussians=covering)


def _fitted(job: Job, targets: Photos, rungs: Sequence[Rung]) -> list[Gaussians]:
    """The rungs fitted to renders of the originals, side by side: threads gain little within a step."""
    rows, device = spread(job.scene.train_ids.tolist(), _REFIT), device_of(job.backend)
    cameras = [job.scene.views[row].camera for row in rows]
    images = [torch.from_numpy(as_unit(targets[row])).to(device) for row in rows]

    def fit(rung: Rung | None) -> list[Gaussians]:
        if rung is None:
            return []
        passes, rate = (5, 2.0) if rung.share <= _SMALL else (3, 1.0)
        fitted = fit_to_renders(
            rung.gaussians.to(device), cameras, images, passes, rate, antialiased=job.antialiased,
            backend=job.backend,
        )  # fmt: skip
        return [fitted.to("cpu")]

    # the first item would have all threads, which takes longer than with one; large ones take longest
    return [g for found in each_view(fit, [None, *rungs[::-1]], device) for g in found][::-1]


def _trained(
    job: Job, targets: Photos, starts: Mapping[float, Gaussians], config: AdoptConfig, key: str
) -> list[Set]:
    """Levels trained on renders of the originals, those of similar size as prefixes of one set.

    `starts`: Gaussians to start from, by share.
    """
    sets, views = list[Set](), spread(job.scene.train_ids.tolist(), _REFIT)
    for shares in trained_sets(list(starts)):
        top = starts[shares[-1]]
        most = top.counts()
        sizes = [starts[share].counts() for share in shares]
        sets.append(Set(top, tuple({i: min(n, most[i]) for i, n in size.items()} for size in sizes)))
    ranks = [
        importance(one.gaussians, job.scene, views, "sensitivity", antialiased=job.antialiased)
        for one in sets
    ]
    trained, spans = joined(sets, ranks)
    settings = NestConfig(steps=config.steps, rate_weight=0.0)
    for event in nested.nest(
        trained, job.scene, targets, train_config(job), settings, seed=config.seed,
        backend=job.backend, checkpoint=job.run.nest_checkpoint, settings=key, spans=spans,
    ):  # fmt: skip
        if isinstance(event, NestStep):
            job.emit(Progress("nest", event.step, config.steps, f"loss {event.loss:.3f}"))
        elif isinstance(event, Nested):
            trained = event
    return split_sets(trained.gaussians, sets)


def _streams(
    job: Job, ladder: Assembled, label_of: Mapping[int, int], precision: Precision | None
) -> Streams:
    """Write the increments of a ladder.

    Levels of the originals have a precision, or are exact (None). Those below are rounded as trained levels
    are.
    """
    job.run.provenance("nest").unlink(missing_ok=True)  # from here on the earlier ladder is gone
    return write_streams(
        job.run.increments, ladder.gaussians, ladder.sizes, job.names(), label_of=label_of,
        replaces=ladder.replaces, last=precision, antialiased=job.antialiased,
    )  # fmt: skip


def _prefixes(
    job: Job,
    made: Streams,
    replaces: Mapping[int, tuple[int, ...]],
    label_of: Mapping[int, int],
    num_lower: int,
    came_in: Sequence[tuple[int, np.ndarray]],
    settings: dict[str, Any],
) -> list[str]:
    """Write the ladder as its increments show it; `num_lower` of the levels are not of the originals.

    `came_in`: images of what came in, by view.
    """
    run, levels, lossless = job.run, len(next(iter(made.sizes.values()))), settings["lossless"]
    sent = read_increments(run.increments, made.increments)
    write_set(run.prefixes, sent, settings["steps"], made.sizes, replaces=replaces, exact=True)
    top = NestedLadder(read_prefixes(run.prefixes), dict(label_of)).load(levels)
    ssim, decibels = _kept(job, top, came_in)
    if not lossless and (other := sum(one.format != "stream" for one in made.increments)):
        job.emit(Warned(f"{other} files are PLY: some of their Gaussians lie too far off to be rounded"))
    write_cells(run.cells, describe_cells(sent, dict(label_of)))
    palettes = sum(palettes_of(made.increments).values())
    everything = sum(one.nbytes for one in made.increments) + palettes
    shown = sum(one.nbytes for one in full_scene(made.increments)) + palettes
    if ssim < KEPT and not lossless:
        job.emit(
            Warned(f"rounding costs {1 - ssim:.4f} of SSIM; --lossless keeps the last level as it came in")
        )
    loss = f"SSIM {ssim:.5f}, PSNR {decibels:.1f} dB to what came in"
    loss = "as it came in" if np.isinf(decibels) else loss
    return [
        f"{levels} levels, {num_lower} of them of merged Gaussians; the last one takes {shown / 1e6:.2f} MB, "
        f"all together {everything / 1e6:.2f} MB, since merged levels are replaced",
        f"{len(sent):,} Gaussians, {len(top):,} of them at the last level: {loss}",
    ]


def _precision(job: Job, g: Gaussians, targets: Sequence[tuple[int, np.ndarray]]) -> Precision:
    """The coarsest steps that Gaussians as they came in look the same in, else the finest."""
    for precision in AS_GIVEN[:-1]:
        if _kept(job, rounded(g, precision), targets[::2])[0] >= KEPT:
            return precision
    return AS_GIVEN[-1]


def _kept(job: Job, top: Gaussians, targets: Sequence[tuple[int, np.ndarray]]) -> tuple[float, float]:
    """Mean SSIM and PSNR in dB of the last level to images of what came in, by view; infinite if the same."""
    space = Workspace()
    images = [(_image(job, top, row, space), image) for row, image in targets]
    error = float(np.mean([np.square(one - other).mean() for one, other in images]))
    ssim = float(np.mean([ssim_map(one, other).mean() for one, other in images]))
    return ssim, -10 * float(np.log10(error)) if error else float("inf")


def _ssim(job: Job, g: Gaussians, targets: Mapping[int, np.ndarray]) -> float:
    """Mean SSIM to images by view."""
    space = Workspace()

    def in_view(row: int) -> float:
        return float(ssim_map(_image(job, g, row, space), targets[row]).mean())

    return float(np.mean(list(each_view(in_view, list(targets), device_of(job.backend)))))


def _image(job: Job, g: Gaussians, row: int, space: Workspace) -> np.ndarray:
    camera = job.scene.views[row].camera
    return render_rgb(g, camera, backend=job.backend, antialiased=job.antialiased, workspace=space)
