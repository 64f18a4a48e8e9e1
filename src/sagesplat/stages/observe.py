"""Makes the observations: the quality of every category at every level in every view, from renders."""

from collections.abc import Collection, Sequence

import numpy as np

from sagesplat.adapt.observe import Observations, merge, observe
from sagesplat.core.config import FitConfig
from sagesplat.core.events import Progress
from sagesplat.output import tables
from sagesplat.run.executor import split
from sagesplat.run.job import Job
from sagesplat.run.remote import work_all
from sagesplat.run.stage import run_stage
from sagesplat.segment.display_names import titles
from sagesplat.stages.methods import method_of
from sagesplat.stages.results import has_photos
from sagesplat.stages.shared import label_image_inputs

_OBSERVED = 3  # of so many training views of a splat without photos one is measured at all levels


def observe_levels(job: Job, config: FitConfig) -> None:
    """Measure every category at every level in every view."""
    run = job.run

    def make() -> list[str]:
        table = observed_views(job, config)
        table.write_csv(run.observations)
        seen = table.select(np.isin(table.view, job.scene.train_ids))
        names = titles(job.names())
        job.emit(tables.ladder_table(seen, job.ladder.counts, job.ladder.recovering, names).event)
        exposed = any(view.camera.exposure is not None for view in job.scene.views)
        how = ", rendered with the exposure of their photos" if exposed else ""
        fewer = len(_last_only(job))
        alone = f", in {fewer} of them of the last level alone" if fewer else ""
        return [
            f"{len(table):,} observations of {len(job.ladder.levels)} levels in "
            f"{len(job.scene.views)} views{how}{alone}"
        ]

    levels = method_of(job).level_files[:2]
    inputs = [*run.scene_files, run.labels, run.provenance("train"), *levels, *label_image_inputs(run)]
    settings = {"distance": config.distance}
    run_stage(job, "observe", settings, inputs, [run.observations], make)


def observed_views(job: Job, config: FitConfig, labels: Collection[int] | None = None) -> Observations:
    """The observations of all categories in all views, or of some alone (ids), divided among who compute."""
    far = job.distances(config.distance)
    parts = [(rows, far, labels) for rows in split(range(len(job.scene.views)), job.pieces)]
    return merge(work_all(job, "observe", _observe_views, parts))


def _last_only(job: Job) -> set[int]:
    """Views in which the last level alone is measured: most of a splat without photos.

    Its views are renders, beside which drawn viewpoints say what each level is worth; these are for the
    report, and to know what each view shows.
    """
    if has_photos(job.run):
        return set()
    train = job.scene.train_ids.tolist()
    return set(train) - set(train[1::_OBSERVED])  # not those alone that levels are fitted to (`spread`)


def _observe_views(
    job: Job, part: tuple[Sequence[int], dict[int, np.ndarray], Collection[int] | None]
) -> Observations:
    """The observations of some views (rows, distances in all views, categories)."""
    rows, far, labels = part
    return observe(
        job.scene, job.photos, job.level_masks, job.ladder, far,
        views=rows, valid=job.valid, labels=labels, last_only=_last_only(job),
        backend=job.backend, antialiased=job.antialiased,
        progress=lambda done, total: job.emit(Progress("observe", done, total)),
    )  # fmt: skip
