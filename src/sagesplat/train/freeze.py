"""Selective optimisation (Fig. 1 of the paper): a category that has reached its quality stops changing."""

from collections.abc import Mapping

import numpy as np
import torch

from sagesplat.config import TrainConfig
from sagesplat.gaussians import Gaussians
from sagesplat.metrics import means_by_label, ssim_map
from sagesplat.raster import Backend, Workspace, rasterize
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.segment.masks import Masks

MOST_VIEWS = 32  # training views that a measurement takes at most, evenly spread: it must stay cheap


def measured_views(scene: Scene) -> list[int]:
    """Rows of the training views that quality is measured on."""
    rows = scene.train_ids
    picked = np.linspace(0, len(rows) - 1, min(MOST_VIEWS, len(rows))).round().astype(int)
    return rows[np.unique(picked)].tolist()


def label_quality(
    gaussians: Gaussians,
    scene: Scene,
    photos: Photos,
    masks: Masks,
    config: TrainConfig,
    sh_degree: int,
    backend: Backend,
    workspace: Workspace,
) -> dict[int, float]:
    """Mean SSIM of each category over those of `measured_views` that show it."""
    found: dict[int, list[float]] = {}
    for row in measured_views(scene):
        view = scene.views[row]
        with torch.no_grad():
            render = rasterize(
                gaussians, view.camera, sh_degree=sh_degree, antialiased=config.antialiased, backend=backend,
                workspace=workspace,
            )  # fmt: skip
        quality = ssim_map(render.rgb.clamp(0, 1).float().numpy(), photos[row].astype(np.float32) / 255)
        for label, (mean, _) in means_by_label(quality, masks[view]).items():
            found.setdefault(label, []).append(mean)
    return {label: float(np.mean(values)) for label, values in found.items()}


def trainable_rows(gaussians: Gaussians, frozen: Mapping[int, int]) -> torch.Tensor:
    """Bool [N]: the Gaussians whose category may still change."""
    if not frozen:
        return torch.ones(len(gaussians), dtype=torch.bool)
    return ~torch.isin(gaussians.label_ids, torch.tensor(list(frozen), dtype=gaussians.label_ids.dtype))
