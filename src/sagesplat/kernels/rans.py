"""An asymmetric numeral system (range variant, rANS) with frequency tables that adapt from block to block.

Duda, "Asymmetric numeral systems" (arXiv:1311.2540). Frequencies are of 14 bits, the state of 31, and it is
renewed by bytes. The encoder begins with the smallest state, so that a decoder that does not end with it has
read damaged bytes. docs/formats.md specifies the bits.
"""

from typing import Protocol

import numpy as np
from jaxtyping import Int64, UInt8

from sagesplat.kernels.jit import njit

BITS = 14
TOTAL = 1 << BITS  # of the frequencies of a table
LOWEST = 1 << 23  # state
COUNTED = 128  # what a symbol adds to its count
RENEWED = 4  # of a row's counts, the part that has to be new before its frequencies are
MOST = 1 << 18


class Coder(Protocol):
    """Codes columns of integers: a writer takes values and returns them, a reader returns what it reads."""

    def symbols(self, name: str, contexts: Int64[np.ndarray, " N"], values: np.ndarray | None) -> np.ndarray:
        """Symbols int64 [N], each by the row `contexts` of the table `name`."""
        ...

    def bits(self, widths: Int64[np.ndarray, " N"], values: np.ndarray | None) -> np.ndarray:
        """Values int64 [N] of `widths` bits each, all equally likely, at most 14."""
        ...

    def end_block(self) -> None:
        """Count what was coded since the last block."""


class Tables:
    """Counts of symbols and the frequencies that follow from them, by name and context.

    Args:
        weights: By name, the first counts: int [contexts, symbols]. Symbols of count 0 cannot be coded.
    """

    def __init__(self, weights: dict[str, np.ndarray]) -> None:
        self.counts = {name: weight.astype(np.int64) for name, weight in weights.items()}
        self.ends = {name: np.zeros((len(w), w.shape[1] + 1), np.int64) for name, w in weights.items()}
        self._new = {name: np.full(len(w), MOST, np.int64) for name, w in weights.items()}
        for name, counts in self.counts.items():
            _refresh(counts, self.ends[name], self._new[name])
        self._seen: list[tuple[str, np.ndarray, np.ndarray]] = []

    def saw(self, name: str, contexts: np.ndarray, symbols: np.ndarray) -> None:
        """Remember symbols until the end of the block."""
        self._seen.append((name, contexts, symbols))

    def end_block(self) -> None:
        """Count the symbols of the block, and renew the frequencies of rows that have enough of new ones."""
        for name, contexts, symbols in self._seen:
            _count(self.counts[name], self._new[name], contexts, symbols)
        for name in {name for name, _, _ in self._seen}:
            _refresh(self.counts[name], self.ends[name], self._new[name])
        self._seen = []


