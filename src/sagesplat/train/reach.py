"""Large Gaussians that reach the cameras are made smaller.

A far Gaussian, of the sky say, may grow until cameras stand inside it. Views that look at it show no more
than its colour, and those that look elsewhere do not draw it. But its centre may be just in front of the
image plane of a camera that no photo was taken from: there it covers the whole image like mist. High learning
rates of the scales get that far within a few hundred steps, and runs that are too short for an opacity reset
never prune large Gaussians.
"""

import math

import torch
from jaxtyping import Float32
from torch import Tensor

from sagesplat.core.gaussians import Gaussians

EVERY = 20  # steps; the scales grow by e^0.4 in between at the most
CLEAR = 3.0  # standard deviations between a Gaussian and the nearest camera, by its longest axis
LARGE = 0.1  # longest standard deviation of those that are looked at, scene extents; others reach nobody far


def keep_clear(g: Gaussians, cameras: Float32[Tensor, "V 3"], extent: float, trainable: Tensor) -> Tensor:
    """Limit large Gaussians, in place, to 1 / CLEAR of their distance to the nearest camera.

    The limit holds for all axes: what the projection makes of a long axis that points at the image plane
    covers the image as well. No Gaussian becomes smaller than LARGE.

    Args:
        g: The Gaussians; `log_scales` are changed.
        cameras: Camera centres in the world, on the same device.
        extent: Of the scene, world units.
        trainable: bool [N]; other rows keep every bit.

    Returns:
        Indices of the rows that were changed.
    """
    rows = torch.nonzero((g.log_scales.amax(1) > math.log(LARGE * extent)) & trainable)[:, 0]
    # exact distances: matrix products would round those of far Gaussians
    distance = torch.cdist(g.means[rows], cameras, compute_mode="donot_use_mm_for_euclid_dist").amin(1)
    most = (distance / CLEAR).clamp_min(LARGE * extent).log()
    reaching = g.log_scales[rows].amax(1) > most
    rows = rows[reaching]
    g.log_scales[rows] = torch.minimum(g.log_scales[rows], most[reaching][:, None])
    return rows
