"""Tables as frozen dataclasses of equal-length numpy columns, stored as CSV; cells of text in any CSV."""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Self, TypeVar

import numpy as np

from sagesplat.core.errors import DataError, short
from sagesplat.io.files import atomic_path

_CELL = 40  # characters of a number, at most: numpy pads all cells of a column to the widest
# what spreadsheets begin a formula with (OWASP, "CSV Injection"), and those characters in full width
_FORMULA = re.compile("'*[=+\\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")
Columns = TypeVar("Columns", bound="ColumnTable")  # its fields are annotated with jaxtyping arrays [R]


class ColumnTable:
    """Base of tables: frozen dataclasses whose fields are columns, numpy arrays [R]."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def select(self, keep: np.ndarray) -> Self:
        """The rows that a boolean mask or an index array names."""
        return type(self)(**{name: column[keep] for name, column in vars(self).items()})

    @classmethod
    def joined(cls, tables: Sequence[Self]) -> Self:
        """The rows of several tables in turn."""
        names = [f.name for f in fields(cls)]  # type: ignore
        return cls(**{name: np.concatenate([getattr(table, name) for table in tables]) for name in names})

    def write_csv(self, path: Path) -> None:
        """A header, then one line per row; floats so that they read back identical."""
        names = list(vars(self))
        # numpy prints the shortest text that reads back as the same float32
        columns = [getattr(self, name).astype(str).tolist() for name in names]
        with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(names)
            writer.writerows(zip(*columns, strict=True))


def text_cell(text: str) -> str:
    """A text as a cell that no spreadsheet takes for a formula: after a ' where it begins like one."""
    return f"'{text}" if _FORMULA.match(text) else text


def _types(table: type) -> dict[str, np.dtype]:
    return {f.name: np.dtype(f.type.dtypes[0]) for f in fields(table)}  # type: ignore


def from_rows(table: type[Columns], rows: Sequence[Mapping[str, float]]) -> Columns:
    """A table from rows: column name -> value."""
    return table(
        **{name: np.array([row[name] for row in rows], dtype) for name, dtype in _types(table).items()}
    )


def read_columns(path: Path, table: type[Columns], cure: str) -> Columns:
    """The table that `ColumnTable.write_csv` wrote. DataError for another file; `cure` is the error's advice.

    Needs at most 96 bytes of memory per byte of the file, plus `_CELL` characters per number.
    """
    types = _types(table)
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = filter(None, csv.reader(file))  # without empty lines
        cells = dict(zip(header, zip(*rows, strict=True) if rows else [()] * len(header), strict=True))
        with np.errstate(all="ignore"):  # numbers too large for float32 become infinite
            columns = {name: _column(cells[name], dtype) for name, dtype in types.items()}
    except (OSError, KeyError, ValueError, OverflowError, csv.Error) as error:
        raise DataError(f"{path}: not readable as {table.__name__} ({short(repr(error))}); {cure}") from None
    return table(**columns)


def _column(cells: Sequence[str], dtype: np.dtype) -> np.ndarray:
    if max(map(len, cells), default=0) > _CELL:
        raise ValueError(f"a number of more than {_CELL} characters")
    return np.array(cells, dtype=str).astype(dtype)
