"""The multiple-choice knapsack: one level per label, of most value, within a budget.

Steps along the convex hull of each label (Sinha and Zoltners 1979) give a composition and, at the price of
the first step that does not fit, a Lagrangian bound. Pareto fronts label by label, cut by both, give the best
of all (Kellerer, Pferschy and Pisinger 2004, ch. 11). Costs and values are whole numbers, held in float64.
"""

import math

import numpy as np

from sagesplat.kernels.jit import njit

UNITS = 2.0**40  # of value in the total weight


@njit(cache=True, error_model="numpy")
def _step(extra, gain, at, limit):
    """Of the levels above level `at` of a label the one of most gain per cost, the cheaper of equals.

    Returns level, gain per cost, cost; -1, 0, 0 where none has more value for at most `limit` more.
    """
    best, slope, least = -1, 0.0, 0.0
    for k in range(len(extra)):
        more = extra[k] - extra[at]
        if gain[k] > gain[at] and more <= limit:
            ratio = (gain[k] - gain[at]) / more
            if ratio > slope or (ratio == slope and more < least):
                best, slope, least = k, ratio, more
    return best, slope, least


@njit(cache=True, error_model="numpy")
def _greedy(extra, gain, floor, room):
    """Levels by gain per cost until nothing fits; gain per cost of the first step that did not, else 0."""
    L, levels, critical = len(floor), floor.copy(), 0.0
    steps, slopes, mores = np.empty(L, np.int64), np.empty(L), np.empty(L)
    for label in range(L):
        steps[label], slopes[label], mores[label] = _step(extra[label], gain[label], floor[label], room)
    while True:
        best = 0
        for label in range(1, L):
            if slopes[label] > slopes[best] or (slopes[label] == slopes[best] and mores[label] < mores[best]):
                best = label
        if slopes[best] == 0:
            return levels, critical
        if mores[best] <= room:
            levels[best] = steps[best]
            room -= mores[best]
        elif critical == 0:
            critical = slopes[best]
        limit = room if critical > 0 else np.inf  # before that the steps are those of the convex hull
        steps[best], slopes[best], mores[best] = _step(extra[best], gain[best], levels[best], limit)


@njit(cache=True, error_model="numpy")
def _before(parent, choice, a, b):
    """Whether partial composition `a` has the lower level at the first label where it differs from `b`."""
    lower = False
    while a != b:
        if choice[a] != choice[b]:
            lower = choice[a] < choice[b]
        a, b = parent[a], parent[b]
    return lower


@njit(cache=True, error_model="numpy")
def _front(extra, gain, room, slope, least, states):
    """The best levels of all, none if that takes more states, and the Lagrangian bound on their gain.

    Label by label the Pareto front of (cost, gain), ascending: the fronts that each level of the next label
    makes of it are merged. Left out is what cannot reach `least` even at the price `slope` for cost. Each
    label adds its share of the states, so that what would take too many is given up early.
    """
    L, K = extra.shape
    rest = np.zeros(L + 1)  # most that the labels from here on can add at that price
    for label in range(L - 1, -1, -1):
        rest[label] = rest[label + 1] + (gain[label] - slope * extra[label]).max()
    parent, choice = np.empty(states + 1, np.int64), np.empty(states + 1, np.int64)
    costs, gains = np.zeros(states + 1), np.zeros(states + 1)
    begin, end = 0, 1
    for label in range(L):
        # whole numbers against a sum of rounded ones: a unit per label is far more than the rounding
        needed = least - L - slope * room - rest[label + 1]
        heads, n = np.full(K, begin), end
        allowed = states * (label + 1) // L
        while True:
            best, cost, most = -1, 0.0, 0.0
            for k in range(K):
                while heads[k] < end:
                    c = costs[heads[k]] + extra[label, k]
                    g = gains[heads[k]] + gain[label, k]
                    if c > room:
                        heads[k] = end
                    elif (n > end and g <= gains[n - 1]) or g - slope * c < needed:
                        heads[k] += 1
                    else:
                        if best < 0 or c < cost or (c == cost and g > most):
                            best, cost, most = k, c, g
                        elif c == cost and g == most and _before(parent, choice, heads[k], heads[best]):
                            best = k
                        break
            if best < 0:
                break
            if n > allowed:
                return np.empty(0, np.int64), rest[0] + slope * room
            parent[n], choice[n], costs[n], gains[n] = heads[best], best, cost, most
            heads[best] += 1
            n += 1
        begin, end = end, n
    if begin == end:  # never, as what reaches `least` is known to exist; else this would read past the arrays
        return np.empty(0, np.int64), rest[0] + slope * room
    levels, at = np.empty(L, np.int64), end - 1
    for label in range(L - 1, -1, -1):
        levels[label], at = choice[at], parent[at]
    return levels, rest[0] + slope * room


@njit(cache=True, error_model="numpy")
def _sum(table, levels):
    total = 0.0
    for label in range(len(levels)):
        total += table[label, levels[label]]
    return total


@njit(cache=True, error_model="numpy")
def _above_floor(q, c, weight, budget, previous, slack):
    """Cheapest levels, cost and value above them [L, K], budget left beside them, value of the cheapest.

    What has no more value than the cheapest, or does not fit beside the cheapest of the others, costs inf.
    """
    L, K = q.shape
    total, room, base = 0.0, budget, 0.0
    for label in range(L):
        total += weight[label]
    extra, gain, floor = np.full((L, K), np.inf), np.zeros((L, K)), np.zeros(L, np.int64)
    for label in range(L):
        share, at = weight[label] / total * UNITS if total > 0 else 0.0, -1
        first = (0.0, 0.0, 0.0)
        for k in range(K):
            if c[label, k] < np.inf:
                kept = q[label, k] + slack if k == previous[label] else q[label, k]
                gain[label, k] = math.floor(share * kept + 0.5)
                key = (c[label, k], -gain[label, k], -q[label, k])
                if at < 0 or key < first:
                    at, first = k, key
        floor[label] = at
        room -= c[label, at]
        base += gain[label, at]
        gain[label] -= gain[label, at]
    for label in range(L):
        for k in range(K):
            more = c[label, k] - c[label, floor[label]]
            if k == floor[label] or (gain[label, k] > 0 and more <= room):
                extra[label, k] = more
    return floor, extra, gain, room, base


@njit(cache=True, error_model="numpy")
def most_within(q, c, weight, budget, previous, slack, states):
    """Levels, whether they fit the budget, bound on the value in units, whether they are proven the best.

    See `allocate.best_within`; `q` and `c` [L, K] float64 without NaN, c inf for a level that cannot be had.
    """
    floor, extra, gain, room, base = _above_floor(q, c, weight, budget, previous, slack)
    if room < 0:
        return floor, False, base, True
    levels, slope = _greedy(extra, gain, floor, room)
    most = _sum(gain, levels)
    if slope == 0:  # every label has its best level
        return levels, True, base + most, True
    stay = floor.copy()
    for label in range(len(floor)):
        if previous[label] >= 0 and extra[label, previous[label]] < np.inf:
            stay[label] = previous[label]
    if _sum(extra, stay) <= room and _sum(gain, stay) >= most:
        levels, most = stay, _sum(gain, stay)
    exact, bound = _front(extra, gain, room, slope, most, states)
    if len(exact) > 0:
        return exact, True, base + _sum(gain, exact), True
    return levels, True, base + bound, False
