"""PLY files (Turk 1994): their headers (byte order, comments, properties of each element) and vertices."""

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

_MOST, _MOST_COMMENTS = 100, 2**14  # elements; comments that are kept, the last one besides
_LINE, _HEADER = 1024, 2**24  # bytes of a line that are looked at; of a header
TYPES = {  # names of the specification, and those that other software writes
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8", "half": "f2", "float16": "f2"},
}


@dataclass(frozen=True)
class Element:
    """Rows of one kind, such as vertices, in the order of the file."""

    name: str
    count: int
    types: dict[str, str]  # property -> numpy type, without lists
    row: list[tuple[str, ...]] = field(default_factory=list)  # types of all properties; a list has two

    @property
    def lists(self) -> bool:
        """Whether rows have lists: then their size is not known."""
        return any(len(kinds) > 1 for kinds in self.row)

    def dtype(self, order: str) -> np.dtype:
        """Numpy type of a row without lists in a binary file of this byte order."""
        return np.dtype([(name, order + kind) for name, kind in self.types.items()])


@dataclass(frozen=True)
class PlyHeader:
    """The description of a PLY file's vertices."""

    order: str  # byte order: "<", ">", or "" for text
    types: dict[str, str]  # property -> numpy type
    count: int
    comments: tuple[str, ...] = ()
    first: bool = True  # whether the vertices are the first element

    @property
    def dtype(self) -> np.dtype:
        """Numpy type of a vertex in a binary file."""
        return np.dtype([(name, self.order + kind) for name, kind in self.types.items()])


def read_header(file: BinaryIO) -> PlyHeader:
    """Read the header; the file is then at the first vertex. ValueError for an invalid header."""
    order, elements, comments = read_elements(file)
    for number, element in enumerate(elements):
        if element.name == "vertex":
            return PlyHeader(order, element.types, element.count, comments, first=number == 0)
        skip(file, order, element)
    raise ValueError("its header names no format or no vertices")


def skip(file: BinaryIO, order: str, element: Element) -> None:
    """Go to the end of an element; ValueError where the file ends before."""
    if element.lists or not order:
        for _ in range(element.count if element.row else 0):
            if order:
                _skip_row(file, order, element)
            elif not file.readline():
                raise ValueError(f"it ends in its element {element.name[:60]}")
        return
    size = element.count * element.dtype(order).itemsize
    if size >= 2**62:
        raise ValueError(f"{element.count} rows in its element {element.name[:60]}")
    file.seek(size, 1)


def _skip_row(file: BinaryIO, order: str, element: Element) -> None:
    """Go past a row with lists: each begins with how many values it has."""
    for count, *item in element.row:
        size = np.dtype(count).itemsize
        content = file.read(size)
        if len(content) != size:
            raise ValueError(f"it ends in its element {element.name[:60]}")
        if item:
            length = float(np.frombuffer(content, order + count)[0])
            if not 0 <= length < 2**32:
                raise ValueError(f"a list of {length:g} values in its element {element.name[:60]}")
            file.seek(int(length) * np.dtype(item[0]).itemsize, 1)


def read_vertices(path: Path, file: BinaryIO, header: PlyHeader) -> dict[str, np.ndarray]:
    """The vertices, text or binary: property -> column [N]. ValueError where the file ends before them."""
    types, count, row = header.types, header.count, header.dtype
    # In text, a value takes at least a digit and a separator; the last line end may be missing.
    smallest = row.itemsize * count if header.order else 2 * len(types) * count - 1
    if smallest > path.stat().st_size - file.tell():
        raise ValueError(f"{count} points announced, but the file ends before them")
    table: np.ndarray
    if header.order:
        table = np.fromfile(file, row, count)
        return {name: table[name] for name in types}
    # With named columns numpy allocates only these, however long the first line is.
    columns = np.dtype([(name, float) for name in types])
    with warnings.catch_warnings(action="ignore"):  # about files without numbers; see the count
        table = np.loadtxt(file, columns, comments=None, max_rows=count, ndmin=1, encoding="latin1")
    if len(table) != count:
        raise ValueError(f"{count} points of {len(types)} values announced, but there are {len(table)}")
    return {name: table[name] for name in types}


def read_elements(file: BinaryIO) -> tuple[str, list[Element], tuple[str, ...]]:
    """Read the header: byte order, elements in the file's order, comments. ValueError if it is invalid."""
    if file.readline(16).strip() != b"ply":
        raise ValueError("it does not begin with 'ply'")
    order: str | None = None
    elements: list[Element] = []
    comments = []
    while (words := _line(file).split())[:1] != ["end_header"]:
        match words:
            case ["format", "ascii" | "binary_little_endian" | "binary_big_endian" as name, *_]:
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[name]
            case ["element", name, number] if number.isdecimal() and len(elements) < _MOST:
                elements.append(Element(name, int(number), {}))
            case ["property", kind, name] if elements and kind in TYPES and name not in elements[-1].types:
                elements[-1].types[name] = TYPES[kind]
                elements[-1].row.append((TYPES[kind],))
            case ["property", "list", count, kind, _] if (
                elements and elements[-1].name != "vertex" and {count, kind} <= TYPES.keys()
            ):
                elements[-1].row.append((TYPES[count], TYPES[kind]))
            case ["comment" | "obj_info", *text]:
                comments[_MOST_COMMENTS:] = []
                comments.append(" ".join(text))
            case _:
                raise ValueError(f"its header breaks at {' '.join(words)[:60]!r}")
    if order is None:
        raise ValueError("its header names no format or no vertices")
    return order, elements, tuple(comments)


def _line(file: BinaryIO) -> str:
    """The beginning of the next line; comments may be of any length."""
    line = part = file.readline(_LINE)
    while len(part) == _LINE and not part.endswith(b"\n"):
        part = file.readline(_LINE)
        if file.tell() > _HEADER:
            raise ValueError(f"its header has more than {_HEADER:,} bytes")
    return line.decode("utf-8", "replace")
