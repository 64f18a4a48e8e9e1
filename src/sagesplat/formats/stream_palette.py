"""Palettes of coded streams: rows of harmonics that many of a file's Gaussians share.

A splat that came from a SOG has at most 65,536 different rows of harmonics. They are written once, at the
start of a file, the most frequent first; a Gaussian names its row. docs/formats.md specifies the bytes.
"""

import struct
from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Int64

from sagesplat.core.sh import BASES
from sagesplat.formats.stream_columns import PALETTE_BITS, code_harmonics, harmonics_tables
from sagesplat.kernels.rans import Coder, Reader, Tables, Writer

MAGIC = b"SGSP"
MAX_ROWS = 1 << PALETTE_BITS
_VERSION = 3
_HEADER = struct.Struct("<4sBBBBII")
_BLOCK = 2048  # rows
_PER_BYTE = 128  # rows in a byte, at most
_MULTIPLIER = 0x9E3779B97F4A7C15  # odd: 2^64 over the golden ratio


@dataclass(frozen=True, eq=False)
class Palette:
    """Rows of harmonics in steps of 2^(1 - bits), in right, up, back."""

    sh_degree: int
    sh_bits: tuple[int, int]
    rows: Int64[np.ndarray, "R K 3"]

    @classmethod
    def of(cls, harmonics: Int64[np.ndarray, "N K 3"], sh_bits: tuple[int, int]) -> Self | None:
        """That of the harmonics of N Gaussians; None where they have too many different rows, or need none.

        It is only there if it takes fewer bytes than coding each row by itself would.
        """
        degree, count = BASES.index(harmonics.shape[1]), len(harmonics)
        _, first, counts = np.unique(_hashes(harmonics), return_index=True, return_counts=True)
        if not degree or not 0 < len(first) <= min(MAX_ROWS, count // 2):
            return None
        order = np.argsort(-counts, kind="stable")
        found = cls(degree, sh_bits, harmonics[first[order]])
        nbytes, lengths = len(found.encoded()), np.frexp(np.arange(len(first)))[1]
        shares = counts[order] / count
        bits = (shares * (lengths - 1).clip(0)).sum()
        by_length = np.bincount(lengths, shares)
        bits -= (by_length * np.log2(by_length, where=by_length > 0, out=np.zeros(len(by_length)))).sum()
        return found if nbytes + count * bits / 8 < nbytes * count / len(first) else None

    def entries(self, harmonics: Int64[np.ndarray, "N K 3"]) -> Int64[np.ndarray, " N"]:
        """The rows that harmonics are; ValueError where some are none."""
        keys = _hashes(self.rows)
        order = np.argsort(keys)
        at = np.searchsorted(keys, _hashes(harmonics), sorter=order).clip(0, len(keys) - 1)
        found = order[at]
        if not np.array_equal(self.rows[found], harmonics):
            raise ValueError("harmonics that are not in the palette")
        return found

    def taken(self, entries: Int64[np.ndarray, " N"]) -> Int64[np.ndarray, "N K 3"]:
        """Rows by their numbers; ValueError for one that is not there."""
        if len(entries) and entries.max() >= len(self.rows):
            raise ValueError(f"row {entries.max()} of a palette of {len(self.rows)}")
        return self.rows[entries]

    def encoded(self) -> bytes:
        """Its bytes."""
        writer = Writer(Tables(harmonics_tables(self.sh_degree)))
        _code(writer, self.sh_degree, len(self.rows), self.rows)
        payload = writer.payload()
        sizes = len(self.rows), len(payload)
        return _HEADER.pack(MAGIC, _VERSION, self.sh_degree, *self.sh_bits, *sizes) + payload


def read_palette(content: bytes) -> Palette | None:
    """The palette that a file of streams begins with, if there is one; ValueError for damage."""
    end = palette_end(content)
    if not end:
        return None
    _, _, degree, low, high, count, _ = _HEADER.unpack_from(content)
    if end > len(content):
        raise ValueError("a palette that is cut off")
    reader = Reader(Tables(harmonics_tables(degree)), content[_HEADER.size : end])
    rows = _code(reader, degree, count, None)
    reader.finish()
    return Palette(degree, (low, high), rows)


def palette_end(content: bytes) -> int:
    """Where the palette ends that a file begins with, 0 without one; ValueError for damage.

    The first bytes of the file are enough.
    """
    if content[:4] != MAGIC:
        return 0
    if len(content) < _HEADER.size:
        raise ValueError("a palette that is cut off")
    _, version, degree, low, high, count, nbytes = _HEADER.unpack_from(content)
    if version != _VERSION or not 1 <= degree <= 3 or not (1 <= low <= 8 and 1 <= high <= 8):
        raise ValueError(f"a palette of version {version}, degree {degree}, steps {low}, {high}")
    if not 0 < count <= min(MAX_ROWS, _PER_BYTE * nbytes):
        raise ValueError(f"a palette of {count} rows in {nbytes} bytes")
    return _HEADER.size + nbytes


def _code(coder: Coder, degree: int, count: int, given: np.ndarray | None) -> np.ndarray:
    parts = []
    for first in range(0, count, _BLOCK):
        now = min(_BLOCK, count - first)
        parts.append(
            code_harmonics(coder, degree, now, None if given is None else given[first : first + now])
        )
        coder.end_block()
    return np.concatenate(parts)


def _hashes(harmonics: np.ndarray) -> np.ndarray:
    """A number of 64 bits for each row; those of different rows differ, but for chance."""
    found = np.zeros(len(harmonics), np.uint64)
    for column in harmonics.reshape(len(harmonics), 3 * harmonics.shape[1]).T:
        found = (found ^ column.astype(np.uint64)) * np.uint64(_MULTIPLIER)
        found ^= found >> np.uint64(29)
    return found
