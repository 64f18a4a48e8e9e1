"""What training reports: a stream of these events."""

from dataclasses import dataclass, field
from pathlib import Path

from sagesplat.core.gaussians import Gaussians
from sagesplat.train.view_parameters import ViewParameters


@dataclass(frozen=True)
class Resumed:
    """Training resumes from a checkpoint."""

    step: int
    damage: str = ""  # what was wrong with the newest checkpoint, where the one before it is used


@dataclass(frozen=True)
class Found:
    """Something about the photos that decides how they are trained on, in words."""

    text: str


@dataclass(frozen=True)
class Step:
    """One optimiser step was taken."""

    step: int
    loss: float
    num_gaussians: int
    drawn: float = 1.0  # share of the tiles that this process rendered


@dataclass(frozen=True)
class LevelSaved:
    """A level was recorded (`path` is None where nothing is written)."""

    step: int
    path: Path | None
    counts: dict[int, int]  # Gaussians by label id
    recovering: bool


@dataclass(frozen=True)
class LabelFrozen:
    """A category has reached the target quality and no longer changes."""

    step: int
    label_id: int
    ssim: float  # mean over the training views measured
    count: int  # its Gaussians


@dataclass(frozen=True)
class Trained:
    """The end."""

    gaussians: Gaussians
    step: int
    frozen: dict[int, int]  # label id -> step from which on the category did not change
    per_view: dict[str, ViewParameters] = field(default_factory=dict)  # what was refined


Event = Resumed | Found | Step | LevelSaved | LabelFrozen | Trained
