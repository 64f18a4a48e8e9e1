"""Ours, and which method a run has: stages and studies ask `method_of`, and never which of the two it is."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from sagesplat.adapt.bound_plans import (
    Costs,
    Quality,
    by_label,
    plan_for_cells,
    plan_for_view,
    plan_within,
    pooled,
    quality_at,
    quality_of_cells,
)
from sagesplat.adapt.calibrate import fewest_views
from sagesplat.adapt.cell_models import Expected, FidelityModel, expect, promised, write_fidelity
from sagesplat.adapt.cells import Cells
from sagesplat.adapt.coverage import Decisions, score
from sagesplat.adapt.fidelity import shown_enough
from sagesplat.adapt.observe import LabelImages, Observations
from sagesplat.adapt.plan import Plan
from sagesplat.adapt.scene_cells import Search, thinned
from sagesplat.adapt.scene_plans import (
    measured_in_composition,
    never_dearer,
    plan_for_scene,
    raise_failing_levels,
)
from sagesplat.adapt.viewpoint import QualityKind, ViewModel, write_promises
from sagesplat.adapt.viewpoints import in_words
from sagesplat.core.config import FitConfig, LadderKind, PlanConfig
from sagesplat.core.errors import RunError
from sagesplat.formats.increments import INDEX
from sagesplat.run.job import Job
from sagesplat.scene.scene import Camera
from sagesplat.segment.masks import UNLABELLED
from sagesplat.stages.fidelity import cell_costs, compositions_at, fit_drawn
from sagesplat.stages.method import Curves, Method
from sagesplat.stages.results import (
    cells_of,
    fidelity_of,
    has_photos,
    promises_of,
    sampled_of,
    viewpoints_of,
)
from sagesplat.stages.shared import distances_from, label_named, observed
from sagesplat.stages.snapshots import Snapshots
from sagesplat.stages.viewpoints import fit_viewpoints

_RAISES = 6  # times that a plan is measured in its composition, and its failing levels raised
# At so many viewpoints at most: four plans of garden take 16 s with 128, and 12 s with 80 but 1 to 9 % more
# bytes; of dinosaur 18 and 12 s, and from 2 % fewer to 5 % more.
_VIEWPOINTS = 96


class NestedLevels(Method):
    """Ours: prefixes of one model, lower bounds of two qualities by viewpoint, the fewest bytes."""

    default_target: ClassVar[dict[str, float]] = {"target_fidelity": 0.95}
    has_fidelity = has_instances = streams = True
    fit_settings = ("confidence",)

    def __init__(self, job: Job) -> None:
        run = job.run
        self.job = job
        self.level_files = [run.prefixes, run.cells, run.increments / INDEX]
        self.sample_files = [run.viewpoints, run.sampled]
        self.model_files = [run.models, run.promises, run.fidelity]
        self.files = [*self.level_files, run.promises, run.fidelity, *self.sample_files]

    def check(self, config: PlanConfig) -> None:
        """See `Method`."""
        if config.target_ssim is not None and not has_photos(self.job.run):
            raise RunError(
                f"{self.job.run.path}: a splat without photos has no SSIM against photos; give "
                "--target-fidelity, or adopt it again with --cameras CAPTURE --force"
            )

    @cached_property
    def costs(self) -> Costs:
        """What the levels of categories cost."""
        return self.cell_costs.by_label(self.job.cells.label_of)

    @cached_property
    def cell_costs(self) -> Costs:
        """What the levels of cells cost."""
        return cell_costs(self.job)

    @cached_property
    def fidelity(self) -> dict[int, FidelityModel]:
        """Models of fidelity by label id."""
        return fidelity_of(self.job)

    @cached_property
    def promises(self) -> dict[int, ViewModel]:
        """Models of SSIM against photos by label id."""
        return promises_of(self.job)

    @cached_property
    def qualities(self) -> dict[QualityKind, Quality]:
        """What is predicted of the levels in every view of the scene."""
        job = self.job
        far = job.distances(job.fit_config.distance)
        cameras = [view.camera for view in job.scene.views]
        return {
            "fidelity": quality_of_cells(self.fidelity, self._expected),
            "ssim": quality_at(self.costs, self.promises, far, cameras, "ssim"),
        }

    @cached_property
    def _expected(self) -> Expected:
        """What every view of the scene is expected to see of the cells."""
        return self.expect([view.camera for view in self.job.scene.views])

    def expect(self, cameras: Sequence[Camera]) -> Expected:
        """What cameras are expected to see of the cells."""
        return expect(self.fidelity, self._cells, cameras, len(self.job.ladder.levels))

    @cached_property
    def _cells(self) -> Cells:
        return cells_of(self.job)

    @cached_property
    def shown(self) -> np.ndarray:
        """Pixels of each category in each view of the scene, float64 [V, L]; 0 for small shares."""
        return self._table(lambda rows: rows.num_pixels, self.job.ladder.levels[-1:], 0.0)[..., 0]

    @cached_property
    def sampled(self) -> tuple[np.ndarray, np.ndarray]:
        """Fidelity of each level and pixels of each category at the viewpoints that were drawn."""
        found = sampled_of(self.job).by_label(self.job.cells.label_of)
        at = {label: i for i, label in enumerate(found.labels)}
        rows = [-1 if label == UNLABELLED else at.get(label, -1) for label in self.costs.labels]
        # unlabelled pixels have no target, and stay in full
        known = (np.array(rows) >= 0) & found.shown()[:, rows]
        fidelity = np.where(known[..., None], found.fidelity[:, rows].astype(np.float64), np.nan)
        return fidelity, np.where(known, found.pixels[:, rows], 0).astype(np.float64)

    @cached_property
    def measured(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """SSIM against photos of training and calibration, pixels there, which of them training saw."""
        scene = self.job.scene
        rows = np.concatenate([scene.train_ids, scene.calibration_ids])
        ssim = self._table(lambda found: found.ssim, self.job.ladder.levels, np.nan)
        ssim[:, np.array(self.costs.labels) == UNLABELLED] = np.nan
        return ssim[rows], self.shown[rows], np.isin(rows, scene.train_ids)

    def _table(
        self, column: Callable[[Observations], np.ndarray], levels: Sequence[int], missing: float
    ) -> np.ndarray:
        """A column of the observations of views that show enough of a category, float64 [V, L, K]."""
        seen, labels = observed(self.job), np.array(self.costs.labels)
        seen = seen.select(np.isin(seen.label_id, labels) & np.isin(seen.level, levels))
        table = np.full((len(self.job.scene.views), len(labels), len(levels)), missing)
        at = np.searchsorted(labels, seen.label_id), np.searchsorted(levels, seen.level)
        table[seen.view, *at] = column(seen)
        return table

    def fit(self, table: Observations, config: FitConfig, curves: Curves) -> list[str]:
        """See `Method`."""
        run, lines = self.job.run, []
        against_photos = (
            fit_viewpoints(self.job, self.costs, table, config, curves) if has_photos(run) else {}
        )
        fidelity = fit_drawn(self.job, config)
        write_promises(run.promises, against_photos)
        write_fidelity(run.fidelity, fidelity)
        for name, models in (("SSIM against photos", against_photos), ("fidelity", fidelity)):
            statuses = [model.status for model in models.values()]
            if not statuses:
                continue  # without photos no SSIM against them
            lines.append(f"{name}: " + ", ".join(f"{statuses.count(s)} {s}" for s in sorted(set(statuses))))
        return [*lines, f"for {in_words(viewpoints_of(self.job))}"]

    def predicted(self, plan: Plan, label_id: int, row: int) -> float:
        """See `Method`."""
        column = self.costs.labels.index(label_id)
        if plan.cells is None or plan.quality == "ssim":
            return float(self.qualities[plan.quality].bound[row, column, plan.levels[label_id] - 1])
        here = self._expected.at(row)
        levels = np.array([[plan.cells[cell] for cell in here.cells.tolist()]])
        return float(promised(self.fidelity, here, here.of_composition(levels))[0, column])

    def plan_view(self, row: int, target: float, quality: QualityKind = "ssim") -> Plan:
        """See `Method`."""
        if quality == "ssim":
            return plan_for_view(self.qualities[quality], self.costs, target, row)
        return plan_for_cells(
            self.fidelity, self._expected, self.qualities[quality], self.cell_costs, target, row
        )

    def plan_camera(self, camera: Camera, target: float, quality: QualityKind) -> Plan:
        """See `Method`."""
        if quality == "ssim":
            far = distances_from(self.job, camera)
            found = quality_at(self.costs, self.promises, far, [camera], quality)
            return replace(plan_for_view(found, self.costs, target, 0), view=None)
        expected = self.expect([camera])
        found = quality_of_cells(self.fidelity, expected)
        plan = plan_for_cells(self.fidelity, expected, found, self.cell_costs, target, 0)
        return replace(plan, view=None)

    def planned_cells(self, expected: Expected, targets: Sequence[float]) -> np.ndarray:
        """Levels of the cells in the plans for fidelity at the viewpoints, [V, J, C]."""
        quality, costs = quality_of_cells(self.fidelity, expected), self.cell_costs
        plans = [
            [plan_for_cells(self.fidelity, expected, quality, costs, target, row) for target in targets]
            for row in range(len(expected.share))
        ]
        return np.array([[list((plan.cells or {}).values()) for plan in of_view] for of_view in plans])

    def plan_scene(self, target: float, share: float, quality: QualityKind = "ssim") -> Plan:
        """See `Method`."""
        if quality == "fidelity":
            return plan_for_scene(*self.sampled, self.costs, target, share, quality)
        ssim, pixels, trained = self.measured
        return plan_for_scene(ssim, pixels, self.costs, target, share, quality, trained)

    def plan_scenes(self, targets: Sequence[tuple[QualityKind, float]], share: float) -> list[Plan]:
        """See `Method`: those for fidelity are measured at drawn viewpoints, and raised."""
        plans = [self.plan_scene(target, share, quality) for quality, target in targets]
        drawn, mean_and_pixels = viewpoints_of(self.job), pooled(*self.sampled)
        cameras = [drawn.cameras[row] for row in drawn.rows("bias", "calibration")[:_VIEWPOINTS]]
        fewer = self._thinned(plans, share, cameras)
        plans = [fewer.get(i, plan) for i, plan in enumerate(plans)]
        open_ones = [i for i, plan in enumerate(plans) if plan.quality == "fidelity" and i not in fewer]
        for left in reversed(range(_RAISES + 1)):
            if not open_ones or not cameras:
                break
            measured = self._in_composition([plans[i] for i in open_ones], cameras)
            found = {
                i: raise_failing_levels(plans[i], measured[:, j], self.costs, *mean_and_pixels, last=not left)
                for j, i in enumerate(open_ones)
            }
            plans = [found[i][0] if i in found else plan for i, plan in enumerate(plans)]
            open_ones = [i for i in open_ones if not found[i][1]]
        return never_dearer(plans)

    def _thinned(self, plans: Sequence[Plan], share: float, cameras: Sequence[Camera]) -> dict[int, Plan]:
        """Plans for fidelity by cell, by their place: the cheapest that hold as composed, at `cameras`.

        What to ask of each category is searched (`scene_cells.Search`), of all at once.
        """
        job, found, label_of = self.job, dict[int, Plan](), self.job.cells.label_of
        if len(self.cell_costs.labels) == len(self.costs.labels) or len(cameras) < fewest_views(share):
            return found
        sampled = sampled_of(job)
        shown = sampled.by_label(label_of).shown()
        counted = shown[:, np.unique(job.cells.labels, return_inverse=True)[1]]
        pixels = np.where(counted, sampled.pixels, 0.0)
        searches = {
            i: Search(plan, self.costs)
            for i, plan in enumerate(plans)
            if plan.quality == "fidelity" and share < 1
        }
        least = dict.fromkeys(searches, math.inf)  # bytes of what holds
        while searches:
            tried = {
                i: thinned(plans[i], sampled.fidelity, pixels, self.cell_costs, label_of, search.asked)
                for i, search in searches.items()
            }
            # nothing is gained by a plan that takes as much as one that holds
            tried = {i: plan for i, plan in tried.items() if (plan.transfer_bytes or 0) < least[i]}
            searches = {i: searches[i] for i in tried}
            if not tried:
                break
            measured = self._in_composition(list(tried.values()), cameras)
            for j, (i, plan) in enumerate(tried.items()):
                plan, over = measured_in_composition(plan, measured[:, j], proven=False)
                held = min(over.values(), default=0.0) >= 0
                if held:
                    found[i], least[i] = plan, plan.transfer_bytes or 0
                if not searches[i].narrow(plan, over):
                    del searches[i]
        return found

    def _in_composition(self, plans: Sequence[Plan], cameras: Sequence[Camera]) -> np.ndarray:
        """Fidelity of each category in each plan's composition, [V, J, L]; NaN where it shows too little."""
        label_of = self.job.cells.label_of
        levels = np.array([list(plan.levels_of_cells(label_of).values()) for plan in plans])
        planned = np.broadcast_to(levels, (len(cameras), *levels.shape))
        fidelity, pixels = compositions_at(self.job, cameras, planned, "plan")
        shown = shown_enough(pixels, cameras)
        shown &= np.array(self.costs.labels) != UNLABELLED
        return np.where(shown[:, None], fidelity[..., :-1], np.nan).astype(np.float64)

    def plan_budget(self, config: PlanConfig) -> Plan:
        """See `Method`."""
        job, budget, unit = self.job, config.budget, config.budget_unit
        weights = {label_named(job, name): weight for name, weight in config.weights.items()}
        if config.quality == "ssim":
            train = job.scene.train_ids
            mean, pixels = pooled(self.qualities["ssim"].mean[train], self.shown[train])
            weight = pixels * [weights.get(label, 1.0) for label in self.costs.labels]
            return plan_within(mean, self.costs, budget, unit, weight, config.quality)
        found, label_of = sampled_of(job), job.cells.label_of
        known = found.pixels * (job.cells.labels != UNLABELLED)
        mean, pixels = pooled(found.fidelity.astype(np.float64), known.astype(np.float64))
        weight = pixels * [weights.get(label, 1.0) for label in job.cells.labels.tolist()]
        plan = plan_within(mean, self.cell_costs, budget, unit, weight, config.quality)
        return by_label(plan, label_of, pixels)

    def amount(self, plan: Plan) -> str:
        """See `Method`."""
        full = int(self.costs.transfer_bytes[:, -1].sum())
        return f"{(plan.transfer_bytes or 0) / 1e6:.2f} of {full / 1e6:.2f} MB, {plan.count:,} Gaussians"

    @property
    def bytes_to_send(self) -> dict[tuple[int, int], int]:
        """See `Method`."""
        sent = zip(self.costs.labels, self.costs.transfer_bytes.tolist(), strict=True)
        return {(label, level): n for label, row in sent for level, n in enumerate(row, 1)}

    def unseen_labels(self) -> LabelImages | None:
        """See `Method`: a promise is measured on the photo's own."""
        return self.job.level_masks

    def coverage(self, targets: Sequence[float]) -> Decisions | None:
        """See `Method`; every category at the same level, costs in transfer bytes."""
        job, costs = self.job, self.bytes_to_send
        return score(observed(job), job.scene, self.promises, costs, targets)


def method_for(ladder: LadderKind) -> type[Method]:
    """The method of a kind of levels."""
    return NestedLevels if ladder == "nested" else Snapshots


def method_of(job: Job) -> Method:
    """The method of the run's ladder."""
    return method_for(job.run.ladder)(job)