class Writer:
    """A `Coder` that collects what a payload holds."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self._parts: list[tuple[np.ndarray, np.ndarray]] = []  # first slots and frequencies

    def symbols(self, name: str, contexts: np.ndarray, values: np.ndarray | None) -> np.ndarray:
        """See `Coder`."""
        assert values is not None
        ends = self._tables.ends[name]
        first = ends[contexts, values]
        self._parts.append((first, ends[contexts, values + 1] - first))
        self._tables.saw(name, contexts, values)
        return values

    def bits(self, widths: np.ndarray, values: np.ndarray | None) -> np.ndarray:
        """See `Coder`."""
        assert values is not None
        self._parts.append((values << (BITS - widths), np.int64(1) << (BITS - widths)))
        return values

    def end_block(self) -> None:
        """See `Coder`."""
        self._tables.end_block()

    def payload(self) -> bytes:
        """The bytes of everything since the last payload."""
        first, frequencies = (np.concatenate([p[i] for p in self._parts]) for i in (0, 1))
        self._parts = []
        if not (frequencies > 0).all():
            raise ValueError("a symbol that its table cannot code")
        return _encode(first, frequencies).tobytes()


class Reader:
    """A `Coder` that reads one payload; ValueError where it is too short or damaged."""

    def __init__(self, tables: Tables, payload: bytes) -> None:
        if len(payload) < 4:
            raise ValueError(f"{len(payload)} bytes of coded values")
        self._tables = tables
        self._bytes = np.frombuffer(payload, np.uint8)
        self._state = np.array([int.from_bytes(payload[:4], "big"), 4], np.int64)  # state, next byte
        if not LOWEST <= self._state[0] < LOWEST << 8:
            raise ValueError("an impossible first state")

    def symbols(self, name: str, contexts: np.ndarray, values: np.ndarray | None = None) -> np.ndarray:
        """See `Coder`."""
        found = _decode(self._bytes, self._state, self._tables.ends[name], contexts)
        self._tables.saw(name, contexts, found)
        return self._whole(found)

    def bits(self, widths: np.ndarray, values: np.ndarray | None = None) -> np.ndarray:
        """See `Coder`."""
        return self._whole(_decode_bits(self._bytes, self._state, widths))

    def _whole(self, found: np.ndarray) -> np.ndarray:
        if self._state[1] > len(self._bytes):
            raise ValueError("coded values are cut off")
        return found

    def end_block(self) -> None:
        """See `Coder`."""
        self._tables.end_block()

    def finish(self) -> None:
        """ValueError unless the payload ends here, in the state that the encoder began with."""
        if self._state[0] != LOWEST or self._state[1] != len(self._bytes):
            raise ValueError("coded values are damaged")


@njit(cache=True)
def _count(counts, new, contexts, symbols):  # pragma: no cover - compiled
    for i in range(len(contexts)):
        counts[contexts[i], symbols[i]] += COUNTED
        new[contexts[i]] += 1


@njit(cache=True)
def _refresh(counts, ends, new):  # pragma: no cover - compiled
    """Frequencies by counts, at least 1 where a count is not 0; the first largest gets what is left."""
    for row in range(len(counts)):
        count = counts[row]
        more = new[row] * COUNTED
        if not more or more * RENEWED < count.sum() - more:
            continue
        new[row] = 0
        while count.sum() > MOST:
            for s in range(len(count)):
                count[s] = (count[s] + 1) >> 1
        total, possible = count.sum(), (count > 0).sum()
        share = ((TOTAL - possible) << 16) // total
        largest, left = 0, TOTAL
        for s in range(len(count)):
            frequency = (count[s] * share >> 16) + 1 if count[s] > 0 else 0
            ends[row, s + 1] = frequency
            left -= frequency
            if count[s] > count[largest]:
                largest = s
        ends[row, largest + 1] += left
        for s in range(len(count)):
            ends[row, s + 1] += ends[row, s]


@njit(cache=True)
def _encode(first, frequencies) -> UInt8[np.ndarray, " B"]:  # pragma: no cover - compiled
    out = np.empty(2 * len(first) + 8, np.uint8)
    at, state = len(out), LOWEST
    for i in range(len(first) - 1, -1, -1):
        frequency = frequencies[i]
        while state >= frequency << (31 - BITS):
            at -= 1
            out[at] = state & 255
            state >>= 8
        state = (state // frequency << BITS) + state % frequency + first[i]
    for _ in range(4):
        at -= 1
        out[at] = state & 255
        state >>= 8
    return out[at:]


@njit(cache=True)
def _decode(content, progress, ends, contexts):  # pragma: no cover - compiled
    found = np.empty(len(contexts), np.int64)
    state, at = progress[0], progress[1]
    for i in range(len(contexts)):
        row = ends[contexts[i]]
        slot = state & (TOTAL - 1)
        low, high = 0, len(row) - 1
        while high - low > 1:  # the last symbol that begins at or before the slot
            middle = (low + high) >> 1
            if row[middle] <= slot:
                low = middle
            else:
                high = middle
        found[i] = low
        state = (row[low + 1] - row[low]) * (state >> BITS) + slot - row[low]
        while state < LOWEST:
            state = state << 8 | (content[at] if at < len(content) else 0)
            at += 1
    progress[0], progress[1] = state, at
    return found


@njit(cache=True)
def _decode_bits(content, progress, widths):  # pragma: no cover - compiled
    found = np.empty(len(widths), np.int64)
    state, at = progress[0], progress[1]
    for i in range(len(widths)):
        shift = BITS - widths[i]
        slot = state & (TOTAL - 1)
        found[i] = slot >> shift
        state = (state >> BITS << shift) + (slot & ((1 << shift) - 1))
        while state < LOWEST:
            state = state << 8 | (content[at] if at < len(content) else 0)
            at += 1
    progress[0], progress[1] = state, at
    return found
