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
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float

from sagesplat.adapt.eq3 import LARGEST, Eq3, SsimModel, model_from_json
from sagesplat.adapt.process import inputs_of, matern32
from sagesplat.core.errors import DataError, short
from sagesplat.io.files import read_json, write_json

QualityKind = Literal["fidelity", "ssim"]  # against the full model, or against photos
STATUSES = (
    "calibrated",  # the bound holds at its confidence
    "uncalibrated",  # too few calibration views for that: widened, but nothing is proven
)
NUMBERS = ("extent", "median_log_distance", "heldout_variance", "rmse")


class Prediction(NamedTuple):
    """Quality of one category at each of its levels from V viewpoints."""

    mean: Float[np.ndarray, "V K"]
    bound: Float[np.ndarray, "V K"]  # lower confidence bound; like the mean, it never falls along the levels
    support: Float[np.ndarray, " V"]  # 1 at a known viewpoint, 0 far from all


@dataclass(frozen=True, eq=False)
class Calibration:
    """From the expected quality to a lower confidence bound."""

    status: str  # one of STATUSES
    confidence: float  # share of decisions that hold
    num_views: int  # calibration views that show the category
    targets: Float[np.ndarray, " G"]  # ascending
    thresholds: Float[np.ndarray, " G"]  # ascending: the mean from which on a level keeps the target
    least_support: float  # below it there is no bound
    discount: float = 0.0  # of the mean where the support is 0; none at a known viewpoint

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

    label_id: int
    quality: QualityKind
    curves: tuple[SsimModel, ...]  # of each level, ascending: Eq. 3, or a constant (`constant_curve`)
    extent: float  # of the scene, world units
    median_log_distance: float  # log distance, for viewpoints that know none
    inputs: Float[np.ndarray, "n 7"]  # of the views behind it: position / extent, direction, log d
    heldout_inputs: Bool[np.ndarray, " n"]  # photos that training never saw; of fidelity none
    lengths: tuple[float, float, float]  # of the three groups of inputs
    heldout_variance: float  # over the variance of the process
    weights: Float[np.ndarray, "n K"]
    rmse: float  # of its views, each predicted without itself; over all levels
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
    def status(self) -> str:
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
    write_json(path, {"promises": [_to_json(model) for model in models.values()]})


def read_promises(path: Path | str) -> dict[int, ViewModel]:
    """What `write_promises` wrote; DataError where the content cannot be used."""
    path = Path(path)
    cure = "delete it and run `sagesplat fit` again"
    document = read_json(path, cure)
    try:
        models = [_from_json(entry) for entry in document["promises"]]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path}: not a file of promises ({short(repr(error))}); {cure}") from None
    return {model.label_id: model for model in models}


def _to_json(model: ViewModel) -> dict[str, Any]:
    entry = {f.name: getattr(model, f.name) for f in fields(model)}
    entry["curves"] = [{**vars(curve), "params": curve.params._asdict()} for curve in model.curves]
    entry["calibration"] = _plain(vars(model.calibration))
    return _plain(entry)


def _plain(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in entry.items()}


def _from_json(entry: dict[str, Any]) -> ViewModel:
    curves = tuple(model_from_json(curve) for curve in entry["curves"])
    x, y, z = map(float, entry["lengths"])
    inputs, weights = (np.array(entry[k], np.float64) for k in ("inputs", "weights"))
    numbers = {name: float(entry[name]) for name in NUMBERS}
    u = np.array(entry["heldout_inputs"], bool)
    n = len(u)
    if not n or u.shape != (n,) or not curves or (inputs.shape, weights.shape) != ((n, 7), (n, len(curves))):
        raise ValueError("lists of unequal length")
    values = (inputs, weights, (x, y, z), list(numbers.values()))
    if not all((np.abs(a) < LARGEST).all() for a in values):
        raise ValueError("numbers out of range")
    if min(x, y, z, numbers["extent"]) <= 0 or numbers["heldout_variance"] < 0:
        raise ValueError("numbers out of range")
    if entry["quality"] not in get_args(QualityKind):
        raise ValueError(f"unknown quality {entry['quality']!r}")
    return ViewModel(
        label_id=int(entry["label_id"]),
        quality=entry["quality"],
        curves=curves,
        heldout_inputs=u,
        lengths=(x, y, z),
        inputs=inputs,
        weights=weights,
        calibration=_calibration_from_json(entry["calibration"]),
        **numbers,
    )


def _calibration_from_json(entry: dict[str, Any]) -> Calibration:
    targets, thresholds = (np.array(entry[k], np.float64) for k in ("targets", "thresholds"))
    confidence, least = float(entry["confidence"]), float(entry["least_support"])
    discount = float(entry.get("discount", 0.0))
    if targets.ndim != 1 or targets.shape != thresholds.shape:
        raise ValueError("lists of unequal length")
    rising = all((np.diff(values) > 0).all() for values in (targets, thresholds))
    within = all((np.abs(values) <= 1).all() for values in (targets, thresholds))
    if not rising or not within or not 0 < confidence < 1 or not 0 <= least <= 1:
        raise ValueError("numbers out of range")
    if not 0 <= discount < LARGEST:
        raise ValueError("numbers out of range")
    if entry["status"] not in STATUSES:
        raise ValueError(f"unknown status {entry['status']!r}")
    return Calibration(
        str(entry["status"]), confidence, int(entry["num_views"]), targets, thresholds, least, discount
    )
