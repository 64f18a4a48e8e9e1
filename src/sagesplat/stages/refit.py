"""Fits the models of some categories of a finished run again; those of the others stay as they are."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sagesplat.adapt.eq3 import write_models
from sagesplat.adapt.fidelity import SampledFidelity
from sagesplat.adapt.fidelity_models import calibrated, fit_fidelity, remove_composition_bias
from sagesplat.adapt.viewpoint import ViewModel, write_promises
from sagesplat.adapt.viewpoints import capture_cameras
from sagesplat.core.config import FitConfig
from sagesplat.run.job import Job
from sagesplat.scene.scene import Camera
from sagesplat.segment.masks import UNLABELLED
from sagesplat.stages.fidelity import Compositions, trial
from sagesplat.stages.fit import fit_curves
from sagesplat.stages.methods import NestedLevels
from sagesplat.stages.results import (
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


def refit(before: Job, job: Job, config: FitConfig, changed: Collection[int]) -> None:
    """Fit and calibrate the categories `changed` of `job`, and take all other models from the run `before`.

    Both are calibrated in compositions in which the others are at the levels that their own models choose.
    """
    table = observed(job)
    curves = {key: one for key, one in models_of(before).items() if key[0] in _kept(before, job, changed)}
    fresh = fit_curves(job, table.select(np.isin(table.label_id, list(changed))))
    write_models(job.run.models, dict(sorted({**curves, **fresh}.items())))
    if has_photos(before.run):
        known = _known(promises_of(before), job, changed)
        costs = NestedLevels(job).costs
        write_promises(job.run.promises, fit_viewpoints(job, costs, table, config, fresh, known))
    known = _known(fidelity_of(before), job, changed)
    write_promises(job.run.fidelity, _fit_drawn(job, config, changed, known))


def _kept(before: Job, job: Job, changed: Collection[int]) -> set[int]:
    """Label ids whose models stay; those below 0 are of the whole image, which did not change."""
    return ({label for label in before.names() if label in job.names()} | {-2}) - set(changed)


def _known(models: Mapping[int, ViewModel], job: Job, changed: Collection[int]) -> dict[int, ViewModel]:
    left = {label for label, _ in job.ladder.counts} - set(changed)
    return {label: model for label, model in models.items() if label in left}


def _fit_drawn(
    job: Job, config: FitConfig, changed: Collection[int], known: Mapping[int, ViewModel]
) -> dict[int, ViewModel]:
    """Models of fidelity: as `stages.fidelity.fit_drawn`, with neighbours whose models are known."""
    drawn, sampled, confidence = viewpoints_of(job), sampled_of(job), config.confidence
    fit = [drawn.cameras[row] for row in drawn.rows("fit")]
    mine = _columns(sampled, [label for label in sampled.labels if label in changed and label != UNLABELLED])
    models = fit_fidelity(
        mine, fit, job.scene.scale, confidence, drawn.focal, drawn.rule.screens, capture_cameras(job.scene)
    )
    for name, step in (("bias", remove_composition_bias), ("calibration", calibrated)):
        cameras = _some([drawn.cameras[row] for row in drawn.rows(name)], _MOST[name])
        measured = trial(
            job, config, {**known, **models}, sampled.labels, Compositions(job, cameras, changed)
        )
        models = step(models, measured, confidence)
    return dict(sorted({**known, **models}.items()))


def _some(cameras: Sequence[Camera], most: int) -> list[Camera]:
    """Up to `most` of them, evenly."""
    rows = np.unique(np.linspace(0, len(cameras) - 1, min(most, len(cameras))).round().astype(int))
    return [cameras[row] for row in rows]


def _columns(sampled: SampledFidelity, labels: Sequence[int]) -> SampledFidelity:
    """The samples of some categories, ascending."""
    rows = [sampled.labels.index(label) for label in labels]
    return replace(
        sampled, labels=tuple(labels), fidelity=sampled.fidelity[:, rows], pixels=sampled.pixels[:, rows],
        distance=sampled.distance[:, rows],
    )  # fmt: skip
