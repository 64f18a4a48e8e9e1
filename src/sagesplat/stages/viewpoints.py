"""Makes the viewpoint models of nested levels, from the observations and from random compositions."""

from collections.abc import Mapping, Sequence

import numpy as np

from sagesplat.adapt.bound_plans import Costs, plan_for_view, quality_at
from sagesplat.adapt.eq3 import SsimModel
from sagesplat.adapt.observe import Observations, as_unit, measure, render_rgb
from sagesplat.adapt.viewpoint import ViewModel, fit_promises, in_composition
from sagesplat.core.config import FitConfig
from sagesplat.core.events import Progress
from sagesplat.raster import Workspace
from sagesplat.run.executor import split
from sagesplat.run.job import Job
from sagesplat.run.remote import work_all
from sagesplat.segment.masks import UNLABELLED
from sagesplat.stages.shared import distances, label_images
from sagesplat.train.early_stopping import VIEWS, spread

_TARGETS = tuple(np.arange(0.5, 0.96, 0.05).round(2).tolist())  # SSIM of the compositions that are looked at


def fit_viewpoints(
    job: Job,
    costs: Costs,
    table: Observations,
    config: FitConfig,
    curves: Mapping[tuple[int, int], SsimModel],
) -> dict[int, ViewModel]:
    """A viewpoint model of every category but the unlabelled pixels, which have no target and stay in full.

    `costs`: of the nested levels; `table`: observations of views that show enough of a category; `curves`:
    Eq. 3 of them. Observations have all categories at the same level. What a category gains or loses in
    composition, beside others at other levels, is measured on compositions planned for the calibration views
    (some training views where there are none).
    """
    table = table.select(table.label_id != UNLABELLED)
    promises = fit_promises(table, job.scene, config.confidence, curves)
    far = distances(job, config.distance)
    quality = quality_at(costs, promises, far, [view.camera for view in job.scene.views])
    keys = zip(table.label_id.tolist(), table.level.tolist(), table.view.tolist(), strict=True)
    alone = dict(zip(keys, table.ssim.tolist(), strict=True))
    changes: dict[int, list[float]] = {}
    rows = job.scene.calibration_ids.tolist() or spread(job.scene.train_ids.tolist(), VIEWS)
    planned = []
    for row in rows:
        plans = [plan_for_view(quality, costs, target, row).levels for target in _TARGETS]
        planned.append((row, list({tuple(plan.items()): plan for plan in plans}.values())))
    parts = [(some, config) for some in split(planned, job.pieces)]
    for some in work_all(job, "fit", _measure_compositions, parts):
        for label, level, row, ssim in some:
            key = label, level, row
            if key in alone:
                changes.setdefault(label, []).append(ssim - alone[key])
    return in_composition(promises, {label: np.array(change) for label, change in changes.items()})


def _measure_compositions(
    job: Job, part: tuple[Sequence[tuple[int, list[dict[int, int]]]], FitConfig]
) -> list[tuple[int, int, int, float]]:
    """(label id, its level, row, SSIM) of compositions (levels by label id) in some views (rows)."""
    planned, config = part
    name = "ssim_eroded" if config.region == "eroded" else "ssim"
    masks, workspace = label_images(job, config.masks), Workspace()
    rows = []
    for done, (row, compositions) in enumerate(planned, 1):
        view = job.scene.views[row]
        for levels in compositions:
            image = render_rgb(
                job.ladder.compose(levels), view.camera,
                backend=job.backend, antialiased=job.antialiased, workspace=workspace,
            )  # fmt: skip
            found = measure(image, as_unit(job.photos[row]), masks[view])
            rows += [(label, levels.get(label, -1), row, values[name]) for label, values in found.items()]
        job.emit(Progress("fit", done, len(planned)))
    return rows
