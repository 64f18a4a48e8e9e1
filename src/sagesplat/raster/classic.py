"""Antialiased models for the many viewers that draw without antialiasing (gsplat's mode `classic`)."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import torch

from sagesplat.core.gaussians import Gaussians
from sagesplat.raster import add_weights
from sagesplat.raster.reference import projected, world_to_camera
from sagesplat.scene.scene import Camera

_LEAST = 1e-6  # blending weight, in pixels, below which a Gaussian counts as unseen


def for_classic(g: Gaussians, cameras: Iterable[Camera]) -> Gaussians:
    """Gaussians that were trained antialiased, to be drawn without antialiasing; the result is on the CPU.

    Antialiasing scales the opacity by what the low-pass adds to the area, which is another factor in every
    view (Mip-Splatting's 2D filter). Here opacities take the geometric mean of these factors over `cameras`,
    weighted by blending weight; Gaussians that no camera sees stay as they are. At the resolution of the
    cameras the pictures are nearly the same. At lower ones they alias, as all models do that are drawn so.
    """
    g = g.detach().to("cpu")
    weighted, weights = torch.zeros(2, len(g), dtype=torch.float64)
    for camera in cameras:
        weight = np.zeros((len(g), 1), np.float32)
        everywhere = np.zeros((camera.height, camera.width), np.int64)
        add_weights(g, camera, everywhere, weight, antialiased=True)
        rows = torch.from_numpy(np.flatnonzero(weight[:, 0] > _LEAST))
        seen, weight = g.select(rows), torch.from_numpy(weight[:, 0])[rows]
        *_, opacities = projected(seen, camera, world_to_camera(camera, None), antialiased=True)
        factors = opacities / seen.logit_opacities.double().sigmoid()
        weighted[rows] += weight * factors.log()
        weights[rows] += weight
    factors = (weighted / weights.clamp_min(_LEAST)).exp()
    opacities = (g.logit_opacities.double().sigmoid() * factors).clamp_max(1 - 1e-7)
    logits = torch.where(weights > 0, torch.logit(opacities).float(), g.logit_opacities)
    return replace(g, logit_opacities=logits)
