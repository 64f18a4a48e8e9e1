"""Cells and measurements of other categories, made from those of the old ones without rendering.

What a new category has of an old cell is a cell, whose levels are what it has of that cell's levels, in their
order: with all categories at the same level the Gaussians are those of before, and so is every image (but
where a part is complete before the last level: a stream gives levels that show the same Gaussians the last
one's opacities; calibration measures these compositions again). A cell that is whole keeps what was measured
of it, and means over the pixels of merged categories are means, weighted by pixels, of those that are known.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Int16, Int64

from sagesplat.adapt.fidelity import SampledFidelity
from sagesplat.adapt.ladder import NestedLadder, PrefixLadder
from sagesplat.adapt.observe import TOTAL, Observations
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.second_opacity import SecondOpacities

_WORST = 1e-10  # squared error that counts as none, as in `metrics.image.psnr`


@dataclass(frozen=True, eq=False)
class NewCell:
    """What a new category has of an old cell."""

    label_id: int  # of the new category
    old: int  # id of the old cell
    rows: Int64[np.ndarray, " n"]  # among all Gaussians of the ladder, in the order of the levels
    sizes: tuple[int, ...]  # Gaussians up to the end of each level
    whole: bool  # whether it has all of the old cell


def new_cells(ladder: NestedLadder, new_ids: Mapping[int, Int16[np.ndarray, " _"]]) -> dict[int, NewCell]:
    """The new cells by id: numbered from 0, by new category and there by old cell.

    Args:
        ladder: Levels, none of which replaces those below it.
        new_ids: By old label id, the new one of each Gaussian, by rank: cells by id, each in its order.
    """
    found = []
    for label, ids in new_ids.items():
        end = 0
        for cell in ladder.cells_of(label):
            sizes, begin = ladder.cells.sizes[cell], end
            end += sizes[-1]
            own, first = ids[begin:end], ladder.cells.ranges[cell][0][0]
            for new in np.unique(own).tolist():
                ranks = np.flatnonzero(own == new)
                counts = tuple(np.searchsorted(ranks, sizes).tolist())
                found.append(NewCell(new, cell, first + ranks, counts, len(ranks) == len(own)))
    return dict(enumerate(sorted(found, key=lambda one: (one.label_id, one.old))))


def regrouped(
    ladder: PrefixLadder, cells: Mapping[int, NewCell]
) -> tuple[Gaussians, dict[int, tuple[int, ...]], SecondOpacities | None]:
    """The Gaussians of new cells, with their ids; the sizes of their levels; second opacities, if there are.

    The weights of second opacities are those of the old cells.
    """
    rows = torch.from_numpy(np.concatenate([np.arange(0), *(one.rows for one in cells.values())]))
    ids = np.repeat(np.array(list(cells), np.int16), [len(one.rows) for one in cells.values()])
    g = replace(ladder.gaussians.select(rows), label_ids=torch.from_numpy(ids))
    sizes, second = {cell: one.sizes for cell, one in cells.items()}, ladder.second
    if second is not None:
        weights = {cell: second.weights[one.old] for cell, one in cells.items()}
        second = SecondOpacities(second.logits[rows], weights)
    return g, sizes, second


def regrouped_observations(
    table: Observations, moved: Mapping[int, int | None], distance: Mapping[int, np.ndarray]
) -> Observations:
    """Observations of merged categories: those of their parts, weighted by pixels, PSNR by squared errors.

    `moved`: by old id the new one; None for one that was split, whose rows are left out. `distance`: d_min by
    new id, [V]. The eroded masks' means are weighted by all pixels: near the border between two parts there
    was none of that category's eroded mask.
    """
    known = {old: new for old, new in moved.items() if new is not None} | {TOTAL: TOTAL}
    table = table.select(np.isin(table.label_id, list(known)))
    labels = np.array([known[old] for old in table.label_id.tolist()], np.int32)
    keys = np.stack([table.level, table.view, labels], 1)
    groups, inverse = np.unique(keys, axis=0, return_inverse=True)
    inverse, n = inverse.ravel(), len(groups)
    pixels = np.bincount(inverse, table.num_pixels, n)
    level, view, label = groups.T.astype(np.int32)
    nowhere = np.full(int(view.max(initial=0)) + 1, np.nan)
    far = [distance.get(one, nowhere)[row] for one, row in zip(label.tolist(), view.tolist(), strict=True)]
    error = _means(10 ** (-table.psnr.astype(np.float64) / 10), table.num_pixels, inverse, n)
    return Observations(
        label_id=label,
        level=level,
        view=view,
        distance=np.array(far, np.float32),
        ssim=_means(table.ssim, table.num_pixels, inverse, n).astype(np.float32),
        ssim_eroded=_means(table.ssim_eroded, table.num_pixels, inverse, n).astype(np.float32),
        psnr=(-10 * np.log10(np.maximum(error, _WORST))).astype(np.float32),
        num_pixels=pixels.astype(np.int32),
    )


def _means(values: np.ndarray, weights: np.ndarray, group: np.ndarray, n: int) -> np.ndarray:
    """Weighted means by group, of what is no NaN; NaN where nothing is left."""
    known = ~np.isnan(values)
    weights = np.where(known, weights, 0).astype(np.float64)
    total = np.bincount(group, weights, n)
    found = np.bincount(group, np.where(known, values, 0) * weights, n)
    return np.divide(found, total, out=np.full(n, np.nan), where=total > 0)


def regrouped_samples(sampled: SampledFidelity, cells: Mapping[int, NewCell]) -> SampledFidelity:
    """Sampled fidelity of new cells: each has what was measured of its old cell."""
    columns = [sampled.labels.index(one.old) for one in cells.values()]
    names = ("fidelity", "pixels", "distance")
    return replace(
        sampled, labels=tuple(cells), **{name: getattr(sampled, name)[:, columns] for name in names}
    )
