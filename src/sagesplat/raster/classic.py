"""Models for viewers that draw otherwise: without antialiasing (gsplat's `classic`), or as PlayCanvas."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from sagesplat.core.gaussians import Gaussians
from sagesplat.raster import add_weights
from sagesplat.raster.reference import projected, world_to_camera
from sagesplat.raster.render import BLUR
from sagesplat.scene.scene import Camera

_LEAST = 1e-6  # blending weight, in pixels, below which a Gaussian counts as unseen
_PLAYCANVAS_BLUR = 0.3 / 4  # px^2
_WIDER = 1.05  # 1.04 keeps the integral of a kernel; what is fainter than 1/255 is left out, too


def for_classic(g: Gaussians, cameras: Iterable[Camera]) -> Gaussians:
    """Gaussians that were trained antialiased, to be drawn without antialiasing; the result is on the CPU.

    Antialiasing scales the opacity by what the low-pass adds to the area, which is another factor in every
    view (Mip-Splatting's 2D filter). Here opacities take the geometric mean of these factors over `cameras`,
    weighted by blending weight; Gaussians that no camera sees stay as they are. At the resolution of the
    cameras the pictures are nearly the same. At lower ones they alias, as all models do that are drawn so.
    """
    g = g.detach().to("cpu")
    weighted, weights = torch.zeros(2, len(g), dtype=torch.float64)
    for camera, rows, weight in _seen(g, cameras, antialiased=True):
        seen = g.select(rows)
        *_, opacities = projected(seen, camera, world_to_camera(camera, None), antialiased=True)
        factors = opacities / seen.logit_opacities.double().sigmoid()
        weighted[rows] += weight * factors.log()
        weights[rows] += weight
    factors = (weighted / weights.clamp_min(_LEAST)).exp()
    opacities = (g.logit_opacities.double().sigmoid() * factors).clamp_max(1 - 1e-7)
    logits = torch.where(weights > 0, torch.logit(opacities).float(), g.logit_opacities)
    return replace(g, logit_opacities=logits)


def for_playcanvas(g: Gaussians, cameras: Iterable[Camera]) -> Gaussians:
    """Gaussians that are drawn without antialiasing, to be drawn by PlayCanvas's engine; they are on the CPU.

    Its low-pass has a quarter of the usual variance (0.3 half pixels squared, in playcanvas 2.23), and its
    kernel is lowered so that it ends in 0 at sqrt(8) standard deviations. So the variance that is missing
    goes into the Gaussians, by the pixels of `cameras` (the mean of pixels per unit, squared, weighted by
    blending weight; none where no camera sees a Gaussian), and they become wider by a twentieth.
    """
    g = g.detach().to("cpu")
    weighted, weights = torch.zeros(2, len(g), dtype=torch.float64)
    for camera, rows, weight in _seen(g, cameras, antialiased=False):
        forward = torch.from_numpy(camera.direction).double()
        depth = g.means[rows].double() @ forward + float(camera.w2c[2, 3])
        weighted[rows] += weight * (camera.focal / depth.clamp_min(_LEAST)) ** 2
        weights[rows] += weight
    per_unit = weighted / weights.clamp_min(_LEAST)  # squared pixels
    missing = torch.where(weights > 0, (BLUR - _PLAYCANVAS_BLUR / _WIDER**2) / per_unit, 0)
    variances = (2 * g.log_scales.double()).exp() + missing[:, None]
    return replace(g, log_scales=((variances.log() / 2) + math.log(_WIDER)).float())


def _seen(
    g: Gaussians, cameras: Iterable[Camera], *, antialiased: bool
) -> Iterator[tuple[Camera, Tensor, Tensor]]:
    """Each camera, the rows that it sees, and their blending weights there."""
    for camera in cameras:
        weight = np.zeros((len(g), 1), np.float32)
        everywhere = np.zeros((camera.height, camera.width), np.int64)
        add_weights(g, camera, everywhere, weight, antialiased=antialiased)
        rows = np.flatnonzero(weight[:, 0] > _LEAST)
        yield camera, torch.from_numpy(rows), torch.from_numpy(weight[rows, 0])
