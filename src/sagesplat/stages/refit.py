"""Fits the models of some categories of a finished run again; those of the others stay as they are."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sagesplat.adapt.calibrate_fidelity import calibrated, remove_composition_bias
from sagesplat.adapt.cell_models import FidelityModel, write_fidelity
from sagesplat.adapt.eq3 import write_models
from sagesplat.adapt.fidelity_models import fit_fidelity
from sagesplat.adapt.regroup import NewCell
from sagesplat.adapt.viewpoint import write_promises
from sagesplat.adapt.viewpoints import capture_cameras
from sagesplat.core.config import FitConfig
from sagesplat.run.job import Job
from sagesplat.scene.scene import Camera
from sagesplat.segment.masks import UNLABELLED
from sagesplat.stages.fidelity import Compositions, trial
from sagesplat.stages.fit import fit_curves
from sagesplat.stages.methods import NestedLevels
from sagesplat.stages.results import (
    cells_of,
    fidelity_of,
    has_photos,
    models_of,
    promises_of,
    sampled_of,
    viewpoints_of,
)
from sagesplat.stages.shared import observed
from sagesplat.stages.viewpoints import fit_viewpoints

# viewpoints of each set that compositions are measured at, at most: a calibration takes 19 at 95 %
_MOST = {"bias": 24, "calibration": 60}


def refit(
    before: Job, job: Job, config: FitConfig, changed: Collection[int], cells: Mapping[int, NewCell]
) -> None:
    """Fit and calibrate the categories `changed` of `job`, and take all other models from the run `before`.

    Both are calibrated in compositions in which the others are at the levels that their own models choose.
    `cells`: of `job`, by id.
    """
    table, left = observed(job), {label for label, _ in job.ladder.counts} - set(changed)
    curves = {key: one for key, one in models_of(before).items() if key[0] in _kept(before, job, changed)}
    fresh = fit_curves(job, table.select(np.isin(table.label_id, list(changed))))
    write_models(job.run.models, dict(sorted({**curves, **fresh}.items())))
    if has_photos(before.run):
        known = {label: one for label, one in promises_of(before).items() if label in left}
        costs = NestedLevels(job).costs
        write_promises(job.run.promises, fit_viewpoints(job, costs, table, config, fresh, known))
    numbers = {one.old: cell for cell, one in cells.items() if one.whole}
    models = {
        label: replace(one, cells=tuple(replace(own, cell=numbers[own.cell]) for own in one.cells))
        for label, one in fidelity_of(before).items()
        if label in left
    }
    write_fidelity(job.run.fidelity, _fit_drawn(job, config, changed, models))


def _kept(before: Job, job: Job, changed: Collection[int]) -> set[int]:
    """Label ids whose models stay; those below 0 are of the whole image, which did not change."""
    return ({label for label in before.names() if label in job.names()} | {-2}) - set(changed)


def _fit_drawn(
    job: Job, config: FitConfig, changed: Collection[int], known: Mapping[int, FidelityModel]
) -> dict[int, FidelityModel]:
    """Models of fidelity: as `stages.fidelity.fit_drawn`, with neighbours whose models are known."""
    drawn, sampled, confidence = viewpoints_of(job), sampled_of(job), config.confidence
    fit = [drawn.cameras[row] for row in drawn.rows("fit")]
    all_cells = cells_of(job)
    rows = np.flatnonzero(np.isin(all_cells.labels, sorted(set(changed) - {UNLABELLED})))
    cells, names = all_cells.select(rows), ("fidelity", "pixels", "distance")
    mine = replace(
        sampled, labels=tuple(cells.ids.tolist()), **{name: getattr(sampled, name)[:, rows] for name in names}
    )
    models = {}
    if len(rows):
        models = fit_fidelity(
            mine, cells, fit, job.scene.scale, confidence, drawn.focal, drawn.rule.screens,
            capture_cameras(job.scene),
        )  # fmt: skip
    for name, step in (("bias", remove_composition_bias), ("calibration", calibrated)):
        cameras = _some([drawn.cameras[row] for row in drawn.rows(name)], _MOST[name])
        compositions = Compositions(job, cameras, cells.ids.tolist())
        models = step(models, trial({**known, **models}, all_cells, compositions), confidence)
    return dict(sorted({**known, **models}.items()))


def _some(cameras: Sequence[Camera], most: int) -> list[Camera]:
    """Up to `most` of them, evenly."""
    rows = np.unique(np.linspace(0, len(cameras) - 1, min(most, len(cameras))).round().astype(int))
    return [cameras[row] for row in rows]
