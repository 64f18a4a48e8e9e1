"""Empirical coverage: decisions on unseen views, by several predictors that are all treated alike.

A planner takes the cheapest level whose predicted quality reaches a target. Predicted is either a mean or a
bound, which is the mean less a margin: every predictor has one of each, its margin from the same calibration,
so that means are compared with means and bounds with bounds.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from sagesplat.adapt.allocate import choose
from sagesplat.adapt.calibrate_photos import LeftOut, calibrate_photos
from sagesplat.adapt.observe import Observations
from sagesplat.adapt.photo_models import measured_at
from sagesplat.adapt.plan import check_target
from sagesplat.adapt.viewpoint import Calibration, ViewModel, means_at, monotone
from sagesplat.io.columns import ColumnTable
from sagesplat.scene.scene import Scene

# means of each level over the training views, of the paper's model, of the viewpoint model; each less its own
# conformal margin ("bound": the viewpoint model's); the measurement itself
PREDICTORS = ("constant", "eq3", "mean", "constant bound", "eq3 bound", "bound", "perfect")
DRAWS = 1000  # of the bootstrap
INTERVAL = (0.025, 0.975)  # quantiles of it
Curve = Callable[[Float[np.ndarray, " V"]], Float[np.ndarray, "V K"]]  # means of each level by distance


@dataclass(frozen=True, eq=False)
class Decisions(ColumnTable):
    """One row per (target, category, predictor, view)."""

    target: Float[np.ndarray, " R"]
    label_id: Int[np.ndarray, " R"]
    predictor: np.ndarray  # [R] names
    view: Int[np.ndarray, " R"]
    accepted: Bool[np.ndarray, " R"]  # the plan says that the target is met
    kept: Bool[np.ndarray, " R"]  # accepted, and the chosen level measures it
    reachable: Bool[np.ndarray, " R"]  # some level measures it
    chosen: Bool[np.ndarray, " R"]  # accepted with more than the cheapest level: there was less to take
    excess: Float[np.ndarray, " R"]  # measured - target of the chosen level
    perfect_excess: Float[np.ndarray, " R"]  # of the cheapest level that measures the target; NaN: none does
    regret: Float[np.ndarray, " R"]  # cost above that level's, in the unit of the costs

    def by(self, predictor: str) -> "Decisions":
        """The rows of one predictor."""
        return self.select(self.predictor == predictor)

    def totals(self) -> dict[str, float]:
        """All rows together, each weighing the same; NaN where there is nothing to average.

        accepted, violated, false_rejections: numbers; coverage: share of the accepted that are kept, and its
        interval `low` to `high` (bootstrap over views); overshoot: mean excess of the accepted; excess and
        perfect_excess: means over what was accepted with more than the cheapest level and is reachable, so
        that both are of the same decisions; regret: mean cost above the cheapest level that would do, of kept
        ones.
        """
        comparable = self.chosen & self.reachable
        low, high = self.interval()
        return {
            "decisions": len(self.view),
            "accepted": int(self.accepted.sum()),
            "violated": int((self.accepted & ~self.kept).sum()),
            "coverage": _mean(self.kept[self.accepted]),
            "low": low,
            "high": high,
            "overshoot": _mean(self.excess[self.accepted]),
            "excess": _mean(self.excess[comparable]),
            "perfect_excess": _mean(self.perfect_excess[comparable]),
            "false_rejections": int((self.reachable & ~self.accepted).sum()),
            "regret": _mean(self.regret[self.kept]),
        }

    def interval(self) -> tuple[float, float]:
        """Of the coverage, 95 %: views drawn again with replacement, all decisions of a view together."""
        views, row = np.unique(self.view, return_inverse=True)
        accepted, kept = (np.bincount(row, of, len(views)) for of in (self.accepted, self.kept))
        if not accepted.sum():
            return np.nan, np.nan
        drawn = np.random.default_rng(0).integers(0, len(views), (DRAWS, len(views)))
        total = accepted[drawn].sum(1)
        share = kept[drawn].sum(1)[total > 0] / total[total > 0]
        low, high = np.quantile(share, INTERVAL)
        return float(low), float(high)


def decide(
    predicted: Mapping[str, Float[np.ndarray, "V K"]],
    measured: Float[np.ndarray, "V K"],
    cost: Float[np.ndarray, " K"] | Int[np.ndarray, " K"],
    targets: Sequence[float],
    views: Int[np.ndarray, " V"],
    label_id: int,
) -> Decisions:
    """Decide on one category in V views, by each predictor and at each target; of any quality.

    Args:
        predicted: By name of the predictor; NaN: nothing is said, so nothing is accepted.
        measured: Of each level.
        cost: Of each level.
        targets: Of quality.
        views: Numbers of the views: those of one number are drawn together by the bootstrap.
        label_id: Of the category.

    Returns:
        A row per target, predictor and view.
    """
    parts = []
    for target in targets:
        best, reachable = choose(measured, cost, target)
        for name, quality in predicted.items():
            level, accepted = choose(quality, cost, target)
            each = np.arange(len(views))
            got = measured[each, level]
            parts.append(
                Decisions(
                    target=np.full(len(views), float(target)),
                    label_id=np.full(len(views), label_id),
                    predictor=np.full(len(views), name, dtype=object),
                    view=np.asarray(views),
                    accepted=accepted,
                    kept=accepted & (got >= target),
                    reachable=reachable,
                    chosen=accepted & (cost[level] > cost.min()),
                    excess=got - target,
                    perfect_excess=np.where(reachable, measured[each, best] - target, np.nan),
                    regret=(cost[level] - cost[best]).astype(np.float64),
                )
            )
    return Decisions.joined(parts)


def score(
    observations: Observations,
    scene: Scene,
    promises: Mapping[int, ViewModel],
    costs: Mapping[tuple[int, int], int],
    targets: Sequence[float],
    views: Int[np.ndarray, " U"] | None = None,
) -> Decisions:
    """Choose the cheapest level in each view (rows of Scene.views; default: test views) and measure it.

    Args:
        observations: Rows of `observe`, of the views and of those that the models were fitted to.
        scene: The capture.
        promises: Models of SSIM against photos, by label id.
        costs: Of each (label id, level), in the unit that plans minimise. Categories without costs have no
            Gaussians: no plan has them, and they are left out.
        targets: SSIM.
        views: Rows of Scene.views. Of a category those count that were measured at all of its levels.

    Returns:
        The decisions of PREDICTORS.

    Raises:
        RunError: For an impossible target.
    """
    for target in targets:
        check_target(target)
    views = scene.test_ids if views is None else views
    planned = {label: model for label, model in promises.items() if (label, model.levels[0]) in costs}
    margins = _margins(observations, scene, planned)
    parts = [_nothing()]
    for label_id, model in planned.items():
        rows, measured, distance, position, direction = measured_at(
            observations, scene, label_id, model.levels, views
        )
        predicted = model.predict(distance, position, direction)
        means = {name: of(distance) for name, (of, _) in margins[label_id].items()}
        certain = np.ones(len(rows))  # those two know of no viewpoint, so none is far
        bounds = {f"{n} bound": margins[label_id][n][1].bound(mean, certain) for n, mean in means.items()}
        every = {**means, "mean": predicted.mean, **bounds, "bound": predicted.bound, "perfect": measured}
        cost = np.array([costs[label_id, level] for level in model.levels])
        parts.append(decide(every, measured, cost, targets, rows, label_id))
    return Decisions.joined(parts)


def _constant(mean: Float[np.ndarray, " K"], distance: Float[np.ndarray, " V"]) -> Float[np.ndarray, "V K"]:
    """Mean of each level over the training views, at any distance."""
    return np.repeat(monotone(mean[None]), len(distance), 0)


def _eq3(model: ViewModel, distance: Float[np.ndarray, " V"]) -> Float[np.ndarray, "V K"]:
    """The paper's model."""
    return monotone(means_at(model.curves, distance))


