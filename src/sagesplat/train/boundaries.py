"""Boundaries of blocks that were trained independently: cut, merge, and measure."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from sagesplat.core import geometry
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.formats.levels import read_level, read_second, read_sizes
from sagesplat.metrics.image import psnr
from sagesplat.scene.blocks import Blocks, visible_shares
from sagesplat.scene.scene import Scene
from sagesplat.segment.block_categories import BlockCategories

SEVERAL = 0.1  # share of what a view sees that is of other blocks, from which on it is a boundary view
_PAD = 0.25  # of the image beyond its edges: Gaussians with their centre there may reach into it


def interior(
    g: Gaussians, blocks: Blocks, parts: BlockCategories, block: int
) -> tuple[Gaussians, Bool[np.ndarray, " N"]]:
    """Gaussians in the interior of a block, with per-block categories; and which rows (bool) they are."""
    inside = blocks.of(g.means.numpy()) == block
    kept = g.select(torch.from_numpy(inside))
    part_ids = parts.ids(kept.label_ids.numpy(), block)
    return replace(kept, label_ids=torch.from_numpy(part_ids)), inside


def interior_sizes(
    labels: np.ndarray,
    inside: np.ndarray,
    sizes: Mapping[int, tuple[int, ...]],
    parts: BlockCategories,
    block: int,
) -> dict[int, tuple[int, ...]]:
    """Level sizes, by per-block category, of the interior (bool [N]) of an ordered model: at least one."""
    found = {}
    for label, levels in sizes.items():
        summed = np.concatenate([[0], inside[labels == label].cumsum()])
        if summed[-1]:
            found[int(parts.ids(np.array(label), block))] = tuple(int(max(1, summed[n])) for n in levels)
    return found


def interior_opacities(
    second: SecondOpacities,
    inside: np.ndarray,
    sizes: Mapping[int, tuple[int, ...]],
    parts: BlockCategories,
    block: int,
) -> SecondOpacities:
    """Second opacities of the interior (bool [N]) of a model, with the weights that it was trained with.

    `sizes`: of `interior_sizes`.
    """
    of_parts = {int(parts.ids(np.array(label), block)): w for label, w in second.weights.items()}
    return SecondOpacities(second.logits[torch.from_numpy(inside)], {i: of_parts[i] for i in sizes})


@dataclass(frozen=True, eq=False)
class Merged:
    """The nested models of all blocks."""

    gaussians: Gaussians
    sizes: dict[int, tuple[int, ...]]  # of levels, by label id
    second: SecondOpacities | None

    @property
    def full(self) -> Gaussians:
        """The full model, with the opacities that it has."""
        g, second = self.gaussians, self.second
        return g if second is None else replace(g, logit_opacities=second.logits)


def together(files: Sequence[Path]) -> Merged:
    """The nested models of all blocks, merged; their categories differ."""
    sizes = {label: n for path in files for label, n in read_sizes(path).items()}
    models = [read_nested(path) for path in files]
    seconds = [second for _, second in models]
    logits, weights = _second(seconds), {i: w for one in seconds if one for i, w in one.weights.items()}
    second = None if logits is None else SecondOpacities(logits, weights)
    return Merged(concat([g for g, _ in models]), sizes, second)


def read_nested(path: Path) -> tuple[Gaussians, SecondOpacities | None]:
    """All Gaussians of a nested ladder, and their second opacities."""
    return read_level(path), read_second(path, read_sizes(path))


def _second(parts: Sequence[SecondOpacities | None]) -> Tensor | None:
    """Their logits in one row; None where a part has none."""
    logits = [part.logits for part in parts if part is not None]
    return torch.cat(logits) if len(logits) == len(parts) else None


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


def around(
    own: tuple[Gaussians, SecondOpacities | None],
    others: Iterable[Path],
    scene: Scene,
    views: Sequence[int],
) -> tuple[Gaussians, Tensor | None]:
    """A block's Gaussians, then those of other blocks that its views see, and the second opacities of all.

    The files of `others` are read one by one.
    """
    parts, seconds = [own[0]], [own[1]]
    for path in others:
        g, second = read_nested(path)
        seen = torch.from_numpy(in_sight(g, scene, views))
        parts.append(g.select(seen))
        seconds.append(second and second.select(seen))
    return concat(parts), _second(seconds)


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
