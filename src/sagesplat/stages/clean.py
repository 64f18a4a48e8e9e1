"""Removes floaters from the last level of a training: what the nested levels are made of."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from sagesplat.core.config import CleanConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Progress
from sagesplat.core.limits import Count, Number
from sagesplat.formats.levels import read_level, select_level
from sagesplat.io.files import write_json
from sagesplat.io.typed import check_limits, read_json_as
from sagesplat.raster import device_of
from sagesplat.run.job import Job
from sagesplat.run.stage import run_stage
from sagesplat.stages.scene import check_not_adopted
from sagesplat.stages.shared import inlier_inputs
from sagesplat.train.clean import Cleaned, Criterion, clean, find_floaters


@dataclass(frozen=True)
class CleanFigures:
    """What was found and removed, by criterion, and what that cost."""

    gaussians: Count  # before
    found: dict[Criterion, Count]
    removed: dict[Criterion, Count]
    before: dict[str, Number]  # mean PSNR of some views, by kind ("train", "calibration"), dB
    after: dict[str, Number]

    def __post_init__(self) -> None:
        if self.found.keys() != self.removed.keys() or self.before.keys() != self.after.keys():
            raise ValueError("other criteria or views before than after")
        if any(count > self.found[name] for name, count in self.removed.items()):
            raise ValueError("more removed than found")


def clean_levels(job: Job, config: CleanConfig) -> None:
    """Write the last level without its floaters (`RunDir.cleaned`); the level itself stays as recorded."""
    run = job.run
    check_not_adopted(run)
    if job.has_blocks:
        raise RunError(f"{run.blocks}: floaters are not removed from a scene in blocks; nest it as it is")
    check_limits(config, "clean.")

    def make() -> list[str]:
        for earlier in (run.cleaned, run.floaters_picture):
            earlier.unlink(missing_ok=True)
        last = job.last_level
        if config.floaters == "keep":
            write_json(run.floaters, asdict(CleanFigures(sum(last.counts.values()), {}, {}, {}, {})))
            return ["nothing is removed"]
        cleaned = _clean(job, last.path, config)
        if not cleaned.keep.all():
            select_level(last.path, run.cleaned, cleaned.keep)
        figures = figures_of(cleaned)
        write_json(run.floaters, asdict(figures))
        return clean_lines(figures)

    inputs = [*run.scene_files, run.provenance("masks"), run.levels, run.provenance("train")]
    figures = read_clean_figures(run.floaters)
    removed = figures is not None and any(figures.removed.values())
    outputs = [run.floaters, *([run.cleaned] if removed else [])]
    run_stage(job, "clean", asdict(config), [*inputs, *inlier_inputs(run)], outputs, make)


def _clean(job: Job, last: Path, config: CleanConfig) -> Cleaned:
    """What to remove of a level, with a picture of it."""
    g, scene = read_level(last).to(device_of(job.backend)), job.scene
    rows = job.inliers.rows(scene, scene.train_ids)
    floaters = find_floaters(
        g, scene, rows,
        label_image=job.masks.__getitem__, valid=job.inliers, antialiased=job.antialiased,
        on_view=lambda done: job.emit(Progress("clean", done, len(rows))),
    )  # fmt: skip
    if sky := job.sky:  # what few views show of it stands before nothing
        near = ~sky.shell.holds(g.means).cpu().numpy()
        floaters = replace(floaters, found={name: rows & near for name, rows in floaters.found.items()})
    kinds = {"train": rows, "calibration": scene.calibration_ids.tolist()}
    cleaned = clean(
        g, floaters, scene, job.photos, config,
        kinds=kinds, valid=job.inliers, antialiased=job.antialiased, backend=job.backend,
    )  # fmt: skip
    if not cleaned.keep.all():
        # loads matplotlib, for which no training has to wait
        from sagesplat.output.before_after import before_after

        cameras = [view.camera for view in scene.views]
        before_after(
            job.run.floaters_picture, g, cleaned.keep, cameras, clean_lines(figures_of(cleaned))[0],
            antialiased=job.antialiased, backend=job.backend,
        )  # fmt: skip
    return cleaned


def figures_of(cleaned: Cleaned) -> CleanFigures:
    """The figures of a cleaning."""
    removed: Any = {name: int(rows.sum()) for name, rows in cleaned.removed.items()}
    found: Any = cleaned.found
    return CleanFigures(len(cleaned.keep), found, removed, cleaned.before, cleaned.after)


def clean_lines(figures: CleanFigures) -> list[str]:
    """The figures in words."""
    total = sum(figures.removed.values())
    parts = [
        f"{count:,} {name}" + (f" (of {figures.found[name]:,})" if count < figures.found[name] else "")
        for name, count in figures.removed.items()
        if figures.found[name]
    ]
    lines = [f"{total:,} of {figures.gaussians:,} Gaussians removed: {', '.join(parts) or 'no floaters'}"]
    if total and figures.after:
        changes = [
            f"{kind} views {figures.after[kind] - before:+.3f} dB" for kind, before in figures.before.items()
        ]
        lines.append(", ".join(changes))
    return lines


def read_clean_figures(path: Path) -> CleanFigures | None:
    """What `clean_levels` wrote; None where it never ran. RunError for anything else."""
    if not path.exists():
        return None
    cure = "delete it and run `sagesplat clean RUN`"
    return read_json_as(path, CleanFigures, "what was cleaned", cure, RunError)
