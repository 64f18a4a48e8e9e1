"""Makes the samples of fidelity: every level at drawn viewpoints, measured against the full model."""

from collections.abc import Collection, Sequence
from dataclasses import asdict, replace

import numpy as np

from sagesplat.adapt.calibrate_fidelity import NOMINAL
from sagesplat.adapt.cells import look
from sagesplat.adapt.fidelity import SampledFidelity, measure_levels, write_sampled
from sagesplat.adapt.fidelity_models import fit_fidelity
from sagesplat.adapt.viewpoints import (
    Rule,
    Viewpoints,
    capture_cameras,
    check_rule,
    draw,
    read_cameras,
    write_viewpoints,
)
from sagesplat.core.config import FitConfig, SampleConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Progress
from sagesplat.io.typed import check_limits
from sagesplat.run.executor import split
from sagesplat.run.job import Job
from sagesplat.run.records import settings_of
from sagesplat.run.remote import work_all
from sagesplat.run.stage import run_stage
from sagesplat.scene.scene import Camera
from sagesplat.stages.methods import method_of

VIEWS = (50, 100, 200)  # to fit to: the next number is tried while the last step made the error smaller by
_SHRINKS = 0.05  # at least this share
DEFAULT_COUNTS = {"fit": VIEWS[-1], "bias": 90, "calibration": 170}  # as many as the training's time allows;
MOST = {"fit": VIEWS[-1], "bias": 90, "calibration": 300}  # after a long training up to these, by
_EXTRA = 0.25  # this share of its time: they make bounds a little tighter, no more
_RENDERS = 4.0  # a training step: sampling and fitting take 0.8 of the demo's training, 0.36 with nesting
_SEED = 0  # of the draws
_SOME = 100  # that tell how many pixels viewpoints have
_LABEL_IMAGE = 4  # renders that a viewpoint's label image takes
_FEWEST = {"fit": 20, "bias": 4, "calibration": 20}
# Times as many to calibrate on where there is one category: no others count as some of its own
_ALONE = 1.5


def sample_levels(job: Job, config: SampleConfig, fit: FitConfig) -> None:
    """Draw viewpoints, and measure every level of every category there against the full model.

    Nested levels only. `fit`: the confidence of preliminary models.
    """
    run = job.run
    if run.ladder != "nested":
        return
    rule = Rule(_SEED, shift=config.shift, screens=config.screens, places=config.places, fov=config.fov)
    check_limits(config, "sample.")  # before an earlier result is given up
    check_rule(rule)

    def make() -> list[str]:
        own, given = capture_cameras(job.scene), config.viewpoints
        base = own if given is None else read_cameras(given, own[0], job.scene.offset)
        some = draw(job.scene, base, rule, {"fit": _SOME}).cameras
        counts = _counts(job, config, _pixels(some) / _pixels(own))
        drawn = draw(job.scene, base, rule, counts, given.name if given else "capture")
        table, used = _until_it_stops_shrinking(job, drawn, fit, bool(config.views))
        rows = np.sort(np.concatenate([drawn.rows("fit")[:used], drawn.rows("bias", "calibration")]))
        drawn = replace(
            drawn,
            cameras=tuple(drawn.cameras[row] for row in rows),
            sets=tuple(drawn.sets[row] for row in rows),
        )
        write_viewpoints(run.viewpoints, drawn)
        write_sampled(run.sampled, table)
        calibration = len(drawn.rows("calibration"))
        return [f"{used} viewpoints to fit to, {len(drawn.rows('bias'))} + {calibration} to calibrate on"]

    made_by = [run.provenance("train"), run.provenance("nest")]
    inputs = [*run.scene_files, run.labels, *method_of(job).level_files[:2], *made_by]
    if config.viewpoints:
        inputs.append(config.viewpoints)
    run_stage(job, "sample", asdict(config), inputs, [run.viewpoints, run.sampled], make)


