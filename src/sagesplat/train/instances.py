"""3D instances: 2D instances of the views are joined, and each Gaussian gets that of its largest weight."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from jaxtyping import Bool, Float32, Int16, Int32, Int64
from numba import prange
from scipy.spatial import KDTree

from sagesplat.core.gaussians import Gaussians
from sagesplat.kernels.jit import njit
from sagesplat.raster import Workspace, add_weights
from sagesplat.scene.scene import Scene, View
from sagesplat.segment.edit import free_id
from sagesplat.segment.instances import NO_INSTANCE
from sagesplat.segment.masks import UNLABELLED, Masks, Taxonomy
from sagesplat.segment.valid import ALL_VALID, ValidPixels
from sagesplat.train.view_consensus import Sightings, join

PhotoInstances = Callable[[View], Int16[np.ndarray, "H W"] | None]
"""The number of each pixel's instance in a view, -1 for none; None where nothing is known of the view."""

LEAST_WEIGHT = 0.02  # pixels of a view that have to show a Gaussian
LEAST_PIXELS = 16  # of a 2D instance
LEAST_SHARE = 0.3  # of what views that show an object see of a Gaussian's category: what has to be in it
_COLUMNS = 2  # of each view that count: at a border a Gaussian paints both sides of it
_ROUNDS, _REACH = 8, 3.0  # of spreading to neighbours; times their median distance
_NEIGHBOURS = 8  # most of which decide what views leave open


@dataclass(frozen=True, eq=False)
class Instances:
    """The 3D instances of a scene."""

    label_ids: Int16[np.ndarray, " N"]  # of the Gaussians: instances, and plain categories
    taxonomy: Taxonomy  # the plain categories and the instances
    parents: dict[int, int]  # instance id -> category id
    alone: dict[int, int]  # category id -> its 2D instances that no other view confirms


def gather(
    gaussians: Gaussians,
    scene: Scene,
    masks: Masks,
    instances: PhotoInstances,
    views: Sequence[int],
    wanted: Collection[int],
    *,
    valid: ValidPixels = ALL_VALID,
    antialiased: bool = False,
    on_view: Callable[[int], None] | None = None,
) -> Sightings:
    """What `views` (rows of `Scene.views`) see of the Gaussians, by blending weight (alpha times T).

    An instance belongs to the category that `masks` shows on most of it, and has no pixels elsewhere; those
    of other categories than `wanted`, and those of less than 16 pixels, are none. Pixels that are not
    `valid` count nowhere. Memory: 12 bytes per Gaussian and view.
    """
    ids = np.array([UNLABELLED, *sorted(masks.taxonomy.names)], np.int16)
    columns = np.full((len(gaussians), len(views), _COLUMNS), -1, np.int16)
    weights = np.zeros(columns.shape, np.float32)
    categories, starts, workspace = list[int](), [0], Workspace()
    for done, row in enumerate(views):
        view = scene.views[row]
        pixels, own = _columns(ids, masks[view], instances(view), wanted)
        if (counts := valid[view]) is not None:
            pixels[~counts] = -1
        sums = np.zeros((len(gaussians), len(ids) + len(own)), np.float32)
        add_weights(gaussians, view.camera, pixels, sums, antialiased=antialiased, workspace=workspace)
        seen = np.flatnonzero(sums.max(1) >= LEAST_WEIGHT)
        sums = sums[seen]
        for k in range(_COLUMNS):
            best = sums.argmax(1)[:, None]
            most = np.take_along_axis(sums, best, 1)
            columns[seen, done, k] = np.where(most > 0, best, -1)[:, 0]
            weights[seen, done, k] = most[:, 0]
            np.put_along_axis(sums, best, 0, 1)
        categories += own
        starts.append(len(categories))
        if on_view:
            on_view(done + 1)
    return Sightings(columns, weights, len(ids), np.array(starts), np.array(categories, np.int16))


