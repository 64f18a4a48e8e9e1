"""Which level of each category meets a target at the least Gaussians (Eq. 1 of the paper); plan.json."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from sagesplat.adapt.allocate import choose
from sagesplat.adapt.eq3 import SsimModel
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.core.errors import RunError
from sagesplat.core.gaussians import BYTES_PER_GAUSSIAN
from sagesplat.core.limits import Count, LabelId, NotNegative, NumberOrNaN, Share, StepNumber
from sagesplat.io.files import write_json
from sagesplat.io.typed import read_json_as

Models = Mapping[tuple[int, int], SsimModel]  # by (label id, level)
Counts = Mapping[tuple[int, int], int]  # Gaussians of each (label id, level)

_UNITS = {"gpu-bytes": "bytes of GPU memory", "count": "Gaussians"}
_CURE = "delete it and run `sagesplat plan` again"
Status = Literal[
    "ok",  # the level is predicted, or measured, to reach the target
    "infeasible",  # no level is; this is the best attainable
    "no promise",  # too far from all that was sampled, or too little known: the highest level
    "no model",  # nothing is known of the category: the highest level
]


@dataclass(frozen=True)
class Reached:
    """The share of viewpoints that measure a target, with its Clopper-Pearson interval at 95 %."""

    share: Share
    low: Share
    high: Share
    num_views: Count

    def __post_init__(self) -> None:
        if not self.low <= self.share <= self.high:
            raise ValueError("an impossible share of views")


@dataclass(frozen=True)
class Choice:
    """The level of one category."""

    label_id: LabelId
    level: StepNumber  # of snapshots the training step, of nested levels 1 to K
    predicted: NumberOrNaN  # quality; in a scene of at least `share` of the views; NaN: nothing promised
    distance: NumberOrNaN  # of the view, world units; NaN in a scene and where unknown
    count: Count  # Gaussians
    status: Status
    transfer_bytes: Count | None = None  # of its increments; None for snapshots
    calibrated: bool | None = None  # whether the promise is proven; None: no bound, a mere prediction
    reached: Reached | None = None  # of a scene's plan: views that measure the target at this level

    @property
    def nbytes(self) -> int:
        """Bytes as the paper counts model size: 248 a Gaussian."""
        return self.count * BYTES_PER_GAUSSIAN

    @property
    def verdict(self) -> str:
        """The status for people, with what is missing to a proof."""
        return f"{self.status}, uncalibrated" if self.calibrated is False else self.status


@dataclass(frozen=True)
class Plan:
    """One level per category, for one view or for a whole scene."""

    target: NumberOrNaN  # quality that every category is to reach; NaN for a plan within a budget
    view: Count | None  # row in Scene.views; None = the scene
    choices: tuple[Choice, ...]  # ordered by label id
    share: Share | None = None  # of the views that must reach the target; None for one view
    budget: NotNegative | None = None  # what the composition may cost, in `unit`
    unit: str | None = None  # bytes, gpu-bytes or count
    fits: bool = True  # whether it keeps the budget
    quality: QualityKind = "ssim"  # of which it is the target

    @property
    def levels(self) -> dict[int, int]:
        """Level by label id."""
        return {choice.label_id: choice.level for choice in self.choices}

    @property
    def count(self) -> int:
        """Gaussians of the composition."""
        return sum(choice.count for choice in self.choices)

    @property
    def nbytes(self) -> int:
        """Bytes of the composition as the paper counts model size."""
        return sum(choice.nbytes for choice in self.choices)

    @property
    def transfer_bytes(self) -> int | None:
        """Bytes of the increments to send; None for snapshots."""
        sizes = [choice.transfer_bytes for choice in self.choices]
        return None if None in sizes else sum(size for size in sizes if size is not None)

    @property
    def status(self) -> str:
        """The worst of its choices: "infeasible", "no promise" or "ok"; or "over budget"."""
        if not self.fits:
            return "over budget"
        if self.infeasible:
            return "infeasible"
        return "no promise" if any(c.status == "no promise" for c in self.choices) else "ok"

    @property
    def calibrated(self) -> bool:
        """Whether no promise in it lacks its proof."""
        return all(choice.calibrated is not False for choice in self.choices)

    @property
    def verdict(self) -> str:
        """The status for people, with what is missing to a proof."""
        return self.status if self.calibrated else f"{self.status}, uncalibrated"

    @property
    def asked(self) -> str:
        """What it was made for, for people: "fidelity 0.95"."""
        if self.budget is not None:
            unit = self.unit or "bytes"
            return f"budget {self.budget:,.0f} {_UNITS.get(unit, unit)}"
        return f"{quality_title(self.quality)} {self.target:g}"

    @property
    def infeasible(self) -> list[int]:
        """The categories for which no level reaches the target."""
        return [c.label_id for c in self.choices if c.status == "infeasible"]

    @property
    def binding(self) -> int | None:
        """The category whose prediction is lowest against the target; None without any model."""
        predicted = [c for c in self.choices if not math.isnan(c.predicted)]
        return min(predicted, key=lambda c: c.predicted).label_id if predicted else None


def quality_title(quality: QualityKind) -> str:
    """A quality as people call it."""
    return {"fidelity": "fidelity", "ssim": "SSIM"}[quality]


def plan_view(
    models: Models,
    counts: Counts,
    distances: Mapping[int, float],
    target: float,
    view: int | None,
    *,
    recovering: Collection[int] = (),
) -> Plan:
    """Choose the cheapest level of each category that is predicted to reach a target in one view (Eq. 1).

        level = argmin count(level) subject to SSIM(level, distance) >= target, for each category by itself

    Where no level reaches the target, the one with the best prediction is taken, with status "infeasible".

    Args:
        models: Eq. 3 by (label id, level).
        counts: Gaussians by (label id, level).
        distances: d_min by label id, world units. A category that is missing, or NaN, is predicted by its
            median.
        target: SSIM, above 0 and at most 1.
        view: Row in `Scene.views`, for the record; None: no view of the scene.
        recovering: Levels recorded just after an opacity reset: taken only where there is no other.

    Returns:
        One choice per category of `counts`.

    Raises:
        RunError: For an impossible target.

    Example:
        >>> from sagesplat.adapt.eq3 import Eq3, SsimModel
        >>> from sagesplat.adapt.plan import plan_view
        >>> def model(level, k):  # SSIM k at distance 0, falling by exp(-0.1 d)
        ...     curve = Eq3(k, 0.1, 0.0, 1.0, k, 0.1, 0.0, 1.0, 0.0)
        ...     return SsimModel(3, level, curve, (0.0, 10.0), k, 0.0, 9, "one regime")
        >>> models, counts = {(3, 1): model(1, 0.7), (3, 2): model(2, 0.95)}, {(3, 1): 100, (3, 2): 900}
        >>> plan_view(models, counts, {3: 1.0}, 0.6, None).levels
        {3: 1}
        >>> plan_view(models, counts, {3: 1.0}, 0.8, None).levels
        {3: 2}
    """
    check_target(target)
    choices = []
    for label_id, levels in _eligible(models, counts, recovering).items():
        distance = float(distances.get(label_id, math.nan))
        choices.append(_choose(models, label_id, levels, np.array([distance]), target, 1.0, distance))
    return Plan(float(target), view, tuple(choices))


def plan_scene(
    models: Models,
    counts: Counts,
    distances: Mapping[int, np.ndarray],
    target: float,
    share: float = 0.95,
    *,
    recovering: Collection[int] = (),
) -> Plan:
    """Choose the cheapest level of each category that reaches a target in a share of the views (Eq. 1).

    Where no level does, the one that reaches it in most views is taken, then the best on average, with status
    "infeasible". Other arguments and errors are those of `plan_view`.

    Args:
        models: Eq. 3 by (label id, level).
        counts: Gaussians by (label id, level).
        distances: By label id, d_min in each view that shows the category, [V] in world units.
        target: SSIM, above 0 and at most 1.
        share: Of the views, above 0 and at most 1.
        recovering: See `plan_view`.

    Returns:
        One choice per category of `counts`.
    """
    check_target(target)
    check_share(share)
    choices = []
    for label_id, levels in _eligible(models, counts, recovering).items():
        known = np.asarray(distances.get(label_id, ()), np.float64)
        views = known if len(known) else np.array([math.nan])
        choices.append(_choose(models, label_id, levels, views, target, share, math.nan))
    return Plan(float(target), None, tuple(choices), float(share))


def _eligible(models: Models, counts: Counts, recovering: Collection[int]) -> dict[int, dict[int, int]]:
    """Per label id, ascending, the counts of the levels to choose from."""
    eligible: dict[int, dict[int, int]] = {}
    for label_id in sorted({label_id for label_id, _ in counts}):
        levels = {level: count for (label, level), count in counts.items() if label == label_id}
        modelled = {level: count for level, count in levels.items() if (label_id, level) in models} or levels
        not_recovering = {level: count for level, count in modelled.items() if level not in recovering}
        eligible[label_id] = not_recovering or modelled
    return eligible


def _choose(
    models: Models,
    label_id: int,
    levels: dict[int, int],
    distances: np.ndarray,  # [V], NaN = unknown
    target: float,
    share: float,
    distance: float,  # for the record
) -> Choice:
    """The level of one category; `levels` maps each candidate to its count."""
    last = max(levels)
    if (label_id, last) not in models:  # never seen: nothing is predicted, nothing is left out
        return Choice(label_id, last, math.nan, distance, levels[last], "no model")
    steps = sorted(levels)
    counts = np.array([levels[step] for step in steps])
    ssim = np.stack([models[label_id, step](distances) for step in steps])
    needed = max(1, math.ceil(share * len(distances) - 1e-9))
    predicted = np.sort(ssim, 1)[:, -needed]  # what the best `needed` views reach
    most_views = (ssim >= target).sum(1), ssim.mean(1)
    found, met = choose_snapshot(predicted, counts, target, most_views)
    at = int(found)
    status = "ok" if met else "infeasible"
    return Choice(label_id, steps[at], float(predicted[at]), distance, int(counts[at]), status)


def choose_snapshot(
    ssim: Float[np.ndarray, "... K"],
    counts: Int[np.ndarray, " K"],
    target: float,
    otherwise: Sequence[Float[np.ndarray, "... K"] | Int[np.ndarray, "... K"]] = (),
) -> tuple[Int[np.ndarray, "..."], Bool[np.ndarray, "..."]]:
    """`allocate.choose` for K snapshots in order of their steps: of equal ones the latest."""
    found, met = choose(ssim[..., ::-1], counts[::-1], target, [key[..., ::-1] for key in otherwise])
    return np.asarray(len(counts) - 1 - found), met  # [] too: numpy makes a number of that


def check_target(target: float, quality: QualityKind = "ssim") -> None:
    """RunError for a quality that no plan can have as its target."""
    _check(f"target {quality_title(quality)}", target)


def check_share(share: float) -> None:
    """RunError for an impossible share of views."""
    _check("share of views", share)


def _check(name: str, value: float) -> None:
    if not (math.isfinite(value) and 0 < value <= 1):
        raise RunError(f"{name} {value} is impossible; choose a number above 0 and at most 1, such as 0.9")


def write_plans(
    path: Path, scene_plans: Sequence[Plan], view_plans: Sequence[Plan] = (), budget_plan: Plan | None = None
) -> None:
    """plan.json: the plans of the scene (one or more targets), those of single views, one for a budget."""
    document = {
        "targets": sorted({plan.target for plan in (*scene_plans, *view_plans)}),
        "scene": [_to_json(plan) for plan in scene_plans],
        "views": [_to_json(plan) for plan in view_plans],
    }
    if budget_plan:
        document["budget"] = _to_json(budget_plan)
    write_json(path, document)


@dataclass(frozen=True)
class _Plans:
    scene: tuple[Plan, ...]
    views: tuple[Plan, ...]
    budget: Plan | None = None


def read_plans(path: Path | str) -> tuple[tuple[Plan, ...], tuple[Plan, ...]]:
    """The scene's plans and the single views' that `write_plans` wrote; DataError for unusable content."""
    plans = _read(Path(path))
    return plans.scene, plans.views


def read_budget_plan(path: Path) -> Plan | None:
    """The plan for a budget, if there is one; DataError for unusable content."""
    return _read(path).budget


def _read(path: Path) -> _Plans:
    return read_json_as(path, _Plans, "a file of plans", _CURE)


def _to_json(plan: Plan) -> dict[str, Any]:
    """A plan with its totals; NaN becomes null, which JSON has."""
    choices = [
        {name: None if value != value else value for name, value in asdict(choice).items()}
        | {"nbytes": choice.nbytes}
        for choice in plan.choices
    ]
    own = {f.name: getattr(plan, f.name) for f in fields(plan) if f.name != "choices"}
    own["target"] = None if math.isnan(plan.target) else plan.target
    totals = {n: getattr(plan, n) for n in ("count", "nbytes", "transfer_bytes", "status", "binding")}
    return {**own, **totals, "choices": choices}
