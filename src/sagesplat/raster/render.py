"""What a rasteriser returns, and the constants that every backend shares."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

TILE = 16  # px, side of the tiles of a tile mask, and of what is blended together
NEAR = 0.01  # Gaussians closer than this along z are not drawn, world units
BLUR = 0.3  # px^2 added to the 2D covariance (3DGS's low-pass)
ALPHA_MIN = 1.0 / 255.0  # a contribution below is none
ALPHA_MAX = 0.999  # as gsplat
TRANSMITTANCE_MIN = 1e-4  # a pixel takes nothing more below
FRUSTUM_MARGIN = 0.3  # the Jacobian is taken at most this share of the half image outside


@dataclass(frozen=True, eq=False)
class Render:
    """An image of a set of Gaussians."""

    rgb: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    features: Float[Tensor, "H W C"] | None
    means2d: Float[Tensor, "N 2"]  # px; carries the gradient that densification reads
    radii: Float[Tensor, " N"]  # px, half the longer side of the bounding box; 0 = not drawn
