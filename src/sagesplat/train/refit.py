"""Fits merged Gaussians to renders in seconds: first what each covers, then all of it in a few passes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from sagesplat.core.gaussians import Gaussians
from sagesplat.metrics.image import photometric_loss
from sagesplat.raster import Backend, Workspace, rasterize
from sagesplat.scene.scene import Camera, Scene
from sagesplat.train.importance import importance

_DAMPED = 0.7  # exponent of a correction: Gaussians take from each other what they cover
_MOST = 2.0  # largest correction of an opacity
_GROWS = 1.5  # largest growth of an area, where the opacity is as large as it can be
_LEAST = 1e-3, 0.1  # opacity; blending weight, in pixels, that corrections are relative to
_OPAQUE = 0.99
# of Adam; that of the means is of a size
_RATES = {"sh0": 0.02, "logit_opacities": 0.05, "log_scales": 0.02, "quats": 0.01, "means": 0.05}
_BETAS = 0.5, 0.9  # there are few steps


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


def fit_to_renders(
    g: Gaussians,
    cameras: Sequence[Camera],
    images: Sequence[Float32[Tensor, "H W 3"]],
    passes: int = 3,
    rate: float = 1.0,
    *,
    antialiased: bool = False,
    backend: Backend = "auto",
) -> Gaussians:
    """Everything but the higher SH coefficients, fitted to `images` in a few passes over them.

    Each image moves the Gaussians by a step of Adam down the loss of 3DGS, with rates that fall to 0 as a
    cosine. What has smaller gradients than most moves less than in Adam: of a large level most Gaussians are
    as they came in, and need no fit.

    Args:
        g: Merged Gaussians.
        cameras: Of the images.
        images: Renders of what was merged, on the device of `g`.
        passes: Over all images.
        rate: Multiplies the rates; 1 for levels of which most did not merge.
        antialiased: How the Gaussians are drawn.
        backend: Rasteriser.
    """
    values = {name: getattr(g, name).clone().requires_grad_() for name in _RATES}
    sizes = torch.exp(g.log_scales).mean(1, keepdim=True)
    first = {name: torch.zeros_like(value) for name, value in values.items()}
    second = {name: torch.zeros_like(value) for name, value in values.items()}
    order, workspace, steps = np.random.default_rng(0), Workspace(), passes * len(cameras)
    rows = np.zeros(0, np.int64)
    for step in range(steps):
        if step % len(cameras) == 0:
            rows = order.permutation(len(cameras))
        row = rows[step % len(cameras)]
        rgb = rasterize(
            replace(g, **values), cameras[row], backend=backend, antialiased=antialiased, workspace=workspace
        ).rgb
        loss = photometric_loss(rgb, images[row], workspace=workspace)
        grads = torch.autograd.grad(loss, list(values.values()))
        falling = rate * (1 + np.cos(np.pi * (step + 1) / steps)) / 2
        for (name, value), grad in zip(values.items(), grads, strict=True):
            first[name].lerp_(grad, 1 - _BETAS[0])
            second[name].lerp_(grad**2, 1 - _BETAS[1])
            mean = first[name] / (1 - _BETAS[0] ** (step + 1))
            square = (second[name] + second[name].mean()) / (1 - _BETAS[1] ** (step + 1))
            moved = falling * _RATES[name] * mean / (square.sqrt() + 1e-15)
            value.data -= moved * sizes if name == "means" else moved
    return replace(g, **{name: value.detach() for name, value in values.items()})
