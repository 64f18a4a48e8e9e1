"""Importance of each Gaussian for the rendered views: the order of the nested levels."""

from collections.abc import Collection
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from sagesplat.core.gaussians import Gaussians
from sagesplat.raster import Workspace, add_weights, each_view, rasterize
from sagesplat.scene.scene import Scene
from sagesplat.segment.valid import ALL_VALID, ValidPixels

Criterion = Literal["weight", "weight-volume", "sensitivity"]
_VOLUME_POWER, _LARGE = 0.1, 0.9  # LightGaussian's exponent, and the quantile at which its volumes are cut


def importance(
    g: Gaussians,
    scene: Scene,
    views: Collection[int],
    criterion: Criterion = "weight",
    *,
    valid: ValidPixels = ALL_VALID,
    antialiased: bool = False,
    seed: int = 0,
) -> Float32[np.ndarray, " N"]:
    """Importance of each Gaussian for `views` (rows of Scene.views), without unit; larger is more important.

    Only pixels that are `valid` count.

    weight: blending weight (alpha times transmittance) summed over all pixels; weight-volume: times the
    volume to the power 0.1, as LightGaussian (arXiv:2311.17245, eq. 3); sensitivity: squared change of the
    pictures when it fades, to first order: the squared gradients of pictures seen through random signs
    (Hutchinson's estimate of the diagonal of Fisher's information).
    """
    if criterion == "sensitivity":
        return _sensitivity(g, scene, views, valid, antialiased, seed)
    total, workspace = np.zeros(len(g), np.float32), Workspace()

    def in_view(row: int) -> np.ndarray:
        camera, counts = scene.views[row].camera, valid[scene.views[row]]
        weights = np.zeros((len(g), 1), np.float32)
        columns = np.zeros((camera.height, camera.width), np.int64)
        if counts is not None:
            columns[~counts] = -1
        add_weights(g, camera, columns, weights, antialiased=antialiased, workspace=workspace)
        return weights[:, 0]

    for of_view in each_view(in_view, list(views), g.means.device):
        total += of_view
    if criterion == "weight-volume" and len(g):
        volumes = torch.exp(g.log_scales.detach().sum(1)).cpu().numpy()
        total *= np.clip(volumes / np.quantile(volumes, _LARGE), 0, 1) ** _VOLUME_POWER
    return total


def _sensitivity(
    g: Gaussians, scene: Scene, views: Collection[int], valid: ValidPixels, antialiased: bool, seed: int
) -> Float32[np.ndarray, " N"]:
    total, workspace = torch.zeros(len(g), device=g.means.device), Workspace()
    opacity = torch.sigmoid(g.logit_opacities.detach())

    def in_view(row: int) -> Tensor:
        logits = g.logit_opacities.detach().clone().requires_grad_()
        fading = replace(g.detach(), logit_opacities=logits)
        image = rasterize(fading, scene.views[row].camera, antialiased=antialiased, workspace=workspace).rgb
        signs = torch.Generator().manual_seed(seed * len(scene.views) + row)
        probe = torch.randint(0, 2, image.shape, generator=signs).float().mul_(2).sub_(1)
        if (counts := valid[scene.views[row]]) is not None:
            probe *= torch.from_numpy(counts)[..., None]
        (grad,) = torch.autograd.grad(image, logits, probe.to(image.device))
        # by the logarithm of the opacity: what is left when all of it goes
        return (grad / (1 - opacity).clamp_min(1e-6)) ** 2

    for of_view in each_view(in_view, list(views), g.means.device):
        total += of_view
    return total.cpu().numpy()
