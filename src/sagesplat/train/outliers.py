"""Outlier masks from the residual: what one photo shows, and the model that the other photos made does not.

After RobustNeRF (Sabour et al. 2023) and SpotLessSplats (Sabour et al. 2024). Details that are not learned
yet have large residuals as well, but of both signs and in small regions: so the residual keeps its sign while
it is averaged, and only regions that hold a whole window are outliers.
"""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from torch import Tensor

from sagesplat.raster import TILE

_FIRST = 0.3  # of the steps, without masks: the model gets its shape
_VISITS = 10  # of each view before that, if there is time
_LATEST = 0.6  # of the steps
_WHOLE_EVERY = 3  # rounds; in one of them all pixels count
SMALLEST = 9  # cells, side of the window that an outlier holds
_GRID = 160  # cells along the longer side of a photo
_BLUR = 5  # cells, side of the window that residuals are averaged over
_TIMES = 8.0  # the photo's median: residuals of outliers
_LEAST = 0.06  # and no less, of colours in [0, 1]
_EDGE = 0.5  # times that threshold: residuals at the edges of outliers
_MOST = 1 / 3  # of a photo; one with more does not fit as a whole, and all of it counts


@dataclass(frozen=True)
class OutlierSchedule:
    """When outliers are left out: not in the first steps, and not in every third round of the views.

    What is left out wrongly would never be learned, and be an outlier for ever, if no round had all pixels.
    """

    first: int  # steps that are taken without masks
    round: float  # steps in which each view is drawn once

    @classmethod
    def of(cls, max_steps: int, batch: int, views: int) -> "OutlierSchedule":
        """The schedule of a training of `views` views, `batch` of them a step."""
        wanted = max(_FIRST * max_steps, _VISITS * views / batch)
        return cls(round(min(wanted, _LATEST * max_steps)), views / batch)

    def __call__(self, step: int) -> bool:
        """Whether outliers are left out after this number of steps."""
        return step >= self.first and int(step / self.round) % _WHOLE_EVERY > 0


def inliers(
    rgb: Float[Tensor, "H W 3"],
    photo: Float[Tensor, "H W 3"] | UInt8[Tensor, "H W 3"],
    valid: Bool[Tensor, "H W"] | None = None,
    tile_mask: Bool[np.ndarray, "h w"] | Bool[Tensor, "h w"] | None = None,
) -> Bool[Tensor, "H W"] | None:
    """The `valid` pixels without outliers.

    Args:
        rgb: Rendered image, with the photo's exposure; no gradients go through here.
        photo: The photo in [0, 1], or uint8.
        valid: The pixels that count; None: all.
        tile_mask: Tiles of 16 x 16 pixels that were rendered; None: all.

    Returns:
        bool [H, W]; `valid` itself where there are no outliers.
    """
    height, width = rgb.shape[:2]
    step = max(1, max(height, width) // (2 * _GRID))  # two pixels across a cell will do
    some, shown = photo[::step, ::step], rgb.detach()[::step, ::step]
    residual = (some if some.is_floating_point() else some.float() / 255) - shown
    seen = _seen(rgb, valid, tile_mask)[::step, ::step, None]
    scale = min(1.0, _GRID / max(height, width))
    grid = max(1, round(scale * height)), max(1, round(scale * width))
    channels = torch.cat([residual * seen, seen], -1).permute(2, 0, 1)[None]
    cells = F.interpolate(channels, size=grid, mode="area")[0].cpu().numpy()
    found = outlier_cells(cells[:3], cells[3] > 0)
    if not found.any():
        return valid
    small = torch.from_numpy(~found).to(residual)[None, None]
    inside = F.interpolate(small, size=(height, width), mode="nearest-exact")[0, 0] > 0
    return inside if valid is None else inside & valid


def _seen(
    rgb: Float[Tensor, "H W 3"], valid: Tensor | None, tile_mask: np.ndarray | Tensor | None
) -> Float[Tensor, "H W"]:
    """1 at the pixels that are compared, 0 at the others."""
    height, width = rgb.shape[:2]
    seen = rgb.new_ones(()).expand(height, width)
    if tile_mask is not None:
        tiles = torch.as_tensor(tile_mask, device=rgb.device)
        seen = seen * tiles.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)[:height, :width]
    return seen if valid is None else seen * valid


def outlier_cells(
    residual: Float[np.ndarray, "3 h w"], seen: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Which cells of a coarse grid are outliers.

    Args:
        residual: Mean of photo - rendering in each cell; 0 where nothing is compared.
        seen: Where something is.

    Returns:
        The regions of large residuals that hold a window of `SMALLEST` cells, grown by a cell.
    """
    none = np.zeros(seen.shape, bool)
    if not seen.any() or not np.isfinite(residual).all():
        return none
    size = np.mean([np.abs(ndimage.uniform_filter(r, _BLUR, mode="nearest")) for r in residual], axis=0)
    threshold = max(_TIMES * float(np.median(size[seen])), _LEAST)
    core = ndimage.minimum_filter(size, SMALLEST, mode="nearest") > threshold
    if not core.any():
        return none
    around = np.ones((3, 3), bool)
    found = ndimage.binary_propagation(core, around, mask=size > _EDGE * threshold)
    found = ndimage.binary_dilation(found, around)
    return none if found[seen].mean() > _MOST else found
