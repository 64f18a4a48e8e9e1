"""Boundaries of blocks that were trained independently: cut, merge, and measure."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool

from sagesplat.core import geometry
from sagesplat.core.errors import DataError, RunError
from sagesplat.core.gaussians import Gaussians, concat, relabelled
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.formats.levels import read_level, read_more, read_second, read_sizes, write_set
from sagesplat.metrics.image import psnr
from sagesplat.scene.blocks import Blocks, visible_shares
from sagesplat.scene.scene import Scene
from sagesplat.segment.masks import MAX_LABEL_ID, UNLABELLED

SEVERAL = 0.1  # share of what a view sees that is of other blocks, from which on it is a boundary view
_PAD = 0.25  # of the image beyond its edges: Gaussians with their centre there may reach into it


@dataclass(frozen=True, eq=False)
class BlockLevels:
    """The nested levels of a block, or of several that were merged, by cell."""

    gaussians: Gaussians  # the label ids are those of cells
    sizes: Mapping[int, tuple[int, ...]]  # of levels, by cell
    label_of: Mapping[int, int]  # label id by cell
    second: SecondOpacities | None = None

    @property
    def full(self) -> Gaussians:
        """The full model, with the opacities that it has."""
        g, second = self.gaussians, self.second
        return g if second is None else replace(g, logit_opacities=second.logits)

    def select(self, rows: Bool[np.ndarray, " N"]) -> "BlockLevels":
        """Some of the Gaussians, in levels of those that are left: at least one where a cell has some."""
        cells, sizes = self.gaussians.label_ids.numpy(), {}
        for cell, levels in self.sizes.items():
            summed = np.concatenate([[0], rows[cells == cell].cumsum()])
            if summed[-1]:
                sizes[cell] = tuple(int(max(1, summed[n])) for n in levels)
        kept, second = torch.from_numpy(rows), self.second
        if second is not None:
            second = SecondOpacities(second.logits[kept], {cell: second.weights[cell] for cell in sizes})
        label_of = {cell: self.label_of[cell] for cell in sizes}
        return BlockLevels(self.gaussians.select(kept), sizes, label_of, second)


def write_block(path: Path, block: BlockLevels, step: int) -> None:
    """Write what `read_block` reads."""
    labels = [block.label_of[cell] for cell in sorted(block.sizes)]
    write_set(path, block.gaussians, step, block.sizes, second=block.second, labels=labels)


def read_block(path: Path) -> BlockLevels:
    """What `write_block` wrote; DataError for anything else."""
    sizes = read_sizes(path)
    labels = read_more(path, "labels")
    possible = labels.dtype.kind == "i" and ((labels >= UNLABELLED) & (labels <= MAX_LABEL_ID)).all()
    if labels.shape != (len(sizes),) or not possible:
        raise DataError(
            f"{path}: not the labels of {len(sizes)} cells; delete it and run `sagesplat nest` again"
        )
    label_of = dict(zip(sorted(sizes), labels.tolist(), strict=True))
    return BlockLevels(read_level(path), sizes, label_of, read_second(path, sizes))


def merged(blocks: Sequence[BlockLevels]) -> BlockLevels:
    """The levels of all blocks, in their order; cells are numbered anew, by category and then by block.

    Of one block they keep their order, as cells are numbered by category everywhere.
    """
    cells = sorted(
        (label, block, cell) for block, one in enumerate(blocks) for cell, label in one.label_of.items()
    )
    if len(cells) > MAX_LABEL_ID:
        raise RunError(
            f"{len(cells):,} cells in {len(blocks)} blocks; choose fewer with --blocks.count or --nest.cells"
        )
    new = {(block, cell): i for i, (_, block, cell) in enumerate(cells)}
    tables = [{cell: new[block, cell] for cell in one.label_of} for block, one in enumerate(blocks)]
    both = list(zip(tables, blocks, strict=True))
    seconds, second = [one.second for one in blocks if one.second], None
    if len(seconds) == len(blocks):
        weights = {to[cell]: w for to, one in both if one.second for cell, w in one.second.weights.items()}
        second = SecondOpacities(torch.cat([one.logits for one in seconds]), weights)
    return BlockLevels(
        concat([relabelled(one.gaussians, to) for to, one in both]),
        {to[cell]: sizes for to, one in both for cell, sizes in one.sizes.items()},
        {i: label for i, (label, _, _) in enumerate(cells)},
        second,
    )


def boundary_views(scene: Scene, blocks: Blocks, block: int) -> list[int]:
    """Training views of a block (rows) that see enough of other blocks."""
    shares = visible_shares(scene, blocks.of(scene.points.xyz), len(blocks))
    return [row for row in scene.train_ids.tolist() if shares[row, block] < 1 - SEVERAL]


def in_sight(g: Gaussians, scene: Scene, views: Sequence[int]) -> Bool[np.ndarray, " N"]:
    """Gaussians whose centre is in the frustum of some of the views, or near it."""
    seen, means = np.zeros(len(g), bool), g.means.numpy()
    for row in views:
        camera = scene.views[row].camera
        pixels, _ = geometry.project(means, camera.w2c, camera.K)
        size = np.array([camera.width, camera.height])
        seen |= ((pixels >= -_PAD * size) & (pixels < (1 + _PAD) * size)).all(1)
    return seen


def around(own: BlockLevels, others: Iterable[Path], scene: Scene, views: Sequence[int]) -> BlockLevels:
    """A block's levels, then what its views see of those of other blocks, whose files are read one by one."""
    parts = [own]
    for path in others:
        other = read_block(path)
        parts.append(other.select(in_sight(other.gaussians, scene, views)))
    return merged(parts)


@dataclass(frozen=True)
class Bands:
    """Quality of a composition near the boundaries of blocks and away from them, over some views."""

    share: float  # of the pixels that are in a band
    psnr: float  # dB over all pixels in bands
    psnr_inside: float  # dB over all others
    ssim: float
    ssim_inside: float


def bands(in_band: Sequence[np.ndarray], squares: Sequence[np.ndarray], ssim: Sequence[np.ndarray]) -> Bands:
    """Sum up views: pixels in a band (bool [H, W]), squared errors and SSIM there."""
    band = np.concatenate([b.ravel() for b in in_band])
    error, quality = (
        np.concatenate([v.ravel() for v in maps]).astype(np.float64) for maps in (squares, ssim)
    )

    def mean(values: np.ndarray) -> float:
        return float(values.mean()) if len(values) else np.nan

    return Bands(
        mean(band),
        float(psnr(mean(error[band]))),
        float(psnr(mean(error[~band]))),
        mean(quality[band]),
        mean(quality[~band]),
    )
