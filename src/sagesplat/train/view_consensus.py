"""Which 2D instances of different views are of one object: those that the views agree on.

The Gaussians are what views share. An instance of one view is *contained* in an instance of another if that
holds nearly all of what this view sees of its Gaussians and has an instance for. Two instances belong
together if most views that see both have an instance that contains both: their view consensus (Yan et
al., CVPR 2024, arXiv:2401.07745). A view that lost a mask, or has cut it in two, has no say; so the fragments
of an object join where other views say so, and neighbours never do because one view has seen them as one.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float32, Int16, Int32, Int64
from numba import prange

from sagesplat.kernels.jit import njit

_NO_SAY, _SPLIT = -1, -2  # of a view on an instance

# when views agree; shares are of blending weight
_SEEN = 0.3  # of an instance: what a view has to see of it to have a say
_COVERED = 0.5  # of what it sees: what has to be in some instance
_CONTAINED = 0.8  # of that: what has to be in one instance
_CUT = 0.7  # of the views with a say: where more than these cut it, it is taken for several objects
_AGREE = 0.4  # of the views that see both: those that see them as one


@dataclass(frozen=True, eq=False)
class Sightings:
    """How V views see N Gaussians: each view by the B columns that show most of the Gaussian.

    The first columns of every view are the categories, for pixels without an instance; the view's instances
    follow, all instances being numbered view by view.
    """

    columns: Int16[np.ndarray, "N V B"]  # the largest first; -1: none further, the view does not see it
    weights: Float32[np.ndarray, "N V B"]  # its blending weight in that column, pixels
    num_categories: int
    starts: Int64[np.ndarray, " V+1"]  # number of each view's first instance, and of all
    categories: Int16[np.ndarray, " M"]  # category of each instance, as a column

    @property
    def views(self) -> Int64[np.ndarray, " M"]:
        """The view of each instance."""
        return np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))


def join(sightings: Sightings) -> Int32[np.ndarray, " M"]:
    """The object of each instance, from 0 on; -1 for those that views cut, and those of one view alone.

    The instances of an object are of one category and of two views at least.
    """
    containers = _containers(sightings)
    cut = (containers == _SPLIT).sum(1) > _CUT * (containers != _NO_SAY).sum(1)
    objects, count, views = np.full(len(cut), -1, np.int32), 0, sightings.views
    for category in np.unique(sightings.categories):
        rows = np.flatnonzero((sightings.categories == category) & ~cut)
        clusters = _cluster(*_agreement(containers[rows]), np.float32(_AGREE))
        for cluster in np.unique(clusters):
            mine = rows[clusters == cluster]
            if len(np.unique(views[mine])) > 1:
                objects[mine], count = count, count + 1
    return objects


def _containers(sightings: Sightings) -> Int32[np.ndarray, "M V"]:
    """The instance of each view that contains each instance; _SPLIT where several do, _NO_SAY elsewhere."""
    columns, weights = sightings.columns[..., 0], sightings.weights[..., 0]
    mass = (weights.sum(1) / (columns >= 0).sum(1).clip(1)).astype(np.float32)
    m, starts = len(sightings.categories), sightings.starts
    shared, seen = np.zeros((m, m), np.float32), np.zeros((m, len(starts) - 1), np.float32)
    _share(columns, mass, starts, sightings.num_categories, sightings.categories, shared, seen)
    whole = seen[np.arange(m), sightings.views] if m else np.zeros(0, np.float32)
    found = np.full(seen.shape, _NO_SAY, np.int32)
    for view, (start, end) in enumerate(pairwise(starts.tolist())):
        if start == end:
            continue
        block = shared[:, start:end]
        covered, best = block.sum(1), block.argmax(1)
        say = (seen[:, view] >= _SEEN * whole) & (covered >= _COVERED * seen[:, view])
        say &= covered > 0
        one = np.take_along_axis(block, best[:, None], 1)[:, 0] >= _CONTAINED * covered
        found[say, view] = np.where(one, start + best, _SPLIT)[say]
    return found


@njit(parallel=True, cache=True)
def _share(columns, mass, starts, num_categories, categories, shared, seen):  # type: ignore[no-untyped-def]
    """Mass of the Gaussians of each instance: `shared` with each other, and `seen` by each view at all."""
    count, num_views = columns.shape
    for u in prange(num_views):
        for g in range(count):
            a = columns[g, u] - num_categories
            if a < 0:
                continue
            a += starts[u]
            for v in range(num_views):
                column = columns[g, v]
                if column >= 0:
                    seen[a, v] += mass[g]
                    b = starts[v] + column - num_categories
                    if column >= num_categories and categories[b] == categories[a]:
                        shared[a, b] += mass[g]


@njit(parallel=True, cache=True)
def _agreement(containers):  # type: ignore[no-untyped-def]
    """For each two instances: views that contain both in one, and views that contain both in any."""
    m, num_views = containers.shape
    one, both = np.zeros((m, m), np.float32), np.zeros((m, m), np.float32)
    for a in prange(m):
        for b in range(m):
            if a == b:
                continue
            for v in range(num_views):
                of_a, of_b = containers[a, v], containers[b, v]
                if of_a >= 0 and of_b >= 0:
                    both[a, b] += 1
                    if of_a == of_b:
                        one[a, b] += 1
    return one, both


@njit(cache=True)
def _cluster(one, both, agree):  # type: ignore[no-untyped-def]
    """Clusters of instances, numbered by their first members: the pair that agrees best is joined first.

    The counts of joined instances add up. A pair is joined while one / (both + 1) is the largest of all and
    one / both is at least `agree`: one view alone is little to go by.
    """
    m = len(one)
    cluster, alive = np.arange(m), np.ones(m, np.bool_)
    score, partner = np.zeros(m, np.float32), np.full(m, -1)
    for a in range(m):
        _find_partner(a, one, both, alive, agree, score, partner)
    while True:
        a = int(np.argmax(score)) if m else -1
        if a < 0 or score[a] <= 0:
            return cluster
        b = partner[a]
        a, b = min(a, b), max(a, b)
        alive[b], score[b] = False, 0
        for c in range(m):
            if cluster[c] == b:
                cluster[c] = a
            one[a, c] += one[b, c]
            both[a, c] += both[b, c]
            one[c, a], both[c, a] = one[a, c], both[a, c]
        one[a, a], both[a, a] = 0, 0
        _find_partner(a, one, both, alive, agree, score, partner)
        for c in range(m):
            if alive[c] and c != a:
                if partner[c] == a or partner[c] == b:
                    _find_partner(c, one, both, alive, agree, score, partner)
                elif one[c, a] >= agree * both[c, a] and one[c, a] / (both[c, a] + 1) > score[c]:
                    score[c], partner[c] = one[c, a] / (both[c, a] + 1), a


@njit(cache=True)
def _find_partner(a, one, both, alive, agree, score, partner):  # type: ignore[no-untyped-def]
    score[a], partner[a] = 0, -1
    for c in range(len(one)):
        if alive[c] and c != a and one[a, c] > 0 and one[a, c] >= agree * both[a, c]:
            value = one[a, c] / (both[a, c] + 1)
            if value > score[a]:
                score[a], partner[a] = value, c
