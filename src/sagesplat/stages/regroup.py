"""Moves the files of a run to other categories: levels, label images, point labels, measurements."""

import shutil
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree

from sagesplat.adapt.cells import describe_cells, write_cells
from sagesplat.adapt.fidelity import write_sampled
from sagesplat.adapt.ladder import NestedLadder
from sagesplat.adapt.observe import merge
from sagesplat.adapt.regroup import (
    NewCell,
    new_cells,
    regrouped,
    regrouped_observations,
    regrouped_samples,
)
from sagesplat.core.config import FitConfig
from sagesplat.core.events import Progress
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.formats.increments import read_index, write_index
from sagesplat.formats.levels import read_header, read_level, write_set
from sagesplat.formats.stream_header import SIZE, Grid, Header
from sagesplat.formats.stream_header import read_header as read_stream_header
from sagesplat.formats.stream_increments import read_streams, write_streams
from sagesplat.metrics.image import tiles_around
from sagesplat.run.job import Job
from sagesplat.segment.lift import LiftedLabels
from sagesplat.segment.masks import UNLABELLED, Masks, Taxonomy, mask_path, write_mask
from sagesplat.segment.relabel import Relabelled
from sagesplat.stages.observe import observed_views
from sagesplat.stages.results import observations_of, sampled_of, viewpoints_of
from sagesplat.stages.sample import measured_levels
from sagesplat.stages.shared import rendered_labels


def move_levels(job: Job, new: Job, made: Relabelled) -> dict[int, NewCell]:
    """Write ladder, cells and increments of the new categories; those that did not change keep their files.

    Returns the new cells by id.
    """
    ladder, before = job.by_cell, job.ladder
    assert isinstance(before, NestedLadder)
    cells = new_cells(before, made.new_ids)
    changed = {cell: one for cell, one in cells.items() if one.label_id in made.changed}
    same = {cell: one for cell, one in cells.items() if cell not in changed}
    g, sizes, second = regrouped(ladder, changed)
    folder = new.run.increments
    listed, numbers = read_index(folder), {one.old: cell for cell, one in same.items()}
    kept = [replace(one, cell=numbers[one.cell]) for one in listed if one.cell in numbers]
    headers = _headers(folder)
    with TemporaryDirectory(dir=new.run.adapted) as work:
        streams = Path(work) / "streams"
        written = write_streams(
            streams, g, sizes, made.names, label_of={cell: one.label_id for cell, one in changed.items()},
            second=second, antialiased=job.antialiased,
            grids={cell: Grid.of(headers[one.old]) for cell, one in changed.items()},
        )  # fmt: skip
        decoded, seconds = read_streams(streams, written.increments)
        for uri in {one.uri for one in listed} - {one.uri for one in kept}:
            (folder / uri).unlink()
        for uri in {one.uri for one in written.increments}:
            shutil.move(streams / uri, folder / uri)
    write_index(folder, sorted([*kept, *written.increments], key=lambda one: (one.cell, one.level)))
    # what is hardly to be seen is in no stream, and may be all of a cell
    cells = {cell: one for cell, one in cells.items() if cell in same or cell in written.sizes}
    _write_ladder(job, new, regrouped(ladder, same), (decoded, written.sizes, seconds))
    _write_cells(job, new, cells)
    return cells


def _headers(folder: Path) -> dict[int, Header]:
    """The header of each cell's stream, by cell id."""
    found = {}
    for one in read_index(folder):
        if one.cell not in found:  # its first increment, which begins with the header
            with (folder / one.uri).open("rb") as file:
                file.seek(one.offset)
                found[one.cell] = read_stream_header(file.read(SIZE))
    return found


_Levels = tuple[Gaussians, dict[int, tuple[int, ...]], SecondOpacities | None]


def _write_ladder(job: Job, new: Job, *parts: _Levels) -> None:
    """Write ladder.npz: cells that did not change as they were, and the others as decoded."""
    gaussians, sizes, seconds = zip(*parts, strict=True)
    both = concat(gaussians)
    order = torch.argsort(both.label_ids, stable=True)
    known, second = [one for one in seconds if one is not None], None
    if known:
        weights = {cell: of_levels for one in known for cell, of_levels in one.weights.items()}
        second = SecondOpacities(torch.cat([one.logits for one in known])[order], weights)
    all_sizes = {cell: of_levels for one in sizes for cell, of_levels in one.items()}
    step = read_header(job.run.prefixes).step
    write_set(new.run.prefixes, both.select(order), step, dict(sorted(all_sizes.items())), second=second)


def _write_cells(job: Job, new: Job, cells: Mapping[int, NewCell]) -> None:
    """Write cells.npz: cells that are whole as they were."""
    before, g = job.cells, read_level(new.run.prefixes)
    kept = before.select(np.searchsorted(before.ids, [one.old for one in cells.values()]))
    labels = {cell: one.label_id for cell, one in cells.items()}
    parts = {cell: labels[cell] for cell, one in cells.items() if not one.whole}
    if parts:
        rows, found = np.flatnonzero([not one.whole for one in cells.values()]), describe_cells(g, parts)
        for name in ("bounds", "grid", "area", "radius"):
            getattr(kept, name)[rows] = getattr(found, name)
    write_cells(new.run.cells, replace(kept, ids=np.array(list(labels)), labels=np.array([*labels.values()])))