def _margins(
    observations: Observations, scene: Scene, models: Mapping[int, ViewModel]
) -> dict[int, dict[str, tuple[Curve, Calibration]]]:
    """The other predictors of each category: the mean, and its calibration by the views behind the model."""
    known = np.concatenate([scene.train_ids, scene.calibration_ids])
    means: dict[str, dict[int, Curve]] = {"constant": {}, "eq3": {}}
    left_out: dict[str, dict[int, LeftOut]] = {"constant": {}, "eq3": {}}
    for label, model in models.items():
        rows, ssim, distance, _, _ = measured_at(observations, scene, label, model.levels, known)
        heldout = np.isin(rows, scene.calibration_ids)
        seen = ssim if heldout.all() else ssim[~heldout]
        constant, eq3 = partial(_constant, seen.mean(0)), partial(_eq3, model)
        others = np.maximum(len(seen) - 1, 1)
        without = np.where(heldout[:, None], seen.mean(0), (seen.sum(0) - ssim) / others)
        certain = np.ones(len(rows))
        for name, of, mean in (("constant", constant, monotone(without)), ("eq3", eq3, eq3(distance))):
            means[name][label] = of
            left_out[name][label] = LeftOut.alone(rows, heldout, mean, ssim, certain)
    confidence = next((model.confidence for model in models.values()), 0.95)
    found = {name: calibrate_photos(views, confidence) for name, views in left_out.items()}
    return {label: {name: (means[name][label], found[name][label]) for name in means} for label in models}


def _nothing() -> Decisions:
    """No rows, for a run without a category that a plan can have."""
    none = np.zeros((0, 1))
    return decide({"mean": none}, none, np.ones(1, np.int64), [0.5], np.zeros(0, np.int64), 0)


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else np.nan
