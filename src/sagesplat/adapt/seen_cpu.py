"""Compositions of one camera on a CPU: only opacities differ, so each Gaussian is projected once."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32
from numba import prange
from torch import Tensor

from sagesplat.core.gaussians import Gaussians
from sagesplat.kernels.jit import njit
from sagesplat.kernels.planes import padded, to_image
from sagesplat.metrics.ssim_cpu import all_tiles
from sagesplat.raster import Workspace, blend, cpu, tiles
from sagesplat.raster.render import ALPHA_MIN
from sagesplat.scene.scene import Camera

_F = np.float32
_LEAST = _F(np.log2(ALPHA_MIN))  # log2 of an opacity that is not drawn
_CHUNK = 512  # rows that a thread takes at a time


@dataclass(frozen=True, eq=False)
class Drawn:
    """N Gaussians as a camera draws them, at the larger of two opacities."""

    records: Float32[np.ndarray, "N 11"]  # see `raster.blend`
    depths: Float32[np.ndarray, " N"]
    logits: Float32[np.ndarray, "N 2"]  # of the first opacity, and of the second one
    filtered: Float32[np.ndarray, " N"]  # log2 of what antialiasing leaves of opacities
    weights: Mapping[int, Sequence[float]]  # of the second opacity, by label id and level
    camera: Camera
    workspace: Workspace
    tile_mask: Bool[np.ndarray, "h w"] | None = None  # the others show the background; None: all are drawn

    @property
    def nbytes(self) -> int:
        """Memory that it takes, about."""
        return 4 * 15 * len(self.records)

    def render(self, parts: Sequence[tuple[int, int, float]]) -> Float32[np.ndarray, "H W 3"]:
        """An image in [0, 1] of some rows: of each part the first and last + 1, and the weight of the second
        opacity. It holds until the next call with the same workspace.
        """
        camera, take = self.camera, self.workspace.take
        width, height = camera.width, camera.height
        count = sum(last - first for first, last, _ in parts)
        records, depths, radii = (
            take("records", count, blend.RECORD),
            take("depths", count),
            take("radii", count),
        )
        at = 0
        for first, last, weight in parts:
            rows, to = slice(first, last), slice(at, at + last - first)
            _compose(
                self.records[rows], self.depths[rows], self.logits[rows], self.filtered[rows], _F(weight),
                records[to], depths[to], radii[to], width, height,
            )  # fmt: skip
            at = to.stop
        drawn = all_tiles(height, width) if self.tile_mask is None else self.tile_mask
        found = tiles.intersect(records, depths, radii, width, height, drawn.ravel(), self.workspace)
        image, left = take("image 0", 3, height, padded(width)), take("left", height, padded(width))
        ends = np.empty(len(found.starts) - 1, np.int64)
        behind = np.array(camera.background, np.float32) / 255
        blend.forward(
            records, found.starts, found.ids, found.row_order, width, height, behind, image, left, ends
        )
        return to_image(np.clip(image, 0, 1, out=image), width).numpy()


def drawn_from(
    g: Gaussians,
    second: Tensor | None,
    weights: Mapping[int, Sequence[float]],
    camera: Camera,
    antialiased: bool,
    workspace: Workspace,
    tile_mask: Bool[np.ndarray, "h w"] | None = None,
) -> Drawn:
    """Gaussians without harmonics that `camera` sees, with their `second` opacities (logits [N]), if any."""
    first = g.logit_opacities
    second = first if second is None else second
    most = first.maximum(second)
    found, *_ = cpu.intersections(
        replace(g, logit_opacities=most), camera, workspace, antialiased=antialiased
    )
    records = found.copy()
    logits = np.stack([first.numpy(), second.numpy()], 1)
    opacities = 1 / (1 + np.exp(-most.double().numpy()))
    depths = g.means.double().numpy() @ camera.w2c[2, :3].astype(np.float64) + np.float64(camera.w2c[2, 3])
    filtered = (records[:, 5] - np.log2(opacities)).astype(np.float32)
    return Drawn(records, depths.astype(np.float32), logits, filtered, weights, camera, workspace, tile_mask)


@njit(parallel=True, error_model="numpy", cache=True)
def _compose(found, depths, logits, filtered, weight, records, to_depths, radii, width, height):
    """Records at other opacities: their logarithm, and boxes, which grow with the root of what is above the
    least that is drawn.
    """
    one, zero = _F(1), _F(0)
    for chunk in prange((len(found) + _CHUNK - 1) // _CHUNK):
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(found))):
            logit = logits[i, 0] + weight * (logits[i, 1] - logits[i, 0])
            level = filtered[i] - np.log2(one + np.exp(-logit))
            above = level - _LEAST
            radii[i], to_depths[i] = zero, depths[i]
            if above <= zero:
                continue
            for k in range(9):
                records[i, k] = found[i, k]
            grows = np.sqrt(above / (found[i, 5] - _LEAST))
            x, y, wide, high = found[i, 0], found[i, 1], found[i, 9] * grows, found[i, 10] * grows
            records[i, 5], records[i, 9], records[i, 10] = level, wide, high
            if x + wide > zero and x - wide < width and y + high > zero and y - high < height:
                radii[i] = max(wide, high)
