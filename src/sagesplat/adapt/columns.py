"""Tables as frozen dataclasses of equal-length numpy columns, kept as CSV."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sagesplat.errors import DataError
from sagesplat.files import atomic_path

Columns = TypeVar("Columns")  # a dataclass whose fields are annotated with jaxtyping arrays [R]


def write_columns(path: Path, table: Any) -> None:
    """Write a dataclass of columns [R]: a header, one line per row, floats that read back identical."""
    names = [f.name for f in fields(table)]
    # numpy prints the shortest text that gives the same float32 again
    columns = [getattr(table, name).astype(str).tolist() for name in names]
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows(zip(*columns, strict=True))


def _types(table: type) -> dict[str, np.dtype]:
    return {f.name: np.dtype(f.type.dtypes[0]) for f in fields(table)}  # pyright: ignore


def from_rows(table: type[Columns], rows: Sequence[Mapping[str, float]]) -> Columns:
    """A table from rows that name its columns."""
    return table(
        **{name: np.array([row[name] for row in rows], dtype) for name, dtype in _types(table).items()}
    )


def read_columns(path: Path, table: type[Columns], cure: str) -> Columns:
    """The table that `write_columns` wrote. DataError where it is not one; `cure` says what to run then."""
    types = _types(table)
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file)
        cells = dict(zip(header, zip(*rows, strict=True) if rows else [()] * len(header), strict=True))
        columns = {name: np.array(cells[name], dtype=str).astype(dtype) for name, dtype in types.items()}
    except (OSError, KeyError, ValueError, OverflowError, csv.Error) as error:
        raise DataError(f"{path}: not readable as {table.__name__} ({error!r}); {cure}") from None
    return table(**columns)
