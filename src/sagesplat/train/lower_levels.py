"""Lower levels of Gaussians that are there already: merged sets that replace each other, then the originals.

A category's levels are sets of Gaussians. The lower ones are merged (`merging`), and fitted to renders of the
originals or trained on them; a set replaces the smaller one. From a certain level on they are prefixes of the
originals, ordered by importance; the last level is all of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import KDTree

from sagesplat.core.gaussians import Gaussians, concat, gather
from sagesplat.train.cells import split_cells
from sagesplat.train.merging import merge
from sagesplat.train.nested import Nested, Spans

FEWEST = 50  # Gaussians of a level, all categories together
Counts = Mapping[int, int]  # label id -> Gaussians
_SPAN = 2.5  # ratio of the sizes of the levels that share a trained set


def usable_shares(shares: Sequence[float], count: int) -> tuple[float, ...]:
    """Sizes of levels as fractions of `count` Gaussians, ascending, ending with 1."""
    return (*sorted({share for share in shares if share < 1 and share * count >= FEWEST}), 1.0)


def size_of(share: float, count: int) -> int:
    """Gaussians of a level of `share` of `count`."""
    return max(1, int(np.ceil(share * count - 1e-9)))


@dataclass(frozen=True, eq=False)
class Set:
    """Gaussians of all categories, and the levels that are prefixes of them, in each category by itself."""

    gaussians: Gaussians
    levels: tuple[Counts, ...]  # Gaussians of each category; the last has all


def whole(g: Gaussians) -> Set:
    """All Gaussians as one level."""
    return Set(g, (g.counts(),))


@dataclass(frozen=True, eq=False)
class Rung:
    """All Gaussians merged to fewer."""

    gaussians: Gaussians
    share: float  # of all
    stands_for: np.ndarray  # float32 [N], blending weight of the originals that each is made of


def by_label(g: Gaussians) -> dict[int, np.ndarray]:
    """Rows of each category, ascending, by label id."""
    labels = g.label_ids.numpy()
    return {int(label): np.flatnonzero(labels == label) for label in np.unique(labels)}


def merged_rungs(g: Gaussians, weights: np.ndarray, shares: Sequence[float]) -> list[Rung]:
    """The originals merged to each of `shares` of all Gaussians, ascending.

    A category keeps more of its Gaussians where mergers show more.
    """
    descending = sorted(shares, reverse=True)
    found = []
    for share, merged in zip(
        descending, merge(g, weights, [size_of(share, len(g)) for share in descending]), strict=True
    ):
        stands = np.bincount(merged.into, weights, len(merged.gaussians)).astype(np.float32)
        found.append(Rung(merged.gaussians, share, stands))
    return found[::-1]


def first_of_all(ordered: Gaussians, share: float, least: Counts) -> Gaussians:
    """The first Gaussians, `share` of all, with at least `least` and one of each category."""
    return ordered.select(torch.from_numpy(_first(ordered, share, least)))


def counts_of_first(ordered: Gaussians, share: float, least: Counts) -> Counts:
    """How many of each category `first_of_all` has."""
    labels, counts = np.unique(ordered.label_ids[_first(ordered, share, least)], return_counts=True)
    return dict(zip(labels.tolist(), counts.tolist(), strict=True))


def _first(ordered: Gaussians, share: float, least: Counts) -> np.ndarray:
    kept = np.arange(len(ordered)) < size_of(share, len(ordered))
    for label, rows in by_label(ordered).items():
        kept[rows[: max(1, least.get(label, 0))]] = True
    return kept


def trained_sets(shares: Sequence[float]) -> list[tuple[float, ...]]:
    """The shares that are trained as prefixes of one set, the sets ascending: neighbours in size."""
    sets: list[list[float]] = []
    for share in sorted(shares, reverse=True):
        if sets and sets[-1][0] <= _SPAN * share:
            sets[-1].append(share)
        else:
            sets.append([share])
    return [tuple(sorted(one)) for one in reversed(sets)]


def joined(sets: Sequence[Set], importances: Sequence[np.ndarray]) -> tuple[Nested, Spans]:
    """Sets of Gaussians as one model to train, each in the order of its importances."""
    order, first, last, level = [], [], [], 0
    for one, importance in zip(sets, importances, strict=True):
        place, shown = np.empty(len(one.gaussians), np.float32), np.empty(len(one.gaussians), np.int8)
        for label, rows in by_label(one.gaussians).items():
            ranked = rows[np.argsort(-importance[rows], kind="stable")]
            place[ranked] = np.arange(len(rows), dtype=np.float32) / len(rows)
            ends = [counts[label] for counts in one.levels]
            shown[ranked] = level + np.searchsorted(ends, np.arange(len(rows)), side="right")
        order.append(place)
        first.append(shown)
        level += len(one.levels)
        last.append(np.full(len(place), level - 1, np.int8))
    g = concat([one.gaussians for one in sets])
    nested = Nested(g, np.zeros(len(g), bool))
    return nested, Spans(np.concatenate(order), np.concatenate(first), np.concatenate(last), level)


@dataclass(frozen=True, eq=False)
class Assembled:
    """All levels as one ladder: rows by category, in a category by level."""

    gaussians: Gaussians
    sizes: dict[int, tuple[int, ...]]  # rows of the category up to the end of each level
    replaces: dict[int, tuple[int, ...]]  # levels that replace those below


def assemble(sets: Sequence[Set]) -> Assembled:
    """Join sets of levels, ascending, each in its order, into one ladder; the last is the originals."""
    parts, sizes, replaces = [], dict[int, tuple[int, ...]](), dict[int, tuple[int, ...]]()
    rows = [by_label(one.gaussians) for one in sets]
    for label in rows[-1]:
        ends, replacing, begin = list[int](), list[int](), 0
        for one, mine in zip(sets, rows, strict=True):
            if ends:
                replacing.append(len(ends) + 1)
            ends += [begin + counts[label] for counts in one.levels]
            begin = ends[-1]
            parts.append((one.gaussians, torch.from_numpy(mine[label])))
        sizes[label], replaces[label] = tuple(ends), tuple(replacing)
    return Assembled(gather(parts), sizes, replaces)


def in_cells(ladder: Assembled, count: int) -> tuple[Assembled, dict[int, int]]:
    """The ladder in about `count` cells, by whose ids its rows then are, and the label id of each.

    The originals are split by place, and what stands for them goes with the nearest one. Every cell has
    Gaussians at every level, so that each set replaces the one before: a category that is too small is one
    cell. With all cells at one level the Gaussians are those of before.
    """
    g, rows_of = ladder.gaussians, by_label(ladder.gaussians)
    last = {label: max((1, *ladder.replaces[label])) - 1 for label in rows_of}  # where the originals begin
    begins = {label: ladder.sizes[label][level - 1] if level else 0 for label, level in last.items()}
    originals = np.concatenate([rows[begins[label] :] for label, rows in rows_of.items()])
    means, labels = g.means.numpy(), g.label_ids.numpy()
    split, _ = split_cells(means[originals], labels[originals], count)
    order, ids, found = [], [], Assembled(g, {}, {})
    label_of = dict[int, int]()
    for label, rows in rows_of.items():
        mine = split[labels[originals] == label]
        lower, upper = np.split(means[rows], [begins[label]])
        nearest = KDTree(upper).query(lower, workers=-1)[1] if len(lower) else np.zeros(0, np.int64)
        _, own = np.unique(np.concatenate([mine[nearest], mine]), return_inverse=True)
        sizes, replaces = ladder.sizes[label], ladder.replaces[label]
        starts = [0, *(sizes[level - 2] for level in replaces)]
        firsts = [sizes[0], *(sizes[level - 1] for level in replaces)]
        for start, end in zip(starts, firsts, strict=True):
            if not _all_present(own[start:end], means[rows[start:end]], own, means[rows]):
                own = np.zeros_like(own)
                break
        for part in range(int(own.max()) + 1):
            ranks, cell = np.flatnonzero(own == part), len(label_of)
            order.append(rows[ranks])
            ids.append(np.full(len(ranks), cell, np.int16))
            found.sizes[cell] = tuple(np.searchsorted(ranks, sizes).tolist())
            found.replaces[cell], label_of[cell] = replaces, label
    g = g.select(torch.from_numpy(np.concatenate(order)))
    return replace(found, gaussians=replace(g, label_ids=torch.from_numpy(np.concatenate(ids)))), label_of


def _all_present(level: np.ndarray, means: np.ndarray, own: np.ndarray, everywhere: np.ndarray) -> bool:
    """Give each cell that is not in `level` (cells, changed in place) the nearest that others can spare."""
    counts = np.bincount(level, minlength=int(own.max()) + 1)
    if len(level) < len(counts):
        return False
    for cell in np.flatnonzero(counts == 0):
        centre = everywhere[own == cell].mean(0)
        spare = np.flatnonzero(counts[level] > 1)
        one = spare[((means[spare] - centre) ** 2).sum(1).argmin()]
        counts[level[one]] -= 1
        counts[cell], level[one] = 1, cell
    return True


def split_sets(g: Gaussians, sets: Sequence[Set]) -> list[Set]:
    """The sets that `joined` joined, once trained: each in its order."""
    trained, taken, found = by_label(g), dict[int, int](), []
    for one in sets:
        rows = []
        for label, count in one.gaussians.counts().items():
            begin = taken.get(label, 0)
            rows.append(trained[label][begin : begin + count])
            taken[label] = begin + count
        found.append(Set(g.select(torch.from_numpy(np.concatenate(rows))), one.levels))
    return found
