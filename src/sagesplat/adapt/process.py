"""A Gaussian process over the viewpoint, with values at several levels (Rasmussen & Williams 2006, ch. 2, 5).

One kernel serves all levels, only its amplitude differs:

    x        = (position / extent, direction, log screen, log field, log distance): 9 numbers, 4 groups with a
               length scale each, screen and field together; screen: the viewer's focal length in pixels over
               the photos'; field: root of the picture's area, at distance 1
    a(x, x') = sqrt(3 * sum over the groups of |x - x'|^2 / length^2)
    c(x, x') = (1 + a) exp(-a)                                        Matern 3/2
    S_ij     = c(x_i, x_j) + heldout_variance * u_i * u_j + noise * [i = j]
               u: 1 at views that training never saw, else 0
    k_i      = c(x, x_i) + heldout_variance * u_i                     at a viewpoint without a photo
    mean_k   = sum_i k_i * weights_ik,  weights = S^-1 values         eq. 2.25

`heldout_variance` is the variance of a constant by which views that training never saw differ. Length
scales, `heldout_variance` and `noise` maximise the marginal likelihood, mean over the levels, times a prior
(eq. 5.8); what each view would be predicted as without itself is eqs. 5.10 to 5.12.

Of many views only m, the inducing ones, stay in the model (`fit_together`: the subset of regressors, section
8.3.1), with the weights that are the best for all n views:

    weights = argmin |values - C_nm weights|^2 + noise weights' C_mm weights
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve, cholesky, lstsq, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

# of the inputs: position, direction, log screen and log field, log distance
GROUPS = (slice(0, 3), slice(3, 6), slice(6, 8), slice(8, 9))
# logs of the hyperparameters (lengths of GROUPS; heldout variance and noise over the amplitude's square):
# where they are sought, one standard deviation of the prior, and the bounds in standard deviations
PRIOR = np.log([0.3, 0.5, 1.0, 0.5, 0.1, 0.1])
PRIOR_WIDTH = np.array([0.7, 0.7, 0.7, 0.7, 1.5, 1.5])
PRIOR_REACH = 3.0
NUGGET = 1e-3  # on the diagonal of a process that is sent: far below what a mean is uncertain by
_JITTER = 1e-8  # on the diagonal of C_mm: far below any noise
FEW = 0.1  # what values are uncertain by if seen in one view; falls as 1 / views


@dataclass(frozen=True, eq=False)
class Process:
    """A fitted process, and its views predicted without themselves."""

    lengths: tuple[float, float, float, float]  # of GROUPS
    heldout_variance: float  # variances over that of the process
    noise: float
    weights: Float[np.ndarray, "n K"]
    left_out: Float[np.ndarray, "n K"]  # mean at each view, predicted without it


def inputs_of(
    distance: Float[np.ndarray, " V"],
    position: Float[np.ndarray, "V 3"],
    direction: Float[np.ndarray, "V 3"],
    extent: float,
    median_log_distance: float,
    screen: Float[np.ndarray, " V"] | None = None,
    field: Float[np.ndarray, " V"] | None = None,
) -> Float[np.ndarray, "V 9"]:
    """The inputs x of viewpoints; unknown distances (NaN) count as the median, no screen or field as 1."""
    known = np.isfinite(distance) & (distance > 0)
    log_distance = np.where(known, np.log(np.where(known, distance, 1.0)), median_log_distance)
    logs = [np.zeros(len(distance)) if value is None else np.log(value) for value in (screen, field)]
    return np.column_stack([position / extent, direction, *logs, log_distance]).astype(np.float64)


def matern32(
    a: Float[np.ndarray, "A D"], b: Float[np.ndarray, "B D"], lengths: Sequence[float]
) -> Float[np.ndarray, "A B"]:
    """c(x, x') of the module's text, for all pairs of inputs, or of the first groups of them."""
    scale = np.repeat(lengths, [group.stop - group.start for group in GROUPS[: len(lengths)]])
    scaled_distance = np.sqrt(3) * cdist(a / scale, b / scale)
    return (1 + scaled_distance) * np.exp(-scaled_distance)


def covariance(inputs: Float[np.ndarray, "n 9"], lengths: Sequence[float]) -> Float[np.ndarray, "n n"]:
    """The kernel between all views, with the nugget."""
    return matern32(inputs, inputs, lengths) + NUGGET * np.eye(len(inputs))


def values_at(
    sent: Float[np.ndarray, "m 9"],
    own: Float[np.ndarray, "n 9"],
    weights: Float[np.ndarray, "n K"],
    lengths: Sequence[float],
) -> Float[np.ndarray, "m K"]:
    """Values at rounded inputs, by which a process predicts in its own views what these weights do.

    `weights_from` is how a reader gets the weights back.
    """
    if not len(own):
        return np.zeros((len(sent), weights.shape[1]))
    expected = matern32(own, own, lengths) @ weights
    found = lstsq(matern32(own, sent, lengths), expected, cond=1e-9, lapack_driver="gelsy")
    assert found is not None  # as its stub has it
    return covariance(sent, lengths) @ found[0]


def weights_from(
    inputs: Float[np.ndarray, "n 9"], values: Float[np.ndarray, "n K"], lengths: Sequence[float]
) -> Float[np.ndarray, "n K"]:
    """The weights of views, from the values in them (`values_at`)."""
    return cho_solve(cho_factor(covariance(inputs, lengths)), values)


@dataclass(frozen=True, eq=False)
class Together:
    """Processes with the same hyperparameters; weights and views left out of each, as of `Process`."""

    lengths: tuple[float, float, float, float]
    weights: list[Float[np.ndarray, "_ J"]]  # of the inducing views
    left_out: list[Float[np.ndarray, "_ J"]]


def fit_process(
    x: Float[np.ndarray, "n 9"], heldout: Bool[np.ndarray, " n"], values: Float[np.ndarray, "n K"]
) -> Process:
    """Fit a process of zero mean to values at n >= 1 viewpoints and K levels.

    Args:
        x: [n, 9], inputs (`inputs_of`).
        heldout: [n], whether training never saw the view.
        values: [n, K], what the levels' means leave.

    Returns:
        The process, and for each view what is predicted without it.
    """
    part = _squares(x), heldout, values
    theta = _hyperparameters([part])
    weights, left_out = _solved(part, theta)
    position, direction, screen, distance, heldout_variance, noise = np.exp(theta).tolist()
    lengths = position, direction, screen, distance
    return Process(lengths, heldout_variance, noise, weights, left_out)


def fit_together(
    inputs: Sequence[Float[np.ndarray, "_ 8"]],
    values: Sequence[Float[np.ndarray, "_ J"]],
    inducing: Sequence[Bool[np.ndarray, " _"]],
    shapes: Sequence[Float[np.ndarray, "J K"]],
) -> Together:
    """Fit processes of zero mean that differ in their values alone, each at n >= 0 viewpoints.

    Args:
        inputs: Of the viewpoints of each.
        values: What is learnt of each.
        inducing: Which views stay in the models; the hyperparameters are those of these.
        shapes: What the values mean: the hyperparameters are those of `values @ shapes`, where small terms
            count as little as they move what they stand for.
    """
    all_parts = [
        (x[some], v[some] @ shape)
        for x, v, some, shape in zip(inputs, values, inducing, shapes, strict=True)
        if some.any()
    ]
    theta = _hyperparameters([(_squares(x), np.zeros(len(x), bool), v) for x, v in all_parts])
    solved = [_solved_through(x, v, some, theta) for x, v, some in zip(inputs, values, inducing, strict=True)]
    position, direction, screen, distance, *_ = np.exp(theta).tolist()
    lengths = position, direction, screen, distance
    return Together(lengths, [weights for weights, _ in solved], [left_out for _, left_out in solved])


_Part = tuple[list[np.ndarray], np.ndarray, np.ndarray]  # squared distances by group, heldout, values


def _squares(x: np.ndarray) -> list[np.ndarray]:
    return [cdist(x[:, group], x[:, group], "sqeuclidean") for group in GROUPS]


def _solved_through(
    x: np.ndarray, values: np.ndarray, inducing: np.ndarray, theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the inducing views, and what is predicted of each view without it."""
    *lengths, _, noise = np.exp(theta)
    own = x[inducing]
    root = cholesky(matern32(own, own, lengths) + _JITTER * np.eye(len(own)), lower=True)
    basis = solve_triangular(root, matern32(own, x, lengths), lower=True)  # [m, n]
    factor = cho_factor(basis @ basis.T + noise * np.eye(len(own)))
    inner = cho_solve(factor, basis @ values)
    own_part = (basis * cho_solve(factor, basis)).sum(0)  # of each value in its own prediction
    left_out = values - (values - basis.T @ inner) / (1 - own_part)[:, None]
    return solve_triangular(root, inner, lower=True, trans=1), left_out


def _solved(part: _Part, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights, and what is predicted of each view without it."""
    squares, heldout, values = part
    if not len(values):
        return values, values
    inverse, _ = _inverse(_terms(squares, heldout, theta)[0])
    weights = inverse @ values
    return weights, values - weights / np.diag(inverse)[:, None]


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


def _inverse(S: np.ndarray) -> tuple[np.ndarray, float]:
    """The inverse of S and the log of S's determinant."""
    factor = cho_factor(S, lower=True)
    return cho_solve(factor, np.eye(len(S))), 2 * float(np.log(factor[0].diagonal()).sum())


def _variances(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Squared amplitude of each level, the best for its values [K]."""
    return (values * weights).mean(0) + (FEW / len(values)) ** 2


def _hyperparameters(parts: Sequence[_Part]) -> np.ndarray:
    """Logs of lengths, heldout variance and noise: those of the smallest `_cost` within bounds."""
    reach = PRIOR_REACH * PRIOR_WIDTH
    bounds = list(zip(PRIOR - reach, PRIOR + reach, strict=True))
    options = {"maxiter": 50}
    return minimize(_cost, PRIOR, (parts,), jac=True, method="L-BFGS-B", bounds=bounds, options=options).x


def _cost(theta: np.ndarray, parts: Sequence[_Part]) -> tuple[float, np.ndarray]:
    """Negative log of the marginal likelihood, mean over levels, times the prior; and its derivatives."""
    z = (theta - PRIOR) / PRIOR_WIDTH
    value, slope = float(z @ z) / 2, z / PRIOR_WIDTH
    for squares, u, values in parts:
        S, slopes = _terms(squares, u, theta)
        inverse, log_determinant = _inverse(S)
        weights = inverse @ values
        variances = _variances(values, weights)
        value += (len(u) * np.log(variances).mean() + log_determinant) / 2
        part = (inverse - (weights / variances) @ weights.T / len(variances)) / 2
        slope = slope + np.array([(part * s).sum() for s in slopes])
    return value, slope
