"""Upgrades after the cheapest levels, where those lie below equal levels of the same bytes.

The cheapest level of each category that keeps a target serves the lowest category well and the whole image
badly: bytes go to what is hard, not to what is large. So the upgrades of most gain per byte are added, until
the image as a whole is at most `SLACK` worse than with all categories at one level, at equal bytes. (Without
the slack a hard category of few pixels, all of which has to be sent, drew half of the scene along.) The rule,
exactly, as a second implementation must have it (tests/data/plans.json, mode "fill"):

- W(levels) = sum weight * mean / sum weight, B(levels) = sum cost. The uniform curve has the points
  (B(all at k), W(all at k)), k = 1 to K, linear between; below the first it is W(all at 1), above the last
  W(all at K); where levels take equal bytes, the first one ends what comes before and the last one begins
  what follows. Nothing is added if W(levels) >= curve(B(levels)) - SLACK.
- The upgrades of a label are the segments of the upper concave hull of (cost, weight * mean) from its level
  on. From a vertex the next one is the level above of the largest slope = gain / bytes; a gain without bytes
  has an infinite slope. Of equal slopes the one of fewer bytes, then of more gain, then the lower level.
- All segments, by falling slope, then by label, are added one after another until W >= curve(B) - SLACK.
  Slopes fall along a label, so each step takes the steepest of the labels' next segments.
- A label of weight 0, or with a mean that is NaN, stays; it has no part in W, its bytes count.

Plans of a whole scene look at the lowest category too (`lowest`): while its mean lies further than that below
the lowest of equal levels at the same bytes, it gets its own next segment first.
"""

import numpy as np
from jaxtyping import Float, Int

from sagesplat.core.errors import RunError
from sagesplat.kernels.jit import njit

SLACK = 0.004  # of W


def fill(
    levels: Int[np.ndarray, "L"],
    quality: Float[np.ndarray, "L K"],
    cost: Float[np.ndarray, "L K"] | Int[np.ndarray, "L K"],
    weight: Float[np.ndarray, "L"],
    lowest: float = np.inf,
) -> Int[np.ndarray, "L"]:
    """Add upgrades until the composition is hardly worse than equal levels of the same cost (module's rule).

    Args:
        levels: [L], columns of `quality` to begin with; they are the least that each label gets.
        quality: [L, K], mean quality of each label and level, never falling along the levels; NaN: unknown.
        cost: [L, K], bytes, finite.
        weight: [L], pixels times what a pixel counts; 0: the label stays.
        lowest: How far the lowest label may lie below the lowest of equal levels of the same cost.

    Returns:
        A level per label, none below `levels`.

    Raises:
        RunError: For arguments that do not fit.

    Example:
        >>> import numpy as np
        >>> from sagesplat.adapt.fill import fill
        >>> quality = np.array([[0.3, 0.4, 0.9], [0.5, 0.95, 1.0]])  # a hard category that is small
        >>> cost, weight = np.array([[10, 20, 60], [10, 30, 90]]), np.array([1.0, 9.0])
        >>> fill(np.array([2, 0]), quality, cost, weight).tolist()
        [2, 1]
    """
    quality, cost = np.ascontiguousarray(quality, np.float64), np.ascontiguousarray(cost, np.float64)
    weight = np.array(weight, np.float64, order="C")
    shape = quality.shape
    if quality.ndim != 2 or cost.shape != shape or (levels.shape, weight.shape) != (shape[:1], shape[:1]):
        raise RunError(
            f"quality {shape}, cost {cost.shape} and levels {levels.shape} do not fit; give one each"
        )
    if not np.isfinite(cost).all() or (cost < 0).any():
        raise RunError("a cost is negative or not finite; give bytes")
    if levels.min(initial=0) < 0 or levels.max(initial=0) >= shape[1]:
        raise RunError(f"levels to begin with do not fit; give whole numbers, 0 to {shape[1] - 1}")
    weight[~np.isfinite(quality).all(1)] = 0
    if not np.isfinite(weight).all() or (weight < 0).any():
        raise RunError("a weight is negative or not finite; give 0 for a label that does not matter")
    value = weight[:, None] * np.where(weight[:, None] > 0, quality, 0)
    return _fill(np.array(levels, np.int64), value, cost, weight, float(lowest))


@njit(cache=True, error_model="numpy")
def _fill(levels, value, cost, weight, lowest):
    L, total, nbytes, worth = len(levels), weight.sum(), 0.0, 0.0
    tops, slopes = np.empty(L, np.int64), np.empty(L)
    for label in range(L):
        nbytes += cost[label, levels[label]]
        worth += value[label, levels[label]]
        tops[label], slopes[label] = next_upgrade(cost[label], value[label], levels[label])
    uniform_bytes, uniform, uniform_lowest = cost.sum(0), value.sum(0), _lowest_of_levels(value, weight)
    while total > 0:
        label = -1
        if lowest < np.inf:
            low, least = _lowest(value, weight, levels)
            if tops[low] >= 0 and least < _at(nbytes, uniform_bytes, uniform_lowest) - lowest:
                label = low
        if label < 0:
            if worth / total >= _at(nbytes, uniform_bytes, uniform) / total - SLACK:
                break
            label = int(slopes.argmax())  # of equal slopes the lower label
            if tops[label] < 0:
                break
        before, at = levels[label], tops[label]
        nbytes += cost[label, at] - cost[label, before]
        worth += value[label, at] - value[label, before]
        levels[label] = at
        tops[label], slopes[label] = next_upgrade(cost[label], value[label], at)
    return levels


@njit(cache=True, error_model="numpy")
def _lowest(value, weight, levels):
    """The label of the lowest mean among those that count, and that mean."""
    low, least = 0, np.inf
    for label in range(len(levels)):
        if weight[label] > 0 and value[label, levels[label]] / weight[label] < least:
            low, least = label, value[label, levels[label]] / weight[label]
    return low, least


@njit(cache=True, error_model="numpy")
def _lowest_of_levels(value, weight):
    """The lowest mean of all labels at one level, by level."""
    levels = np.empty(value.shape[0], np.int64)
    found = np.empty(value.shape[1])
    for k in range(value.shape[1]):
        levels[:] = k
        found[k] = _lowest(value, weight, levels)[1]
    return found


@njit(cache=True, error_model="numpy")
def next_upgrade(cost, value, at):
    """The next vertex of the hull after level `at`, and the slope to it; -1, 0 where nothing gains."""
    best, most, fewest, highest = -1, 0.0, 0.0, 0.0
    for k in range(at + 1, len(cost)):
        more, gain = cost[k] - cost[at], value[k] - value[at]
        if gain > 0:
            slope = gain / more if more > 0 else np.inf
            better = more < fewest or (more == fewest and gain > highest)
            if slope > most or (slope == most and better):
                best, most, fewest, highest = k, slope, more, gain
    return best, most


@njit(cache=True, error_model="numpy")
def _at(nbytes, sizes, values):
    """What equal levels have at some bytes: linear between the levels, constant outside."""
    for k in range(len(sizes)):
        if nbytes <= sizes[k]:
            if k == 0:
                return values[0]
            part = (nbytes - sizes[k - 1]) / (
                sizes[k] - sizes[k - 1]
            )  # above the point before, so the two differ
            return values[k - 1] + part * (values[k] - values[k - 1])
    return values[-1]
