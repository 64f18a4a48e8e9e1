"""Lists of whole numbers in a document, coded as a stream's columns are: 0.7 of the bytes of gzip.

`packed` replaces each list by its length, and puts all of them into `numbers`, in base64. docs/formats.md
specifies the bytes, `web/src/core/numbers.ts` reads them.
"""

from base64 import b64decode, b64encode
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Int64

from sagesplat.formats.stream_columns import code_bits
from sagesplat.kernels.rans import Coder, Reader, Tables, Writer

# the lists by name, in the order that they are coded in; True: as differences to the number before
LISTS = {
    "views": True, "photos": True, "thresholds": True, "slopes": False, "rows": True, "logDistances": True,
    "offsets": True, "terms": False, "values": True, "factors": True, "shares": True, "corrections": True,
}  # fmt: skip
_BITS = 32  # of a number
_COUNT = 16  # of each symbol of a new table
_BLOCK = 16
_MOST = 2**22  # numbers of a document


def packed(document: dict[str, Any]) -> dict[str, Any]:
    """The document with the lengths of its lists for them, and `numbers`.

    Raises:
        ValueError: For numbers, or differences of them, of more than 32 bits.
    """
    lists: dict[str, list[list[int]]] = {name: [] for name in LISTS}

    def taken(name: str, numbers: list[int]) -> int:
        lists[name].append(numbers)
        return len(numbers)

    lengths = _exchanged(document, taken, lambda value: isinstance(value, list) and _is_flat(value))
    writer, total = Writer(_tables()), 0
    for name, some in lists.items():
        wholes = [np.array(own, np.int64) for own in some]
        numbers = np.concatenate(
            [np.zeros(0, np.int64), *([np.diff(own, prepend=0) for own in wholes] if LISTS[name] else wholes)]
        )
        if (np.abs(numbers) >= 2**_BITS).any():
            raise ValueError(f"{name}: numbers of more than {_BITS} bits")
        _code(writer, name, len(numbers), numbers)
        total += len(numbers)
    return {**lengths, "numbers": b64encode(writer.payload() if total else b"").decode()}


def unpacked(document: dict[str, Any]) -> dict[str, Any]:
    """The document that was packed.

    Raises:
        ValueError: For damaged numbers, or too many.
    """
    lists: dict[str, list[list[int]]] = {name: [] for name in LISTS}
    total = 0

    def announced(name: str, length: int) -> list[int]:
        nonlocal total
        total += length
        if length < 0 or total > _MOST:
            raise ValueError(f"a list of {length} numbers; a document has at most {_MOST}")
        lists[name].append([0] * length)
        return lists[name][-1]

    whole = _exchanged(document, announced, lambda value: isinstance(value, int))
    content = b64decode(whole.pop("numbers"), validate=True)
    if total:
        reader = Reader(_tables(), content)
        for name, some in lists.items():
            found = _code(reader, name, sum(map(len, some)), None)
            for own in some:
                part, found = found[: len(own)], found[len(own) :]
                own[:] = (part.cumsum() if LISTS[name] else part).tolist()
        reader.finish()
    return whole


def _is_flat(value: list[Any]) -> bool:
    return not any(isinstance(item, list) for item in value)


def _exchanged(document: dict[str, Any], other: Callable[..., Any], isit: Callable[[Any], bool]) -> Any:
    """The document with other values for its lists: `other` of name and value, where `isit`."""

    def walk(value: Any, name: str) -> Any:
        if name in LISTS and isit(value):
            return other(name, value)
        if isinstance(value, dict):
            return {key: walk(item, key) for key, item in value.items()}
        return [walk(item, name) for item in value] if isinstance(value, list) else value

    return walk(document, "")


def _tables() -> Tables:
    return Tables({name: np.full((1, 2 * _BITS + 1), _COUNT) for name in LISTS})


def _code(
    coder: Coder, name: str, count: int, given: Int64[np.ndarray, " N"] | None
) -> Int64[np.ndarray, " N"]:
    """Code numbers: their sign and how many bits they have, then those below the highest."""
    found = np.empty(count, np.int64)
    for at in range(0, count, _BLOCK):
        part, kinds, sizes = slice(at, min(at + _BLOCK, count)), None, None
        if given is not None:
            sizes = np.abs(given[part])
            kinds = 2 * np.frexp(sizes.astype(np.float64))[1].astype(np.int64) - (given[part] < 0)
        kinds = coder.symbols(name, np.zeros(part.stop - at, np.int64), kinds)
        lengths = (kinds + 1) >> 1
        sizes = code_bits(coder, np.minimum(lengths, 1), np.maximum(lengths - 1, 0), sizes)
        found[part] = np.where(kinds & 1, -sizes, sizes)
        coder.end_block()
    return found
