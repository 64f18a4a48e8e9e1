"""Makes the fidelity models of nested levels, from drawn viewpoints; compositions calibrate them."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from sagesplat.adapt.bound_plans import Costs
from sagesplat.adapt.calibrate_fidelity import (
    NOMINAL,
    NOTHING_HELD,
    Trial,
    calibrated,
    hold_all_categories,
    plan_nominal,
    remove_composition_bias,
    trial_of,
)
from sagesplat.adapt.cell_models import FidelityModel, expect
from sagesplat.adapt.cells import Cells
from sagesplat.adapt.fidelity import measure_compositions, pooled_cells, shown_enough
from sagesplat.adapt.fidelity_models import fit_fidelity
from sagesplat.adapt.viewpoints import capture_cameras
from sagesplat.core.config import FitConfig
from sagesplat.core.events import Progress
from sagesplat.formats.increments import totals
from sagesplat.run.executor import split
from sagesplat.run.job import Job
from sagesplat.run.remote import work_all
from sagesplat.scene.scene import Camera
from sagesplat.segment.masks import UNLABELLED
from sagesplat.stages.results import cells_of, increments_of, sampled_of, viewpoints_of

_ROUNDS = 2  # after one, categories whose neighbours moved much would seem to be beyond help; one has none


def fit_drawn(job: Job, config: FitConfig) -> dict[int, FidelityModel]:
    """Models of fidelity by label id, calibrated at viewpoints that nothing was fitted to."""
    drawn, sampled, confidence = viewpoints_of(job), sampled_of(job), config.confidence
    cells = cells_of(job)
    fit = [drawn.cameras[row] for row in drawn.rows("fit")]
    bias, calibration = (
        Compositions(job, [drawn.cameras[row] for row in drawn.rows(name)])
        for name in ("bias", "calibration")
    )
    models = fit_fidelity(
        sampled,
        cells,
        fit,
        job.scene.scale,
        confidence,
        drawn.focal,
        drawn.rule.screens,
        capture_cameras(job.scene),
    )
    models.pop(UNLABELLED, None)  # has no target and stays in full
    held = NOTHING_HELD
    alone = len(np.unique(job.cells.labels)) == 1
    for _ in range(1 if alone else _ROUNDS):
        models = remove_composition_bias(models, trial(models, cells, bias), confidence)
    if not alone:
        models, held = hold_all_categories(models, trial(models, cells, bias), confidence)
    for _ in range(_ROUNDS):  # what calibration moved moves the neighbours
        models = calibrated(models, trial(models, cells, calibration), confidence, held)
    return models


def trial(models: Mapping[int, FidelityModel], cells: Cells, compositions: "Compositions") -> Trial:
    """Compositions planned with the models at viewpoints, measured."""
    job, cameras = compositions.job, compositions.cameras
    expected = expect(models, cells, cameras, len(job.ladder.levels))
    planned = plan_nominal(models, expected, cell_costs(job).transfer_bytes, NOMINAL)
    fidelity, pixels = compositions.measure(planned)
    shown = shown_enough(pixels, cameras)
    return trial_of(models, expected, planned, shown, fidelity[..., :-1])


def cell_costs(job: Job) -> Costs:
    """What the levels of each cell cost."""
    cells, increments, levels = job.cells.ids.tolist(), increments_of(job), len(job.ladder.levels)
    columns = (totals(increments, cells, levels, name) for name in ("count", "nbytes", "gpu_bytes"))
    return Costs(tuple(cells), *columns)


class Compositions:
    """Measures compositions of cells at viewpoints, none twice: rounds of calibration plan many again.

    `only`: ids of the cells that are wanted; what is measured of others is NaN. None: all.
    """

    def __init__(self, job: Job, cameras: Sequence[Camera], only: Collection[int] | None = None) -> None:
        self.job, self.cameras, self._only = job, cameras, only
        self._known: list[dict[tuple[int, ...], np.ndarray]] = [{} for _ in cameras]
        self._pixels = np.zeros((len(cameras), 0), np.int32)

    def measure(self, planned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `compositions_at`."""
        wanted = [list(map(tuple, of_view.tolist())) for of_view in planned]
        new = [sorted(set(some) - set(known)) for some, known in zip(wanted, self._known, strict=True)]
        rows = [row for row, some in enumerate(new) if some]
        if rows:
            most = max(len(new[row]) for row in rows)
            # what is asked for twice is measured once: filled up to one length
            asked = np.array([new[row] + new[row][:1] * (most - len(new[row])) for row in rows])
            cameras = [self.cameras[row] for row in rows]
            fidelity, pixels = compositions_at(self.job, cameras, asked, "fit", self._only)
            for row, values in zip(rows, fidelity, strict=True):
                self._known[row] |= dict(zip(new[row], values, strict=False))
            if not self._pixels.size:  # the first time all are new
                self._pixels = pixels
        found = [[known[one] for one in some] for known, some in zip(self._known, wanted, strict=True)]
        return np.array(found, np.float32) if found else np.zeros((*planned.shape[:2], 0)), self._pixels


def compositions_at(
    job: Job,
    cameras: Sequence[Camera],
    planned: np.ndarray,
    stage: str,
    only: Collection[int] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Fidelity [V, J, L + 1] of compositions of cells (levels [V, J, C]), and pixels of categories [V, L].

    The last column is the whole image, NaN where not all cells are wanted.

    It is divided among all who compute. `only`: ids of the cells that are measured; None: all.
    """
    rows = split(range(len(cameras)), job.pieces)
    parts = [([cameras[row] for row in some], planned[list(some)], stage, only) for some in rows]
    found = work_all(job, stage, _measure_some, parts)
    fidelity, pixels = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    member = job.cells.labels[:, None] == np.unique(job.cells.labels)
    of_labels = pooled_cells(fidelity[..., :-1], pixels, member)
    return np.concatenate([of_labels, fidelity[..., -1:]], 2), (pixels @ member).astype(np.int32)


def _measure_some(
    job: Job, part: tuple[Sequence[Camera], np.ndarray, str, Collection[int] | None]
) -> tuple[np.ndarray, np.ndarray]:
    cameras, planned, stage, only = part
    return measure_compositions(
        job.by_cell, cameras, planned, only=only, full=job.came_in, backend=job.backend,
        antialiased=job.antialiased,
        progress=lambda done, total: job.emit(Progress(stage, done, total)),
        references=job.references if only is None else None,
    )  # fmt: skip
