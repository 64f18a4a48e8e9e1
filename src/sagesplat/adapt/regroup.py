"""Levels and measurements of other categories, made from those of the old ones without rendering.

Level k of a merged category is the union of level k of its parts, and level k of a part is what it has of
level k: with all categories at the same level the Gaussians are those of before, and so is every image (but
where a part is complete before the last level: a stream gives levels that show the same Gaussians the last
one's opacities; calibration measures these compositions again). Means
over the pixels of merged categories are then means, weighted by pixels, of those that are known.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int16

from sagesplat.adapt.fidelity import SampledFidelity
from sagesplat.adapt.ladder import PrefixLadder
from sagesplat.adapt.observe import TOTAL, Observations
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.second_opacity import SecondOpacities

_STEPS = 255  # of weights of second opacities
_WORST = 1e-10  # squared error that counts as none, as in `metrics.image.psnr`


def regrouped(
    ladder: PrefixLadder, new_ids: Mapping[int, Int16[np.ndarray, " _"]], labels: Sequence[int]
) -> tuple[Gaussians, dict[int, tuple[int, ...]], SecondOpacities | None]:
    """The Gaussians of some new categories in the order of their levels.

    Args:
        ladder: Levels, none of which replaces those below it.
        new_ids: By old label id, the new one of each Gaussian, by rank.
        labels: The new categories that are wanted, ascending.

    Returns:
        The Gaussians; by new id, how many there are up to the end of each level; second opacities, where the
        ladder has some: the weight of a level is the mean of those of its parts, in steps of 1/255.
    """
    rows, sizes, weights = [], {}, {}
    for new in labels:
        parts = _ranks_by_level(ladder, new_ids, new)
        rows += [some for level in parts for some in level]
        counts = [sum(map(len, level)) for level in parts]
        sizes[new] = tuple(np.cumsum(counts).tolist())
        if ladder.second is not None:
            weights[new] = _weights(ladder.second, new_ids, new)
    order = torch.from_numpy(np.concatenate(rows))
    g = ladder.gaussians.select(order)
    ids = np.repeat(np.array(labels, np.int16), [sizes[new][-1] for new in labels])
    second = None if ladder.second is None else SecondOpacities(ladder.second.logits[order], weights)
    return replace(g, label_ids=torch.from_numpy(ids)), sizes, second


def _ranks_by_level(
    ladder: PrefixLadder, new_ids: Mapping[int, np.ndarray], new: int
) -> list[list[np.ndarray]]:
    """Rows of a new category among all Gaussians: by level, and there by old category."""
    parts: list[list[np.ndarray]] = [[] for _ in ladder.levels]
    for old, ids in new_ids.items():
        mine, first = np.flatnonzero(ids == new), ladder.ranges[old][0][0]
        ends = np.searchsorted(mine, ladder.sizes[old])
        for level, ranks in enumerate(np.split(mine, ends[:-1])):
            parts[level].append(first + ranks)
    return parts


def _weights(second: SecondOpacities, new_ids: Mapping[int, np.ndarray], new: int) -> tuple[float, ...]:
    counts = {old: int((ids == new).sum()) for old, ids in new_ids.items()}
    shares = np.array([counts[old] for old in counts if counts[old]], np.float64)
    of_parts = np.array([second.weights[old] for old in counts if counts[old]])
    mean = (shares / shares.sum()) @ of_parts
    return tuple((np.round(mean * _STEPS) / _STEPS).tolist())


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


def regrouped_samples(
    sampled: SampledFidelity, moved: Mapping[int, int | None], distance: np.ndarray, labels: Sequence[int]
) -> SampledFidelity:
    """Sampled fidelity of merged categories, weighted by pixels; NaN for those that `moved` is None of.

    Exact but for pixels at borders: in the label image of the full model two parts together can paint most of
    a pixel that neither painted most of.

    `moved`: by old id the new one; None for one that was split. `distance`: d_min of the new categories
    `labels` (ascending) at the viewpoints, [V, L].
    """
    V, _, K = sampled.fidelity.shape
    total = np.zeros((V, len(labels), K))
    pixels = np.zeros((V, len(labels)), np.int64)
    for column, old in enumerate(sampled.labels):
        if (to := moved[old]) is None:
            continue
        at = labels.index(to)
        mine = sampled.pixels[:, column]
        pixels[:, at] += mine
        total[:, at] += (
            np.where(mine[:, None] > 0, np.nan_to_num(sampled.fidelity[:, column]), 0) * mine[:, None]
        )
    fidelity = np.divide(
        total, pixels[..., None], out=np.full(total.shape, np.nan), where=pixels[..., None] > 0
    )
    return SampledFidelity(
        tuple(labels), fidelity.astype(np.float32), pixels.astype(np.int32), sampled.image, sampled.whole,
        distance.astype(np.float32),
    )  # fmt: skip
