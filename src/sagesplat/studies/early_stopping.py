"""Categories stopped during training (Fig. 1) beside snapshots of a full run composed afterwards."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sagesplat.adapt.ladder import Ladder
from sagesplat.adapt.observe import TOTAL, Observations, as_unit, measure, near_border, render_rgb
from sagesplat.core.errors import RunError
from sagesplat.core.gaussians import Gaussians
from sagesplat.metrics.image import psnr, squared_error_map
from sagesplat.output.table import Table
from sagesplat.output.tables import by_size, mean, name_of
from sagesplat.raster import Workspace
from sagesplat.run.capture import read_capture
from sagesplat.run.job import Job
from sagesplat.run.records import seconds_of, settings_of
from sagesplat.segment.display_names import titles
from sagesplat.stages.results import observations_of
from sagesplat.stages.train import read_frozen
from sagesplat.train.early_stopping import measured_views

BAND = 10  # px around the borders of categories
_FREE = {"freeze_at"}  # settings that may differ between the two runs


def compare_early_stopping(stopped: Job, full: Job, out: Path) -> tuple[Table, Table]:
    """A run with --train.freeze-at against the same run without: by method, and by category.

    From the full run each category takes the first level that has reached the target by the same measurement
    that stops it during training. Both, and the full run, are measured on the test views. Writes
    `out`/early_stopping.* and early_stopping_categories.*; RunError where the runs differ in more than that.
    """
    target = check_runs(stopped, full)
    if not full.run.observations.exists():
        raise RunError(f"{full.run.observations}: missing; run `sagesplat observe {full.run.path}`")
    stops = read_frozen(stopped.run.frozen)
    ladder = full.ladder
    views = measured_views(full.scene, full.masks)
    reached = first_levels(ladder, observations_of(full), views, target)
    sets = {
        "early stopping": stopped.ladder.load(stopped.ladder.levels[-1]),
        "composed": ladder.compose(reached),
        "full run": ladder.load(ladder.levels[-1]),
    }
    seconds = {job: seconds_of(job.run, "train") for job in (stopped, full)}
    times = {"early stopping": seconds[stopped], "composed": seconds[full], "full run": seconds[full]}
    measured = {name: _measure(full, g) for name, g in sets.items()}
    labels = by_size(ladder.counts)
    methods = Table(
        f"Stopped in training or composed afterwards, SSIM {target:g}: test views",
        ("method", "Gaussians", "SSIM", "PSNR", "at borders", "inside", "training s"),
        ("", ",d", ".3f", ".2f", ".2f", ".2f", ".1f"),
        [
            (name, len(g), *(measured[name][key] for key in ("ssim", "psnr", "band", "inside")), times[name])
            for name, g in sets.items()
        ],
        notes=(f"Borders: PSNR within {BAND} px of another category; inside: elsewhere.",),
    )
    counts = {name: g.counts() for name, g in sets.items()}
    body = []
    for label in labels:
        cells: list[str | int | float] = [name_of(label, titles(full.names()))]
        for name, steps in (("early stopping", stops), ("composed", reached), ("full run", {})):
            if name != "full run":
                last = (stopped if name == "early stopping" else full).ladder.levels[-1]
                cells.append(steps.get(label, last))
            cells += [counts[name].get(label, 0), measured[name].get(label, np.nan)]
        body.append(tuple(cells))
    categories = Table(
        "By category",
        ("category", "stops at", "Gaussians", "SSIM", "level", "Gaussians", "SSIM", "Gaussians", "SSIM"),
        ("", ",d", ",d", ".3f", ",d", ",d", ".3f", ",d", ".3f"),
        body,
        groups=(("early stopping", 3), ("composed", 3), ("full run", 2)),
    )
    methods.write(out / "early_stopping")
    categories.write(out / "early_stopping_categories")
    return methods, categories


def first_levels(
    ladder: Ladder, observations: Observations, views: Mapping[int, list[int]], target: float
) -> dict[int, int]:
    """Per category the first level whose mean SSIM over its views has reached the target, else the last."""
    chosen = {}
    for label in sorted({label for label, _ in ladder.counts}):
        chosen[label] = ladder.levels[-1]
        mine = (observations.label_id == label) & np.isin(observations.view, views.get(label, []))
        for level in ladder.levels:
            if mean(observations.ssim[mine & (observations.level == level)]) >= target:
                chosen[label] = level
                break
    return chosen


def check_runs(stopped: Job, full: Job) -> float:
    """The target of the stopped run; RunError where the two runs cannot be compared."""
    made, other = (settings_of(job.run, "train") for job in (stopped, full))
    target = made.get("freeze_at")
    if target is None or other.get("freeze_at") is not None:
        raise RunError(
            f"{stopped.run.path}: this run needs --train.freeze-at and {full.run.path} must not have it; "
            "swap them, or train one of them so"
        )
    scenes = [read_capture(job.run.scene) for job in (stopped, full)]
    names = {name for name in {*made, *other} - _FREE if made.get(name) != other.get(name)}
    if (scenes[0].fingerprint, scenes[0].photos) != (scenes[1].fingerprint, scenes[1].photos) or names:
        what = f"settings ({', '.join(sorted(names))})" if names else "captures"
        raise RunError(
            f"{full.run.path}: other {what} than {stopped.run.path}; train one of them like the other"
        )
    return float(target)


def _measure(job: Job, g: Gaussians) -> Mapping[str | int, float]:
    """Means over the test views: SSIM and PSNR of the image, PSNR near and off borders, SSIM by label id."""
    found: dict[str | int, list[float]] = {}
    workspace = Workspace()
    for row in job.valid.rows(job.scene, job.scene.test_ids):
        view = job.scene.views[row]
        photo, label_ids = as_unit(job.photos[row]), job.masks[view]
        image = render_rgb(
            g, view.camera, backend=job.backend, antialiased=job.antialiased, workspace=workspace
        )
        valid = job.valid[view]
        error, band = squared_error_map(image, photo), near_border(label_ids, BAND)
        counts = np.ones_like(band) if valid is None else valid
        values: dict[str | int, float] = {}
        for label, quality in measure(image, photo, label_ids, valid=valid).items():
            if label == TOTAL:
                values |= {"ssim": quality["ssim"], "psnr": quality["psnr"]}
            else:
                values[label] = quality["ssim"]
        for name, pixels in (("band", error[band & counts]), ("inside", error[~band & counts])):
            if pixels.size:
                values[name] = float(psnr(pixels.mean()))
        for name, value in values.items():
            found.setdefault(name, []).append(value)
    empty = dict.fromkeys(("ssim", "psnr", "band", "inside"), np.nan)
    return {**empty, **{name: float(np.mean(values)) for name, values in found.items()}}
