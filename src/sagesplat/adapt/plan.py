"""Plans: the level of each category, with what it costs and whether it meets the target."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from sagesplat.adapt.eq3 import SsimModel
from sagesplat.adapt.ladder import Ladder, NestedLadder
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.core.errors import RunError
from sagesplat.core.gaussians import BYTES_PER_GAUSSIAN, Gaussians
from sagesplat.core.limits import Count, LabelId, NotNegative, NumberOrNaN, Share, StepNumber
from sagesplat.core.text_table import aligned

Models = Mapping[tuple[int, int], SsimModel]  # by (label id, level)
Counts = Mapping[tuple[int, int], int]  # Gaussians of each (label id, level)

_UNITS = {"gpu-bytes": "bytes of GPU memory", "count": "Gaussians"}
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
    """The level of one category; where its cells have levels of their own, the highest of these."""

    label_id: LabelId
    level: StepNumber  # of recorded levels the training step, of nested ones 1 to K
    predicted: NumberOrNaN  # quality; in a scene of at least `share` of the views; NaN: nothing promised
    distance: NumberOrNaN  # of the view, world units; NaN in a scene and where unknown
    count: Count  # Gaussians
    status: Status
    transfer_bytes: Count | None = None  # of its increments; None for recorded levels
    calibrated: bool | None = None  # whether the promise is proven; None: no bound, a mere prediction
    reached: Reached | None = None  # of a scene's plan: views that measure the target at this level

    @property
    def nbytes(self) -> int:
        """Bytes as the paper counts model size: 248 a Gaussian."""
        return self.count * BYTES_PER_GAUSSIAN

    @property
    def sizes(self) -> tuple[str, str]:
        """Megabytes, to send where increments are, and Gaussians, for people."""
        return _sizes(self.nbytes if self.transfer_bytes is None else self.transfer_bytes, self.count)

    @property
    def promised(self) -> str:
        """What is predicted of the quality, for people: a dash where nothing is."""
        return "–" if math.isnan(self.predicted) else f"{self.predicted:.3f}"

    @property
    def verdict(self) -> str:
        """The status for people, with what is missing to a proof."""
        return f"{self.status}, uncalibrated" if self.calibrated is False else self.status


@dataclass(frozen=True)
class Plan:
    """One level per category, for one view or for a whole scene; `print` lists the categories."""

    target: NumberOrNaN  # quality that every category is to reach; NaN for a plan within a budget
    view: Count | None  # row in Scene.views; None = the scene
    choices: tuple[Choice, ...]  # ordered by label id
    share: Share | None = None  # of the views that must reach the target; None for one view
    budget: NotNegative | None = None  # what the composition may cost, in `unit`
    unit: str | None = None  # bytes, gpu-bytes or count
    fits: bool = True  # whether it keeps the budget
    quality: QualityKind = "ssim"  # of which it is the target
    cells: dict[int, int] | None = None  # level by cell id; None: that of the category
    titles: Mapping[int, str] = field(default_factory=dict, compare=False)  # names for people, where known

    def __repr__(self) -> str:
        megabytes, count = self.sizes
        return f"<Plan for {self.asked}: {megabytes} MB, {count} Gaussians, {self.verdict}>"

    def __str__(self) -> str:
        megabytes, count = self.sizes
        rows = [
            (
                self.titles.get(c.label_id, f"category {c.label_id}"), str(c.level), *c.sizes, c.promised,
                c.verdict,
            )
            for c in self.choices
        ]  # fmt: skip
        rows.append(("all", "", megabytes, count, "", self.verdict))
        header = ("category", "level", "MB", "Gaussians", "predicted", "status")
        return f"Plan for {self.asked}\n{aligned(header, rows, right=(1, 2, 3, 4))}"

    @property
    def levels(self) -> dict[int, int]:
        """Level by label id."""
        return {choice.label_id: choice.level for choice in self.choices}

    def levels_of_cells(self, label_of: Mapping[int, int]) -> dict[int, int]:
        """Level by cell id, of all cells; `label_of`: label id by cell id."""
        levels = self.levels
        return self.cells or {cell: levels[label] for cell, label in label_of.items()}

    def compose(self, ladder: Ladder) -> Gaussians:
        """The Gaussians of the ladder that it chose."""
        if self.cells is None:
            return ladder.compose(self.levels)
        assert isinstance(ladder, NestedLadder)
        return ladder.compose_cells(self.cells)

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
        """Bytes of the increments to send; None for recorded levels."""
        sizes = [choice.transfer_bytes for choice in self.choices]
        return None if None in sizes else sum(size for size in sizes if size is not None)

    @property
    def sizes(self) -> tuple[str, str]:
        """Megabytes, to send where increments are, and Gaussians, for people."""
        return _sizes(self.nbytes if self.transfer_bytes is None else self.transfer_bytes, self.count)

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


def _sizes(nbytes: int, count: int) -> tuple[str, str]:
    return f"{nbytes / 1e6:,.2f}", f"{count:,}"


def quality_title(quality: QualityKind) -> str:
    """A quality as people call it."""
    return {"fidelity": "fidelity", "ssim": "SSIM"}[quality]


def check_target(target: float, quality: QualityKind = "ssim") -> None:
    """RunError for a quality that no plan can have as its target."""
    _check(f"target {quality_title(quality)}", target)


def check_share(share: float) -> None:
    """RunError for an impossible share of views."""
    _check("share of views", share)


def _check(name: str, value: float) -> None:
    if not (math.isfinite(value) and 0 < value <= 1):
        raise RunError(f"{name} {value} is impossible; choose a number above 0 and at most 1, such as 0.9")
