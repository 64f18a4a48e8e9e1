"""SSIM over viewing distance, per category and level (Eq. 3 of the paper)."""

import math
from collections.abc import Iterator
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, get_args, overload

import numpy as np
from jaxtyping import Float
from msgspec import Meta
from scipy.ndimage import median_filter
from scipy.optimize import least_squares

from sagesplat.adapt.observe import TOTAL, Observations
from sagesplat.core.limits import Count, NotNegative, Number, StepNumber
from sagesplat.io.files import write_json
from sagesplat.io.typed import read_json_as

NOISE = 0.05  # SSIM residual from which an observation counts as an outlier (scale of the soft L1 loss)
FLOOR = 0.003  # SSIM residual below which a better fit does not justify a parameter
REGIME_SIZE = 4  # parameters of one regime: K, gamma, mu, alpha
SIDE = 6  # fewest observations on a side of beta
Status = Literal["two regimes", "one regime", "constant", "not converged"]
STATUSES: tuple[Status, ...] = get_args(Status)

# Bounds and starts of one regime, with distances mapped to [0, 1]. gamma = s**-alpha, where s is the distance
# from mu at which SSIM has fallen to K/e: unlike gamma, s means the same at every alpha.
ALPHA = (0.5, 4.0)
LOG_S = (math.log(0.02), math.log(30.0))
STARTS = np.stack(
    np.meshgrid(np.linspace(*LOG_S, 11), np.linspace(0, 1, 11), [0.6, 1.0, 2.0, 3.5], indexing="ij"), -1
).reshape(-1, 3)  # log s, mu, alpha


@dataclass(frozen=True)
class Eq3:
    """K1 exp(-g1 |d - mu1|^a1) for d < beta, K2 exp(-g2 |d - mu2|^a2) from beta on; d in world units."""

    K1: Number
    g1: NotNegative
    mu1: Number
    a1: Number
    K2: Number
    g2: NotNegative
    mu2: Number
    a2: Number
    beta: Number

    def __iter__(self) -> Iterator[float]:
        return iter(astuple(self))

    def __call__(self, distance: np.ndarray) -> np.ndarray:
        """SSIM at each distance, as the equation says and nothing more."""
        near = self.K1 * np.exp(-self.g1 * np.abs(distance - self.mu1) ** self.a1)
        far = self.K2 * np.exp(-self.g2 * np.abs(distance - self.mu2) ** self.a2)
        return np.where(distance < self.beta, near, far)


@dataclass(frozen=True)
class SsimModel:
    """What SSIM to expect of one category at one level, by distance."""

    label_id: Annotated[int, Meta(ge=TOTAL, le=2**15 - 1)]
    level: StepNumber  # of recorded levels the training step, of nested ones 1 to K
    params: Eq3  # one regime or a constant: both halves are equal
    d_range: tuple[Number, Number]  # smallest and largest distance fitted, world units; (0, 0) = none known
    median: Number  # SSIM where the distance is unknown
    rmse: Number  # of the fitted observations, SSIM
    num_observations: Count
    status: Status  # "not converged" still holds the best parameters found

    def __post_init__(self) -> None:
        if self.d_range[0] > self.d_range[1]:
            raise ValueError("the smallest distance is above the largest")

    @overload
    def __call__(self, distance: float) -> float: ...
    @overload
    def __call__(self, distance: np.ndarray) -> np.ndarray: ...
    def __call__(self, distance: float | np.ndarray) -> float | np.ndarray:
        """Predicted SSIM in [-1, 1]: beyond `d_range` the value at its end, the median where NaN."""
        d = np.asarray(distance, np.float64)
        ssim = np.where(np.isnan(d), self.median, self.params(np.clip(d, *self.d_range)))
        ssim = np.clip(ssim, -1.0, 1.0)
        return ssim if isinstance(distance, np.ndarray) else float(ssim)


class Samples(NamedTuple):
    """What Eq. 3 of a category at a level is fitted to."""

    label_id: int
    level: int
    distance: Float[np.ndarray, " n"]
    ssim: Float[np.ndarray, " n"]


