"""Quality models: what to expect of a category at each level from any viewpoint, and a lower bound of it.

There are two qualities. Fidelity is SSIM against the full model rendered from the same viewpoint; any
viewpoint can tell it. SSIM against photos needs a photo. Both are predicted in the same way, and a viewer
evaluates the same formulas (`web/src/core/quality.ts`):

    mean_k  = m_k(d) + sum_i k_i * weights_ik       m_k: Eq. 3 over the distance (fidelity: a constant);
                                                    k_i: the kernel of `adapt.process`
              made monotone over the levels: half of (the largest up to k + the smallest from k on), kept in
              [-1, 1]
    support = max_i c(x, x_i)                       1 at a known viewpoint, 0 far from all
    away    = 1 - max_p c(x, photo_p)               by position and direction alone, with PHOTO_LENGTHS; of
                                                    SSIM against photos it is 1 - support
    bound_k = the largest target whose threshold, this far away, mean_k reaches
              threshold = threshold_target + slope_target * away, at least those of lower targets, at most 1;
              of fidelity 1 - (1 - that) / strictness, for the lens and screen (`adapt.cell_models`)

`adapt.calibrate` finds, for each target, the threshold: the mean from which on a level keeps the target, at a
confidence. Between targets it is interpolated. The slopes are for errors that grow away from the photos: what
no photo showed was trained by none. Where the support is below that of all calibration views there is no
bound (NaN): nothing is known there. An unknown distance (NaN) counts as `median_log_distance` in x, and m_k
is then the median.

A viewpoint's screen is its focal length in pixels over that of the photos. Fidelity is known for those in
`screens`; smaller ones are promised what the smallest has, and on larger ones the picture is meant averaged
down to the largest. SSIM against photos is known in the photos' pixels alone.
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
from sagesplat.scene.scene import Camera

QualityKind = Literal["fidelity", "ssim"]  # against the full model, or against photos
Status = Literal[
    "calibrated",  # the bound holds at its confidence
    "uncalibrated",  # too few calibration views for that: widened, but nothing is proven
]
STATUSES: tuple[Status, ...] = get_args(Status)
_ROUNDED = 1e-9  # by which sums of the same means differ
_LARGEST_THRESHOLD = 1e6  # a bundle has them in whole steps


class Prediction(NamedTuple):
    """Quality of one category at each of its levels from V viewpoints."""

    mean: Float[np.ndarray, "V K"]
    bound: Float[np.ndarray, "V K"]  # lower confidence bound; like the mean, it never falls along the levels
    support: Float[np.ndarray, " V"]  # 1 at a known viewpoint, 0 far from all
    away: Float[np.ndarray, " V"]  # 0 at a photo, 1 far from all


@dataclass(frozen=True, eq=False)
class Calibration:
    """From the expected quality to a lower confidence bound."""

    status: Status
    confidence: Annotated[float, Meta(gt=0, lt=1)]  # share of decisions that hold
    num_views: Count  # calibration views that show the category
    targets: Float[np.ndarray, " G"]  # ascending; above them nothing is kept
    thresholds: Float[np.ndarray, " G"]  # the mean from which on a level keeps the target, at a photo
    slopes: Float[np.ndarray, " G"]  # by which that rises to far from all photos
    least_support: Share  # below it there is no bound

    def bound(
        self,
        mean: Float[np.ndarray, "V K"],
        support: Float[np.ndarray, " V"],
        away: Float[np.ndarray, " V"] | None = None,
        strictness: Float[np.ndarray, " V"] | float = 1.0,
        most: Float[np.ndarray, " V"] | float = np.inf,
    ) -> Float[np.ndarray, "V K"]:
        """The largest target that each mean keeps; below the first target the same distance from the mean.

        NaN without any target, and where the support is too small. `away`: None: 1 - support. `strictness`
        divides the loss that thresholds allow. `most`: the mean that keeps all targets, however far away.
        """
        away = 1 - support if away is None else away
        if not len(self.targets):
            return np.full(mean.shape, np.nan)
        needed = self._needed(away, strictness, most)
        found = np.array(
            [np.interp(m, n, self.targets) for m, n in zip(mean, needed, strict=True)], np.float64
        ).reshape(mean.shape)
        low = mean < needed[:, :1]
        found = np.where(low, mean + (self.targets[0] - needed[:, :1]), found)
        found[support < self.least_support] = np.nan
        return found

    def needed(
        self,
        target: float | Float[np.ndarray, "*t V"],
        away: Float[np.ndarray, " V"],
        strictness: Float[np.ndarray, " V"] | float = 1.0,
        most: Float[np.ndarray, " V"] | float = np.inf,
    ) -> Float[np.ndarray, "*t V"]:
        """The mean from which on a target is kept (arguments: `bound`); inf: no level keeps it.

        Between targets it is interpolated.
        """
        if not len(self.targets):
            return np.full(len(away), np.nan)
        known = self._needed(away, strictness, most)
        target = np.broadcast_to(target, np.broadcast_shapes(np.shape(target), away.shape))
        found = np.array(
            [
                np.interp(one, self.targets, row, right=np.inf)
                for one, row in zip(np.moveaxis(target, -1, 0), known, strict=True)
            ]
        )
        found = np.moveaxis(found.reshape(len(known), *target.shape[:-1]), 0, -1)
        return np.where(target < self.targets[0], known[:, 0] - (self.targets[0] - target), found)

    def _needed(
        self,
        away: Float[np.ndarray, " V"],
        strictness: Float[np.ndarray, " V"] | float,
        most: Float[np.ndarray, " V"] | float,
    ) -> Float[np.ndarray, "V G"]:
        """The mean that each of the targets needs."""
        found = np.minimum(np.maximum.accumulate(self.thresholds + np.outer(away, self.slopes), 1), 1)
        found = 1 - (1 - found) / np.reshape(strictness, (-1, 1))
        return np.fmin(found, np.reshape(most, (-1, 1)) - _ROUNDED)


NO_CALIBRATION = Calibration("uncalibrated", 0.95, 0, np.zeros(0), np.zeros(0), np.zeros(0), 0.0)
PHOTOS_ONLY = (1.0, 1.0)  # screens of a model that knows the photos' pixels alone
PHOTO_LENGTHS = (0.3, 0.5)  # of position / extent and direction, for how far a place is from the photos


@dataclass(frozen=True, eq=False)
class ViewModel:
    """What quality to expect of one category, by level and viewpoint (formulas: the module's text)."""

    label_id: LabelId
    quality: QualityKind
    curves: tuple[SsimModel, ...]  # of each level, ascending: Eq. 3, or a constant (`constant_curve`)
    extent: Positive  # of the scene, world units
    median_log_distance: Number  # log distance, for viewpoints that know none
    focal: Positive  # of the photos, pixels: what screens are measured by
    screens: tuple[Positive, Positive]  # from and to; what lies outside counts as the end of it
    inputs: Float[np.ndarray, "n 9"]  # of the views behind it: position / extent, direction, log s, 0, log d
    heldout_inputs: Bool[np.ndarray, " n"]  # photos that training never saw; of fidelity none
    lengths: tuple[Positive, Positive, Positive, Positive]  # of the groups of inputs
    heldout_variance: NotNegative  # over the variance of the process
    photos: Float[np.ndarray, "6 P"]  # position / extent and direction of photos; none: the views are photos
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
        screen: Float[np.ndarray, " V"] | None = None,
    ) -> Prediction:
        """Predict the quality of each level at V viewpoints, whether a photo was taken there or not.

        Args:
            distance: [V], d_min to the category in world units; NaN: unknown.
            position: [V, 3], camera centres in world units.
            direction: [V, 3], unit viewing directions (the camera's z) in the world.
            screen: [V], focal length in pixels over `focal`; None: 1.

        Returns:
            mean and bound [V, K], each column a level; support [V]: 1 at a known viewpoint, 0 far from all;
            away [V]: 0 at a photo, 1 far from all. The bound is NaN where the support is too small.

        Example:
            >>> import numpy as np
            >>> from sagesplat import open_run
            >>> run = open_run("runs/garden")  # doctest: +SKIP
            >>> near = np.array([3.0])  # world units
            >>> camera, model = run.scene.views[0].camera, run.fidelity[184]  # doctest: +SKIP
            >>> model.predict(near, camera.position[None], camera.direction[None]).bound  # doctest: +SKIP
        """
        x = self.inputs_at(distance, position, direction, screen)
        near = matern32(x, self.inputs, self.lengths)
        k = near + self.heldout_variance * self.heldout_inputs
        mean = monotone(means_at(self.curves, distance) + k @ self.weights)
        support = near.max(1)
        away = away_from(x, self.photos, support)
        return Prediction(mean, self.calibration.bound(mean, support, away), support, away)

    def inputs_at(
        self,
        distance: Float[np.ndarray, " V"],
        position: Float[np.ndarray, "V 3"],
        direction: Float[np.ndarray, "V 3"],
        screen: Float[np.ndarray, " V"] | None = None,
    ) -> Float[np.ndarray, "V 9"]:
        """The inputs of viewpoints, as of `predict`."""
        screen = None if screen is None else np.clip(screen, *self.screens)
        return inputs_of(distance, position, direction, self.extent, self.median_log_distance, screen)


