"""Thresholds for SSIM against photos, from few of them: conformal risk control by view, over views left out.

Photos that training never saw are too few to calibrate with alone: at 0.95 split conformal prediction needs
19, and then takes the widest error of all. So every view behind the process takes part, predicted without
itself. What training views cannot tell is how much larger the errors of new photos are: theirs are inflated.

    error_i  = measured - mean; of a training view times `_inflation`
    score_ik = mean_ik - discount * (1 - support_i)           errors grow away from known viewpoints
    a level is taken where score >= target + multiplier * scale - bias
                                scale: root mean square of the errors; bias: what compositions add on average
    risk     = (sum over views of the share of accepted decisions missed + C) / (views that accept any + C)

The multiplier of a target is the smallest one for which, and for the next half, the risk is within
1 - confidence; it need not fall steadily, since a higher threshold accepts less. This is conformal risk
control (Angelopoulos et al. 2022) by view, as the errors of one view are alike. C views that miss everything
are counted in: 1, or 2 where fewer than 19 calibration views tell of new photos. The calibration views by
themselves must stay within the risk too, with none counted in. The risk is that of what is accepted, so a
target that few views accept is hard to hold. Each target has its own multiplier, at least that of the targets
beside it. Where none suffices no level is accepted at that target.

A category that 19 calibration views show (at 0.95) is "calibrated", the others are widened and
"uncalibrated". As the inflation is estimated neither is exact, unlike split conformal prediction:
`python -m benchmarks.promises` tests both on splits drawn again.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import nnls
from scipy.special import stdtrit

from sagesplat.adapt.calibrate import fewest_views
from sagesplat.adapt.viewpoint import Calibration
from sagesplat.core.errors import RunError

TARGETS = np.arange(0.3, 0.96, 0.05).round(2)  # SSIM that thresholds are sought for
MULTIPLIERS = np.arange(-1, 6.01, 0.1)  # of the scale: narrowest first; below 0 where the discount is enough
INFLATION = 1.5  # of the errors of training views, where no calibration view tells
OWN_VIEWS = 8  # calibration views from which a category's own errors count more than those of the others
FEW = 2  # views that miss everything, counted in where calibration views are too few to be proof
STEADY = 5  # of MULTIPLIERS: on these next ones too the risk is to stay small
LEAST_ERROR = 1e-6  # SSIM; of categories that are predicted exactly


@dataclass(frozen=True, eq=False)
class LeftOut:
    """The views of one category, each predicted without itself."""

    rows: Int[np.ndarray, " n"]  # of Scene.views
    heldout: Bool[np.ndarray, " n"]  # training never saw it
    mean: Float[np.ndarray, "n K"]  # never falls from level to level
    ssim: Float[np.ndarray, "n K"]  # measured, all categories at the same level
    support: Float[np.ndarray, " n"]  # by the other views
    # what the category gains in composition, beside others at other levels, by target of TARGETS; 0: unknown
    change: Float[np.ndarray, "n G"]
    bias: Float[np.ndarray, " G"]  # the part of it to expect in any view

    @classmethod
    def alone(
        cls,
        rows: Int[np.ndarray, " n"],
        heldout: Bool[np.ndarray, " n"],
        mean: Float[np.ndarray, "n K"],
        ssim: Float[np.ndarray, "n K"],
        support: Float[np.ndarray, " n"],
    ) -> "LeftOut":
        """Views of which no composition was measured."""
        none = np.zeros(len(TARGETS))
        return cls(rows, heldout, mean, ssim, support, np.tile(none, (len(rows), 1)), none)

    @property
    def error(self) -> Float[np.ndarray, " n"]:
        """Mean absolute error over the levels."""
        return np.abs(self.ssim - self.mean).mean(1)


@dataclass(frozen=True, eq=False)
class _Scored:
    """A category ready to calibrate."""

    score: Float[np.ndarray, "n K"]
    measured: Float[np.ndarray, "n K"]  # as a new photo would be
    change: Float[np.ndarray, "n G"]
    bias: Float[np.ndarray, " G"]
    scale: float
    discount: float


def calibrate_photos(views: Mapping[int, LeftOut], confidence: float) -> dict[int, Calibration]:
    """Find the thresholds of each category.

    Args:
        views: By label id, each with at least one view.
        confidence: 1 - the accepted risk, between 0 and 1.

    Returns:
        By label id. Targets that no threshold keeps are left out; with fewer than two views there are none.

    Raises:
        RunError: For an impossible confidence.
    """
    if not 0 < confidence < 1:
        raise RunError(
            f"confidence {confidence} is impossible; choose a number between 0 and 1, such as 0.95"
        )
    if not views:
        return {}
    fewest = fewest_views(confidence)
    scored = _scored(views, confidence)
    multipliers = _multipliers(views, scored, confidence)
    found = {}
    for label, own in views.items():
        targets, thresholds = _envelope(multipliers, scored[label])
        heldout = int(own.heldout.sum())
        found[label] = Calibration(
            status="calibrated" if heldout >= fewest else "uncalibrated",
            confidence=confidence,
            num_views=heldout,
            targets=targets,
            thresholds=thresholds,
            slopes=np.full(len(targets), scored[label].discount),
            least_support=float(np.clip(own.support.min(), 0, 1)),
        )
    return found


def with_changes(
    own: LeftOut, changes: Mapping[int, Float[np.ndarray, " G"]], near: Float[np.ndarray, "n n"]
) -> LeftOut:
    """The views in composition, beside other categories at other levels.

    Args:
        own: The views of a category.
        changes: By row of Scene.views, SSIM in a composition planned for each of TARGETS minus SSIM with all
            categories at the same level; NaN: not measured.
        near: How alike the views are. One without a measurement gets that of the most alike.

    Returns:
        The views with their changes. The bias is their mean, drawn to 0 where they are of few views.
    """
    known = np.array([np.isfinite(changes.get(row, np.nan)).any() for row in own.rows.tolist()])
    if not known.any():
        return own
    table = np.array([_filled(changes[row]) for row in own.rows[known].tolist()])
    nearest = near[:, known].argmax(1)
    nearest[known] = np.arange(known.sum())
    return replace(own, change=table[nearest], bias=table.sum(0) / (len(table) + OWN_VIEWS))


def _filled(change: Float[np.ndarray, " G"]) -> Float[np.ndarray, " G"]:
    """Changes of targets that were not measured, from those that were."""
    known = np.isfinite(change)
    return np.interp(TARGETS, TARGETS[known], change[known])


def _scored(views: Mapping[int, LeftOut], confidence: float) -> dict[int, _Scored]:
    inflation, slope = _inflation(views), _slope(views)
    # from a mean absolute error to the quantile of a Gaussian one
    quantile = max(NormalDist().inv_cdf(confidence), 0.0) * np.sqrt(np.pi / 2)
    found = {}
    for label, own in views.items():
        by = np.where(own.heldout, 1.0, inflation[label])[:, None]
        error = by * (own.ssim - own.mean)
        unsupported = 1 - own.support
        discount = float(quantile * slope * np.abs(error).mean() / max(unsupported.mean(), LEAST_ERROR))
        found[label] = _Scored(
            score=own.mean - discount * unsupported[:, None],
            measured=own.mean + error,
            change=own.change,
            bias=own.bias,
            scale=max(float(np.sqrt(np.mean(error**2) + np.mean((own.change - own.bias) ** 2))), LEAST_ERROR),
            discount=discount,
        )
    return found


def _inflation(views: Mapping[int, LeftOut]) -> dict[int, float]:
    """By how much the errors of new photos may exceed those of training views.

    The ratio of mean errors, drawn to that of all categories where calibration views are few, and a standard
    error more: 1 / sqrt(2 n) of n views.
    """
    seen = {label: (own.error[own.heldout], own.error[~own.heldout]) for label, own in views.items()}
    both = [(new.sum(), len(new) * old.mean()) for new, old in seen.values() if len(new) and len(old)]
    new_sum, old_sum = np.sum(both, 0) if both else (0.0, 0.0)
    shared = new_sum / old_sum if old_sum > LEAST_ERROR else INFLATION
    found = {}
    for label, (new, old) in seen.items():
        ratio = shared
        if len(new) and len(old) and old.mean() > LEAST_ERROR:
            ratio = (OWN_VIEWS * shared + new.sum() / old.mean()) / (OWN_VIEWS + len(new))
        found[label] = float(max(ratio, 1.0) * (1 + 1 / np.sqrt(2 * max(len(new), 1))))
    return found


def _slope(views: Mapping[int, LeftOut]) -> float:
    """The share of an average error that grows with 1 - support, of all categories together; 0 to about 1."""
    some = [own for own in views.values() if len(own.rows) > 1 and own.error.mean() > LEAST_ERROR]
    unsupported = [(1 - own.support) / max((1 - own.support).mean(), LEAST_ERROR) for own in some]
    if not some:
        return 0.0
    inputs = np.concatenate(unsupported)
    errors = np.concatenate([own.error / own.error.mean() for own in some])
    return float(nnls(np.column_stack([np.ones_like(inputs), inputs]), errors)[0][1])


def _multipliers(
    views: Mapping[int, LeftOut], scored: Mapping[int, _Scored], confidence: float
) -> Float[np.ndarray, " G"]:
    """Of each target; inf where none suffices."""
    fewest = fewest_views(confidence)
    rows = np.unique(np.concatenate([own.rows for own in views.values()]))
    heldout = np.isin(rows, np.concatenate([own.rows[own.heldout] for own in views.values()]))
    counted_in = 1 if heldout.sum() >= fewest else FEW
    if len(rows) < counted_in * fewest:  # too few for any proof: a Gaussian view to come, twice as far
        n = len(rows)
        wide = 2 * float(stdtrit(n - 1, confidence)) * np.sqrt(1 + 1 / n) if n > 1 else np.inf
        return np.full(len(TARGETS), max(wide, 0.0))
    found = np.full(len(TARGETS), np.inf)
    for g in range(len(TARGETS)):
        accepted, missed = (np.zeros((len(rows), len(MULTIPLIERS))) for _ in range(2))
        for label, own in views.items():
            take = _decisions(scored[label], g)
            at = np.searchsorted(rows, own.rows)
            accepted[at] += take[0]
            missed[at] += take[1]
        risk = np.maximum(_risks(accepted, missed, counted_in), _risks(accepted[heldout], missed[heldout], 0))
        ok = risk <= 1 - confidence + 1e-9
        enough = (accepted > 0).sum(0) >= counted_in * fewest
        fine = np.pad(ok | ~enough, (0, STEADY), constant_values=True)
        steady = ok & enough & sliding_window_view(fine, STEADY + 1).all(1)
        if steady.any():
            found[g] = MULTIPLIERS[steady.argmax()]
    beside = np.pad(found, 1, "edge")
    return np.max([beside[:-2], found, beside[2:]], 0)


def _decisions(own: _Scored, g: int) -> tuple[Bool[np.ndarray, "n M"], Bool[np.ndarray, "n M"]]:
    """Whether a view accepts target g by each of MULTIPLIERS, and the level taken then misses it."""
    n, K = own.score.shape
    target = float(TARGETS[g])
    threshold = target + MULTIPLIERS * own.scale - own.bias[g]
    level = (own.score[:, None, :] < threshold[:, None]).sum(2)
    accepted = level < K
    got = own.measured[np.arange(n)[:, None], np.minimum(level, K - 1)] + own.change[:, g, None]
    return accepted, accepted & (got < target)


def _risks(
    accepted: Float[np.ndarray, "n M"], missed: Float[np.ndarray, "n M"], counted_in: int
) -> Float[np.ndarray, " M"]:
    """The larger of two risks: each view weighs the same, or each decision; of views that accept any."""
    shares = (missed / np.maximum(accepted, 1)).sum(0)
    views, decisions = (accepted > 0).sum(0), accepted.sum(0)
    typical = decisions / np.maximum(views, 1)  # of a view
    by_view = (shares + counted_in) / np.maximum(views + counted_in, 1)
    by_decision = (missed.sum(0) + counted_in * typical) / np.maximum(decisions + counted_in * typical, 1e-9)
    return np.maximum(by_view, by_decision)


def _envelope(
    multipliers: Float[np.ndarray, " G"], own: _Scored
) -> tuple[Float[np.ndarray, " H"], Float[np.ndarray, " H"]]:
    """Targets and thresholds of a category, both rising; without targets that no score reaches.

    The first stays all the same: its margin is that of lower qualities, which are no targets.
    """
    thresholds = TARGETS + multipliers * own.scale - own.bias
    # what keeps a higher target keeps this one
    thresholds = np.minimum.accumulate(thresholds[::-1])[::-1]
    thresholds = thresholds + 1e-9 * np.arange(len(TARGETS))  # of equal ones
    reached = thresholds <= own.score.max()
    reached[0] = True
    reached &= np.abs(thresholds) <= 1
    return TARGETS[reached], thresholds[reached]
