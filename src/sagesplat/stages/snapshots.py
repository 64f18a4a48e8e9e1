"""The paper's method (`Method`): snapshots of the training as levels, Eq. 3 over distance, Eq. 1."""

from functools import cached_property
from typing import ClassVar

import numpy as np

from sagesplat.adapt.eq1 import plan_scene, plan_view
from sagesplat.adapt.plan import Plan
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.core.config import PlanConfig
from sagesplat.core.errors import RunError
from sagesplat.run.job import Job
from sagesplat.scene.scene import Camera
from sagesplat.stages.method import Curves, Method
from sagesplat.stages.results import models_of
from sagesplat.stages.shared import distances_from, observed


class Snapshots(Method):
    """The paper's: snapshots of the training, Eq. 3 over distance, the fewest Gaussians (Eq. 1)."""

    default_target: ClassVar[dict[str, float]] = {"target_ssim": 0.8}
    has_fidelity = has_instances = streams = False
    fit_settings = ()

    def __init__(self, job: Job) -> None:
        self.job = job
        self.level_files, self.model_files = [job.run.levels], [job.run.models]
        self.files = [*self.level_files, *self.model_files]

    @cached_property
    def _models(self) -> Curves:
        return models_of(self.job)

    @cached_property
    def _distances(self) -> dict[int, np.ndarray]:
        return self.job.distances(self.job.fit_config.distance)

    @cached_property
    def _training_distances(self) -> dict[int, np.ndarray]:
        """Of the training views that show enough of a category, by label id."""
        table = observed(self.job)
        last = table.level == self.job.ladder.levels[-1]  # a row for each view, whatever its level measures
        seen = table.select(last & np.isin(table.view, self.job.scene.train_ids))
        return {label: seen.distance[seen.label_id == label] for label, _ in self.job.ladder.counts}

    def check(self, config: PlanConfig) -> None:
        """See `Method`."""
        if config.budget:
            self.plan_budget(config)

    def predicted(self, plan: Plan, label_id: int, row: int) -> float:
        """See `Method`."""
        model = self._models.get((label_id, plan.levels[label_id]))
        return model(self._distance(label_id, row)) if model else np.nan

    def _distance(self, label_id: int, row: int) -> float:
        return float(self._distances[label_id][row]) if label_id in self._distances else np.nan

    def plan_view(self, row: int, target: float, quality: QualityKind = "ssim") -> Plan:
        """See `Method`."""
        ladder = self.job.ladder
        here = {label: self._distance(label, row) for label in self._distances}
        return plan_view(self._models, ladder.counts, here, target, row, recovering=ladder.recovering)

    def plan_camera(self, camera: Camera, target: float, quality: QualityKind) -> Plan:
        """See `Method`."""
        ladder = self.job.ladder
        near = {label: float(np.float64(d[0])) for label, d in distances_from(self.job, camera).items()}
        return plan_view(self._models, ladder.counts, near, target, None, recovering=ladder.recovering)

    def plan_scene(self, target: float, share: float, quality: QualityKind = "ssim") -> Plan:
        """See `Method`."""
        ladder, far = self.job.ladder, self._training_distances
        return plan_scene(self._models, ladder.counts, far, target, share, recovering=ladder.recovering)

    def plan_budget(self, config: PlanConfig) -> Plan:
        """See `Method`."""
        raise RunError("--budget needs the nested ladder; use --ladder nested")

    def amount(self, plan: Plan) -> str:
        """See `Method`."""
        full = self.job.ladder.size(self.job.ladder.levels[-1])
        return f"{plan.count:,} of {full:,} Gaussians"
