"""Levels as one camera sees them: compositions that are rendered from it many times hold little else."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from sagesplat.adapt.ladder import PrefixLadder, composed
from sagesplat.core import sh
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.raster import Backend, Workspace, device_of, in_sight
from sagesplat.scene.scene import Camera


@dataclass(frozen=True, eq=False)
class SeenLevels:
    """The levels of a nested ladder without what a camera does not see, and with the colours that it sees.

    A composition renders as that of the ladder does, from this camera alone: its Gaussians have no harmonics.
    """

    gaussians: Gaussians
    second: SecondOpacities | None
    ranges: Mapping[int, tuple[tuple[int, int], ...]]  # first row and last + 1 of each level, by label id

    @property
    def nbytes(self) -> int:
        """Memory that they take, about: 15 float32 values of each Gaussian."""
        return 60 * len(self.gaussians)

    def compose(self, levels: Mapping[int, int]) -> Gaussians:
        """The union over categories of the Gaussians of each at its level (label id -> level, 1 to K)."""
        return composed(self.gaussians, self.second, self.ranges, levels)


def seen_from(
    ladder: PrefixLadder, camera: Camera, *, backend: Backend, antialiased: bool, workspace: Workspace
) -> SeenLevels:
    """The levels of a ladder as `camera` sees them; `antialiased`: how the model was trained."""
    device = device_of(backend)
    g, second = ladder.gaussians.to(device), ladder.second
    most = g
    if second is not None:
        second = SecondOpacities(second.logits.to(device), second.weights)
        most = replace(g, logit_opacities=g.logit_opacities.maximum(second.logits))
    seen = in_sight(most, camera, antialiased=antialiased, backend=backend, workspace=workspace)
    before = np.concatenate([[0], seen.cpu().numpy().cumsum()])
    ranges = {
        label: tuple((int(before[first]), int(before[last])) for first, last in of_level)
        for label, of_level in ladder.ranges.items()
    }
    rows = torch.nonzero(seen)[:, 0]
    return SeenLevels(_as_seen(g.select(rows), camera), second.select(rows) if second else None, ranges)


def _as_seen(g: Gaussians, camera: Camera) -> Gaussians:
    """The same Gaussians with the colours that a camera sees, and without harmonics."""
    position = torch.from_numpy(camera.position).to(g.means)
    directions = torch.nn.functional.normalize(g.means - position, dim=-1)
    bases = sh.bases(*directions.unbind(-1))
    colour = g.sh0[:, 0] * sh.C0
    for basis, coefficients in zip(bases[1:], g.shN.unbind(1), strict=False):
        colour = torch.addcmul(colour, torch.as_tensor(basis)[:, None], coefficients)
    return replace(g, sh0=(colour / sh.C0)[:, None], shN=g.shN[:, :0])
