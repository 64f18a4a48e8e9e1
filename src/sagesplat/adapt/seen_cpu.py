"""Compositions of one camera on a CPU: only opacities differ, so each Gaussian is projected once, and listed
in the tiles that it meets at its largest one.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int, Int32, Int64
from numba import prange
from torch import Tensor

from sagesplat.core.gaussians import Gaussians
from sagesplat.kernels.jit import njit
from sagesplat.kernels.planes import padded, to_image
from sagesplat.raster import Workspace, blend, cpu
from sagesplat.raster import weights as weights_of
from sagesplat.raster.render import ALPHA_MIN
from sagesplat.scene.scene import Camera

_F = np.float32
_LEAST = _F(np.log2(ALPHA_MIN))  # log2 of an opacity that is not drawn
_CHUNK = 512  # rows that a thread takes at a time
_NOWHERE = -30.0  # logit of what is not drawn


@dataclass(frozen=True, eq=False)
class Drawn:
    """N Gaussians as a camera draws them, at the larger of two opacities.

    `drawn_from` overwrites it when it is called again with the same workspace, but for what `kept` returns.
    """

    records: Float32[np.ndarray, "N 11"]  # see `raster.blend`
    logits: Float32[np.ndarray, "N 2"]  # of the first opacity, and of the second one; no rows without that
    filtered: Float32[np.ndarray, " N"]  # log2 of what antialiasing leaves of opacities; the same
    row_order: Int64[np.ndarray, " rows"]  # these three: see `raster.tiles.Intersections`
    starts: Int64[np.ndarray, " tiles+1"]
    ids: Int32[np.ndarray, " I"]
    weights: Mapping[int, Sequence[float]]  # of the second opacity, by label id and level
    camera: Camera
    workspace: Workspace

    @property
    def nbytes(self) -> int:
        """Memory that it takes, about."""
        return self.records.nbytes + self.logits.nbytes + self.filtered.nbytes + self.ids.nbytes

    def kept(self) -> "Drawn":
        """The same in memory of its own."""
        return replace(self, records=self.records.copy(), ids=self.ids.copy())

    def render(self, parts: Sequence[tuple[int, int, float]]) -> Float32[np.ndarray, "H W 3"]:
        """An image in [0, 1] of some rows: of each part the first and last + 1, and the weight of the second
        opacity. It holds until the next call with the same workspace.
        """
        camera, take = self.camera, self.workspace.take
        width, height = camera.width, camera.height
        records, starts, ids = self._composed(parts)
        image, left = take("image 0", 3, height, padded(width)), take("left", height, padded(width))
        ends = np.empty(len(starts) - 1, np.int64)
        behind = np.array(camera.background, np.float32) / 255
        blend.forward(records, starts, ids, self.row_order, width, height, behind, image, left, ends)
        return to_image(np.clip(image, 0, 1, out=image), width).numpy()

    @property
    def remains(self) -> Float32[np.ndarray, "H W"]:
        """Transmittance that the last image left, until the next one."""
        camera = self.camera
        return self.workspace.take("left", camera.height, padded(camera.width))[:, : camera.width]

    def most_painted(
        self, parts: Sequence[tuple[int, int, float]], columns_of: Int[np.ndarray, " N"], num_columns: int
    ) -> Int64[np.ndarray, "H W"]:
        """As `raster.most_painted`, of the same rows as `render`."""
        out = np.zeros((self.camera.height, self.camera.width), np.int64)
        records, starts, ids = self._composed(parts)
        weights_of.most(
            records, starts, ids, self.row_order, self.camera.width, self.camera.height,
            columns_of.astype(np.int64), num_columns, out,
        )  # fmt: skip
        return out

    def _composed(self, parts: Sequence[tuple[int, int, float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Records at the opacities of the parts, and the tile lists of what they show."""
        take, records = self.workspace.take, self.records
        shown = take("shown", len(records), dtype=np.bool_)
        shown.fill(False)
        if len(self.logits):
            records = take("records", *self.records.shape)
        for first, last, weight in parts:
            rows = slice(first, last)
            if not len(self.logits):
                shown[rows] = True
                continue
            _compose(
                self.records[rows], self.logits[rows], self.filtered[rows], _F(weight), records[rows],
                shown[rows],
            )  # fmt: skip
        starts, ids = np.empty_like(self.starts), take("ids", len(self.ids), dtype=np.int32)
        _list_shown(self.starts, self.ids, shown, starts, ids)
        return records, starts, ids


def drawn_from(
    g: Gaussians,
    second: Tensor | None,
    weights: Mapping[int, Sequence[float]],
    camera: Camera,
    antialiased: bool,
    workspace: Workspace,
    tile_mask: Bool[np.ndarray, "h w"] | None = None,
    used: Iterable[tuple[int, int]] | None = None,
) -> tuple[Drawn, Int64[np.ndarray, " M"]]:
    """What `camera` sees of Gaussians with their `second` opacities (logits [N]), if any; and their rows.

    `used`: ranges of rows (first, last + 1) that are drawn; None: all.
    """
    first = g.logit_opacities
    most = first if second is None else first.maximum(second)
    if used is not None:  # the others end a projection early, and are in no list
        every, most = most, torch.full_like(most, _NOWHERE)
        for begin, end in used:
            most[begin:end] = every[begin:end]
    rows, records, lists = cpu.seen(
        replace(g, logit_opacities=most), camera, workspace, antialiased=antialiased, tile_mask=tile_mask
    )
    logits, filtered = np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
    if second is not None:
        logits = np.stack([first.numpy()[rows], second.numpy()[rows]], 1)
        opacities = 1 / (1 + np.exp(-logits.max(1).astype(np.float64)))
        filtered = (records[:, 5] - np.log2(opacities)).astype(np.float32)
    order, starts = lists.row_order, lists.starts
    ids = workspace.take("seen ids", len(lists.ids), dtype=np.int32)
    np.copyto(ids, lists.ids)
    return Drawn(records, logits, filtered, order, starts, ids, weights, camera, workspace), rows


@njit(parallel=True, error_model="numpy", cache=True)
def _compose(found, logits, filtered, weight, records, shown):
    """Records at other opacities, of what these show: their logarithm, and boxes, which grow with the root of
    what is above the least that is drawn.
    """
    one = _F(1)
    for chunk in prange((len(found) + _CHUNK - 1) // _CHUNK):
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(found))):
            logit = logits[i, 0] + weight * (logits[i, 1] - logits[i, 0])
            level = filtered[i] - np.log2(one + np.exp(-logit))
            above = level - _LEAST
            if above <= _F(0):
                continue
            shown[i] = True
            for k in range(9):
                records[i, k] = found[i, k]
            grows = np.sqrt(above / (found[i, 5] - _LEAST))
            records[i, 5], records[i, 9], records[i, 10] = level, found[i, 9] * grows, found[i, 10] * grows


@njit(error_model="numpy", cache=True)
def _list_shown(starts, ids, shown, new_starts, new_ids):
    """The lists of tiles without what is not shown, in the order that they have."""
    at = 0
    for tile in range(len(starts) - 1):
        new_starts[tile] = at
        for k in range(starts[tile], starts[tile + 1]):
            new_ids[at] = ids[k]
            at += shown[ids[k]]
    new_starts[-1] = at
