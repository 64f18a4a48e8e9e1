"""Quality models: what to expect of a category at each level from any viewpoint, and a lower bound of it.

There are two qualities. Fidelity is SSIM against the full model rendered from the same viewpoint; any
viewpoint can tell it. SSIM against photos needs a photo. Both are predicted in the same way, and a viewer
evaluates the same formulas (`web/src/core/quality.ts`):

    mean_k  = m_k(d) + sum_i k_i * weights_ik       m_k: Eq. 3 over the distance (fidelity: a constant);
                                                    k_i: the kernel of `adapt.process`
              made monotone over the levels: half of (the largest up to k + the smallest from k on), kept in
              [-1, 1]
    support = max_i c(x, x_i)                       1 at a known viewpoint, 0 far from all
    bound_k = the largest target whose threshold mean_k - discount * (1 - support) reaches

`adapt.calibrate` finds, for each target, the threshold: the mean from which on a level keeps the target, at a
confidence. Between targets it is interpolated. The discount is for errors that grow away from known
viewpoints (fidelity: 0). Where the support is below that of all calibration views there is no bound (NaN):
nothing is known there. An unknown distance (NaN) counts as `median_log_distance` in x, and m_k is then the
median.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float
from msgspec import Meta

from sagesplat.adapt.eq3 import Eq3, SsimModel
from sagesplat.adapt.process import inputs_of, matern32
from sagesplat.core.limits import LARGEST, Count, LabelId, NotNegative, Number, Positive, Share
from sagesplat.io.files import write_json
from sagesplat.io.typed import read_json_as, refused, to_plain

QualityKind = Literal["fidelity", "ssim"]  # against the full model, or against photos
Status = Literal[
    "calibrated",  # the bound holds at its confidence
    "uncalibrated",  # too few calibration views for that: widened, but nothing is proven
]
STATUSES: tuple[Status, ...] = get_args(Status)


class Prediction(NamedTuple):
    """Quality of one category at each of its levels from V viewpoints."""

    mean: Float[np.ndarray, "V K"]
    bound: Float[np.ndarray, "V K"]  # lower confidence bound; like the mean, it never falls along the levels
    support: Float[np.ndarray, " V"]  # 1 at a known viewpoint, 0 far from all


@dataclass(frozen=True, eq=False)
class Calibration:
    """From the expected quality to a lower confidence bound."""

    status: Status
    confidence: Annotated[float, Meta(gt=0, lt=1)]  # share of decisions that hold
    num_views: Count  # calibration views that show the category
    targets: Float[np.ndarray, " G"]  # ascending
    thresholds: Float[np.ndarray, " G"]  # ascending: the mean from which on a level keeps the target
    least_support: Share  # below it there is no bound
    discount: NotNegative = 0.0  # of the mean where the support is 0; none at a known viewpoint

    def bound(
        self, mean: Float[np.ndarray, "V K"], support: Float[np.ndarray, " V"]
    ) -> Float[np.ndarray, "V K"]:
        """The largest target that each mean keeps; below the first target the same distance from the mean.

        NaN without any target, and where the support is too small.
        """
        if not len(self.targets):
            return np.full(mean.shape, np.nan)
        mean = mean - self.discount * (1 - support)[:, None]
        found = np.interp(mean, self.thresholds, self.targets)
        low = mean < self.thresholds[0]
        found[low] = mean[low] + (self.targets[0] - self.thresholds[0])
        found[support < self.least_support] = np.nan
        return found


NO_CALIBRATION = Calibration("uncalibrated", 0.95, 0, np.zeros(0), np.zeros(0), 0.0)


@dataclass(frozen=True, eq=False)
class ViewModel:
    """What quality to expect of one category, by level and viewpoint (formulas: the module's text)."""

    label_id: LabelId
    quality: QualityKind
    curves: tuple[SsimModel, ...]  # of each level, ascending: Eq. 3, or a constant (`constant_curve`)
    extent: Positive  # of the scene, world units
    median_log_distance: Number  # log distance, for viewpoints that know none
    inputs: Float[np.ndarray, "n 7"]  # of the views behind it: position / extent, direction, log d
    heldout_inputs: Bool[np.ndarray, " n"]  # photos that training never saw; of fidelity none
    lengths: tuple[Positive, Positive, Positive]  # of the three groups of inputs
    heldout_variance: NotNegative  # over the variance of the process
    weights: Float[np.ndarray, "n K"]
    rmse: Number  # of its views, each predicted without itself; over all levels
    calibration: Calibration = field(default=NO_CALIBRATION)

    @property
    def levels(self) -> tuple[int, ...]:
        """The levels that it predicts, ascending."""
        return tuple(curve.level for curve in self.curves)

    @property
    def num_views(self) -> int:
        """Views behind the process."""
        return len(self.inputs)

    @property
    def status(self) -> Status:
        """One of STATUSES."""
        return self.calibration.status

    @property
    def confidence(self) -> float:
        """Share of accepted decisions that hold."""
        return self.calibration.confidence

    def predict(
        self,
        distance: Float[np.ndarray, " V"],
        position: Float[np.ndarray, "V 3"],
        direction: Float[np.ndarray, "V 3"],
    ) -> Prediction:
        """Predict the quality of each level at V viewpoints, whether a photo was taken there or not.

        Args:
            distance: [V], d_min to the category in world units; NaN: unknown.
            position: [V, 3], camera centres in world units.
            direction: [V, 3], unit viewing directions (the camera's z) in the world.

        Returns:
            mean and bound [V, K], each column a level; support [V]: 1 at a known viewpoint, 0 far from all.
            The bound is NaN where the support is too small.

        Example:
            >>> import numpy as np
            >>> from sagesplat import open_run
            >>> run = open_run("runs/garden")  # doctest: +SKIP
            >>> near = np.array([3.0])  # world units
            >>> camera, model = run.scene.views[0].camera, run.fidelity[184]  # doctest: +SKIP
            >>> model.predict(near, camera.position[None], camera.direction[None]).bound  # doctest: +SKIP
        """
        x = inputs_of(distance, position, direction, self.extent, self.median_log_distance)
        near = matern32(x, self.inputs, self.lengths)
        k = near + self.heldout_variance * self.heldout_inputs
        mean = monotone(means_at(self.curves, distance) + k @ self.weights)
        support = near.max(1)
        return Prediction(mean, self.calibration.bound(mean, support), support)


def monotone(mean: Float[np.ndarray, "V K"]) -> Float[np.ndarray, "V K"]:
    """Means that never fall from level to level, in [-1, 1]."""
    # Halfway between the largest so far and the smallest to come: as good as least squares, and one line.
    rising = np.maximum.accumulate(mean, 1)
    return np.clip((rising + np.minimum.accumulate(mean[:, ::-1], 1)[:, ::-1]) / 2, -1, 1)


def means_at(curves: Sequence[SsimModel], distance: Float[np.ndarray, " V"]) -> Float[np.ndarray, "V K"]:
    """m_k(d) of the module's text."""
    return np.stack([curve(np.asarray(distance, np.float64)) for curve in curves], 1)


def constant_curve(label_id: int, level: int, value: float, rmse: float, n: int) -> SsimModel:
    """A curve that is the same at every distance."""
    params = Eq3(value, 0.0, 0.0, 1.0, value, 0.0, 0.0, 1.0, 0.0)
    return SsimModel(label_id, level, params, (0.0, 0.0), value, rmse, n, "constant")


def write_promises(path: Path, models: Mapping[int, ViewModel]) -> None:
    """fidelity.json or promises.json: one entry per category."""
    write_json(path, {"promises": [to_plain(model) for model in models.values()]})


@dataclass(frozen=True, eq=False)
class _Promises:
    promises: list[ViewModel]


def read_promises(path: Path | str) -> dict[int, ViewModel]:
    """What `write_promises` wrote; DataError where the content cannot be used."""
    path, what, cure = Path(path), "a file of promises", "delete it and run `sagesplat fit` again"
    models = read_json_as(path, _Promises, what, cure).promises
    with refused(path, what, cure):
        for model in models:
            _check(model)
    return {model.label_id: model for model in models}


def _check(model: ViewModel) -> None:
    """ValueError for a model whose parts do not belong together."""
    n, calibration = len(model.heldout_inputs), model.calibration
    shapes = (len(model.inputs), *model.weights.shape)
    if not n or not model.curves or shapes != (n, n, len(model.curves)):
        raise ValueError("lists of unequal length")
    if calibration.targets.shape != calibration.thresholds.shape:
        raise ValueError("lists of unequal length")
    for rising in (calibration.targets, calibration.thresholds):
        if not (np.diff(rising) > 0).all() or not (np.abs(rising) <= 1).all():
            raise ValueError("targets or thresholds out of range")
    if not all((np.abs(array) < LARGEST).all() for array in (model.inputs, model.weights)):
        raise ValueError("numbers out of range")
