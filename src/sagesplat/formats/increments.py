"""Chunks of a nested ladder: one file per category and level, each only what the level adds."""

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
from sagesplat.formats.ply import write_ply
from sagesplat.formats.spz import SH_BITS, encode_spz, packing_order, read_spz
from sagesplat.io.files import atomic_folder, read_json, write_json

Format = Literal["spz", "ply"]
INDEX = "index.json"
_URI = r"(?!\.)[A-Za-z0-9_.-]{1,200}"  # a plain file in the folder of the index
_GPU_BYTES = (16, 24, 40, 56)  # of a splat in Spark 2.2, by degree of its harmonics


@dataclass(frozen=True)
class Increment:
    """What a level adds to the one below it."""

    label_id: int
    level: int
    uri: str  # below the chunks' folder; its hash makes it cacheable for ever
    count: int  # Gaussians
    nbytes: int
    gpu_bytes: int
    sha256: str


def packed(
    g: Gaussians, sizes: Mapping[int, Sequence[int]], *, sh_bits: tuple[int, int] = SH_BITS
) -> Int64[np.ndarray, " N"]:
    """Rows by category and level, and inside a level, where the order is free, as they compress best."""
    rows = [
        part[packing_order(g.select(torch.from_numpy(part)), sh_bits=sh_bits)]
        for _, _, part in increments(g, sizes)
    ]
    return np.concatenate([*rows, np.arange(0)])


def increments(g: Gaussians, sizes: Mapping[int, Sequence[int]]) -> list[tuple[int, int, np.ndarray]]:
    """(label id, level, rows that it adds) of a ladder; levels that add nothing are left out."""
    labels, parts = g.label_ids.numpy(), []
    for label in sorted(sizes):
        rows = np.flatnonzero(labels == label)
        for level, (low, high) in enumerate(pairwise((0, *sizes[label])), 1):
            if high > low:
                parts.append((label, level, rows[low:high]))
    return parts


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
    """Write a ladder's increments and an index of them into a folder of their own, which is replaced."""
    chunks = []
    with atomic_folder(folder) as fresh:
        for label, level, rows in increments(g, sizes):
            part = g.select(torch.from_numpy(rows))
            temporary = fresh / f"chunk.{kind}"
            if kind == "spz":
                temporary.write_bytes(encode_spz(part, sh_bits=sh_bits, coarse=True, antialiased=antialiased))
            else:
                write_ply(temporary, part, names)
            content = temporary.read_bytes()
            digest = hashlib.sha256(content).hexdigest()
            slug = re.sub(r"[^a-z0-9]+", "-", names.get(label, str(label)).lower()).strip("-")
            uri = f"{slug}-{level:02d}-{digest[:12]}.{kind}"
            temporary.rename(fresh / uri)
            gpu = len(part) * _GPU_BYTES[part.sh_degree]
            chunks.append(Increment(label, level, uri, len(part), len(content), gpu, digest))
        write_json(fresh / INDEX, {"format": kind, "chunks": [asdict(chunk) for chunk in chunks]})
    return chunks


def read_index(folder: Path) -> list[Increment]:
    """The index that `write_chunks` wrote; DataError for unusable content."""
    document: Any = read_json(folder / INDEX)
    try:
        chunks = [Increment(**entry) for entry in document["chunks"]]
        for chunk in chunks:
            _check(chunk)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{folder / INDEX}: not an index of chunks ({short(repr(error))}); run `sagesplat nest` again"
        ) from None
    return chunks


def _check(chunk: Increment) -> None:
    """ValueError for an entry that no ladder has, such as a file outside the folder."""
    sizes = (chunk.level, chunk.count, chunk.nbytes, chunk.gpu_bytes)
    if not all(type(size) is int and 0 < size < 2**53 for size in sizes):
        raise ValueError("a chunk without content")
    if type(chunk.label_id) is not int or not -1 <= chunk.label_id < 2**15:
        raise ValueError(f"label id {chunk.label_id!r}")
    if not isinstance(chunk.uri, str) or not re.fullmatch(_URI, chunk.uri):
        raise ValueError(f"{chunk.uri!r} is no name of a chunk")
    if not isinstance(chunk.sha256, str) or not re.fullmatch("[0-9a-f]{64}", chunk.sha256):
        raise ValueError(f"{chunk.sha256!r} is no SHA-256")


def read_increments(folder: Path, chunks: Sequence[Increment]) -> Gaussians:
    """What SPZ chunks hold, one after the other; DataError for a broken one."""
    if not chunks:
        raise DataError(f"{folder}: no chunks; run `sagesplat nest` again")
    return concat([read_spz(folder / chunk.uri, chunk.label_id) for chunk in chunks])


def totals(chunks: Sequence[Increment], labels: Sequence[int], levels: int, what: str) -> np.ndarray:
    """A column of the chunks summed up to each level: int64 [L, K] for rows `labels` and levels 1 to K.

    DataError for a chunk of another category or level.
    """
    table = np.zeros((len(labels), levels), np.int64)
    row = {label: i for i, label in enumerate(labels)}
    for chunk in chunks:
        if chunk.label_id not in row or chunk.level > levels:
            raise DataError(
                f"{chunk.uri}: of category {chunk.label_id} and level {chunk.level}, which this run has not; "
                "run `sagesplat nest` again"
            )
        table[row[chunk.label_id], chunk.level - 1] += getattr(chunk, what)
    return table.cumsum(1)
