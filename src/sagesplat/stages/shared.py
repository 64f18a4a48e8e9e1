"""Helpers that several stages share: settings, label images and names of a run."""

from collections.abc import Collection, Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from sagesplat.adapt.observe import (
    PERCENTILE,
    Observations,
    RenderedLabels,
    distances_in_views,
    large_enough,
    widest_lens,
    within_lens,
)
from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.names import composed
from sagesplat.run.job import Job
from sagesplat.run.records import settings_of
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.scene import Camera, View
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
    made = [("masks", run.masks), ("fuse", run.fused)]
    made += [("instances", run.instances)] if run.has_instances else []
    return [run.provenance(stage) for stage, folder in made if (folder / "labels.json").exists()]


def existing(*paths: Path) -> list[Path]:
    """Those that are there: inputs of a stage that not every run has."""
    return [path for path in paths if path.exists()]


def inlier_inputs(run: RunDir) -> list[Path]:
    """The images of the pixels that Gaussians are fitted to after training, where some are not."""
    return existing(run.inliers) or existing(run.valid)


def rendered_labels(job: Job) -> RenderedLabels:
    """The label images that the full model paints."""
    return RenderedLabels(job.ladder.load(job.ladder.levels[-1]), job.backend, job.antialiased)


def distances_from(job: Job, camera: Camera) -> dict[int, np.ndarray]:
    """d_min of each category from a camera, float [1], measured as those that the models were fitted to."""
    percentile = PERCENTILE if job.fit_config.distance == "percentile" else 0.0
    lens = within_lens(camera, widest_lens([view.camera for view in job.scene.views]))
    views = (View("photo", lens, Path()), View("viewer", camera, Path()))
    seen = distances_in_views(replace(job.scene, views=views), job.point_labels, percentile)
    return {label: np.where(np.isnan(d[:1]), d[1:], d[:1]) for label, d in seen.items()}


def observed(job: Job) -> Observations:
    """The rows of views that show enough of a category."""
    return large_enough(observations_of(job), job.scene)


def labels_named(job: Job, names: Sequence[str]) -> list[int]:
    """The ids of categories and instances, those of a category with all its instances.

    Names are those of the run, or as people are shown them (grass for grass-merged). RunError for a name that
    the run does not have.
    """
    known, found, parents = job.names(), list[int](), job.parents
    all_names = {*known.values(), *parents.values()}
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


def category_colors(job: Job, categories: Collection[str]) -> dict[str, str]:
    """A colour such as "#e5484d" for each category by name: that of the viewer, the report and its figures.

    All categories that have Gaussians are to be given: colours are chosen together.
    """
    taxonomy = job.level_masks.taxonomy
    ids = [i for i in (UNLABELLED, *taxonomy.names) if taxonomy.name(i) in categories]
    colors = colors_of({i: taxonomy.color(i) for i in ids})
    return {taxonomy.name(i): colors[i] for i in ids}


def label_colors(job: Job) -> dict[int, tuple[int, int, int]]:
    """RGB, 0 to 255, of each label id: `category_colors`."""
    names = job.names()
    colors = category_colors(job, {names[label] for (label, _), count in job.ladder.counts.items() if count})
    return {label: rgb_of(colors[name]) for label, name in names.items() if name in colors}
