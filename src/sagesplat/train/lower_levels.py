"""Lower levels of Gaussians that are there already: merged sets that replace each other, then the originals.

A category's levels are sets of Gaussians. The lower ones are merged (`merging`), and fitted to renders of the
originals or trained on them; a set replaces the smaller one. From a certain level on they are prefixes of the
originals, ordered by importance; the last level is all of them.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from sagesplat.core.errors import RunError
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.train.merging import merge
from sagesplat.train.nested import Nested, Spans

FEWEST = 50  # Gaussians of a level, all categories together
_WHOLE = 100  # Gaussians of a category that is too small to merge
_SPAN = 2.5  # ratio of the sizes of the levels that share a trained set


def check_shares(shares: Sequence[float]) -> None:
    """RunError for sizes of levels that cannot be."""
    if not shares or not all(0 < share <= 1 for share in shares):
        named = " ".join(map(str, shares))
        raise RunError(f"--shares {named}: impossible; give fractions such as 0.1 0.5 1")


def usable_shares(shares: Sequence[float], count: int) -> tuple[float, ...]:
    """Sizes of levels as fractions of `count` Gaussians, ascending, ending with 1; RunError for others."""
    check_shares(shares)
    return (*sorted({share for share in shares if share < 1 and share * count >= FEWEST}), 1.0)


def size_of(share: float, count: int) -> int:
    """Gaussians of a level of a category with `count` of them."""
    return max(1, int(np.ceil(share * count - 1e-9)))


@dataclass(frozen=True, eq=False)
class Rung:
    """A set of Gaussians of all categories that replaces the smaller ones."""

    gaussians: Gaussians  # by category
    share: float  # its size, as a share of each category
    stands_for: np.ndarray  # float32 [N], blending weight of the originals that each is made of


def by_label(g: Gaussians) -> dict[int, np.ndarray]:
    """Rows of each category, ascending, by label id."""
    labels = g.label_ids.numpy()
    return {int(label): np.flatnonzero(labels == label) for label in np.unique(labels)}


def merged_rungs(g: Gaussians, weights: np.ndarray, shares: Sequence[float]) -> list[Rung]:
    """The originals merged to each of `shares`, ascending; small categories keep their most visible ones."""
    parts: dict[float, list[tuple[Gaussians, np.ndarray]]] = {share: [] for share in shares}
    descending = sorted(shares, reverse=True)
    for rows in by_label(g).values():
        mine, weight = g.select(torch.from_numpy(rows)), weights[rows]
        sizes = [size_of(share, len(rows)) for share in descending]
        if len(rows) < _WHOLE:
            order = np.argsort(-weight, kind="stable")
            for share, size in zip(descending, sizes, strict=True):
                kept = np.sort(order[:size])
                parts[share].append((mine.select(torch.from_numpy(kept)), weight[kept]))
            continue
        for share, merged in zip(descending, merge(mine, weight, sizes), strict=True):
            stands = np.bincount(merged.into, weight, len(merged.gaussians)).astype(np.float32)
            parts[share].append((merged.gaussians, stands))
    return [
        Rung(concat([g for g, _ in parts[share]]), share, np.concatenate([w for _, w in parts[share]]))
        for share in sorted(shares)
    ]


def trained_sets(shares: Sequence[float]) -> list[tuple[float, ...]]:
    """The shares that are trained as prefixes of one set, the sets ascending: neighbours in size."""
    sets: list[list[float]] = []
    for share in sorted(shares, reverse=True):
        if sets and sets[-1][0] <= _SPAN * share:
            sets[-1].append(share)
        else:
            sets.append([share])
    return [tuple(sorted(one)) for one in reversed(sets)]


def joined(
    tops: Mapping[float, Gaussians],
    importances: Sequence[np.ndarray],
    shares: Sequence[float],
    counts: Mapping[int, int],
) -> tuple[Nested, Spans]:
    """Sets of Gaussians as one model to train, each in the order of its importances.

    `tops`: the sets by their size as a share of each category, ascending; `shares`: of all levels to train;
    `counts`: originals of each category.
    """
    order, above, upto = [], [], []
    for g, importance, (low, high) in zip(tops.values(), importances, pairwise([0.0, *tops]), strict=True):
        place = np.empty(len(g), np.float32)
        for label, rows in by_label(g).items():
            ranked = rows[np.argsort(-importance[rows], kind="stable")]
            place[ranked] = np.arange(len(rows), dtype=np.float32) / counts[label]
        order.append(place)
        above.append(np.full(len(g), low, np.float32))
        upto.append(np.full(len(g), high, np.float32))
    g = concat(list(tops.values()))
    nested = Nested(g, np.ones(len(g), np.float32), np.full(len(g), 2, np.int8))
    spans = Spans(np.concatenate(order), np.concatenate(above), np.concatenate(upto), tuple(shares))
    return nested, spans


@dataclass(frozen=True, eq=False)
class Assembled:
    """All levels as one ladder: rows by category, in a category by level."""

    gaussians: Gaussians
    sizes: dict[int, tuple[int, ...]]  # rows of the category up to the end of each level
    replaces: dict[int, tuple[int, ...]]  # levels that replace those below


def assemble(
    sets: Sequence[tuple[Gaussians, Sequence[float]]], originals: Gaussians, shares: Sequence[float]
) -> Assembled:
    """Join sets of lower levels, ascending, and the originals, all in their order, into one ladder.

    `sets`: each with the shares of the levels that are prefixes of it; `shares`: of the originals' levels.
    """
    whole = by_label(originals)
    parts, sizes, replaces = [], {}, {}
    stages = [*sets, (originals, shares)]
    rows = [by_label(g) for g, _ in stages]
    for label, all_rows in whole.items():
        ends, replacing, begin = list[int](), list[int](), 0
        for (g, levels), mine in zip(stages, rows, strict=True):
            here = mine.get(label, np.zeros(0, np.int64))
            if ends:
                replacing.append(len(ends) + 1)
            for share in levels:
                ends.append(begin + min(len(here), size_of(share, len(all_rows))))
            ends[-1] = begin + len(here)
            begin += len(here)
            parts.append(g.select(torch.from_numpy(here)))
        sizes[label], replaces[label] = tuple(ends), tuple(replacing)
    return Assembled(concat(parts), sizes, replaces)


def split_sets(
    g: Gaussians, tops: Iterable[Gaussians], sets: Sequence[tuple[float, ...]]
) -> list[tuple[Gaussians, tuple[float, ...]]]:
    """The sets that `joined` joined, once trained: each in its order, with the shares of its levels."""
    whole, taken, found = by_label(g), dict[int, int](), []
    for top, levels in zip(tops, sets, strict=True):
        rows = []
        for label, count in top.counts().items():
            begin = taken.get(label, 0)
            rows.append(whole[label][begin : begin + count])
            taken[label] = begin + count
        found.append((g.select(torch.from_numpy(np.concatenate(rows))), levels))
    return found