def samples(observations: Observations, train_views: np.ndarray) -> list[Samples]:
    """Distance and SSIM of every (category, level) seen in the training views (rows of Scene.views).

    Rows of other views, rows of the whole image and rows without an SSIM are ignored.
    """
    use = np.isin(observations.view, train_views) & (observations.label_id != TOTAL)
    rows = observations.select(use & np.isfinite(observations.ssim))
    found = []
    for label_id, level in np.unique(np.stack([rows.label_id, rows.level], 1), axis=0).tolist():
        mine = (rows.label_id == label_id) & (rows.level == level)
        found.append(Samples(label_id, level, rows.distance[mine], rows.ssim[mine]))
    return found


def fit_models(observations: Observations, train_views: np.ndarray) -> dict[tuple[int, int], SsimModel]:
    """Fit Eq. 3 of the paper, SSIM over distance, to every category and level.

        SSIM(d) = K1 exp(-g1 |d - mu1|^a1) for d < beta, else K2 exp(-g2 |d - mu2|^a2)

    Fewer parameters are used where they serve as well: one regime, or a constant (`SsimModel.status`).

    Args:
        observations: Rows of `observe`. Only training views, single categories and finite SSIM are used.
        train_views: Rows of `Scene.views`.

    Returns:
        Models by (label id, level). A pair without any row has none; "not converged" is a status, not an
            error.
    """
    return {(found.label_id, found.level): fit_model(*found) for found in samples(observations, train_views)}


def fit_model(
    label_id: int, level: int, distance: Float[np.ndarray, " n"], ssim: Float[np.ndarray, " n"]
) -> SsimModel:
    """Eq. 3 by bounded robust least squares, with as few regimes as the observations justify.

    `distance` may hold NaN (unknown), `ssim` may not and has at least one value. A constant, one regime and
    two regimes compete by their information criterion, so noise alone earns no parameters.
    """
    ssim = ssim.astype(np.float64)
    median = float(np.median(ssim))
    known = np.isfinite(distance)
    order = np.argsort(distance[known], kind="stable")
    d, y = distance[known][order].astype(np.float64), ssim[known][order]
    low, high = (float(d[0]), float(d[-1])) if len(d) else (0.0, 0.0)

    flat = Eq3(median, 0.0, low, 1.0, median, 0.0, low, 1.0, high)
    candidates: list[tuple[float, Eq3, Status]] = [(_criterion(y - median, 1), flat, "constant")]
    if high - low > 1e-6 * abs(high):
        candidates += _regimes(d, y)
    _, params, status = min(candidates, key=lambda candidate: candidate[0])
    residual = y - params(d) if len(d) else ssim - median
    rmse = float(np.sqrt(np.mean(residual**2)))
    return SsimModel(label_id, level, params, (low, high), median, rmse, len(ssim), status)


def _regimes(d: np.ndarray, y: np.ndarray) -> list[tuple[float, Eq3, Status]]:
    """(criterion, parameters, status) of one and of two regimes on observations sorted by distance."""
    low, span = d[0], d[-1] - d[0]
    x = (d - low) / span

    def in_world_units(regime: np.ndarray) -> tuple[float, float, float, float]:
        K, log_s, mu, a = regime.tolist()
        return K, math.exp(-a * (log_s + math.log(span))), float(low + mu * span), a

    start, halves = _search(x, y)
    found = []
    if len(np.unique(x)) >= REGIME_SIZE:
        regime, converged = _polish(x, y, start)
        params = Eq3(*in_world_units(regime), *in_world_units(regime), float(d[-1]))
        score = _criterion(y - _curve(regime, x), REGIME_SIZE)
        found.append((score, params, "one regime" if converged else "not converged"))
    if halves:
        split, near_start, far_start = halves
        near, near_converged = _polish(x[:split], y[:split], near_start)
        far, far_converged = _polish(x[split:], y[split:], far_start)
        params = Eq3(*in_world_units(near), *in_world_units(far), float(d[split]))
        residual = y - np.append(_curve(near, x[:split]), _curve(far, x[split:]))
        status = "two regimes" if near_converged and far_converged else "not converged"
        found.append((_criterion(residual, 2 * REGIME_SIZE + 1), params, status))
    return found


