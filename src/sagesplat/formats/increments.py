"""Increments of nested levels: one file per category and level, with the Gaussians that the level adds."""

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Int64

from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.core.names import slugs
from sagesplat.formats.ply import write_ply
from sagesplat.formats.spz import SH_BITS, encode_spz, packing_order, read_spz
from sagesplat.io.files import atomic_folder, read_json, write_json

Format = Literal["spz", "ply"]
INDEX = "index.json"
_CURE = "delete that folder and run `sagesplat nest` again"
_URI = r"(?!\.)[A-Za-z0-9_.-]{1,200}"  # a plain file name
_GPU_BYTES = (16, 24, 40, 56)  # per Gaussian in Spark 2.2, by SH degree


@dataclass(frozen=True)
class Increment:
    """The Gaussians that a level of a category adds to the level below it, as a file."""

    label_id: int
    level: int
    uri: str  # file name in the folder of the index; it holds a hash, so it can be cached for ever
    count: int  # Gaussians
    nbytes: int
    gpu_bytes: int
    sha256: str


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
    kind: Format = "spz",
    sh_bits: tuple[int, int] = SH_BITS,
    antialiased: bool = False,
) -> list[Increment]:
    """Write the increments of nested levels and their index; `folder` is replaced.

    `sizes`: by label id, the number of Gaussians in each level. `names`: label id -> category. `sh_bits` and
    `antialiased` as in `encode_spz`.
    """
    written = []
    stems = slugs({label: names.get(label, str(label)) for label in sizes})
    with atomic_folder(folder) as fresh:
        for label, level, rows in increments(g, sizes):
            part = g.select(torch.from_numpy(rows))
            temporary = fresh / f"increment.{kind}"
            if kind == "spz":
                temporary.write_bytes(encode_spz(part, sh_bits=sh_bits, coarse=True, antialiased=antialiased))
            else:
                write_ply(temporary, part, names)
            content = temporary.read_bytes()
            digest = hashlib.sha256(content).hexdigest()
            uri = f"{stems[label]}-{level:02d}-{digest[:12]}.{kind}"
            temporary.rename(fresh / uri)
            gpu = len(part) * _GPU_BYTES[part.sh_degree]
            written.append(Increment(label, level, uri, len(part), len(content), gpu, digest))
        write_json(fresh / INDEX, {"format": kind, "chunks": [asdict(one) for one in written]})
    return written


def read_index(folder: Path) -> list[Increment]:
    """The increments that `write_increments` listed; DataError for an invalid index."""
    document: Any = read_json(folder / INDEX, _CURE)
    try:
        listed = [Increment(**entry) for entry in document["chunks"]]
        for increment in listed:
            _check(increment)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{folder / INDEX}: not an index of increments ({short(repr(error))}); {_CURE}"
        ) from None
    return listed


def _check(increment: Increment) -> None:
    """ValueError for an impossible entry, such as a file outside the folder."""
    sizes = (increment.level, increment.count, increment.nbytes, increment.gpu_bytes)
    if not all(type(size) is int and 0 < size < 2**53 for size in sizes):
        raise ValueError("an increment without content")
    if type(increment.label_id) is not int or not -1 <= increment.label_id < 2**15:
        raise ValueError(f"label id {increment.label_id!r}")
    if not isinstance(increment.uri, str) or not re.fullmatch(_URI, increment.uri):
        raise ValueError(f"{increment.uri!r} is not a file name of an increment")
    if not isinstance(increment.sha256, str) or not re.fullmatch("[0-9a-f]{64}", increment.sha256):
        raise ValueError(f"{increment.sha256!r} is not a SHA-256")


def read_increments(folder: Path, listed: Sequence[Increment]) -> Gaussians:
    """The Gaussians of SPZ increments, concatenated; DataError for a missing or damaged file."""
    if not listed:
        raise DataError(f"{folder}: no increments; {_CURE}")
    return concat([read_spz(folder / increment.uri, increment.label_id) for increment in listed])


def totals(listed: Sequence[Increment], labels: Sequence[int], levels: int, what: str) -> np.ndarray:
    """Cumulative sums over the levels of a field of the increments: int64 [L, K].

    Rows are `labels`, columns the levels 1 to K; `what` is count, nbytes or gpu_bytes. DataError for an
    increment of another category or level.
    """
    table = np.zeros((len(labels), levels), np.int64)
    row = {label: i for i, label in enumerate(labels)}
    for increment in listed:
        if increment.label_id not in row or increment.level > levels:
            raise DataError(
                f"{increment.uri}: this run has no category {increment.label_id}, level {increment.level}; "
                f"{_CURE}"
            )
        table[row[increment.label_id], increment.level - 1] += getattr(increment, what)
    return table.cumsum(1)
