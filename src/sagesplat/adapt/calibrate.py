"""Thresholds that keep a target, from views that nothing was fitted to: conformal prediction of decisions.

A plan takes the cheapest level whose expected quality reaches a threshold. For one view, a category and a
target there is a critical threshold: above it the level that is taken keeps the target. So the critical
thresholds of the calibration views say, by split conformal prediction (Vovk et al. 2005), which threshold
keeps the target in a new view at a confidence: the ceil((n + 1) confidence)-th smallest of n. Unlike a bound
on each number this counts what is decided only; where levels are far apart it costs almost nothing.

Views are the unit: those of one capture are drawn independently, the categories of one view are not. A
category has its own thresholds, and each target has its own. Of 46 views just one or two are above such a
threshold, so chance moves it: the other categories' views together count as `OTHERS` more (after Ding et al.
2023, "Class-conditional conformal prediction with many classes"). With fewer than 19 views (at 0.95) of its
own not even the largest is enough: "uncalibrated", widened to the largest of all categories.

Away from the photos a mean is less certain, and misses by more. So the threshold is the target and a margin
that is proportional to `AT_A_PHOTO + away` (`adapt.viewpoint`); it is the margin that is calibrated.

Quality depends on the neighbours' levels too. So compositions are measured: plans made for a range of nominal
targets by preliminary thresholds. What is calibrated is the nominal target to ask for.
"""

import math

import numpy as np
from jaxtyping import Float, Int

# Calibration sets of 46 of 160 viewpoints of two built-in captures, drawn 300 times, the rest to test: with
# 0, 10, 20, 40 and 60 of them 7.2, 4.3, 4.1, 5.8 and 7.4 % of the categories keep less than 0.9 where 0.95
# was asked for; thresholds are on average as they are with 0, or lower.
OTHERS = 20.0
AT_A_PHOTO = 0.2  # of the margin there, over what it grows by to far from all photos
NO_OTHERS = np.zeros(0)


def fewest_views(confidence: float) -> int:
    """Views needed to calibrate at a confidence: with fewer, even no violation at all is not enough."""
    return math.ceil(confidence / (1 - confidence) - 1e-9)


def conformal_quantile(
    values: Float[np.ndarray, "*s n"], confidence: float, others: Float[np.ndarray, "*s m"] = NO_OTHERS
) -> Float[np.ndarray, "*s"]:
    """The value that a new one does not exceed at a confidence; inf from too few values.

    `others`: of other categories, which together count as at most `OTHERS` values.
    """
    n, m = values.shape[-1], others.shape[-1]
    weight = np.concatenate([np.ones(n), np.full(m, min(OTHERS / max(m, 1), 1)), [1.0]])
    every = np.concatenate([values, others, np.full((*values.shape[:-1], 1), np.inf)], -1)  # a new one: any
    order = np.argsort(every, -1)
    enough = np.cumsum(weight[order], -1) >= weight.sum() * confidence - 1e-9
    rows = np.take_along_axis(order, enough.argmax(-1)[..., None], -1)
    return np.take_along_axis(every, rows, -1)[..., 0]


def critical_margins(
    mean: Float[np.ndarray, "n K"],
    measured: Float[np.ndarray, "n K"],
    target: float,
    scale: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """In each view, the largest margin by which a level is taken that misses the target; -inf: none.

    A margin takes the first level whose mean reaches target + margin * scale; above all means nothing is.
    """
    taken = np.diff(mean, axis=1, prepend=-np.inf) > 0  # of equal means the first
    missed = (measured < target) & taken
    return np.where(missed, (mean - target) / scale[:, None], -np.inf).max(1)


def critical_asks(
    asked: Float[np.ndarray, "n J"],
    reached: Float[np.ndarray, "n J"],
    steps: Int[np.ndarray, "n J-1"],
    measured: Float[np.ndarray, "n J"],
    target: float,
) -> Float[np.ndarray, " n"]:
    """In each view, the most that can be asked for and a composition is taken that misses the target.

    Args:
        asked: [n, J], ascending: nominal targets that compositions were planned for, or their thresholds.
        reached: [n, J], in the same unit what each has: a composition is taken for all that is up to that.
        steps: [n, J - 1], compositions from each one to the next, that one included: levels between them.
        measured: [n, J], quality in the composition.
        target: That is to be kept.

    Returns:
        [n]. What compositions between two measure and have is interpolated. The first that was asked for
        where none misses; 1 where the last one does: nothing but the full model is known to keep the target.
    """
    n, J = measured.shape
    missed = measured < target
    last = J - 1 - missed[:, ::-1].argmax(1)  # the last composition that misses
    rows, after = np.arange(n), np.minimum(last + 1, J - 1)
    low, high = measured[rows, last], measured[rows, after]
    part = np.clip((target - low) / np.maximum(high - low, 1e-12), 0, 1)
    between = np.column_stack([steps, np.zeros(n, int)])[rows, last]
    taken = np.minimum(np.floor(part * between), between - 1) / np.maximum(between, 1)
    found = reached[rows, last] + taken * (reached[rows, after] - reached[rows, last])
    # the same levels in both: their neighbours' levels made the difference
    found = np.maximum(np.where(between > 0, found, asked[rows, after]), asked[rows, last])
    return np.where(missed.any(1), np.where(last == J - 1, 1.0, found), asked[:, 0])
