"""The viewpoint model: SSIM of a category at each level from any viewpoint, with a lower confidence bound.

Eq. 3 over distance (`adapt.model`) is the mean m_k(d) of level k; a Gaussian process over the viewpoint
models what is left of it (Rasmussen & Williams 2006, eqs. 2.25, 2.26, 5.8; 5.10-5.12 for leaving one out).
One kernel serves all levels of a category, only its amplitude differs. All that a viewer has to evaluate:

    x        = (position / extent, direction, log distance): 7 numbers, 3 groups with a length scale each
    a(x, x') = sqrt(3 * sum over the groups of |x - x'|^2 / length^2)
    c(x, x') = (1 + a) exp(-a)                                        Matern 3/2
    S_ij     = c(x_i, x_j) + heldout_variance * u_i * u_j + noise * [i = j]
               u: 0 at photos trained on, else 1
    k_i      = c(x, x_i) + heldout_variance * u_i
    mean_k   = m_k(d) + sum_i k_i * weights_ik + composition_bias     made monotone over the levels:
               half of (the largest up to k + the smallest from k on), kept in [-1, 1]
    spread_k = amplitudes_k * sqrt(1 + heldout_variance + noise - k' S^-1 k)
               S: n <= 200, one Cholesky factor
    bound_k  = the largest over j <= k of mean_j - sqrt((multiplier * spread_j)^2 + composition_std^2)
    support  = max_i c(x, x_i)                                        1 at a known view, 0 far from all

`heldout_variance` is the variance of a constant by which views that training never saw differ: calibration
views tell what it is. An unknown distance (NaN) counts as `median_log_distance` in x, and m_k is then the
median.

`multiplier` makes the decisions come true, not each number: among calibration views, each predicted without
itself, the cheapest level whose bound reaches a target may miss it for at most 1 - confidence of all targets
that the plan accepts: conformal risk control (Angelopoulos et al. 2022). One more view that misses all
its targets is counted in, as the quantile of split conformal prediction does (Vovk et al. 2005), with as many
targets as a view has on average. Each category's own errors scale its multiplier as far as they are many, the
others' stand in for the rest. The promise is on average over views like the calibration views and over all
categories together, as far as their errors are exchangeable: those of one view, and of views close together,
are alike, so a single capture can stray from it by a few percent. Without enough calibration views (19 pairs
of view and category at 0.95) training views stand in, which look better than new ones: "uncalibrated".
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from sagesplat.adapt.eq3 import LARGEST, SsimModel, fit_models, model_from_json
from sagesplat.adapt.observe import TOTAL, Observations
from sagesplat.core.errors import DataError, RunError, short
from sagesplat.io.files import read_json, write_json
from sagesplat.scene.scene import Scene

STATUSES = (
    "calibrated",  # by its own calibration views, mostly
    "pooled",  # mostly by those of other categories
    "uncalibrated",  # too few in all: by training views left out of the fit, which look better than new ones
)
GROUPS = (slice(0, 3), slice(3, 6), slice(6, 7))  # of the inputs: position, direction, log distance
# logs of the hyperparameters (lengths of GROUPS; heldout variance and noise over the amplitude's square):
# where they are sought, one standard deviation of the prior, and the bounds in standard deviations
PRIOR = np.log([0.3, 0.5, 0.5, 0.1, 0.1])
PRIOR_WIDTH = np.array([0.7, 0.7, 0.7, 1.5, 1.5])
PRIOR_REACH = 3.0
FEW = 0.1  # SSIM that a category's spread is uncertain by if seen in one view; falls as 1 / views
OWN_VIEWS = 8  # calibration views from which a category's own errors count more than those of the others
EASY = 0.1  # SSIM; targets further below the cheapest level's bound would hide violations of the others
NUMBERS = (
    "extent",
    "median_log_distance",
    "heldout_variance",
    "noise",
    "multiplier",
    "confidence",
    "rmse",
    "composition_bias",
    "composition_std",
)
MULTIPLIERS = np.arange(4.0, -0.01, -0.02)  # widest bound first


class Prediction(NamedTuple):
    """SSIM of one category at each of its levels from V viewpoints."""

    mean: Float[np.ndarray, "V K"]
    spread: Float[np.ndarray, "V K"]  # standard deviation of one measurement
    bound: Float[np.ndarray, "V K"]  # what can be promised; like the mean, it never falls from level to level
    support: Float[np.ndarray, " V"]  # 1 at a known viewpoint, 0 far from all


@dataclass(frozen=True, eq=False)
class ViewModel:
    """What SSIM to expect of one category, by level and viewpoint (formulas: the module's text)."""

    label_id: int
    curves: tuple[SsimModel, ...]  # Eq. 3 of each level, ascending
    extent: float  # of the scene, world units
    median_log_distance: float  # log distance, for viewpoints that know none
    inputs: Float[np.ndarray, "n 7"]  # of training and calibration views: position / extent, direction, log d
    heldout_inputs: Bool[np.ndarray, " n"]  # the calibration views
    lengths: tuple[float, float, float]  # of the three groups of inputs
    heldout_variance: float  # variances over that of the process
    noise: float
    weights: Float[np.ndarray, "n K"]  # SSIM
    amplitudes: Float[np.ndarray, " K"]  # SSIM
    multiplier: float  # conformal: spreads from mean to bound
    confidence: float  # share of accepted decisions that hold
    rmse: float  # of its views, each predicted without itself; SSIM over all levels
    status: str  # one of STATUSES
    composition_bias: float = (
        0.0  # what a category gains or loses where its neighbours are at other levels, SSIM
    )
    composition_std: float = 0.0  # what to leave for that, SSIM

    @property
    def levels(self) -> tuple[int, ...]:
        """The levels that it predicts, ascending."""
        return tuple(curve.level for curve in self.curves)

    @property
    def num_views(self) -> int:
        """Views behind the process."""
        return len(self.inputs)

    @property
    def num_calibration(self) -> int:
        """Those of them that training never saw."""
        return int(self.heldout_inputs.sum())

    @cached_property
    def _cholesky(self) -> tuple[np.ndarray, bool]:
        covariance = matern32(self.inputs, self.inputs, self.lengths)
        covariance += self.heldout_variance * np.outer(self.heldout_inputs, self.heldout_inputs)
        return cho_factor(covariance + self.noise * np.eye(self.num_views), lower=True)

    def predict(
        self,
        distance: Float[np.ndarray, " V"],
        position: Float[np.ndarray, "V 3"],
        direction: Float[np.ndarray, "V 3"],
    ) -> Prediction:
        """Predict the SSIM of each level at V viewpoints, whether a photo was taken there or not.

        The mean is Eq. 3 plus a Gaussian process over the viewpoint; the bound is conformal (formulas: the
        module's docstring).

        Args:
            distance: [V], d_min to the category in world units; NaN: unknown.
            position: [V, 3], camera centres in world units.
            direction: [V, 3], unit viewing directions (the camera's z) in the world.

        Returns:
            mean, spread and bound [V, K] in SSIM, each column a level; support [V]: 1 at a known viewpoint, 0
            far from all.

        Example:
            >>> import numpy as np
            >>> from sagesplat import open_run
            >>> run = open_run("runs/garden")  # doctest: +SKIP
            >>> near = np.array([3.0])  # world units
            >>> camera, model = run.scene.views[0].camera, run.promises[184]  # doctest: +SKIP
            >>> model.predict(near, camera.position[None], camera.direction[None]).bound  # doctest: +SKIP
        """
        x = _inputs(distance, position, direction, self.extent, self.median_log_distance)
        near = matern32(x, self.inputs, self.lengths)
        k = near + self.heldout_variance * self.heldout_inputs
        mean = _at(self.curves, distance) + k @ self.weights
        known = (k.T * cho_solve(self._cholesky, k.T)).sum(0)
        variance = np.maximum(1 + self.heldout_variance + self.noise - known, 0)
        spread = np.sqrt(variance)[:, None] * self.amplitudes
        return promise(
            mean + self.composition_bias, spread, self.multiplier, near.max(1), self.composition_std
        )


def promise(
    mean: Float[np.ndarray, "V K"],
    spread: Float[np.ndarray, "V K"],
    multiplier: float | Float[np.ndarray, "V 1"],
    support: Float[np.ndarray, " V"],
    composition_std: float = 0.0,
) -> Prediction:
    """Monotone mean and bound from the process's own mean and spread."""
    # Halfway between the largest so far and the smallest to come: as good as least squares, and one line.
    rising = np.maximum.accumulate(mean, 1)
    mean = np.clip((rising + np.minimum.accumulate(mean[:, ::-1], 1)[:, ::-1]) / 2, -1, 1)
    low = mean - np.hypot(multiplier * spread, composition_std)
    return Prediction(mean, spread, np.maximum.accumulate(low, 1), support)


def in_composition(
    models: Mapping[int, ViewModel], changes: Mapping[int, Float[np.ndarray, " n"]]
) -> dict[int, ViewModel]:
    """The models of categories in composition, beside others at other levels.

    `changes`: by label id, SSIM measured in planned compositions minus SSIM measured with everything at the
    same level. Their mean shifts the category's mean, their spread widens its bound at its confidence.
    """
    found = {}
    for label, model in models.items():
        change = np.asarray(changes.get(label, ()), np.float64)
        if len(change):
            left = max(NormalDist().inv_cdf(model.confidence), 0.0) * float(change.std())
            model = replace(model, composition_bias=float(change.mean()), composition_std=left)
        found[label] = model
    return found


def fit_promises(
    observations: Observations,
    scene: Scene,
    confidence: float = 0.95,
    curves: Mapping[tuple[int, int], SsimModel] | None = None,
) -> dict[int, ViewModel]:
    """Fit a calibrated SSIM model per category: Eq. 3, a Gaussian process, and a conformal multiplier.

    Rows of test views and of the full image are ignored. A category has the levels that Eq. 3 could be fitted
    for, and learns from the views measured at all of them.

    Args:
        observations: Rows of `observe`.
        scene: The capture; its training and calibration views are used.
        confidence: 1 - the accepted risk of a violated target, between 0 and 1 (conformal risk control,
            Angelopoulos et al. 2022).
        curves: Result of `fit_models` on the same rows, if it is at hand.

    Returns:
        Models by label id. A category that no view shows at all levels has none.

    Raises:
        RunError: For an impossible confidence.
    """
    if not 0 < confidence < 1:
        raise RunError(
            f"confidence {confidence} is impossible; choose a number between 0 and 1, such as 0.95"
        )
    rows = observations.select((observations.label_id != TOTAL) & np.isfinite(observations.ssim))
    seen = set(rows.label_id.tolist())
    curves = fit_models(rows, scene.train_ids) if curves is None else curves
    curves = {key: curve for key, curve in curves.items() if key[0] in seen}
    if absent := seen - {label for label, _ in curves}:  # not in any training view
        late = rows.select(np.isin(rows.label_id, list(absent)))
        curves |= fit_models(late, scene.calibration_ids)
    models, left_out = [], []
    for label_id in sorted({label for label, _ in curves}):
        mine = tuple(curve for (label, _), curve in sorted(curves.items()) if label == label_id)
        if fitted := _fit(rows.select(rows.label_id == label_id), scene, mine, confidence):
            models.append(fitted[0])
            left_out.append(fitted[1])
    return {model.label_id: model for model in _calibrated(models, left_out, confidence)}


class _LeftOut(NamedTuple):
    """Views of one category, each predicted without itself."""

    ssim: np.ndarray  # [n, K] measured
    mean: np.ndarray  # [n, K]
    spread: np.ndarray  # [n, K]

    @property
    def errors(self) -> np.ndarray:
        """Mean square over the levels, in spreads, [n]."""
        return (((self.mean - self.ssim) / self.spread) ** 2).mean(1)


def _fit(
    rows: Observations, scene: Scene, curves: tuple[SsimModel, ...], confidence: float
) -> tuple[ViewModel, _LeftOut] | None:
    """One category's model before calibration, and its views left out."""
    levels = np.array([curve.level for curve in curves])
    known = np.concatenate([scene.train_ids, scene.calibration_ids])
    rows = rows.select(np.isin(rows.view, known) & np.isin(rows.level, levels))
    views, column = np.unique(rows.view, return_inverse=True)
    ssim = np.full((len(views), len(levels)), np.nan)
    ssim[column, np.searchsorted(levels, rows.level)] = rows.ssim
    distance = np.full(len(views), np.nan)
    distance[column] = rows.distance
    whole = np.isfinite(ssim).all(1)
    views, ssim, distance = views[whole], ssim[whole], distance[whole]
    if not len(views):
        return None

    measured = np.log(distance[distance > 0])
    median_log_distance = float(np.median(measured)) if len(measured) else 0.0
    cameras = [scene.views[row].camera for row in views]
    position, direction = (np.stack([getattr(c, of) for c in cameras]) for of in ("position", "direction"))
    extent = scene.extent if scene.extent > 0 else 1.0  # all cameras in one place
    x = _inputs(distance, position, direction, extent, median_log_distance)
    u = np.isin(views, scene.calibration_ids)
    residual = ssim - _at(curves, distance)
    squares = [cdist(x[:, group], x[:, group], "sqeuclidean") for group in GROUPS]
    theta = _hyperparameters(squares, u, residual)
    inverse = _inverse(_terms(squares, u, theta)[0])
    weights = inverse @ residual
    amplitudes = np.sqrt(_variances(residual, weights))
    own = np.diag(inverse)[:, None]
    mean, spread, _, _ = promise(ssim - weights / own, amplitudes / np.sqrt(own), 0.0, np.ones(len(views)))
    left_out = _LeftOut(ssim, mean, spread)
    position_length, direction_length, distance_length, heldout_variance, noise = np.exp(theta).tolist()
    model = ViewModel(
        label_id=curves[0].label_id,
        curves=curves,
        extent=extent,
        median_log_distance=median_log_distance,
        inputs=x,
        heldout_inputs=u,
        lengths=(position_length, direction_length, distance_length),
        heldout_variance=heldout_variance,
        noise=noise,
        weights=weights,
        amplitudes=amplitudes,
        multiplier=0.0,
        confidence=confidence,
        rmse=float(np.sqrt(np.mean((mean - ssim) ** 2))),
        status="uncalibrated",
    )
    return model, left_out


def _at(curves: tuple[SsimModel, ...], distance: np.ndarray) -> np.ndarray:
    return np.stack([curve(np.asarray(distance, np.float64)) for curve in curves], 1)


def _inputs(
    distance: np.ndarray,
    position: np.ndarray,
    direction: np.ndarray,
    extent: float,
    median_log_distance: float,
) -> np.ndarray:
    known = np.isfinite(distance) & (distance > 0)
    log_distance = np.where(known, np.log(np.where(known, distance, 1.0)), median_log_distance)
    return np.column_stack([position / extent, direction, log_distance]).astype(np.float64)


def matern32(
    a: Float[np.ndarray, "A 7"], b: Float[np.ndarray, "B 7"], lengths: Sequence[float]
) -> Float[np.ndarray, "A B"]:
    """c(x, x') of the module's text, for all pairs of inputs."""
    scale = np.repeat(lengths, [group.stop - group.start for group in GROUPS])
    scaled_distance = np.sqrt(3) * cdist(a / scale, b / scale)
    return (1 + scaled_distance) * np.exp(-scaled_distance)


def _terms(
    squares: list[np.ndarray], u: np.ndarray, theta: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray]]:
    """S and its derivatives by the log hyperparameters, from squared distances in each group, [n, n] each."""
    *lengths, heldout_variance, noise = np.exp(theta)
    scaled = [3 * square / length**2 for square, length in zip(squares, lengths, strict=True)]
    scaled_distance = np.sqrt(np.sum(scaled, 0))
    exp_neg_r = np.exp(-scaled_distance)
    offset, own = heldout_variance * np.outer(u, u), noise * np.eye(len(u))
    return (1 + scaled_distance) * exp_neg_r + offset + own, [*(s * exp_neg_r for s in scaled), offset, own]