def _search(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, tuple[int, np.ndarray, np.ndarray] | None]:
    """Starts (K, log s, mu, alpha): for one regime, and for two with the first row of the second, if any.

    Every shape in STARTS is scored at every split at once: K is linear, so running sums give its least
    squares value and cost on both sides of each observed distance.
    """
    # Observations far from the median of their neighbours weigh as little as the robust loss will let them.
    outlying = (y - median_filter(y, 7, mode="nearest")) / NOISE
    w = 1 / np.sqrt(1 + outlying**2)
    shapes = np.exp(-((np.exp(-STARTS[:, :1]) * np.abs(x - STARTS[:, 1:2])) ** STARTS[:, 2:]))  # [S, n]
    products = (w * shapes * shapes, w * shapes * y, (w * y * y)[None])
    near_costs, near = _best_shapes(*[np.cumsum(p, 1) for p in products], top=np.maximum.accumulate(y))
    far_costs, far = _best_shapes(
        *[np.cumsum(p[:, ::-1], 1)[:, ::-1] for p in products], top=np.maximum.accumulate(y[::-1])[::-1]
    )

    splits = np.arange(SIDE, max(SIDE, len(x) - SIDE + 1))
    splits = splits[x[splits] > x[splits - 1]]
    if not len(splits):
        return near[-1], None
    split = int(splits[np.argmin(near_costs[splits - 1] + far_costs[splits])])
    return near[-1], (split, near[split - 1], far[split])


def _best_shapes(
    ff: np.ndarray, fy: np.ndarray, yy: np.ndarray, top: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Per column of the running sums [S, n]: the least cost [n] and its K, log s, mu, alpha [n, 4]."""
    K = np.clip(fy / np.maximum(ff, 1e-12), -1, top)
    costs = yy - 2 * K * fy + K * K * ff
    shape, column = costs.argmin(0), np.arange(costs.shape[1])
    return costs[shape, column], np.column_stack([K[shape, column], STARTS[shape]])


def _polish(x: np.ndarray, y: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, bool]:
    """One regime by robust least squares from `start`, and whether it converged.

    K, the peak, stays below the best observation, so a model never promises more than was seen.
    """
    lower = np.array([-1.0, LOG_S[0], 0.0, ALPHA[0]])
    upper = np.array([y.max() + 1e-6, LOG_S[1], 1.0, ALPHA[1]])
    result = least_squares(
        lambda p: _curve(p, x) - y,
        np.clip(start, lower + 1e-9, upper - 1e-9),
        jac=lambda p: _jacobian(p, x),  # pyright: ignore[reportArgumentType] (stubs know only names)
        bounds=(lower, upper),
        loss="soft_l1",
        f_scale=NOISE,
        ftol=1e-5,
        xtol=1e-5,
        gtol=1e-8,
        max_nfev=100,
    )
    return result.x, bool(result.success)


def _curve(regime: np.ndarray, x: np.ndarray) -> np.ndarray:
    """K exp(-(|x - mu| / s)^alpha) for (K, log s, mu, alpha)."""
    K, log_s, mu, a = regime
    return K * np.exp(-((np.abs(x - mu) * math.exp(-log_s)) ** a))


def _jacobian(regime: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Derivatives of `_curve` by its four parameters, [n, 4]."""
    K, log_s, mu, a = regime
    away = np.maximum(np.abs(x - mu), 1e-6)  # the peak is a cusp for alpha < 1
    log_u = np.log(away) - log_s
    u = np.exp(a * log_u)
    e = np.exp(-u)
    slope = K * e * u
    return np.stack([e, slope * a, slope * a * np.sign(x - mu) / away, -slope * log_u], 1)


def _criterion(residual: np.ndarray, num_parameters: int) -> float:
    """Bayesian information criterion under the robust loss, lower is better; inf without freedom left."""
    n = len(residual)
    if n <= num_parameters + 1:
        return math.inf if num_parameters > 1 else 0.0
    loss = 2 * NOISE**2 * np.mean(np.sqrt(1 + (residual / NOISE) ** 2) - 1)
    return n * math.log(loss + FLOOR**2) + num_parameters * math.log(n)


def write_models(path: Path, models: dict[tuple[int, int], SsimModel]) -> None:
    """models.json: one entry per (category, level)."""
    write_json(path, {"models": [asdict(model) for model in models.values()]})


@dataclass(frozen=True)
class _Models:
    models: list[SsimModel]


def read_models(path: Path) -> dict[tuple[int, int], SsimModel]:
    """What `write_models` wrote; DataError where the content cannot be used."""
    models = read_json_as(
        path, _Models, "a file of quality models", "delete it and run `sagesplat fit` again"
    )
    return {(model.label_id, model.level): model for model in models.models}