def _columns(
    ids: Int16[np.ndarray, " C"],
    label_ids: Int16[np.ndarray, "H W"],
    instances: Int16[np.ndarray, "H W"] | None,
    wanted: Collection[int],
) -> tuple[Int64[np.ndarray, "H W"], list[int]]:
    """Column of each pixel (of its category or its instance), and the category column of each instance."""
    pixels = np.searchsorted(ids, label_ids)
    own = list[int]()
    if instances is None or not (instances != NO_INSTANCE).any():
        return pixels, own
    counts = np.zeros((int(instances.max()) + 1, len(ids)), np.int64)
    some = instances != NO_INSTANCE
    np.add.at(counts, (instances[some], pixels[some]), 1)
    for number in range(len(counts)):
        category = int(counts[number].argmax())
        if ids[category] in wanted and counts[number, category] >= LEAST_PIXELS:
            pixels[(instances == number) & (pixels == category)] = len(ids) + len(own)
            own.append(category)
    return pixels, own


def label(gaussians: Gaussians, sightings: Sightings, taxonomy: Taxonomy) -> Instances:
    """Join the 2D instances, and give each Gaussian the 3D instance that views see it in.

    A Gaussian has the category of its largest weight, or its own where no view sees it. It has the instance
    of largest weight in that category, if that is at least 0.3 of the category's weight in views that show
    the instance: a view that lost its mask has no say. Gaussians that no view sees get the instance of their
    neighbours, and those without one that of most of their eight nearest in the category. Instances are
    numbered by their weight, the largest first: "chair 1".

    Args:
        gaussians: The model, with categories as `label_ids`.
        sightings: What views see of it (`gather`), with the categories of `taxonomy`.
        taxonomy: The categories.

    Returns:
        Labels of the Gaussians, names of categories and instances, and what no second view confirmed.
    """
    objects = join(sightings)
    ids = np.array([UNLABELLED, *sorted(taxonomy.names)], np.int16)
    of_object = np.full(int(objects.max(initial=-1)) + 1, -1, np.int64)  # category column
    of_object[objects[objects >= 0]] = sightings.categories[objects >= 0]
    shows = np.zeros((len(sightings.starts) - 1, len(of_object)), bool)  # which objects each view shows
    shows[sightings.views[objects >= 0], objects[objects >= 0]] = True
    best, category, size = _vote(
        sightings.columns, sightings.weights, len(ids), sightings.starts, sightings.categories, objects,
        of_object, shows, LEAST_SHARE,
    )  # fmt: skip
    own = np.searchsorted(ids, gaussians.label_ids.numpy())
    unseen = category < 0
    category = np.where(unseen, own, category)
    places = gaussians.means.detach().cpu().numpy()
    for column in np.unique(of_object):
        _spread(places, best, category == column, unseen)
        _fill(places, best, category == column)
    new_ids, names, parents = _named(of_object, size, ids, taxonomy)
    label_ids = np.where(best >= 0, new_ids[best], ids[category]) if len(of_object) else ids[category]
    alone = ids[sightings.categories[objects < 0]]
    lost = {int(i): int((alone == i).sum()) for i in np.unique(alone)}
    return Instances(label_ids.astype(np.int16), names, parents, lost)