def _counts(job: Job, config: SampleConfig, pixels: float) -> dict[str, int]:
    """Viewpoints by set: what is asked, else what the training's time allows.

    `pixels`: of a viewpoint over those of a photo, on average.
    """
    train, nest = settings_of(job.run, "train"), settings_of(job.run, "nest")
    base_steps = nest["base_steps"] if nest["base_share"] else 0
    renders = _RENDERS * (train["max_steps"] + nest["steps"] + base_steps) / pixels
    compositions = 2 * (len(NOMINAL) + _LABEL_IMAGE)  # measured twice, for the bias three times
    levels = len(job.ladder.levels)
    cost = {"fit": levels + _LABEL_IMAGE, "bias": 1.5 * compositions, "calibration": compositions}
    part = renders / sum(DEFAULT_COUNTS[name] * cost[name] for name in DEFAULT_COUNTS)
    counts = {name: max(int(min(part, 1) * DEFAULT_COUNTS[name]), _FEWEST[name]) for name in DEFAULT_COUNTS}
    left = renders - sum(counts[name] * cost[name] for name in counts)
    left *= _EXTRA if part > 1 else 1
    for name in counts:
        more = int(np.clip(left // cost[name], 0, MOST[name] - counts[name]))
        counts[name], left = counts[name] + more, left - more * cost[name]
    if len(np.unique(job.cells.labels)) == 1:
        counts["calibration"] = min(int(_ALONE * counts["calibration"]), MOST["calibration"])
    counts["fit"] = config.views or counts["fit"]
    counts["calibration"] = config.calibration_views or counts["calibration"]
    return counts


def _pixels(cameras: Sequence[Camera]) -> float:
    return float(np.mean([camera.width * camera.height for camera in cameras]))


def _until_it_stops_shrinking(
    job: Job, drawn: Viewpoints, fit: FitConfig, all_of_them: bool
) -> tuple[SampledFidelity, int]:
    """Measure viewpoints to fit to in growing numbers, as long as that makes the models' error smaller."""
    cameras = [drawn.cameras[row] for row in drawn.rows("fit")]
    stops = [len(cameras)] if all_of_them else [n for n in VIEWS if n < len(cameras)] + [len(cameras)]
    table, errors = None, []
    for stop in stops:
        start = 0 if table is None else len(table.fidelity)
        more = measured_levels(job, cameras[start:stop])
        table = more if table is None else _joined(table, more)
        if stop == stops[-1]:
            break
        models = fit_fidelity(
            table, job.cells, cameras[:stop], job.scene.scale, fit.confidence, drawn.focal,
            drawn.rule.screens, capture_cameras(job.scene),
        )  # fmt: skip
        errors.append(float(np.mean([model.rmse for model in models.values()])))
        if len(errors) > 1 and errors[-1] > (1 - _SHRINKS) * errors[-2]:
            break
    assert table is not None
    if not (table.pixels > 0).any():
        raise RunError(
            f"{job.run.path}: none of {len(table.pixels)} viewpoints shows anything of the scene; draw them "
            "closer to its cameras (--sample.shift, --sample.places 1 0 0), or leave out --sample.viewpoints"
        )
    return table, len(table.fidelity)


def measured_levels(
    job: Job, cameras: Sequence[Camera], only: Collection[int] | None = None
) -> SampledFidelity:
    """Fidelity of the cells' levels at some viewpoints, divided among those who compute.

    `only`: ids of the cells that are measured; the others, and the whole image, are NaN. None: all.
    """
    parts = [(list(part), only) for part in split(cameras, job.pieces)]
    found = work_all(job, "sample", _measure_some, parts)
    fidelity, pixels, whole = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    distance = look(job.cells, cameras).distance.astype(np.float32)
    image = np.array([camera.width * camera.height for camera in cameras], np.int32)
    return SampledFidelity(tuple(job.cells.ids.tolist()), fidelity, pixels, image, whole, distance)


def _measure_some(
    job: Job, part: tuple[Sequence[Camera], Collection[int] | None]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    cameras, only = part
    return measure_levels(
        job.by_cell, cameras, only=only, full=job.came_in, backend=job.backend, antialiased=job.antialiased,
        progress=lambda done, total: job.emit(Progress("sample", done, total)),
    )  # fmt: skip


def _joined(table: SampledFidelity, more: SampledFidelity) -> SampledFidelity:
    """The rows of one after those of the other."""
    names = ("fidelity", "pixels", "image", "whole", "distance")
    return replace(table, **{n: np.concatenate([getattr(table, n), getattr(more, n)]) for n in names})
