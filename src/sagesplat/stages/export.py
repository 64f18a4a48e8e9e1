"""Makes splat files of others' formats, from levels, compositions and increments of a run."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from sagesplat.adapt.ladder import NestedLadder, read_prefixes
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.core.errors import RunError
from sagesplat.core.events import Warned
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import offset_text
from sagesplat.core.sh import BASES
from sagesplat.formats.increments import (
    INDEX,
    FileFormat,
    Increment,
    read_increments,
    read_index,
    write_increments,
)
from sagesplat.formats.lod_meta import LOD_META
from sagesplat.formats.offsets import beside, write_doubles, write_offset
from sagesplat.formats.ply import WRITER as PLY_WRITER
from sagesplat.formats.ply import write_ply
from sagesplat.formats.splat import WriteLevels
from sagesplat.formats.splats import write_splat, writer_of
from sagesplat.raster import device_of, rasterize
from sagesplat.run.job import Job
from sagesplat.scene.scene import Camera
from sagesplat.stages.compose import classic, for_engine
from sagesplat.stages.methods import method_of
from sagesplat.stages.plan import main_plan, scene_plan
from sagesplat.stages.shared import labels_named
from sagesplat.train.cells import cells_wanted, split_cells
from sagesplat.train.early_stopping import spread

_HOLE_VIEWS = 16  # training views in which holes are counted
RasterizeMode = Literal["classic", "antialiased", "playcanvas"]  # the first two are gsplat's names


def export_increments(job: Job, folder: Path, kind: FileFormat) -> int:
    """Write what each level of each category adds as files of their own; returns how many."""
    if not method_of(job).streams:
        raise RunError(f"{job.run.path}: these levels have no chunks; use --ladder nested")
    if folder.exists() and not (job.force and (folder / INDEX).exists()):
        raise RunError(f"{folder}: exists; choose a new folder (--force replaces one of chunks)")
    written = increment_files(job, folder, kind)
    if other := sum(one.format != kind for one in written):
        job.emit(Warned(f"{other} files are PLY: SPZ's steps of positions are larger than their Gaussians"))
    _say_offset(job, "which the files do not say")
    return len(written)


def _say_offset(job: Job, where: str) -> None:
    """Say what positions are relative to: no format of splats holds coordinates such as those in UTM."""
    if any(offset := job.scene.offset):
        text = offset_text(offset)
        job.emit(Warned(f"positions are relative to {text}, {where}: add it for those of the capture"))


def increment_files(job: Job, folder: Path, kind: FileFormat) -> list[Increment]:
    """Write the increments of the run's nested levels as files of their own, in the order of the ladder.

    What streams hold is kept by the finest steps of SPZ. Of two opacities a Gaussian gets that of the full
    model. PLY files are for viewers that do not antialias.
    """
    ladder = read_prefixes(job.run.prefixes)
    listed = read_index(job.run.increments)
    streams = any(one.format == "stream" for one in listed)
    g = read_increments(job.run.increments, listed) if streams else ladder.gaussians
    antialiased = job.antialiased and kind != "ply"
    if kind == "ply":  # in the published layout, with all harmonics
        g = classic(job, g)
        g = replace(g, shN=torch.nn.functional.pad(g.shN, (0, 0, 0, BASES[-1] - g.shN.shape[1])))
    return write_increments(
        folder, g, ladder.sizes, job.names(), label_of={one.cell: one.label_id for one in listed},
        replaces=ladder.replaces, kind=kind, fine=ladder.levels if streams else (),
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
    without: Sequence[str] = (),
    labels_inside: bool = False,
    doubles: bool = False,
) -> int:
    """Write a level or a composition, whole or some categories, in the format of the path's name.

    `labels` (none: all) and `without` name categories or instances; a category means its instances too. What
    is left out leaves holes, which an event names.

    `rasterize_mode`: how the file will be drawn; None: levels of detail as by PlayCanvas's engine, scenes as
    the run was trained where the format says so, else `classic`. `lod-meta.json` and `.ssog` get `levels`,
    or all there are, as levels of detail. `labels_inside`: a PLY has the labels as a property, not beside it.
    `doubles`: positions of a PLY are doubles in the capture's own coordinates. Returns the number of
    Gaussians.
    """
    writer = writer_of(path)
    for given, name in ((labels_inside, "labels-inside"), (doubles, "doubles")):
        if given and writer is not PLY_WRITER:
            raise RunError(f"{path}: --{name} is for .ply; leave it out")
    if rasterize_mode == "antialiased" and not job.antialiased:
        raise RunError(f"{job.run.path}: trained without antialiasing; leave out --rasterize-mode")
    if path.name == LOD_META:
        _check_folder(job, path.parent)
    elif path.exists() and not job.force:
        raise RunError(f"{path}: exists; add --force to replace it")
    wanted = labels_named(job, labels) or list(job.names())
    gone = labels_named(job, without)
    wanted = [label for label in wanted if label not in gone]
    if not wanted:
        raise RunError(f"{path}: no category is left; leave out some of --without")
    if level is not None and target is not None:
        raise RunError(f"{path}: a level, or the scene planned for a target; leave one of them out")
    if writer.write_levels and (level is not None or target is not None):
        raise RunError(f"{path}: holds several levels; leave out --level and targets (--levels chooses)")
    if writer.write_levels:
        return _export_levels(job, path, writer.write_levels, levels, wanted, rasterize_mode or "playcanvas")
    if levels:
        raise RunError(f"{path}: levels are for {LOD_META} and .ssog; name one with --level")
    if level is not None:
        whole = job.ladder.load(level)
    else:
        plan = main_plan(job) if target is None else scene_plan(job, *target)
        whole = plan.compose(job.ladder)
    g = whole.of_labels(wanted)
    if gone:
        job.emit(Warned(_holes(job, whole, g, without)))
    if g.sh_degree > writer.sh_degree and bool(g.shN.any()):
        job.emit(Warned(f"{path}: the format holds no harmonics, which are left out"))
    offset, mode = job.scene.offset, rasterize_mode or ("antialiased" if writer.antialiases else "classic")
    g, antialiased = _drawn(job, g, mode)
    kept = {"parents": job.parents_by_id, "antialiased": antialiased}
    if labels_inside:
        write_ply(path, g, job.names(), **kept, labels_inside=True)
        write_offset(path, offset)
    else:
        write_splat(path, g, job.names(), **kept, offset=offset)
    if doubles:
        write_doubles(path, offset)
    else:
        _say_offset(job, f"written to {beside(path).name}")
    return len(g)


def _holes(job: Job, whole: Gaussians, g: Gaussians, without: Sequence[str]) -> str:
    """How much of what photos show is a hole now: nothing was seen behind what is left out."""
    opaque, holes = 0, 0
    for row in spread(job.scene.train_ids.tolist(), _HOLE_VIEWS):
        camera = job.scene.views[row].camera
        before, after = (_alpha(job, some, camera) >= 0.5 for some in (whole, g))
        opaque += int(before.sum())
        holes += int((before & ~after).sum())
    return (
        f"without {', '.join(without)}, {holes / max(opaque, 1):.1%} of what the photos show is a hole: "
        "no photo saw what is behind"
    )


def _alpha(job: Job, g: Gaussians, camera: Camera) -> Tensor:
    if not len(g):
        return torch.zeros(camera.height, camera.width)
    with torch.no_grad():
        g = g.to(device_of(job.backend))
        return rasterize(g, camera, sh_degree=0, antialiased=job.antialiased, backend=job.backend).alpha.cpu()


def _check_folder(job: Job, folder: Path) -> None:
    """RunError unless `folder` is new, empty, or with --force holds an earlier export and nothing else."""
    inside = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
    ours = (LOD_META, beside(folder / LOD_META).name)
    other = [name for name in inside if name not in ours and not re.fullmatch(r"\d+_\d+", name)]
    if other or (inside and not job.force) or (folder.exists() and not folder.is_dir()):
        raise RunError(f"{folder}: not empty; choose a new folder (--force replaces one that export wrote)")


def _drawn(job: Job, g: Gaussians, mode: RasterizeMode) -> tuple[Gaussians, bool]:
    """The Gaussians for a way of drawing, and whether it antialiases."""
    if mode == "antialiased" and job.antialiased:
        return g, True
    return (for_engine if mode == "playcanvas" else classic)(job, g), False


def _export_levels(
    job: Job,
    path: Path,
    write: WriteLevels,
    levels: Sequence[int],
    wanted: Sequence[int],
    mode: RasterizeMode,
) -> int:
    chosen = sorted(set(levels) or job.ladder.levels, reverse=True)  # the finest is level of detail 0
    if isinstance(job.ladder, NestedLadder):
        label_of = {cell: label for cell, label in job.ladder.label_of.items() if label in wanted}
        sets = [job.by_cell.load(level, list(label_of)) for level in chosen]
    else:
        sets, label_of = _in_cells([job.ladder.load(level, wanted) for level in chosen])
    sets = [g for i, g in enumerate(sets) if len(g) and (i == 0 or len(g) < len(sets[i - 1]))]
    drawn = [_drawn(job, g, mode) for g in sets]
    antialiased = any(one for _, one in drawn)
    write(path, [g for g, _ in drawn], label_of, job.names(), job.parents_by_id, antialiased)
    write_offset(path, job.scene.offset)
    _say_offset(job, f"written to {beside(path).name}")
    return len(sets[0]) if sets else 0


def _in_cells(sets: Sequence[Gaussians]) -> tuple[list[Gaussians], dict[int, int]]:
    """Recorded levels with cell ids for label ids, and the label id of each: all are split at once."""
    means, labels = (torch.cat([getattr(g, name) for g in sets]).numpy() for name in ("means", "label_ids"))
    cells, label_of = split_cells(means, labels, cells_wanted(max(map(len, sets))))
    parts = np.split(cells, np.cumsum([len(g) for g in sets])[:-1])
    return [replace(g, label_ids=torch.from_numpy(own)) for g, own in zip(sets, parts, strict=True)], label_of
