"""Levels as one camera sees them: compositions that are rendered from it many times hold little else."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float32

from sagesplat.adapt.ladder import PrefixLadder, composed
from sagesplat.adapt.seen_cpu import Drawn, drawn_from
from sagesplat.core import sh
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.raster import Backend, Workspace, device_of, in_sight, rasterize
from sagesplat.scene.scene import Camera

Ranges = Mapping[int, tuple[tuple[int, int], ...]]  # first row and last + 1 of each level, by label id


class Seen(Protocol):
    """The levels of a nested ladder from one camera."""

    @property
    def nbytes(self) -> int:
        """Memory that they take, about."""
        ...

    def render(self, levels: Mapping[int, int]) -> Float32[np.ndarray, "H W 3"]:
        """An image in [0, 1] of each category at its level (label id -> level, 1 to K).

        It may be overwritten when the next one is rendered.
        """
        ...


@dataclass(frozen=True, eq=False)
class SeenRecords:
    """The same on a CPU: what does not depend on the levels was projected once."""

    drawn: Drawn
    ranges: Ranges

    @property
    def nbytes(self) -> int:
        """See `Seen`."""
        return self.drawn.nbytes

    def render(self, levels: Mapping[int, int]) -> Float32[np.ndarray, "H W 3"]:
        """See `Seen`."""
        parts = [
            (*of_level[levels[label] - 1], self.drawn.weights[label][levels[label] - 1])
            for label, of_level in self.ranges.items()
            if label in levels
        ]
        return self.drawn.render(parts)


@dataclass(frozen=True, eq=False)
class SeenLevels:
    """The levels of a nested ladder without what a camera does not see, and with the colours that it sees.

    A composition renders as that of the ladder does, from this camera alone: its Gaussians have no harmonics.
    """

    gaussians: Gaussians
    second: SecondOpacities | None
    ranges: Ranges
    camera: Camera
    backend: Backend
    antialiased: bool
    tile_mask: Bool[np.ndarray, "h w"] | None = None  # the others show the background; None: all are drawn

    @property
    def nbytes(self) -> int:
        """Memory that they take, about: 15 float32 values of each Gaussian."""
        return 60 * len(self.gaussians)

    def compose(self, levels: Mapping[int, int]) -> Gaussians:
        """The union over categories of the Gaussians of each at its level (label id -> level, 1 to K)."""
        return composed(self.gaussians, self.second, self.ranges, levels)

    def render(self, levels: Mapping[int, int]) -> Float32[np.ndarray, "H W 3"]:
        """See `Seen`."""
        how: dict[str, Any] = {
            "antialiased": self.antialiased,
            "backend": self.backend,
            "tile_mask": self.tile_mask,
        }
        with torch.no_grad():
            return rasterize(self.compose(levels), self.camera, **how).rgb.clamp(0, 1).float().cpu().numpy()


def seen_from(
    ladder: PrefixLadder,
    camera: Camera,
    *,
    backend: Backend,
    antialiased: bool,
    workspace: Workspace,
    tile_mask: Bool[np.ndarray, "h w"] | None = None,
) -> Seen:
    """The levels of a ladder as `camera` sees them; `antialiased`: how the model was trained.

    On a CPU all that have the same workspace render into the same memory. `tile_mask`: tiles of 16 x 16 px
    that images are wanted in.
    """
    how = {"backend": backend, "antialiased": antialiased, "workspace": workspace, "tile_mask": tile_mask}
    found = seen_levels(ladder, camera, **how)
    if backend not in ("auto", "cpu") or camera.exposure is not None or not len(found.gaussians):
        return found
    weights = found.second.weights if found.second else {k: (0.0,) * len(v) for k, v in found.ranges.items()}
    second = found.second.logits if found.second else None
    drawn = drawn_from(found.gaussians, second, weights, camera, antialiased, workspace, tile_mask)
    return SeenRecords(drawn, found.ranges)


def seen_levels(
    ladder: PrefixLadder,
    camera: Camera,
    *,
    backend: Backend,
    antialiased: bool,
    workspace: Workspace,
    tile_mask: Bool[np.ndarray, "h w"] | None = None,
) -> SeenLevels:
    """The same as Gaussians, on any device."""
    device = device_of(backend)
    g, second = ladder.gaussians.to(device), ladder.second
    most = g
    if second is not None:
        second = SecondOpacities(second.logits.to(device), second.weights)
        most = replace(g, logit_opacities=g.logit_opacities.maximum(second.logits))
    how = {"antialiased": antialiased, "backend": backend, "workspace": workspace}
    seen = in_sight(most, camera, tile_mask=tile_mask, **how)
    before = np.concatenate([[0], seen.cpu().numpy().cumsum()])
    ranges = {
        label: tuple((int(before[first]), int(before[last])) for first, last in of_level)
        for label, of_level in ladder.ranges.items()
    }
    rows = torch.nonzero(seen)[:, 0]
    second = second.select(rows) if second else None
    return SeenLevels(
        _as_seen(g.select(rows), camera), second, ranges, camera, backend, antialiased, tile_mask
    )


def _as_seen(g: Gaussians, camera: Camera) -> Gaussians:
    """The same Gaussians with the colours that a camera sees, and without harmonics."""
    position = torch.from_numpy(camera.position).to(g.means)
    directions = torch.nn.functional.normalize(g.means - position, dim=-1)
    bases = sh.bases(*directions.unbind(-1))
    colour = g.sh0[:, 0] * sh.C0
    for basis, coefficients in zip(bases[1:], g.shN.unbind(1), strict=False):
        colour = torch.addcmul(colour, torch.as_tensor(basis)[:, None], coefficients)
    return replace(g, sh0=(colour / sh.C0)[:, None], shN=g.shN[:, :0])
