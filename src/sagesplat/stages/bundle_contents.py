"""The contents that bundles of finished runs and of running trainings have in common."""

import numpy as np

from sagesplat.core.gaussians import Gaussians
from sagesplat.run.job import Job
from sagesplat.segment.display_names import title_of
from sagesplat.segment.masks import UNLABELLED
from sagesplat.stages.shared import category_and_block, category_colors
from sagesplat.viewer import boxes
from sagesplat.viewer.frames import FLIP
from sagesplat.viewer.manifest import CameraEntry, Category, Contents

_GROUND = {"dirt", "floor", "grass", "gravel", "ground", "pavement", "platform", "playingfield", "railroad"}
_GROUND |= {"path", "road", "sand", "sidewalk", "snow", "soil", "street", "terrain"}
_OPAQUE = 0.1  # least opacity of Gaussians that a category's boxes take where it has few SfM points


def bundle_contents(job: Job, g: Gaussians, antialiased: bool) -> Contents:
    """The contents of a bundle without increments and bounds."""
    scene, names = job.scene, job.names()
    labels = sorted(g.counts())
    job.check_named(job.run.levels, labels)
    split_names = {i: category_and_block(job, names[i]) for i in labels}
    colors = category_colors(job, {category for category, _ in split_names.values()})
    ground = [i for i in labels if _GROUND & set(_title(job, split_names[i][0]).split())]
    places, parents = _places(job, g), job.parents
    return Contents(
        name=scene.name,
        extent=scene.extent,
        cameras=[
            CameraEntry(view.name, scene.split(row), view.camera) for row, view in enumerate(scene.views)
        ],
        categories=[
            Category(
                i,
                names[i],
                _title(job, category),
                colors[category],
                boxes.split_boxes(places[i] * FLIP),
                block=block,
                parent=parents.get(category),
            )
            for i, (category, block) in split_names.items()
        ],
        chunks=[],
        folder=job.run.increments,
        sh_degree=g.sh_degree,
        antialiased=antialiased,
        points=scene.points.xyz,
        ground=np.isin(job.point_labels, ground),
    )


def _title(job: Job, category: str) -> str:
    return title_of(category) if category != job.whole_masks.taxonomy.name(UNLABELLED) else "everything else"


def _places(job: Job, g: Gaussians) -> dict[int, np.ndarray]:
    """By label id its SfM points [N, 3]; where they are few, also the means of its opaque Gaussians."""
    points, rows = job.scene.points.xyz, _rows_by_label(job.point_labels)
    means, mine = g.means.numpy(), _rows_by_label(g.label_ids.numpy())
    opaque = g.logit_opacities.numpy() >= np.log(_OPAQUE / (1 - _OPAQUE))
    places = {}
    for label, own in mine.items():
        known = points[rows.get(label, [])]
        if len(known) < boxes.FEW:
            seen = own[opaque[own]]
            known = np.concatenate([known, means[seen if len(seen) else own]])
        places[label] = known
    return places


def _rows_by_label(label_ids: np.ndarray) -> dict[int, np.ndarray]:
    order = np.argsort(label_ids, kind="stable")
    labels, starts = np.unique(label_ids[order], return_index=True)
    return dict(zip(labels.tolist(), np.split(order, starts[1:]), strict=True))
