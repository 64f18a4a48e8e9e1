"""Short tables as plain text, for `print`."""

from collections.abc import Collection, Sequence

from sagesplat.core.names import visible


def aligned(header: Sequence[str], rows: Sequence[Sequence[str]], right: Collection[int] = ()) -> str:
    """A header and rows of as many cells, in columns; those of `right` end at the same place.

    What a terminal would obey is shown (`names.visible`).
    """
    lines = [list(map(visible, line)) for line in (header, *rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if i in right else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )
