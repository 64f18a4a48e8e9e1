"""What the report of a run is made from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, UInt8

from sagesplat.adapt.eq3 import SsimModel
from sagesplat.adapt.evaluate import Evaluation
from sagesplat.adapt.observe import Observations
from sagesplat.adapt.plan import Counts, Plan
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.core.gaussians import BYTES_PER_GAUSSIAN
from sagesplat.output.figures import Colours, Panel, Sizes
from sagesplat.output.next_steps import Commands, NextStep, next_steps
from sagesplat.output.place_figures import Place

Facts = Sequence[tuple[str, str]]


@dataclass(frozen=True)
class PromiseFacts:
    """What promises of fidelity were made from."""

    confidence: float
    fitted: int  # drawn viewpoints that the models were fitted to
    composed: int  # further ones, at which plans were composed and measured
    calibration: int  # further ones, at which they were calibrated
    conditions: str  # what screens and places they are for, in words


@dataclass(frozen=True, eq=False)
class Look:
    """A part of a view at the plan for a fidelity, or of the full model."""

    asked: float  # 1: the full model
    nbytes: int  # to send, of the whole scene
    fidelity: float  # that the whole view measures
    fidelity_of_part: float
    image: UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class ReportData:
    """Everything the page shows, wherever it comes from. Views are rows of `view_names`."""

    title: str
    target: float  # of the plan that the page leads with; one of `plans` has it
    names: Mapping[int, str]  # label id -> name
    colours: Colours  # label id -> RGB, 0..255
    observations: Observations
    train_views: np.ndarray
    test_views: np.ndarray  # unseen by training and fitting
    view_names: Sequence[str]
    counts: Counts  # (label id, level) -> Gaussians, every level of the ladder
    recovering: frozenset[int]  # levels taken shortly after an opacity reset
    models: Mapping[tuple[int, int], SsimModel]  # by (label id, level)
    plans: Sequence[Plan]  # of the scene, one per quality and target
    evaluation: Evaluation
    quality: QualityKind = "ssim"  # of the plan that the page leads with
    ssim_target: float | None = None  # of the plan for SSIM beside one for fidelity
    sizes: Sizes | None = None  # bytes to send of each (label id, level); None: 248 a Gaussian
    panels: Sequence[Panel] = ()  # at the page's target
    scene_facts: Facts = ()
    settings: Facts = ()
    timings: Sequence[tuple[str, float]] = ()  # stage, seconds
    provenance: Facts = ()  # versions, hashes of the inputs
    exposed: bool = False  # views are rendered with the exposure of their photos, fitted where held out
    photos: bool = True  # False: renders of a splat that somebody else trained
    adopted: Facts = ()  # how such a splat was looked at, and how its levels were made
    viewpoints: UInt8[np.ndarray, "H W 3"] | None = None  # what its viewpoints see
    noticed: Sequence[str] = ()  # what the run noticed, and dealt with, in words
    commands: Commands | None = None  # what commands on the run name
    can_view: bool = False  # whether `sagesplat view` shows the run
    links: Facts = ()  # what else was made of the run: title, address relative to the page
    url: str = ""  # where the run's bundle was published
    place: Place | None = None  # the capture from above
    promise: PromiseFacts | None = None
    drawn: Mapping[int, Float32[np.ndarray, "V K"]] = field(default_factory=dict)
    """Fidelity by label id: of each level, at drawn viewpoints; NaN where one shows too little of it."""
    planned: Mapping[int, Float32[np.ndarray, " V"]] = field(default_factory=dict)
    """The same of the levels of the plan that the page leads with; those of cells are added up."""
    drawn_at: Place | None = None  # those viewpoints from above
    looks: Sequence[Look] = ()  # ascending, the full model last


def main_plan(data: ReportData) -> Plan:
    """The plan that the page leads with: of its quality, the one whose target is nearest to `data.target`."""
    return nearest(data, data.quality, data.target)


def nearest(data: ReportData, quality: QualityKind, target: float) -> Plan:
    """The plan of a quality whose target is nearest to one."""
    return min(data.plans, key=lambda plan: (plan.quality != quality, abs(plan.target - target)))


def sizes_of(data: ReportData) -> Sizes:
    """Bytes of each (label id, level), as the page counts them."""
    return data.sizes or {key: count * BYTES_PER_GAUSSIAN for key, count in data.counts.items()}


def steps_of(data: ReportData) -> list[NextStep]:
    """What to do next with the run."""
    if data.commands is None:
        return []
    return next_steps(
        data.observations, data.train_views, data.test_views, data.view_names, data.names, main_plan(data),
        data.commands,
    )  # fmt: skip