def _inverse(S: np.ndarray) -> np.ndarray:
    return cho_solve(cho_factor(S, lower=True), np.eye(len(S)))


def _variances(residual: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Squared amplitude of each level, the best for its residuals [K]."""
    return (residual * weights).mean(0) + (FEW / len(residual)) ** 2


def _hyperparameters(squares: list[np.ndarray], u: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Logs of lengths, heldout variance and noise: marginal likelihood, mean over levels, times the prior."""

    def cost(theta: np.ndarray) -> tuple[float, np.ndarray]:
        S, slopes = _terms(squares, u, theta)
        inverse = _inverse(S)
        weights = inverse @ residual
        variances = _variances(residual, weights)
        z = (theta - PRIOR) / PRIOR_WIDTH
        value = (len(u) * np.log(variances).mean() - np.linalg.slogdet(inverse)[1] + z @ z) / 2
        slope = (inverse - (weights / variances) @ weights.T / len(variances)) / 2
        return value, np.array([(slope * s).sum() for s in slopes]) + z / PRIOR_WIDTH

    reach = PRIOR_REACH * PRIOR_WIDTH
    bounds = list(zip(PRIOR - reach, PRIOR + reach, strict=True))
    return minimize(cost, PRIOR, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 50}).x


def _calibrated(models: list[ViewModel], left_out: list[_LeftOut], confidence: float) -> list[ViewModel]:
    """The models with their conformal multipliers."""
    if not models:
        return []
    own = [
        _LeftOut(*(part[m.heldout_inputs] for part in out)) for m, out in zip(models, left_out, strict=True)
    ]
    calibrated = sum(len(out.ssim) for out in own) >= _fewest(confidence)
    used = own if calibrated else left_out
    errors = [out.errors for out in used]
    pooled = OWN_VIEWS * np.concatenate(errors).mean()
    # what a category's scale is without the view that it is tried on
    tried = [np.sqrt((pooled + e.sum() - e) / (OWN_VIEWS + len(e) - 1)) for e in errors]
    multiplier = _conformal_multiplier(used, tried, confidence)
    if multiplier is None:  # a scene of a few views: as if errors were Gaussian
        gaussian = max(NormalDist().inv_cdf(confidence), 0.0)
        return [replace(model, multiplier=gaussian) for model in models]
    done = []
    for model, e in zip(models, errors, strict=True):
        scale = math.sqrt((pooled + e.sum()) / (OWN_VIEWS + len(e)))
        status = "uncalibrated" if not calibrated else "calibrated" if len(e) >= OWN_VIEWS else "pooled"
        done.append(replace(model, multiplier=multiplier * scale, status=status))
    return done


