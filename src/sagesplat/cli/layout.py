"""Tables that fit a terminal: names and headers wrap, and columns that do not fit go into a second table."""

import textwrap
from collections.abc import Sequence

from rich.cells import cell_len

_FIRST = 14  # characters that names are wrapped to, rather than splitting the table
_PAD = 2  # characters between two columns

Rows = Sequence[Sequence[str]]
Cells = list[list[str]]


def fitted(header: Sequence[str], rows: Rows, width: int) -> list[tuple[list[str], Cells]]:
    """The table, or several with some of its columns each, none wider than `width` characters.

    Every part begins with the first column (the names). Cells of the others are never cut.
    """
    names = [header[0], *(row[0] for row in rows)]
    longest = max(map(cell_len, names))
    needed = [_needed(name, [row[i] for row in rows]) for i, name in enumerate(header)]
    first = max(min(longest, width - 2 - sum(n + _PAD for n in needed[1:])), min(longest, _FIRST))
    parts: list[list[int]] = [[]]
    room = used = width - first - _PAD
    for column in range(1, len(header)):
        if parts[-1] and used < needed[column] + _PAD:
            parts.append([])
            used = room
        parts[-1].append(column)
        used -= needed[column] + _PAD
    return [_part(header, rows, columns, first, needed) for columns in parts]


def _needed(name: str, cells: Sequence[str]) -> int:
    """Width of a column: that of its cells, and of the longest word of its header."""
    return max(map(cell_len, [*name.split(), *cells]), default=0)


def _part(
    header: Sequence[str], rows: Rows, columns: Sequence[int], first: int, needed: Sequence[int]
) -> tuple[list[str], Cells]:
    heads = [_wrapped(header[0], first), *(_wrapped(header[i], needed[i]) for i in columns)]
    return heads, [[_wrapped(row[0], first), *(row[i] for i in columns)] for row in rows]


def _wrapped(text: str, width: int) -> str:
    if cell_len(text) <= width:
        return text
    letters = width if cell_len(text) == len(text) else width // 2  # of double width
    return "\n".join(textwrap.wrap(text, max(1, letters)))
