"""SSIM against photos: does the bound hold, if calibration and test views are drawn again?

One split of a capture tells little: views that training never saw are few, and some are hard. So they are
drawn again into calibration and test views, as many of each as before, and the models are fitted and
calibrated again. Training views stay, as the trained model depends on them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sagesplat.adapt.coverage import Decisions, decide
from sagesplat.adapt.eq3 import fit_models
from sagesplat.adapt.observe import Observations
from sagesplat.adapt.photo_models import fit_photo_models, measured_at
from sagesplat.run.job import Job
from sagesplat.scene.scene import Scene
from sagesplat.segment.masks import UNLABELLED
from sagesplat.stages.shared import observed

TARGETS = tuple(np.arange(0.5, 0.91, 0.05).round(2).tolist())  # SSIM
DRAWS = 20
_TOTALS = ("excess", "perfect_excess", "accepted", "violated", "false_rejections")


def measure(job: Job, draws: int = DRAWS, targets: Sequence[float] = TARGETS) -> dict[str, Any]:
    """Coverage and excess by target, of a finished run whose held-out views are drawn again (`summary`)."""
    table = observed(job)
    table = table.select(table.label_id != UNLABELLED)
    parts = redrawn(table, job.scene, job.ladder.counts, targets, draws, job.fit_config.confidence)
    views = len(job.scene.calibration_ids), len(job.scene.test_ids)
    return {"calibration_views": views[0], "test_views": views[1], **summary(parts)}


def lines(name: str, found: Mapping[str, Any]) -> list[str]:
    """What `measure` found, for people."""
    views = f"{found['calibration_views']} calibration and {found['test_views']} test views"
    said = [f"{name}, SSIM against photos, {views} drawn again:"]
    for target, row in found["targets"].items():
        said.append(
            f"  {target:>4}: kept {row['coverage']:.1%} (5th percentile {row['coverage_p5']:.1%}), excess "
            f"{row['excess']:.3f} (perfect {row['perfect_excess']:.3f}), {row['accepted']} accepted, "
            f"{row['false_rejections']} falsely rejected"
        )
    return said


def redrawn(
    table: Observations,
    scene: Scene,
    costs: Mapping[tuple[int, int], int],
    targets: Sequence[float],
    draws: int,
    confidence: float = 0.95,
) -> list[Decisions]:
    """The decisions of each draw on its test views, by the bound and by a perfect planner."""
    heldout = np.concatenate([scene.calibration_ids, scene.test_ids])
    count = len(scene.calibration_ids)
    curves = {key: curve for key, curve in fit_models(table, scene.train_ids).items() if key[0] >= 0}
    found = []
    for draw in range(draws):
        order = np.random.default_rng(draw).permutation(heldout)
        drawn = _split(scene, order[:count], order[count:])
        models = fit_photo_models(table, drawn, confidence, curves)
        parts = []
        for label, model in models.items():
            views = measured_at(table, drawn, label, model.levels, drawn.test_ids)
            bound = model.predict(views.distance, views.position, views.direction).bound
            cost = np.array([costs[label, level] for level in model.levels])
            says = {"bound": bound, "perfect": views.ssim}
            parts.append(decide(says, views.ssim, cost, targets, views.rows, label))
        if parts:
            found.append(Decisions.joined(parts))
    return found


def summary(draws: Sequence[Decisions]) -> dict[str, Any]:
    """By target: means over the draws; excess and perfect_excess are SSIM above it in the same decisions."""
    rows: dict[str, Any] = {}
    for target in sorted({target for draw in draws for target in draw.target.tolist()}):
        of = [draw.select((draw.target == target) & (draw.predictor == "bound")) for draw in draws]
        coverage = [one.kept.sum() / one.accepted.sum() for one in of if one.accepted.any()]
        if not coverage:
            continue
        totals = Decisions.joined(of).totals()
        rows[f"{target:g}"] = {
            "coverage": float(np.mean(coverage)),
            "coverage_p5": float(np.percentile(coverage, 5)),
            **{name: totals[name] for name in _TOTALS},
        }
    return {"targets": rows}


def _split(scene: Scene, calibration: np.ndarray, test: np.ndarray) -> Scene:
    names = [frozenset(scene.views[row].name for row in rows) for rows in (calibration, test)]
    return replace(scene, calibration_names=names[0], test_names=names[1])
