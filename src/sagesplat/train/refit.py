"""Fits merged Gaussians to renders without gradient descent: first what each covers, then its colour."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from sagesplat.core.gaussians import Gaussians
from sagesplat.core.sh import C0
from sagesplat.raster import Backend, Workspace, rasterize
from sagesplat.scene.scene import Camera, Scene
from sagesplat.train.importance import importance

_DAMPED = 0.7  # exponent of a correction: Gaussians take from each other what they cover
_MOST = 2.0  # largest correction of an opacity
_GROWS = 1.5  # largest growth of an area, where the opacity is as large as it can be
_LEAST = 1e-3, 0.1  # opacity; blending weight, in pixels, that corrections are relative to
_OPAQUE = 0.99


def refit_coverage(
    g: Gaussians,
    wanted: Float32[np.ndarray, " N"],
    scene: Scene,
    views: Sequence[int],
    *,
    antialiased: bool = False,
) -> Gaussians:
    """Opacities, and areas where those are at their limit, so that blending weights come near `wanted`.

    What merges covers less: a mixture's tails are longer than those of its parts, and an opacity is at most
    1. `wanted`: the blending weight over the same `views` (rows of `scene.views`) of what each stands for;
    over others, what only those show would grow into floaters.
    """
    has = importance(g, scene, views, "weight", antialiased=antialiased)
    ratio = ((wanted + _LEAST[1]) / (has + _LEAST[1])) ** _DAMPED
    opacity = torch.sigmoid(g.logit_opacities) * torch.from_numpy(ratio).clamp(1 / _MOST, _MOST)
    possible = opacity.clamp(_LEAST[0], _OPAQUE)
    grows = (opacity / possible).clamp(1, _GROWS).log() / 2
    return replace(g, logit_opacities=torch.logit(possible), log_scales=g.log_scales + grows[:, None])


def refit_colors(
    g: Gaussians,
    cameras: Sequence[Camera],
    images: Sequence[Float32[Tensor, "H W 3"]],
    rounds: int = 3,
    *,
    antialiased: bool = False,
    backend: Backend = "auto",
) -> Gaussians:
    """Colours of degree 0 of least squares to `images`, by Jacobi's iteration (SIRT).

    A picture is linear in the colours; each round moves a colour by the mean difference of the pixels that a
    Gaussian paints, weighted by how much it paints of them.
    """
    workspace = Workspace()
    painted = torch.zeros(len(g), 1, 1, device=g.means.device)
    for turn in range(rounds):
        moved = torch.zeros_like(g.sh0)
        for camera, image in zip(cameras, images, strict=True):
            sh0 = g.sh0.clone().requires_grad_()
            if turn == 0:  # how much each paints does not change with its colour
                rgb = rasterize(
                    replace(g, sh0=sh0), camera, backend=backend, antialiased=antialiased, workspace=workspace
                ).rgb
                (grad,) = torch.autograd.grad(rgb.sum(), sh0)
                painted += grad.amax(2, keepdim=True) / C0  # a channel that is clipped at black has none
            rgb = rasterize(
                replace(g, sh0=sh0), camera, backend=backend, antialiased=antialiased, workspace=workspace
            ).rgb
            (grad,) = torch.autograd.grad(rgb, sh0, image - rgb.detach())
            moved += grad
        g = replace(g, sh0=g.sh0 + moved / (C0**2 * (painted + _LEAST[1])))
    return g
