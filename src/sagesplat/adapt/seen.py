"""Levels as one camera sees them: compositions that are rendered from it many times hold little else."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from sagesplat.adapt.ladder import Ladder, PrefixLadder, composed
from sagesplat.core import sh
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.raster import Backend, Workspace, device_of, rasterize
from sagesplat.scene.scene import Camera


@dataclass(frozen=True, eq=False)
class SeenLevels:
    """The levels of a nested ladder without what a camera does not see, and with the colours that it sees.

    A composition renders as that of the ladder does, from this camera alone: its Gaussians have no harmonics.
    """

    gaussians: Gaussians
    second: SecondOpacities | None
    ranges: Mapping[int, tuple[tuple[int, int], ...]]  # first row and last + 1 of each level, by label id

    def compose(self, levels: Mapping[int, int]) -> Gaussians:
        """The union over categories of the Gaussians of each at its level (label id -> level, 1 to K)."""
        return composed(self.gaussians, self.second, self.ranges, levels)


class Sight:
    """Composes levels for one camera after the other; snapshots are composed as they are."""

    def __init__(self, ladder: Ladder, backend: Backend, antialiased: bool) -> None:
        self._ladder, self._antialiased = ladder, antialiased
        self._backend: Backend = backend
        self._workspace = Workspace()

    def of(self, camera: Camera) -> Ladder | SeenLevels:
        """What composes the levels that are to be rendered from `camera`."""
        if not isinstance(self._ladder, PrefixLadder):
            return self._ladder
        g, second = self._whole
        most = g if second is None else replace(g, logit_opacities=g.logit_opacities.maximum(second))
        with torch.no_grad():
            radii = rasterize(
                most, camera, sh_degree=0, backend=self._backend, antialiased=self._antialiased,
                workspace=self._workspace,
            ).radii  # fmt: skip
        seen = torch.nonzero(radii > 0)[:, 0]
        ends = torch.nn.functional.pad((radii > 0).cumsum(0), (1, 0)).tolist()
        ranges = {
            label: tuple((ends[first], ends[last]) for first, last in of_level)
            for label, of_level in self._ladder.ranges.items()
        }
        few = _as_seen(g.select(seen), camera)
        weights = self._ladder.second.weights if self._ladder.second else {}
        return SeenLevels(few, None if second is None else SecondOpacities(second[seen], weights), ranges)

    @cached_property
    def _whole(self) -> tuple[Gaussians, Tensor | None]:
        assert isinstance(self._ladder, PrefixLadder)
        device, second = device_of(self._backend), self._ladder.second
        return self._ladder.gaussians.to(device), None if second is None else second.logits.to(device)


def _as_seen(g: Gaussians, camera: Camera) -> Gaussians:
    """The same Gaussians with the colours that a camera sees, and without harmonics."""
    position = torch.from_numpy(camera.position).to(g.means)
    directions = torch.nn.functional.normalize(g.means - position, dim=-1)
    bases = sh.bases(*directions.unbind(-1))
    colour = g.sh0[:, 0] * sh.C0
    for basis, coefficients in zip(bases[1:], g.shN.unbind(1), strict=False):
        colour = torch.addcmul(colour, torch.as_tensor(basis)[:, None], coefficients)
    return replace(g, sh0=(colour / sh.C0)[:, None], shN=g.shN[:, :0])
