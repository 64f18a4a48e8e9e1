"""Selective optimisation (Fig. 1 of the paper): a category that has reached its quality stops changing."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Int16
from scipy.ndimage import binary_dilation

from sagesplat.config import TrainConfig
from sagesplat.gaussians import Gaussians
from sagesplat.metrics import means_by_label, ssim_map
from sagesplat.raster import TILE, Backend, Workspace, rasterize
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.segment.masks import Masks
from sagesplat.train.group import ALONE, Group

MOST_VIEWS = 16  # training views that a measurement takes at most, evenly spread: it must stay cheap


def measured_views(scene: Scene) -> list[int]:
    """Rows of the training views that quality is measured on."""
    rows = scene.train_ids
    picked = np.linspace(0, len(rows) - 1, min(MOST_VIEWS, len(rows))).round().astype(int)
    return rows[np.unique(picked)].tolist()


@dataclass(frozen=True, eq=False)
class Work:
    """What the categories that have stopped leave to learn: tiles of 16 px that show another one."""

    scene: Scene
    masks: Masks | None  # needed once a category has stopped
    frozen: frozenset[int] = frozenset()  # label ids
    _kept: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)

    def tiles(self, row: int, factor: int = 1) -> Bool[np.ndarray, "h w"] | None:
        """The tiles of a view, drawn `factor` times smaller, that are left; None: all."""
        if not self.frozen or self.masks is None:
            return None
        if (row, factor) not in self._kept:
            self._kept[row, factor] = active_tiles(self.masks[self.scene.views[row]], self.frozen, factor)
        return self._kept[row, factor]

    def finished(self, row: int) -> bool:
        """Whether a view shows nothing but stopped categories."""
        tiles = self.tiles(row)
        return tiles is not None and not tiles.any()


def active_tiles(
    label_ids: Int16[np.ndarray, "H W"], frozen: Collection[int], factor: int = 1
) -> Bool[np.ndarray, "h w"]:
    """Which tiles of 16 x 16 pixels, of an image `factor` times smaller, show another than those labels."""
    height, width = label_ids.shape
    side = TILE * factor
    rows, columns = (-(-max(1, round(n / factor)) // TILE) for n in (height, width))
    learns = np.zeros((rows * side, columns * side), bool)
    stopped = np.array(list(frozen), label_ids.dtype)
    shown = ~np.isin(label_ids[: rows * side, : columns * side], stopped, kind="table")
    learns[: shown.shape[0], : shown.shape[1]] = shown
    return np.asarray(learns.reshape(rows, side, columns, side).any((1, 3)))


def label_quality(
    gaussians: Gaussians,
    work: Work,
    photos: Photos,
    config: TrainConfig,
    sh_degree: int,
    backend: Backend,
    workspace: Workspace,
    group: Group = ALONE,
) -> dict[int, float]:
    """Mean SSIM of each category that has not stopped, over those of `measured_views` that show it.

    The processes of a `group` measure some views each.
    """
    assert work.masks is not None
    found: dict[int, dict[int, float]] = {}
    for row in group.share(measured_views(work.scene)):
        view, tiles = work.scene.views[row], work.tiles(row)
        if tiles is not None:  # windows reach into the tiles around
            tiles = binary_dilation(tiles, np.ones((3, 3)))
        with torch.no_grad():
            render = rasterize(
                gaussians, view.camera, sh_degree=sh_degree, antialiased=config.antialiased,
                tile_mask=tiles, backend=backend, workspace=workspace,
            )  # fmt: skip
        photo = photos[row].astype(np.float32) / 255
        quality = ssim_map(render.rgb.clamp(0, 1).float().cpu().numpy(), photo, tiles)
        for label, (mean, _) in means_by_label(quality, work.masks[view]).items():
            if label not in work.frozen:
                found.setdefault(label, {})[row] = mean
    values: dict[int, dict[int, float]] = {}  # by label and view, whoever measured it
    for part in group.gather(found):
        for label, by_row in part.items():
            values.setdefault(label, {}).update(by_row)
    return {label: float(np.mean([by[row] for row in sorted(by)])) for label, by in sorted(values.items())}


def trainable_rows(gaussians: Gaussians, frozen: Mapping[int, int]) -> torch.Tensor:
    """Bool [N]: the Gaussians whose category may still change."""
    labels = gaussians.label_ids
    return ~torch.isin(labels, torch.tensor(list(frozen), dtype=labels.dtype, device=labels.device))
