"""Levels as one camera sees them: compositions that are rendered from it many times hold little else."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int16, Int64

from sagesplat.adapt.ladder import PrefixLadder, composed
from sagesplat.adapt.seen_cpu import Drawn, drawn_from
from sagesplat.core import sh
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.raster import Backend, Workspace, device_of, in_sight, most_painted, rasterize
from sagesplat.scene.scene import Camera
from sagesplat.segment.masks import UNLABELLED

Ranges = Mapping[int, tuple[tuple[int, int], ...]]  # first row and last + 1 of each level, by label id


class Seen(Protocol):
    """The levels of a nested ladder from one camera, until the next one's with the same workspace."""

    @property
    def nbytes(self) -> int:
        """Memory that they take, about."""
        ...

    def kept(self) -> "Seen":
        """The same, which no other overwrites."""
        ...

    def render(self, levels: Mapping[int, int]) -> Float32[np.ndarray, "H W 3"]:
        """An image in [0, 1] of each category at its level (label id -> level, 1 to K).

        It may be overwritten when the next one is rendered.
        """
        ...

    def label_ids(self, levels: Mapping[int, int]) -> Int16[np.ndarray, "H W"]:
        """Per pixel the category that paints most of it; -1 where more shines through than that."""
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

    def kept(self) -> "SeenRecords":
        """See `Seen`."""
        return replace(self, drawn=self.drawn.kept())

    def render(self, levels: Mapping[int, int]) -> Float32[np.ndarray, "H W 3"]:
        """See `Seen`."""
        return self.drawn.render(self._parts(levels))

    def label_ids(self, levels: Mapping[int, int]) -> Int16[np.ndarray, "H W"]:
        """See `Seen`."""
        ids = sorted({UNLABELLED, *self.ranges})
        columns = np.zeros(len(self.drawn.records), np.int64)
        for label, level in levels.items():
            if label in self.ranges:
                columns[slice(*self.ranges[label][level - 1])] = ids.index(label)
        return np.array(ids, np.int16)[self.drawn.most_painted(self._parts(levels), columns, len(ids))]

    def _parts(self, levels: Mapping[int, int]) -> list[tuple[int, int, float]]:
        return [
            (*of_level[levels[label] - 1], self.drawn.weights[label][levels[label] - 1])
            for label, of_level in self.ranges.items()
            if label in levels
        ]


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

    def kept(self) -> "SeenLevels":
        """See `Seen`."""
        return self

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

    def label_ids(self, levels: Mapping[int, int]) -> Int16[np.ndarray, "H W"]:
        """See `Seen`."""
        g = self.compose(levels)
        ids = torch.tensor(sorted({UNLABELLED, *self.ranges}), device=g.label_ids.device, dtype=torch.int16)
        painted = most_painted(
            g, self.camera, torch.searchsorted(ids, g.label_ids), len(ids),
            antialiased=self.antialiased, backend=self.backend, tile_mask=self.tile_mask,
        )  # fmt: skip
        return ids.cpu().numpy()[painted]


def seen_from(
    ladder: PrefixLadder,
    camera: Camera,
    *,
    backend: Backend,
    antialiased: bool,
    workspace: Workspace,
    tile_mask: Bool[np.ndarray, "h w"] | None = None,
    compositions: Sequence[Mapping[int, int]] | None = None,
) -> Seen:
    """The levels of a ladder as `camera` sees them; `antialiased`: how the model was trained.

    On a CPU all that have the same workspace render into the same memory. `tile_mask`: tiles of 16 x 16 px
    that images are wanted in. `compositions`: those that will be rendered (label id -> level); None: any.
    """
    if backend not in ("auto", "cpu") or camera.exposure is not None:
        return seen_levels(
            ladder, camera,
            backend=backend, antialiased=antialiased, workspace=workspace, tile_mask=tile_mask,
        )  # fmt: skip
    g, second = ladder.gaussians, ladder.second
    weights = second.weights if second else {k: (0.0,) * len(v) for k, v in ladder.ranges.items()}
    logits = second.logits if second else None
    used = None
    if compositions is not None:
        chosen = {pair for levels in compositions for pair in levels.items() if pair[0] in ladder.ranges}
        used = [ladder.ranges[label][level - 1] for label, level in chosen]
    drawn, rows = drawn_from(g, logits, weights, camera, antialiased, workspace, tile_mask, used)
    return SeenRecords(drawn, _ranges_among(ladder, rows))


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
    rows = torch.nonzero(seen)[:, 0]
    ranges = _ranges_among(ladder, rows.cpu().numpy())
    second = second.select(rows) if second else None
    return SeenLevels(
        _as_seen(g.select(rows), camera), second, ranges, camera, backend, antialiased, tile_mask
    )


def _ranges_among(ladder: PrefixLadder, rows: Int64[np.ndarray, " M"]) -> Ranges:
    """The levels of a ladder as ranges among some of its rows, ascending."""
    return {
        label: tuple((int(first), int(last)) for first, last in np.searchsorted(rows, of_level))
        for label, of_level in ladder.ranges.items()
    }


def _as_seen(g: Gaussians, camera: Camera) -> Gaussians:
    """The same Gaussians with the colours that a camera sees, and without harmonics."""
    position = torch.from_numpy(camera.position).to(g.means)
    directions = torch.nn.functional.normalize(g.means - position, dim=-1)
    bases = sh.bases(*directions.unbind(-1))
    colour = g.sh0[:, 0] * sh.C0
    for basis, coefficients in zip(bases[1:], g.shN.unbind(1), strict=False):
        colour = torch.addcmul(colour, torch.as_tensor(basis)[:, None], coefficients)
    return replace(g, sh0=(colour / sh.C0)[:, None], shN=g.shN[:, :0])
