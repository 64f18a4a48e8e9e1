"""Splats: Gaussians of somebody else's file with what was wrong with them, and how formats are described."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
import torch
from torch import Tensor

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import NO_OFFSET, Position, offset_of, offset_text

# Axes in a file, left or right, up or down, front or back: SPZ's own are rub; COLMAP's and PLY's are rdf.
Frame = Literal["rub", "ldb", "rdb", "lub", "ldf", "rdf", "luf", "ruf"]
SOME = 2**16  # Gaussians that say how far from the origin all are
OPAQUE = 16.0  # logit of opacities that a file has as infinite; its sigmoid is 1 - 1e-7


@dataclass(frozen=True, eq=False)
class Splat:
    """A splat file's content, in COLMAP's axes as INRIA's PLY has it."""

    gaussians: Gaussians  # on the CPU; label ids -1 where the file has none
    kind: str  # the format, such as "PLY" or "SPZ 3"
    names: dict[int, str] = field(default_factory=dict)  # category names by label id, where the file has them
    antialiased: bool = False  # trained with an antialiasing filter, if the file says so
    announced: int = -1  # Gaussians in the file; -1: as many as there are
    dropped: dict[str, int] = field(default_factory=dict)  # reason -> Gaussians that were left out
    parents: dict[int, str] = field(default_factory=dict)  # by label id of an instance: its category's name
    notes: tuple[str, ...] = ()  # what was not read as it is in the file, a line each, for people
    offset: Position = NO_OFFSET  # that was subtracted from the positions in the file, world units
    up: str = "auto"  # which way is up, such as "z", if the file says so


@dataclass(frozen=True)
class ReadOptions:
    """What a caller of `read_splat` chooses; a reader uses what its format knows."""

    lod: int = 0  # level of detail, 0 is the finest; above it only for a reader with `num_lods`
    spz_axes: Frame = "rub"  # of SPZ files that do not say theirs


@dataclass(frozen=True)
class SplatReader:
    """How one format is recognised and read; `registry.READERS` lists all.

    A file is of the first format whose `magic` it begins with and that `accepts` it, or whose `json_key` its
    document has. Only if there is none does the suffix of its name tell.
    """

    read: Callable[[Path, ReadOptions], Splat]
    magic: tuple[bytes, ...] = ()  # of at most 64 bytes
    accepts: Callable[[BinaryIO], bool] | None = None  # tells apart formats that begin with the same bytes
    json_key: str | None = None
    suffix: str | None = None  # of files without a header, such as ".splat"
    in_folder: str | None = None  # name of the file to read where the path is of a folder
    num_lods: Callable[[Path], int] | None = None  # levels of detail of a file; None: the format has one


Names = Mapping[int, str]
# Of a path: a scene, category names by label id, names of the categories that instances are of, antialiasing.
WriteScene = Callable[[Path, Gaussians, Names, Names, bool], object]
# Likewise of levels, the finest first, whose label ids are cell ids; label ids by these precede the names.
WriteLevels = Callable[[Path, Sequence[Gaussians], Mapping[int, int], Names, Names, bool], object]


@dataclass(frozen=True)
class SplatWriter:
    """How one format is written: a scene, or its levels of detail; `registry.WRITERS` lists all."""

    write: WriteScene | None = None
    write_levels: WriteLevels | None = None
    antialiases: bool = True  # whether viewers draw a file as it says that it was trained
    sh_degree: int = 3  # the highest that the format holds


def cleaned(splat: Splat, name: str) -> Splat:
    """The splat without the Gaussians that cannot be drawn, which `dropped` counts by reason.

    These hold NaN or infinities, have a rotation of zeros, or are invisible (an opacity or a scale of zero,
    whose logarithm is -infinity). An opacity logit of +infinity becomes `OPAQUE`. DataError, which calls the
    file `name`, if none is left.
    """
    g = splat.gaussians
    announced = len(g) if splat.announced < 0 else splat.announced
    if not len(g):
        raise DataError(f"{name}: no Gaussians in it; export the scene again")
    if opaque := bool(torch.isposinf(g.logit_opacities).any()):
        g = replace(g, logit_opacities=g.logit_opacities.clamp(max=OPAQUE))
    reasons = undrawable(g)
    dropped = {reason: count for reason, rows in reasons.items() if (count := int(rows.sum()))}
    if sum(dropped.values()) == len(g):
        why = ", ".join(f"{count} {reason}" for reason, count in dropped.items())
        raise DataError(
            f"{name}: none of its {len(g)} Gaussians can be drawn ({why}); export the scene again"
        )
    if dropped:
        g = g.select(~torch.stack(list(reasons.values())).any(0))
    if not dropped and not opaque and splat.announced >= 0:
        return splat
    return replace(splat, gaussians=g, announced=announced, dropped=splat.dropped | dropped)


def near_origin(splat: Splat) -> Splat:
    """The splat with an offset subtracted from its positions where it is far from its origin.

    A reader of doubles has subtracted one already, before they became float32. A note says where float32 has
    rounded the positions to more than the size of the Gaussians.
    """
    means = splat.gaussians.means.numpy()
    offset = offset_of(means[:: len(means) // SOME + 1])
    if any(splat.offset) or not any(offset):
        return splat
    step = float(np.spacing(np.float32(np.abs(offset).max())))
    size = float(splat.gaussians.log_scales.median().exp())
    if step > size:
        note = f"positions in float32 are at {offset_text(offset)}, which rounds them to {step:.2g}, "
        note += (
            f"more than the size of most Gaussians ({size:.2g}); export it with doubles, or near the origin"
        )
        splat = replace(splat, notes=(*splat.notes, note))
    return relative_to(splat, offset)


def relative_to(splat: Splat, offset: Position) -> Splat:
    """The splat with positions from which `offset` is subtracted, in place of its own."""
    if offset == splat.offset:
        return splat
    by = torch.tensor(splat.offset, dtype=torch.float64) - torch.tensor(offset, dtype=torch.float64)
    means = (splat.gaussians.means.double() + by).float()
    return replace(splat, gaussians=replace(splat.gaussians, means=means), offset=offset)


def check_writable(g: Gaussians, name: str) -> None:
    """DataError, which calls the file `name`, for NaN or infinities, or a rotation of zeros."""
    for key, values in g.parameters().items():
        if bad := int((~torch.isfinite(values)).sum()):
            raise DataError(f"{name}: {bad} values of {key} are NaN or infinite; train the scene again")
    if bad := int((~g.quats.any(1)).sum()):
        raise DataError(f"{name}: {bad} Gaussians have a rotation of zeros; train the scene again")


def undrawable(g: Gaussians) -> dict[str, Tensor]:
    """Bool [N] by reason: the Gaussians that `cleaned` leaves out. An infinite opacity logit can be drawn."""
    invisible = torch.isneginf(g.logit_opacities) | torch.isneginf(g.log_scales).any(1)
    g = replace(g, logit_opacities=g.logit_opacities.clamp(max=OPAQUE))
    broken = ~invisible & ~_all_finite(g)
    zero = ~invisible & ~broken & ~g.quats.any(1)
    return {"NaN or infinite": broken, "a rotation of zeros": zero, "invisible": invisible}


def _all_finite(g: Gaussians) -> Tensor:
    rows = torch.ones(len(g), dtype=torch.bool)
    for values in g.parameters().values():
        rows &= torch.isfinite(values.reshape(len(g), -1)).all(1)
    return rows
