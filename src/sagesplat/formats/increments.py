"""Increments of nested levels: one file per category and level, with the Gaussians that the level adds.

A level may replace those below it (`refine: REPLACE`, as in 3D Tiles): a category then shows the increments
from the newest such level on, and not the ones below.
"""

import hashlib
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Int64

from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.core.names import slugs
from sagesplat.formats.levels import starts_of
from sagesplat.formats.ply import read_ply, write_ply
from sagesplat.formats.spz import SH_BITS, encode_spz, packing_order, read_spz
from sagesplat.io.files import atomic_folder, read_json, write_json

Format = Literal["spz", "ply"]
Refine = Literal["ADD", "REPLACE"]
INDEX = "index.json"
_FINE_BITS = 8, 8  # of SH coefficients
_CURE = "delete that folder and run `sagesplat nest` again"
_URI = r"(?!\.)[A-Za-z0-9_.-]{1,200}"  # a plain file name
_GPU_BYTES = (16, 24, 40, 56)  # per Gaussian in Spark 2.2, by SH degree


@dataclass(frozen=True)
class Increment:
    """The Gaussians that a level of a category adds to the level below it, or replaces it by, as a file."""

    label_id: int
    level: int
    uri: str  # file name in the folder of the index; it holds a hash, so it can be cached for ever
    count: int  # Gaussians
    nbytes: int
    gpu_bytes: int
    sha256: str
    refine: Refine = "ADD"  # REPLACE: instead of all increments of lower levels

    @property
    def format(self) -> Format:
        """Of the file, by its name."""
        return "ply" if self.uri.endswith(".ply") else "spz"


def packed(
    g: Gaussians, sizes: Mapping[int, Sequence[int]], *, sh_bits: tuple[int, int] = SH_BITS
) -> Int64[np.ndarray, " N"]:
    """Rows sorted by category and level, and within a level, where any order is valid, by `packing_order`."""
    rows = [
        part[packing_order(g.select(torch.from_numpy(part)), sh_bits=sh_bits)]
        for _, _, part in increments(g, sizes)
    ]
    return np.concatenate([*rows, np.arange(0)])


def increments(g: Gaussians, sizes: Mapping[int, Sequence[int]]) -> list[tuple[int, int, np.ndarray]]:
    """(label id, level, added rows) of every level that adds Gaussians.

    `sizes`: by label id, the number of Gaussians in each level.
    """
    labels, added = g.label_ids.numpy(), []
    for label in sorted(sizes):
        rows = np.flatnonzero(labels == label)
        for level, (low, high) in enumerate(pairwise((0, *sizes[label])), 1):
            if high > low:
                added.append((label, level, rows[low:high]))
    return added


def write_increments(
    folder: Path,
    g: Gaussians,
    sizes: Mapping[int, Sequence[int]],
    names: dict[int, str],
    *,
    replaces: Mapping[int, Collection[int]] | None = None,
    kind: Format | Callable[[int, int], Format] = "spz",
    sh_bits: tuple[int, int] = SH_BITS,
    fine: Collection[int] = (),
    antialiased: bool = False,
) -> list[Increment]:
    """Write the increments of nested levels and their index; `folder` is replaced.

    `sizes`: by label id, the rows up to the end of each level. `names`: label id -> category. `replaces`: by
    label id, the levels that replace those below (`formats.levels.starts_of`). `kind`: of all files, or of a
    label id and level. `sh_bits` and `antialiased` as in `encode_spz`; the levels `fine` are rounded by the
    smallest steps of the format instead.

    ValueError for levels that cannot replace.
    """
    replaces, written = replaces or {}, []
    for label, levels in replaces.items():
        starts_of(sizes[label], levels)  # what cannot replace is an error, not an increment lost
    kind_of = kind if callable(kind) else lambda label, level: kind
    stems = slugs({label: names.get(label, str(label)) for label in sizes})
    with atomic_folder(folder) as fresh:
        for label, level, rows in increments(g, sizes):
            part = g.select(torch.from_numpy(rows))
            suffix = kind_of(label, level)
            temporary = fresh / f"increment.{suffix}"
            if suffix == "spz":
                bits = _FINE_BITS if level in fine else sh_bits
                temporary.write_bytes(
                    encode_spz(part, sh_bits=bits, coarse=level not in fine, antialiased=antialiased)
                )
            else:
                write_ply(temporary, part, names, antialiased=antialiased)
            content = temporary.read_bytes()
            digest = hashlib.sha256(content).hexdigest()
            uri = f"{stems[label]}-{level:02d}-{digest[:12]}.{suffix}"
            temporary.rename(fresh / uri)
            gpu = len(part) * _GPU_BYTES[part.sh_degree]
            refine: Refine = "REPLACE" if level in replaces.get(label, ()) else "ADD"
            written.append(Increment(label, level, uri, len(part), len(content), gpu, digest, refine))
        formats = sorted({one.format for one in written}, reverse=True)
        write_json(fresh / INDEX, {"format": "+".join(formats), "chunks": [_entry(one) for one in written]})
    return written