class Where(NamedTuple):
    """Where V cameras are, as `ViewModel.predict` takes it after the distance."""

    position: Float[np.ndarray, "V 3"]  # world
    direction: Float[np.ndarray, "V 3"]
    screen: Float[np.ndarray, " V"]


def where(cameras: Sequence[Camera], focal: float) -> Where:
    """Of cameras, by the photos' focal length in pixels."""
    position = np.array([camera.position for camera in cameras], np.float64).reshape(-1, 3)
    direction = np.array([camera.direction for camera in cameras], np.float64).reshape(-1, 3)
    return Where(position, direction, np.array([camera.focal for camera in cameras], np.float64) / focal)


def away_from(
    x: Float[np.ndarray, "V 9"], photos: Float[np.ndarray, "6 P"], support: Float[np.ndarray, " V"]
) -> Float[np.ndarray, " V"]:
    """How far viewpoints, given by their inputs, are from the photos: 0 at one of them, 1 far from all.

    Without `photos` the known viewpoints are the photos, and it is 1 - support.
    """
    if not photos.size:
        return 1 - support
    return 1 - matern32(x[:, :6], photos.T, PHOTO_LENGTHS).max(1)


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
    n = len(model.heldout_inputs)
    shapes = (len(model.inputs), *model.weights.shape)
    if not n or not model.curves or shapes != (n, n, len(model.curves)):
        raise ValueError("lists of unequal length")
    check_parts(model.calibration, model.screens, model.inputs, model.photos, model.weights)


def check_parts(calibration: Calibration, screens: tuple[float, float], *numbers: np.ndarray) -> None:
    """ValueError for parts of a model that no calibration, screens or numbers of it can have."""
    targets, thresholds, slopes = calibration.targets, calibration.thresholds, calibration.slopes
    if not targets.shape == thresholds.shape == slopes.shape:
        raise ValueError("lists of unequal length")
    if not (np.diff(targets) > 0).all() or not (np.abs(targets) <= 1).all():
        raise ValueError("targets out of range")
    if not screens[0] <= screens[1]:
        raise ValueError("screens out of order")
    if not all((np.abs(array) <= _LARGEST_THRESHOLD).all() for array in (thresholds, slopes)):
        raise ValueError("thresholds or slopes out of range")
    if not all((np.abs(array) < LARGEST).all() for array in numbers):
        raise ValueError("numbers out of range")
