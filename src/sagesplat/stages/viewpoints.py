"""Makes the models of SSIM against photos of nested levels, from the observations and from compositions."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from sagesplat.adapt.bound_plans import Costs, plan_for_view, quality_at
from sagesplat.adapt.calibrate_photos import TARGETS
from sagesplat.adapt.eq3 import SsimModel
from sagesplat.adapt.ladder import NestedLadder
from sagesplat.adapt.observe import Observations, as_unit, erode, measure
from sagesplat.adapt.photo_models import calibrated, fit_photos, in_composition
from sagesplat.adapt.seen import seen_from
from sagesplat.adapt.viewpoint import ViewModel
from sagesplat.core.config import FitConfig
from sagesplat.core.events import Progress
from sagesplat.metrics.image import tiles_around
from sagesplat.raster import Workspace, device_of, each_view
from sagesplat.run.executor import split
from sagesplat.run.job import Job
from sagesplat.run.remote import work_all
from sagesplat.segment.masks import UNLABELLED
from sagesplat.train.early_stopping import VIEWS, spread

_MEASURED = np.flatnonzero(TARGETS >= 0.499)  # of TARGETS, those that compositions are planned for

_Planned = tuple[int, list[tuple[list[int], dict[int, int]]]]  # row; compositions: targets, level by label id


def fit_viewpoints(
    job: Job,
    costs: Costs,
    table: Observations,
    config: FitConfig,
    curves: Mapping[tuple[int, int], SsimModel],
    known: Mapping[int, ViewModel] = MappingProxyType({}),
) -> dict[int, ViewModel]:
    """A model of SSIM against photos of every category but the unlabelled pixels, which stay in full.

    `costs`: of the nested levels; `table`: observations of views that show enough of a category; `curves`:
    Eq. 3 of them. Observations have all categories at the same level. What a category gains or loses in
    composition, beside others at other levels, is measured on compositions planned for the calibration views
    (some training views where there are none), by models that are calibrated without.

    `known`: models of categories that are not fitted; they are returned as they are.
    """
    table = table.select(~np.isin(table.label_id, [UNLABELLED, *known]))
    fits = fit_photos(table, job.scene, curves)
    far = job.distances(config.distance)
    cameras = [view.camera for view in job.scene.views]
    quality = quality_at(costs, {**known, **calibrated(fits, config.confidence)}, far, cameras)
    planned: list[_Planned] = []
    for row in job.scene.calibration_ids.tolist() or spread(job.scene.train_ids.tolist(), VIEWS):
        compositions: dict[tuple, list[int]] = {}
        for number in _MEASURED.tolist():
            plan = plan_for_view(quality, costs, float(TARGETS[number]), row)
            compositions.setdefault(tuple(plan.levels.items()), []).append(number)
        planned.append((row, [(targets, dict(levels)) for levels, targets in compositions.items()]))
    wanted = sorted(set(table.label_id.tolist())) if known else None
    parts = [(some, wanted) for some in split(planned, job.pieces)]
    measured = [one for some in work_all(job, "fit", _measure_compositions, parts) for one in some]
    found = calibrated(in_composition(fits, _changes(table, measured)), config.confidence)
    return dict(sorted({**known, **found}.items()))


def _changes(
    table: Observations, measured: Sequence[tuple[int, int, int, list[int], float]]
) -> dict[int, dict[int, np.ndarray]]:
    """By label id and row, SSIM in the composition of each of TARGETS less that of the level by itself."""
    keys = zip(table.label_id.tolist(), table.level.tolist(), table.view.tolist(), strict=True)
    alone = dict(zip(keys, table.ssim.tolist(), strict=True))
    found: dict[int, dict[int, np.ndarray]] = {}
    for label, level, row, targets, ssim in measured:
        if (label, level, row) in alone:
            change = found.setdefault(label, {}).setdefault(row, np.full(len(TARGETS), np.nan))
            change[targets] = ssim - alone[label, level, row]
    return found


def _measure_compositions(
    job: Job, part: tuple[Sequence[_Planned], Sequence[int] | None]
) -> list[tuple[int, int, int, list[int], float]]:
    """(label id, its level, row, numbers of targets, SSIM) of compositions in some views.

    Of the categories that are wanted (ids), by rendering the parts of images that show them; None: of all.
    """
    planned, wanted = part
    ladder = job.ladder
    assert isinstance(ladder, NestedLadder)
    masks, workspace = job.level_masks, Workspace()

    def in_view(of_view: _Planned) -> list[tuple[int, int, int, list[int], float]]:
        row, compositions = of_view
        view, rows = job.scene.views[row], []
        tiles = None if wanted is None else tiles_around(np.isin(masks[view], wanted))
        if tiles is not None and not tiles.any():
            return rows
        seen = seen_from(
            ladder.cells, view.camera,
            backend=job.backend, antialiased=job.antialiased, workspace=workspace, tile_mask=tiles,
        )  # fmt: skip
        inner, photo = erode(masks[view]), as_unit(job.photos[row])
        for targets, levels in compositions:
            image = seen.render(ladder.of_cells(levels))
            found = measure(image, photo, masks[view], inner, job.valid[view], tiles)
            rows += [
                (label, levels.get(label, -1), row, targets, values["ssim"])
                for label, values in found.items()
                if wanted is None or label in wanted
            ]
        return rows

    rows = []
    for done, found in enumerate(each_view(in_view, planned, device_of(job.backend)), 1):
        rows += found
        job.emit(Progress("fit", done, len(planned)))
    return rows
