"""How a scene is adapted, as one protocol: nested levels (`methods.py`) or the paper's (`snapshots.py`)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Protocol

from sagesplat.adapt.coverage import Decisions
from sagesplat.adapt.eq3 import SsimModel
from sagesplat.adapt.observe import LabelImages, Observations
from sagesplat.adapt.plan import Plan
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.core.config import FitConfig, PlanConfig
from sagesplat.run.job import Job
from sagesplat.scene.scene import Camera

Curves = Mapping[tuple[int, int], SsimModel]  # Eq. 3 by (label id, level)


class Method(Protocol):
    """Levels of a run, what predicts their SSIM, and what they cost. The levels themselves: `Job.ladder`."""

    default_target: ClassVar[dict[str, float]]  # of `PlanConfig`, where none is given
    has_fidelity: ClassVar[bool]  # whether levels are compared with the full model too
    has_instances: ClassVar[bool]  # whether instances can be categories of their own
    streams: ClassVar[bool]  # whether a viewer can load the levels
    level_files: Sequence[Path]  # what the levels are read from
    sample_files: Sequence[Path] = ()  # what `sample` leaves
    model_files: Sequence[Path]  # what `fit` leaves
    files: Sequence[Path]  # what a plan, and all that is made from it, depends on
    fit_settings: tuple[str, ...]  # fields of FitConfig that the models depend on

    def __init__(self, job: Job) -> None: ...

    def fit(self, table: Observations, config: FitConfig, curves: Curves) -> list[str]:
        """Fit what there is beside Eq. 3; `table`: of views that show enough of a category."""
        return []

    def check(self, config: PlanConfig) -> None:
        """RunError for a plan that cannot be made of these levels."""

    def predicted(self, plan: Plan, label_id: int, row: int) -> float:
        """Quality that a plan counts on in a view (row of Scene.views); NaN where nothing is promised."""
        ...

    def plan_view(self, row: int, target: float, quality: QualityKind = "ssim") -> Plan:
        """The cheapest levels predicted to reach `target` in a view, seen or not."""
        ...

    def plan_camera(self, camera: Camera, target: float, quality: QualityKind) -> Plan:
        """The same from any camera."""
        ...

    def plan_scene(self, target: float, share: float, quality: QualityKind = "ssim") -> Plan:
        """The cheapest levels that reach `target` in a `share` of the viewpoints."""
        ...

    def plan_scenes(self, targets: Sequence[tuple[QualityKind, float]], share: float) -> list[Plan]:
        """Plans of the scene for several targets, checked in their compositions where that is possible."""
        return [self.plan_scene(target, share, quality) for quality, target in targets]

    def plan_budget(self, config: PlanConfig) -> Plan:
        """The levels of most expected quality within the budget."""
        ...

    def amount(self, plan: Plan) -> str:
        """What a plan takes of all there is, for people."""
        ...

    @property
    def bytes_to_send(self) -> dict[tuple[int, int], int] | None:
        """Bytes of each (label id, level); None where the levels are not encoded."""
        return None

    def unseen_labels(self) -> LabelImages | None:
        """The label images of test views; None: as the Gaussians paint them, as the paper has no others."""
        return None

    def coverage(self, targets: Sequence[float]) -> Decisions | None:
        """How decisions by a lower confidence bound fare on test views; None without such a bound."""
        return None
