"""The contents that bundles of finished runs and of running trainings have in common."""

import numpy as np

from sagesplat.adapt.cells import Cells
from sagesplat.core.gaussians import Gaussians
from sagesplat.run.job import Job
from sagesplat.segment.display_names import title_of
from sagesplat.segment.masks import UNLABELLED
from sagesplat.stages.shared import category_colors
from sagesplat.viewer.manifest import CameraEntry, Category, Contents

_GROUND = {"dirt", "floor", "grass", "gravel", "ground", "pavement", "platform", "playingfield", "railroad"}
_GROUND |= {"path", "road", "sand", "sidewalk", "snow", "soil", "street", "terrain"}


def bundle_contents(job: Job, g: Gaussians, cells: Cells, antialiased: bool) -> Contents:
    """The contents of a bundle without increments and bounds."""
    scene, names = job.scene, job.names()
    labels = sorted(set(cells.labels.tolist()))
    job.check_named(job.run.levels, labels)
    colors = category_colors(job, {names[i] for i in labels})
    ground = [i for i in labels if _GROUND & set(_title(job, names[i]).split())]
    parents = job.parents
    return Contents(
        name=scene.name,
        extent=scene.extent,
        cameras=[
            CameraEntry(view.name, scene.split(row), view.camera) for row, view in enumerate(scene.views)
        ],
        categories=[
            Category(i, names[i], _title(job, names[i]), colors[names[i]], parent=parents.get(names[i]))
            for i in labels
        ],
        cells=cells,
        chunks=[],
        folder=job.run.increments,
        sh_degree=g.sh_degree,
        antialiased=antialiased,
        points=scene.points.xyz,
        ground=np.isin(job.point_labels, ground),
    )


def _title(job: Job, category: str) -> str:
    return title_of(category) if category != job.level_masks.taxonomy.name(UNLABELLED) else "everything else"
