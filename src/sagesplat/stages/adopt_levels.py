"""Makes the levels of an adopted splat: merged or trained lower ones, and prefixes of what came in."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch

from sagesplat.adapt.ladder import read_prefixes
from sagesplat.adapt.observe import as_unit, render_rgb
from sagesplat.core.config import AdoptConfig, NestConfig
from sagesplat.core.events import Progress
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.increments import packed, read_increments, write_increments
from sagesplat.formats.levels import write_set
from sagesplat.metrics.image import ssim_map
from sagesplat.run.job import Job
from sagesplat.run.records import checkpoint_key
from sagesplat.run.stage import run_stage
from sagesplat.stages.shared import label_image_inputs, train_config
from sagesplat.train import nested
from sagesplat.train.checkpoint import remove_checkpoints
from sagesplat.train.early_stopping import spread
from sagesplat.train.importance import importance
from sagesplat.train.lower_levels import (
    Assembled,
    Rung,
    assemble,
    by_label,
    joined,
    merged_rungs,
    size_of,
    split_sets,
    trained_sets,
    usable_shares,
)
from sagesplat.train.nested import Nested, NestStep
from sagesplat.train.refit import refit_colors, refit_coverage

_WEIGH = 32  # views that importance is measured in
_REFIT = 24  # views that merged Gaussians are fitted to
_COMPARE = 8  # views that merged Gaussians and prefixes of the originals are compared in


def make_levels(job: Job, config: AdoptConfig) -> None:
    """Make the ladder of an adopted splat, and its increments."""
    run = job.run
    g = job.snapshots.load(job.snapshots.levels[-1])
    shares = usable_shares(config.shares, len(g))
    steps = config.steps if config.fit == "renders" else 0
    settings = asdict(NestConfig(steps=steps, levels=len(shares), base_share=0))
    settings |= {"fit": config.fit, "shares": shares, "lossless": config.lossless, "seed": config.seed}
    inputs = [run.scene, run.labels, run.levels, run.provenance("train"), *label_image_inputs(run)]

    def make() -> list[str]:
        views = spread(job.scene.train_ids.tolist(), _WEIGH)
        weights = importance(g, job.scene, views, "weight", antialiased=job.antialiased)
        order = importance(g, job.scene, views, "sensitivity", antialiased=job.antialiased)
        ordered = g.select(torch.from_numpy(np.argsort(-order, kind="stable")))
        rungs = merged_rungs(g, weights, [share for share in shares if share < 1])
        rungs = [replace(rung, gaussians=_covering(job, rung, views)) for rung in rungs]
        rungs = rungs[: _merges_until(job, rungs, ordered, g.counts())]
        if config.fit == "renders":
            key = checkpoint_key(run, settings, inputs)
            sets = _trained(job, rungs, g.counts(), config, key)
        else:
            sets = [(_colored(job, rung.gaussians), (rung.share,)) for rung in rungs]
        used = {share for _, levels in sets for share in levels}
        ladder = assemble(sets, ordered, [share for share in shares if share not in used])
        lines = _write(job, ladder, len(used), g, settings, config.lossless)
        remove_checkpoints(run.nest_checkpoint)
        return lines

    run_stage(job, "nest", settings, inputs, [run.prefixes, run.increments], make, swaps=True)


def _covering(job: Job, rung: Rung, views: Sequence[int]) -> Gaussians:
    few = spread(list(views), _REFIT)
    share = len(few) / len(views)
    return refit_coverage(
        rung.gaussians, rung.stands_for * share, job.scene, few, antialiased=job.antialiased
    )


def _colored(job: Job, g: Gaussians) -> Gaussians:
    rows = spread(job.scene.train_ids.tolist(), _REFIT)
    cameras = [job.scene.views[row].camera for row in rows]
    images = [torch.from_numpy(as_unit(job.photos[row])) for row in rows]
    return refit_colors(g, cameras, images, antialiased=job.antialiased, backend=job.backend)


def _merges_until(job: Job, rungs: Sequence[Rung], ordered: Gaussians, counts: Mapping[int, int]) -> int:
    """How many of the rungs are better than as many of the originals, by SSIM; the larger ones are not."""
    rows = spread(job.scene.train_ids.tolist(), _COMPARE)
    for number in range(len(rungs), 0, -1):
        rung = rungs[number - 1]
        prefix = [mine[: size_of(rung.share, counts[label])] for label, mine in by_label(ordered).items()]
        originals = ordered.select(torch.from_numpy(np.sort(np.concatenate(prefix))))
        if _ssim(job, rung.gaussians, rows) > _ssim(job, originals, rows):
            return number
    return 0


def _trained(
    job: Job, rungs: Sequence[Rung], counts: Mapping[int, int], config: AdoptConfig, key: str
) -> list[tuple[Gaussians, tuple[float, ...]]]:
    """The rungs trained on renders of the originals: levels of similar size as prefixes of one set."""
    sets = trained_sets([rung.share for rung in rungs])
    tops = [rung for rung in rungs for levels in sets if rung.share == levels[-1]]
    views = spread(job.scene.train_ids.tolist(), _REFIT)
    ranks = [
        importance(rung.gaussians, job.scene, views, "sensitivity", antialiased=job.antialiased)
        for rung in tops
    ]
    start, spans = joined(tops, ranks, sets, counts)
    nest = NestConfig(steps=config.steps)
    trained = start
    for event in nested.nest(
        start, job.scene, job.photos, train_config(job), nest, seed=config.seed, backend=job.backend,
        checkpoint=job.run.nest_checkpoint, settings=key, spans=spans,
    ):  # fmt: skip
        if isinstance(event, NestStep):
            job.emit(Progress("nest", event.step, config.steps, f"loss {event.loss:.3f}"))
        elif isinstance(event, Nested):
            trained = event
    return split_sets(trained.gaussians, tops, sets)


def _write(
    job: Job, ladder: Assembled, num_lower: int, before: Gaussians, settings: dict[str, Any], lossless: bool
) -> list[str]:
    """Write the ladder and its increments; the levels above `num_lower` are of the originals."""
    run, levels = job.run, len(next(iter(ladder.sizes.values())))
    run.provenance("nest").unlink(missing_ok=True)  # from here on the earlier ladder is gone
    bits = tuple(settings["sh_bits"])
    g = ladder.gaussians.select(torch.from_numpy(packed(ladder.gaussians, ladder.sizes, sh_bits=bits)))
    chunks = write_increments(
        run.increments, g, ladder.sizes, job.names(), replaces=ladder.replaces, sh_bits=bits,
        kind=lambda _, level: "ply" if lossless and level > num_lower else "spz",
        fine=range(num_lower + 1, levels + 1), antialiased=job.antialiased,
    )  # fmt: skip
    sent = read_increments(run.increments, chunks)
    ones = np.ones(len(sent), np.float32)  # no Gaussian is told to lie on a border
    write_set(
        run.prefixes, sent, settings["steps"], ladder.sizes, replaces=ladder.replaces, exact=True, purity=ones
    )
    size, total = sum(chunk.nbytes for chunk in chunks), len(sent)
    top = read_prefixes(run.prefixes).load(levels)
    return [
        f"{levels} levels, {num_lower} of them of merged Gaussians; "
        f"{size / 1e6:.2f} MB in {len(chunks)} files",
        f"{total:,} Gaussians, {len(before):,} of them at the last level: {_loss(job, top, before)}",
    ]


def _loss(job: Job, top: Gaussians, before: Gaussians) -> str:
    """How far the last level is from what came in, for people."""
    errors = []
    for row in spread(job.scene.train_ids.tolist(), _COMPARE):
        one, other = (_image(job, g, row) for g in (top, before))
        errors.append(float(np.square(one - other).mean()))
    error = float(np.mean(errors))
    return "as it came in" if error == 0 else f"PSNR {-10 * np.log10(error):.1f} dB against what came in"


def _ssim(job: Job, g: Gaussians, rows: Sequence[int]) -> float:
    return float(np.mean([ssim_map(_image(job, g, row), as_unit(job.photos[row])).mean() for row in rows]))


def _image(job: Job, g: Gaussians, row: int) -> np.ndarray:
    camera = job.scene.views[row].camera
    return render_rgb(g, camera, backend=job.backend, antialiased=job.antialiased)