def _entry(increment: Increment) -> dict[str, Any]:
    """Of the index; `refine` is written where a level replaces."""
    entry = asdict(increment)
    return entry if increment.refine == "REPLACE" else {k: v for k, v in entry.items() if k != "refine"}


def read_index(folder: Path) -> list[Increment]:
    """The increments that `write_increments` listed; DataError for an invalid index."""
    document: Any = read_json(folder / INDEX, _CURE)
    try:
        listed = [checked(Increment(**entry)) for entry in document["chunks"]]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{folder / INDEX}: not an index of increments ({short(repr(error))}); {_CURE}"
        ) from None
    return listed


def checked(increment: Increment) -> Increment:
    """The increment; ValueError for an impossible entry, such as a file outside the folder."""
    sizes = (increment.level, increment.count, increment.nbytes, increment.gpu_bytes)
    if not all(type(size) is int and 0 < size < 2**53 for size in sizes):
        raise ValueError("an increment without content")
    if type(increment.label_id) is not int or not -1 <= increment.label_id < 2**15:
        raise ValueError(f"label id {increment.label_id!r}")
    if not isinstance(increment.uri, str) or not re.fullmatch(_URI, increment.uri):
        raise ValueError(f"{increment.uri!r} is not a file name of an increment")
    if not isinstance(increment.sha256, str) or not re.fullmatch("[0-9a-f]{64}", increment.sha256):
        raise ValueError(f"{increment.sha256!r} is not a SHA-256")
    if increment.refine not in get_args(Refine):
        raise ValueError(f"refine {increment.refine!r}")
    return increment


def read_increments(folder: Path, listed: Sequence[Increment]) -> Gaussians:
    """The Gaussians of increments, concatenated; DataError for a missing or damaged file."""
    if not listed:
        raise DataError(f"{folder}: no increments; {_CURE}")
    return concat([_read(folder, increment) for increment in listed])


def _read(folder: Path, increment: Increment) -> Gaussians:
    if increment.format == "spz":
        return read_spz(folder / increment.uri, increment.label_id)
    g = read_ply(folder / increment.uri)
    return replace(g, label_ids=torch.full_like(g.label_ids, increment.label_id))


def shown(listed: Sequence[Increment], label_id: int, level: int) -> list[Increment]:
    """The increments that make up a level of a category, ascending: since the newest REPLACE."""
    mine = (c for c in listed if c.label_id == label_id and c.level <= level)
    return full_scene(sorted(mine, key=lambda c: c.level))


def full_scene(listed: Sequence[Increment]) -> list[Increment]:
    """The increments that make up the highest level of every category, in their order."""
    newest: dict[int, int] = {}
    for one in listed:
        if one.refine == "REPLACE":
            newest[one.label_id] = max(newest.get(one.label_id, 0), one.level)
    return [one for one in listed if one.level >= newest.get(one.label_id, 0)]


def totals(listed: Sequence[Increment], labels: Sequence[int], levels: int, what: str) -> np.ndarray:
    """Sums of a field over the increments that make up each level: int64 [L, K].

    Rows are `labels`, columns the levels 1 to K; `what` is count, nbytes or gpu_bytes. DataError for an
    increment of another category or level.
    """
    table, replaced = np.zeros((2, len(labels), levels), np.int64)
    row = {label: i for i, label in enumerate(labels)}
    for increment in listed:
        if increment.label_id not in row or increment.level > levels:
            raise DataError(
                f"{increment.uri}: this run has no category {increment.label_id}, level {increment.level}; "
                f"{_CURE}"
            )
        at = row[increment.label_id], increment.level - 1
        table[at] += getattr(increment, what)
        replaced[at] |= increment.refine == "REPLACE"
    ends = table.cumsum(1)
    return ends - np.maximum.accumulate(np.where(replaced, ends - table, 0), axis=1)
