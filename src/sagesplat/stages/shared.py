"""Helpers that several stages share: settings, label images and distances of a run."""

from collections.abc import Collection, Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from sagesplat.adapt.observe import (
    PERCENTILE,
    Observations,
    distances_in_views,
    large_enough,
)
from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import TableMade
from sagesplat.core.names import composed
from sagesplat.output.table import Table
from sagesplat.run.job import Job
from sagesplat.run.records import settings_of
from sagesplat.run.run_dir import RunDir
from sagesplat.segment.block_categories import split_name
from sagesplat.segment.display_colors import colors_of, rgb_of
from sagesplat.segment.display_names import meant
from sagesplat.segment.masks import UNLABELLED
from sagesplat.segment.parents import with_instances
from sagesplat.stages.results import observations_of


def train_config(job: Job) -> TrainConfig:
    """How the run was trained."""
    made = settings_of(job.run, "train")
    return TrainConfig(**{f.name: made[f.name] for f in fields(TrainConfig) if f.name in made})


def label_image_inputs(run: RunDir) -> list[Path]:
    """What decides the label images that stages after training look at: the records of who made them."""
    made = [("masks", run.masks), ("fuse", run.fused), ("block_categories", run.block_categories)]
    if run.ladder == "nested":
        made.append(("instances", run.instances))
    return [run.provenance(stage) for stage, folder in made if (folder / "labels.json").exists()]


def valid_inputs(run: RunDir) -> list[Path]:
    """The images of the pixels that count, where some do not."""
    return [run.valid] if run.valid.exists() else []


def inlier_inputs(run: RunDir) -> list[Path]:
    """The images of the pixels that Gaussians are fitted to after training, where some are not."""
    return [run.inliers] if run.inliers.exists() else valid_inputs(run)


def sky_inputs(run: RunDir) -> list[Path]:
    """The sky that training began with, where photos show some."""
    return [run.sky] if run.sky.exists() else []


def distances(job: Job, distance: str) -> dict[int, np.ndarray]:
    """d_min of each category in each view, as `FitConfig.distance` says; kept, as several stages ask."""
    percentile = PERCENTILE if distance == "percentile" else 0.0
    scene, labels = job.scene, job.point_labels
    kept = job.__dict__.get("_distances")
    if kept is None or kept[0] is not scene or kept[1] != percentile or not np.array_equal(kept[2], labels):
        found = distances_in_views(scene, labels, percentile)
        kept = job.__dict__["_distances"] = scene, percentile, labels, found
    return kept[3]


def observed(job: Job) -> Observations:
    """The rows of views that show enough of a category."""
    return large_enough(observations_of(job), job.scene)


def show_table(job: Job, table: Table) -> None:
    """Emit a table for the console."""
    job.emit(TableMade(table.title, table.header, tuple(map(tuple, table.cells()))))


def labels_named(job: Job, names: Sequence[str]) -> list[int]:
    """The ids of categories and instances, those of a category with all its instances and blocks.

    Names are those of the run, or as people are shown them (grass for grass-merged). RunError for a name that
    the run does not have.
    """
    known, found, parents = job.names(), list[int](), job.parents
    without_blocks = {category_and_block(job, name)[0] for name in known.values()}
    all_names = {*known.values(), *without_blocks, *parents.values()}
    for name in names:
        wanted = meant(composed(name), all_names)
        ids = with_instances(known, parents, wanted)
        if not ids:
            raise RunError(f"{job.run.path}: no category {name!r}; there are {', '.join(known.values())}")
        found += [i for i in ids if i not in found]
    return found


def label_named(job: Job, name: str) -> int:
    """The id of a category of the run; RunError for a name that it does not have."""
    ids = {name: label for label, name in job.names().items()}
    stored = meant(composed(name), ids)
    if stored not in ids:
        raise RunError(f"{job.run.path}: no category {name!r}; there are {', '.join(ids)}")
    return ids[stored]


def category_and_block(job: Job, name: str) -> tuple[str, int | None]:
    """The category and block of a label's name; block None unless the scene is in blocks."""
    return split_name(name) if job.has_block_categories else (name, None)


def category_colors(job: Job, categories: Collection[str]) -> dict[str, str]:
    """A colour such as "#e5484d" for each category by name: that of the viewer, the report and its figures.

    All categories that have Gaussians are to be given: colours are chosen together.
    """
    taxonomy = job.whole_masks.taxonomy
    ids = [i for i in (UNLABELLED, *taxonomy.names) if taxonomy.name(i) in categories]
    colors = colors_of({i: taxonomy.color(i) for i in ids})
    return {taxonomy.name(i): colors[i] for i in ids}


def label_colors(job: Job) -> dict[int, tuple[int, int, int]]:
    """RGB, 0 to 255, of each label id: `category_colors`, of parts of blocks that of their category."""
    names = job.names()
    drawn = {names[label] for (label, _), count in job.ladder.counts.items() if count}
    colors = category_colors(job, {category_and_block(job, name)[0] for name in drawn})
    of = {label: category_and_block(job, name)[0] for label, name in names.items()}
    return {label: rgb_of(colors[category]) for label, category in of.items() if category in colors}
