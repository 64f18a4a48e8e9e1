"""Empirical coverage: decisions on unseen views by Eq. 3, by the viewpoint model's mean and by its bound."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sagesplat.adapt.allocate import choose
from sagesplat.adapt.observe import Observations
from sagesplat.adapt.plan import check_target
from sagesplat.adapt.viewpoint import ViewModel
from sagesplat.scene.scene import Scene

# the paper's model; the viewpoint model's mean; its lower confidence bound; the measurement itself
PREDICTORS = ("eq3", "mean", "bound", "oracle")


@dataclass(frozen=True, eq=False)
class Decisions:
    """One row per (target, category, predictor); means are NaN where there is nothing to average."""

    target: Float[np.ndarray, " R"]  # SSIM
    label_id: Int[np.ndarray, " R"]
    predictor: np.ndarray  # [R] one of PREDICTORS
    views: Int[np.ndarray, " R"]  # that show the category and were measured at all of its levels
    accepted: Int[np.ndarray, " R"]  # of them those in which the plan says that the target is met
    kept: Int[np.ndarray, " R"]  # of those the ones in which the chosen level measures it
    overshoot: Float[np.ndarray, " R"]  # mean of measured - target over the accepted
    chosen: Int[np.ndarray, " R"]  # accepted with more than the cheapest level: a plan can overshoot less
    chosen_kept: Int[np.ndarray, " R"]
    chosen_overshoot: Float[np.ndarray, " R"]
    # views in which some level measures the target, yet the plan says that none does
    false_rejections: Int[np.ndarray, " R"]
    # mean cost above the cheapest level that measures the target, where kept; in the unit of the costs
    regret: Float[np.ndarray, " R"]

    def select(self, keep: np.ndarray) -> "Decisions":
        """The rows that a boolean mask or an index array names."""
        return Decisions(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def totals(self) -> dict[str, float]:
        """All rows together, every (category, view, target) weighing the same. NaN where there is none."""
        sums = {name: int(getattr(self, name).sum()) for name in ("accepted", "chosen", "false_rejections")}
        weights = {"overshoot": self.accepted, "chosen_overshoot": self.chosen, "regret": self.kept}
        means = {name: _mean(getattr(self, name)[n > 0], n[n > 0]) for name, n in weights.items()}
        kept = _mean(self.kept / np.maximum(self.accepted, 1), self.accepted)
        chosen_kept = _mean(self.chosen_kept / np.maximum(self.chosen, 1), self.chosen)
        return {**sums, "kept": kept, "chosen_kept": chosen_kept, **means}


def score(
    observations: Observations,
    scene: Scene,
    promises: Mapping[int, ViewModel],
    costs: Mapping[tuple[int, int], int],
    targets: Sequence[float],
    views: Int[np.ndarray, " U"] | None = None,
) -> Decisions:
    """Choose the cheapest level in each view (rows of Scene.views; default: test views) and measure it.

    `costs`: of each (label id, level), in the unit that plans minimise. Categories without costs have no
    Gaussians: no plan has them, and they are left out. So are views not measured at all levels of a category.
    RunError for an impossible target.
    """
    for target in targets:
        check_target(target)
    rows = []
    for label_id, model in promises.items():
        levels = np.array(model.levels)
        if (label_id, model.levels[0]) not in costs:
            continue
        mine = observations.select(
            (observations.label_id == label_id)
            & np.isin(observations.view, scene.test_ids if views is None else views)
            & np.isin(observations.level, levels)
        )
        seen, column = np.unique(mine.view, return_inverse=True)
        measured = np.full((len(levels), len(seen)), np.nan)
        measured[np.searchsorted(levels, mine.level), column] = mine.ssim
        distance = np.full(len(seen), np.nan)
        distance[column] = mine.distance
        whole = np.isfinite(measured).all(0)
        measured, distance = measured[:, whole], distance[whole]
        cameras = [scene.views[row].camera for row in seen[whole]]
        position = np.array([camera.position for camera in cameras], np.float64).reshape(-1, 3)
        direction = np.array([camera.direction for camera in cameras], np.float64).reshape(-1, 3)
        predicted = model.predict(distance, position, direction)
        eq3 = np.stack([curve(distance) for curve in model.curves])
        cost = np.array([costs[label_id, level] for level in model.levels])
        says = (eq3, predicted.mean.T, predicted.bound.T, measured)
        for target in targets:
            for predictor, ssim in zip(PREDICTORS, says, strict=True):
                key = {"target": target, "label_id": label_id, "predictor": predictor}
                rows.append(key | _decide(ssim, measured, cost, target))
    return Decisions(**{f.name: np.array([row[f.name] for row in rows]) for f in fields(Decisions)})


def _decide(
    ssim: Float[np.ndarray, "K V"], measured: Float[np.ndarray, "K V"], cost: np.ndarray, target: float
) -> dict[str, Any]:
    """Some columns of `Decisions` for one category, target and predictor; `cost` [K] of its levels."""
    level, accepted = choose(ssim.T, cost, target)
    best, reachable = choose(measured.T, cost, target)
    got = measured[level, np.arange(len(level))]
    kept = accepted & (got >= target)
    chosen = accepted & (cost[level] > cost.min())
    return {
        "views": len(level),
        "accepted": int(accepted.sum()),
        "kept": int(kept.sum()),
        "overshoot": _mean(got[accepted] - target),
        "chosen": int(chosen.sum()),
        "chosen_kept": int((chosen & kept).sum()),
        "chosen_overshoot": _mean(got[chosen] - target),
        "false_rejections": int((reachable & ~accepted).sum()),
        "regret": _mean((cost[level] - cost[best])[kept]),
    }


def _mean(values: np.ndarray, weights: np.ndarray | None = None) -> float:
    if not values.size or (weights is not None and not weights.sum()):
        return np.nan
    return float(np.average(values, weights=weights))
