"""Makes splat files of others' formats, from levels, compositions and increments of a run."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from sagesplat.adapt.ladder import read_prefixes
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.core.errors import RunError
from sagesplat.formats.increments import (
    INDEX,
    FileFormat,
    Increment,
    read_increments,
    read_index,
    write_increments,
)
from sagesplat.formats.lod_meta import LOD_META
from sagesplat.formats.lod_meta_write import write_lod_meta
from sagesplat.formats.splats_write import write_splat, written_as
from sagesplat.run.job import Job
from sagesplat.run.records import settings_of
from sagesplat.stages.compose import classic, compose
from sagesplat.stages.plan import main_plan, scene_plan
from sagesplat.stages.shared import label_named

RasterizeMode = Literal["classic", "antialiased"]  # gsplat's names


def export_increments(job: Job, folder: Path, kind: FileFormat) -> int:
    """Write what each level of each category adds as files of their own; returns how many."""
    if job.run.ladder != "nested":
        raise RunError(f"{job.run.path}: snapshots have no chunks; use --ladder nested")
    if folder.exists() and not (job.force and (folder / INDEX).exists()):
        raise RunError(f"{folder}: exists; choose a new folder (--force replaces one of chunks)")
    return len(increment_files(job, folder, kind))


def increment_files(job: Job, folder: Path, kind: FileFormat) -> list[Increment]:
    """Write the increments of the run's nested levels as files of their own, in the order of the ladder.

    What streams hold is kept by the finest steps of SPZ. Of two opacities a Gaussian gets that of the full
    model. PLY files are for viewers that do not antialias.
    """
    ladder, made = read_prefixes(job.run.prefixes), settings_of(job.run, "nest")
    listed = read_index(job.run.increments)
    streams = any(one.format == "stream" for one in listed)
    g = read_increments(job.run.increments, listed) if streams else ladder.gaussians
    antialiased = job.antialiased and kind != "ply"
    return write_increments(
        folder, classic(job, g) if kind == "ply" else g, ladder.sizes, job.names(), replaces=ladder.replaces,
        kind=kind, sh_bits=tuple(made["sh_bits"]), fine=ladder.levels if streams else (),
        antialiased=antialiased,
    )  # fmt: skip


def export_scene(
    job: Job,
    path: Path,
    *,
    level: int | None,
    labels: Sequence[str],
    target: tuple[QualityKind, float] | None,
    levels: Sequence[int] = (),
    rasterize_mode: RasterizeMode | None = None,
) -> int:
    """Write a level or a composition, whole or some categories, in the format of the path's name.

    `rasterize_mode`: how the file will be drawn; None: `classic` for a PLY, else as the run was trained.
    `lod-meta.json` gets `levels`, or all there are, as levels of detail. Returns the number of Gaussians.
    """
    written = written_as(path)
    if rasterize_mode == "antialiased" and not job.antialiased:
        raise RunError(f"{job.run.path}: trained without antialiasing; leave out --rasterize-mode")
    if rasterize_mode == "classic" and written == LOD_META:
        raise RunError(f"{path}: says how it is drawn; leave out --rasterize-mode")
    if written == LOD_META:
        _check_folder(job, path.parent)
    elif path.exists() and not job.force:
        raise RunError(f"{path}: exists; add --force to replace it")
    wanted = [label_named(job, name) for name in labels] or list(job.names())
    if written == LOD_META:
        return _export_levels(job, path.parent, levels, wanted)
    if levels:
        raise RunError(f"{path}: levels are for {LOD_META}; name one with --level")
    if level is not None:
        g = job.ladder.load(level, wanted)
    else:
        plan = main_plan(job) if target is None else scene_plan(job, *target)
        g = compose(job, plan).of_labels(wanted)
    mode = rasterize_mode or ("classic" if written == ".ply" else "antialiased")
    if mode == "classic":
        write_splat(path, classic(job, g), job.names())
    else:
        write_splat(path, g, job.names(), antialiased=job.antialiased)
    return len(g)


def _check_folder(job: Job, folder: Path) -> None:
    """RunError unless `folder` is new, empty, or with --force holds an earlier export and nothing else."""
    inside = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
    other = [name for name in inside if name != LOD_META and not re.fullmatch(r"\d+_\d+", name)]
    if other or (inside and not job.force) or (folder.exists() and not folder.is_dir()):
        raise RunError(f"{folder}: not empty; choose a new folder (--force replaces one that export wrote)")


def _export_levels(job: Job, folder: Path, levels: Sequence[int], wanted: Sequence[int]) -> int:
    chosen = sorted(set(levels) or job.ladder.levels, reverse=True)  # the finest is level of detail 0
    sets = [job.ladder.load(level, wanted) for level in chosen]
    sets = [g for i, g in enumerate(sets) if len(g) and (i == 0 or len(g) < len(sets[i - 1]))]
    write_lod_meta(folder, sets, job.names(), antialiased=job.antialiased)
    return len(sets[0]) if sets else 0