def move_labels(job: Job, new: Job, made: Relabelled) -> None:
    """Write label images, their labels.json and the labels of points of the new categories."""
    names = {label: name for label, name in made.names.items() if label != UNLABELLED}
    before = job.taxonomy.names
    # categories without Gaussians that are to be seen stay in the label images
    rest = {label: name for label, name in before.items() if label not in made.new_ids and label not in names}
    taxonomy = Taxonomy(dict(sorted({**names, **rest}.items())))
    for _, folder in _label_folders(job, new):
        taxonomy.write(folder / "labels.json")
    if made.changed or set(taxonomy.names) != set(before):
        _move_pixels(job, new, made, taxonomy)
        _move_points(job, new, made)


def _label_folders(job: Job, new: Job) -> list[tuple[Path, Path]]:
    """Folders of label images and where they go: those of instances are the only ones of an edited run."""
    if job.run.has_instances:
        return [(job.run.instances, new.run.masks)]
    both = [(job.run.masks, new.run.masks), (job.run.fused, new.run.fused)]
    return [(source, target) for source, target in both if (source / "labels.json").exists()]


def _move_pixels(job: Job, new: Job, made: Relabelled, taxonomy: Taxonomy) -> None:
    table = np.arange(-1, max([*job.taxonomy.names, *made.new_ids, 0]) + 1, dtype=np.int16)
    split = {}  # new ids by old one
    for old in made.new_ids:
        moved = made.moved(old)
        if moved is None:
            split[old] = np.unique(made.new_ids[old])
        else:
            table[old + 1] = moved
    painted = rendered_labels(new) if split else None
    for source, target in _label_folders(job, new):
        masks = Masks(source, Taxonomy.read(source / "labels.json"))
        for done, view in enumerate(job.scene.views):
            ids = masks[view]
            pixels = table[ids + 1]
            of_split = np.isin(ids, list(split))
            if painted is not None and of_split.any():
                shown = painted.render(view.camera, tiles_around(of_split))
                for old, parts in split.items():
                    if (mine := ids == old).any():
                        pixels[mine] = _nearest(shown, mine, parts)
            write_mask(mask_path(target, view), pixels, taxonomy)
            job.emit(Progress("labels", done + 1, len(job.scene.views)))


def _nearest(painted: np.ndarray, mine: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """For pixels of a split category: the part that paints most there, or at the nearest of its pixels."""
    known = mine & np.isin(painted, parts)
    if not known.any():
        return np.full(int(mine.sum()), parts[0], np.int16)
    rows, columns = np.asarray(distance_transform_edt(~known, return_distances=False, return_indices=True))
    return painted[rows, columns][mine]


def _move_points(job: Job, new: Job, made: Relabelled) -> None:
    """Points of a split category get the part of its nearest Gaussian."""
    ladder = job.ladder
    assert isinstance(ladder, NestedLadder)
    points = job.scene.points.xyz
    lifted = LiftedLabels.read(job.point_label_file, len(points))
    ids = lifted.label_ids.copy()
    for old, new_ids in made.new_ids.items():
        mine = lifted.label_ids == old
        if (moved := made.moved(old)) is not None:
            ids[mine] = moved
        elif mine.any():
            cells = [ladder.cells.ranges[cell] for cell in ladder.cells_of(old)]
            means = ladder.cells.gaussians.slices([slice(of[0][0], of[-1][1]) for of in cells]).means.numpy()
            ids[mine] = new_ids[KDTree(means).query(points[mine])[1]]
    LiftedLabels(ids, lifted.num_votes, lifted.num_agreeing, lifted.ignored).write(new.run.labels)


def measure(job: Job, new: Job, made: Relabelled, cells: Mapping[int, NewCell], fit: FitConfig) -> bool:
    """Write observations and samples: of what was merged from those of its parts, of parts by rendering.

    With all categories at one level images are those of before, so what did not change is not measured again.
    Returns whether anything was rendered.
    """
    fresh = {one for old, ids in made.new_ids.items() if made.moved(old) is None for one in set(ids.tolist())}
    moved = {old: None if (to := made.moved(old)) in fresh else to for old in made.new_ids}
    if new.run.observations.exists():
        _observe(job, new, fit, moved, fresh)
    sampled = regrouped_samples(sampled_of(job), cells)
    if parts := [cell for cell, one in cells.items() if not one.whole]:
        drawn, columns = viewpoints_of(job), [sampled.labels.index(cell) for cell in parts]
        found = measured_levels(new, [drawn.cameras[row] for row in drawn.rows("fit")], parts)
        for name in ("fidelity", "pixels", "distance"):
            getattr(sampled, name)[:, columns] = getattr(found, name)[:, columns]
    write_sampled(new.run.sampled, sampled)
    return bool(fresh)


def _observe(
    job: Job,
    new: Job,
    fit: FitConfig,
    moved: Mapping[int, int | None],
    fresh: Collection[int],
) -> None:
    """Write the observations; those of the categories `fresh` are measured."""
    table = observations_of(job)
    # rows of categories without Gaussians keep their label
    rest = {label: label for label in np.unique(table.label_id).tolist() if label not in moved}
    known = regrouped_observations(table, {**rest, **moved}, new.distances(fit.distance))
    parts = [known, observed_views(new, fit, fresh)] if fresh else [known]
    merge(parts).write_csv(new.run.observations)