@njit(parallel=True, cache=True)
def _vote(columns, weights, num_ids, starts, categories, objects, of_object, shows, least):  # type: ignore[no-untyped-def]
    """Object (-1: none) and category column (-1: unseen) of each Gaussian, and the weight of each object."""
    n, num_views, num_columns = columns.shape
    best, category = np.full(n, -1, np.int32), np.full(n, -1, np.int64)
    won = np.zeros(n, np.float32)
    for g in prange(n):
        by_category = np.zeros(num_ids, np.float32)
        by_object = np.zeros(len(of_object), np.float32)
        possible = np.zeros(len(of_object), np.float32)  # its category's weight in views that show the object
        for v in range(num_views):
            for i in range(num_columns):
                column, weight = columns[g, v, i], weights[g, v, i]
                if column < 0:
                    break
                if column >= num_ids:
                    instance = starts[v] + column - num_ids
                    column = categories[instance]
                    if objects[instance] >= 0:
                        by_object[objects[instance]] += weight
                by_category[column] += weight
                for k in range(len(of_object)):
                    if shows[v, k] and of_object[k] == column:
                        possible[k] += weight
        most = np.argmax(by_category)
        if by_category[most] <= 0:
            continue
        category[g] = most
        for k in range(len(of_object)):
            if of_object[k] == most and by_object[k] > won[g]:
                won[g], best[g] = by_object[k], k
        if best[g] >= 0 and won[g] < least * possible[best[g]]:
            best[g], won[g] = -1, 0
    size = np.zeros(len(of_object))
    for g in range(n):
        if best[g] >= 0:
            size[best[g]] += won[g]
    return best, category, size


def _spread(
    places: Float32[np.ndarray, "N 3"],
    best: Int32[np.ndarray, " N"],
    mine: Bool[np.ndarray, " N"],
    unseen: Bool[np.ndarray, " N"],
) -> None:
    """Give Gaussians of a category that no view sees the object of their nearest neighbour."""
    known = np.flatnonzero(mine & (best >= 0))
    todo = np.flatnonzero(mine & unseen & (best < 0))
    if len(known) < 2 or not len(todo):
        return
    spacing = np.asarray(KDTree(places[known]).query(places[known], 2)[0])
    reach = _REACH * float(np.median(spacing[:, 1]))
    for _ in range(_ROUNDS):
        distance, near = (np.asarray(found) for found in KDTree(places[known]).query(places[todo]))
        close = distance <= reach
        if not close.any():
            return
        best[todo[close]] = best[known[near[close]]]
        known, todo = np.concatenate([known, todo[close]]), todo[~close]
        if not len(todo):
            return


def _fill(
    places: Float32[np.ndarray, "N 3"], best: Int32[np.ndarray, " N"], mine: Bool[np.ndarray, " N"]
) -> None:
    """Give Gaussians of a category without an object that of most of their nearest neighbours in it."""
    rows, open_ = np.flatnonzero(mine), np.flatnonzero(mine & (best < 0))
    if len(rows) <= _NEIGHBOURS or not len(open_):
        return
    near = np.asarray(KDTree(places[rows]).query(places[open_], _NEIGHBOURS + 1)[1])[:, 1:]
    of_near = np.sort(best[rows[near]], axis=1)
    middle = of_near[:, _NEIGHBOURS // 2]  # what most have is in the middle
    most = (of_near == middle[:, None]).sum(1) > _NEIGHBOURS / 2
    best[open_[most]] = middle[most]


def _named(
    of_object: Int64[np.ndarray, " K"],
    size: np.ndarray,
    ids: Int16[np.ndarray, " C"],
    taxonomy: Taxonomy,
) -> tuple[Int16[np.ndarray, " K"], Taxonomy, dict[int, int]]:
    """New ids of the objects that have Gaussians, all names, and the categories of the new ids."""
    names, parents = dict(taxonomy.names), dict[int, int]()
    new_ids, taken = np.full(len(of_object), UNLABELLED, np.int16), set(names)
    for column in np.unique(of_object):
        parent = int(ids[column])
        rows = np.flatnonzero((of_object == column) & (size > 0))
        numbered = (f"{taxonomy.name(parent)} {number}" for number in count(1))
        fresh = (name for name in numbered if name not in taxonomy.names.values())
        for name, row in zip(fresh, rows[np.argsort(-size[rows], kind="stable")], strict=False):
            new_ids[row] = free_id(name, taken)
            taken.add(int(new_ids[row]))
            names[int(new_ids[row])] = name
            parents[int(new_ids[row])] = parent
    return new_ids, Taxonomy(dict(sorted(names.items()))), parents
