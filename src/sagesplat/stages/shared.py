"""Helpers that several stages share: settings, label images and distances of a run."""

from dataclasses import fields
from pathlib import Path

import numpy as np

from sagesplat.adapt.observe import PERCENTILE, LabelImages, RenderedLabels, distances_in_views
from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import TableMade
from sagesplat.formats.increments import INDEX
from sagesplat.output.tables import Table
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir, settings_of


def train_config(job: Job) -> TrainConfig:
    """How the run was trained."""
    made = settings_of(job.run, "train")
    return TrainConfig(**{f.name: made[f.name] for f in fields(TrainConfig) if f.name in made})


def fusion(run: RunDir) -> list[Path]:
    """What results change with that look at label images after training."""
    made = [("fuse", run.fused), ("parts", run.block_categories)]
    return [run.provenance(stage) for stage, folder in made if (folder / "labels.json").exists()]


def label_images(job: Job, source: str) -> LabelImages:
    """The label images that came with the photos ("given"), or those of the 3D labels ("rendered")."""
    if source == "given":
        return job.best_masks
    return RenderedLabels(job.ladder.load(job.ladder.levels[-1]), job.backend, job.antialiased)


def distances(job: Job, distance: str) -> dict[int, np.ndarray]:
    """d_min of each category in each view, as `FitConfig.distance` says."""
    percentile = PERCENTILE if distance == "percentile" else 0.0
    return distances_in_views(job.scene, job.point_labels, percentile)


def ladder_files(run: RunDir) -> list[Path]:
    """What the run's levels, and the models of their quality, are read from."""
    if run.ladder == "nested":
        return [run.prefixes, run.increments / INDEX, run.promises]
    return [run.levels, run.models]


def _show(job: Job, table: Table) -> None:
    job.emit(TableMade(table.title, table.header, tuple(map(tuple, table.cells()))))


def label_named(job: Job, name: str) -> int:
    """The id of a category of the run; RunError for a name that it does not have."""
    ids = {name: label for label, name in job.names().items()}
    if name not in ids:
        raise RunError(f"{job.run.path}: no category {name!r}; there are {', '.join(ids)}")
    return ids[name]