def _fewest(confidence: float) -> float:
    """Views needed to calibrate at a confidence: with fewer, even no violation at all is not enough."""
    return confidence / (1 - confidence) - 1e-9


def _conformal_multiplier(used: list[_LeftOut], scales: list[np.ndarray], confidence: float) -> float | None:
    """The smallest multiplier from which on the risk stays within 1 - confidence; None from too few views."""
    widest = max(out.ssim.shape[1] for out in used)
    # a category with fewer levels repeats its last: no decision falls there
    ssim, mean, spread = (
        np.concatenate([np.pad(part, ((0, 0), (0, widest - part.shape[1])), "edge") for part in parts])
        for parts in zip(*used, strict=True)
    )
    if len(ssim) < _fewest(confidence):
        return None
    spread *= np.concatenate(scales)[:, None]
    best = MULTIPLIERS[0]
    for multiplier in MULTIPLIERS:
        violated, total_risk = decisions(ssim, promise(mean, spread, multiplier, np.empty(0)).bound)
        if violated.sum() + total_risk.mean() > (1 - confidence) * (total_risk.sum() + total_risk.mean()):
            break
        best = multiplier
    return float(best)


def decisions(
    ssim: Float[np.ndarray, "n K"], bound: Float[np.ndarray, "n K"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """In each view the length (SSIM) of the targets that a plan by `bound` misses, and of all it accepts.

    `bound` never falls; a target between two bounds is given the level of the upper one. Targets more than
    EASY below the lowest bound are left out of both.
    """
    below = np.concatenate([bound[:, :1] - EASY, bound[:, :-1]], 1)
    violated = np.maximum(bound - np.maximum(below, ssim), 0).sum(1)
    return violated, bound[:, -1] - below[:, 0]


def write_promises(path: Path, models: Mapping[int, ViewModel]) -> None:
    """promises.json: one entry per category."""
    write_json(path, {"promises": [_to_json(model) for model in models.values()]})


def read_promises(path: Path) -> dict[int, ViewModel]:
    """What `write_promises` wrote; DataError where the content cannot be used."""
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
    return {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in entry.items()}


def _from_json(entry: dict[str, Any]) -> ViewModel:
    curves = tuple(model_from_json(curve) for curve in entry["curves"])
    x, y, z = map(float, entry["lengths"])
    inputs, weights, amplitudes = (
        np.array(entry[k], np.float64) for k in ("inputs", "weights", "amplitudes")
    )
    numbers = {name: float(entry[name]) for name in NUMBERS}
    u = np.array(entry["heldout_inputs"], bool)
    n = len(u)
    shapes = (inputs.shape, weights.shape, amplitudes.shape)
    if not n or u.shape != (n,) or not curves or shapes != ((n, 7), (n, len(curves)), (len(curves),)):
        raise ValueError("lists of unequal length")
    finite = all(
        (np.abs(a) < LARGEST).all() for a in (inputs, weights, amplitudes, (x, y, z), list(numbers.values()))
    )
    if (
        not finite
        or min(x, y, z, numbers["extent"], numbers["noise"]) <= 0
        or numbers["heldout_variance"] < 0
    ):
        raise ValueError("numbers out of range")
    if entry["status"] not in STATUSES:
        raise ValueError(f"unknown status {entry['status']!r}")
    return ViewModel(
        label_id=int(entry["label_id"]),
        curves=curves,
        heldout_inputs=u,
        lengths=(x, y, z),
        status=entry["status"],
        inputs=inputs,
        weights=weights,
        amplitudes=amplitudes,
        **numbers,
    )
