"""Makes the quality models, from the observations: Eq. 3, and viewpoint models with a lower bound."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sagesplat.adapt.bound_plans import plan_for_view, quality_at
from sagesplat.adapt.eq3 import Samples, SsimModel, fit_model, samples, write_models
from sagesplat.adapt.observe import (
    Observations,
    as_unit,
    large_enough,
    measure,
    read_observations,
    render_rgb,
)
from sagesplat.adapt.viewpoint import ViewModel, fit_promises, in_composition, write_promises
from sagesplat.core.config import FitConfig
from sagesplat.core.events import Progress
from sagesplat.formats.increments import INDEX
from sagesplat.raster import Workspace
from sagesplat.run.executor import split
from sagesplat.run.job import Job
from sagesplat.run.remote import work_all
from sagesplat.run.stage import run_stage
from sagesplat.segment.masks import UNLABELLED
from sagesplat.stages.plan import costs_of
from sagesplat.stages.shared import distances, label_images
from sagesplat.train.early_stopping import VIEWS, spread

_TARGETS = tuple(np.arange(0.5, 0.96, 0.05).round(2).tolist())  # SSIM of the compositions that are looked at


def fit_curves(job: Job, table: Observations) -> dict[tuple[int, int], SsimModel]:
    """Eq. 3 of every category at every level, from the training views."""
    parts = split(samples(table, job.scene.train_ids), job.pieces)
    found = [model for part in work_all(job, "fit", _fit_some, parts) for model in part]
    return {(model.label_id, model.level): model for model in found}


def _fit_some(job: Job, part: Sequence[Samples]) -> list[SsimModel]:
    return [fit_model(*found) for found in part]


def fit_viewpoints(
    job: Job, table: Observations, config: FitConfig, curves: Mapping[tuple[int, int], SsimModel]
) -> dict[int, ViewModel]:
    """Promises for every category but the unlabelled pixels, which nobody asks for: they are shipped whole.

    `table`: observations of views that show enough of a category; `curves`: Eq. 3 of them. Levels
    are measured with everything at the same one; what a category gains or loses among neighbours at others
    is measured on compositions planned for the calibration views (some training views where there are none).
    """
    table = table.select(table.label_id != UNLABELLED)
    promises = fit_promises(table, job.scene, config.confidence, curves)
    far, costs = distances(job, config.distance), costs_of(job)
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


def eroded(table: Observations, region: str) -> Observations:
    """The table with SSIM as `FitConfig.region` measures it."""
    return replace(table, ssim=table.ssim_eroded) if region == "eroded" else table


def fit_ladder(job: Job, config: FitConfig) -> None:
    """Fit Eq. 3 to the observations of the training views."""
    run = job.run

    def make() -> list[str]:
        table = large_enough(read_observations(run.observations), job.scene, config.min_share)
        table = eroded(table, config.region)
        models = fit_curves(job, table)
        write_models(run.models, models)
        statuses = [m.status for m in models.values()]
        lines = [", ".join(f"{statuses.count(s)} {s}" for s in sorted(set(statuses)))]
        if run.ladder == "nested":
            promises = fit_viewpoints(job, table, config, models)
            write_promises(run.promises, promises)
            statuses = [m.status for m in promises.values()]
            lines.append("promises: " + ", ".join(f"{statuses.count(s)} {s}" for s in sorted(set(statuses))))
        return lines

    settings: dict[str, Any] = {"min_share": config.min_share, "region": config.region}
    inputs, outputs = [run.scene, run.observations], [run.models]
    if run.ladder == "nested":
        settings["confidence"] = config.confidence
        inputs, outputs = [*inputs, run.prefixes, run.increments / INDEX], [*outputs, run.promises]
    run_stage(job, "fit", settings, inputs, outputs, make)
