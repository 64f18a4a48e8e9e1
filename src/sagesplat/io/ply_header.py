"""Headers of PLY files (Turk 1994): byte order, comments, and the properties of each element."""

from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

_MOST, _MOST_COMMENTS = 100, 2**14  # elements; comments that are kept, the last one besides
TYPES = {  # names of the specification, and those that other software writes
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}


@dataclass(frozen=True)
class Element:
    """Rows of one kind, such as vertices, in the order of the file."""

    name: str
    count: int
    types: dict[str, str]  # property -> numpy type
    lists: bool = False  # whether it has lists, too: then its size is not known

    def dtype(self, order: str) -> np.dtype:
        """Numpy type of a row in a binary file of this byte order."""
        return np.dtype([(name, order + kind) for name, kind in self.types.items()])


@dataclass(frozen=True)
class PlyHeader:
    """The description of a PLY file's vertices."""

    order: str  # byte order: "<", ">", or "" for text
    types: dict[str, str]  # property -> numpy type
    count: int
    comments: tuple[str, ...] = ()

    @property
    def dtype(self) -> np.dtype:
        """Numpy type of a vertex in a binary file."""
        return np.dtype([(name, self.order + kind) for name, kind in self.types.items()])


def read_header(file: BinaryIO) -> PlyHeader:
    """Read the header; the file is then at the first vertex. ValueError for an invalid header."""
    order, elements, comments = read_elements(file)
    for element in elements:
        if element.name == "vertex":
            return PlyHeader(order, element.types, element.count, comments)
        raise ValueError(f"element {element.name[:60]} comes before the vertices")
    raise ValueError("its header names no format or no vertices")


def read_elements(file: BinaryIO) -> tuple[str, list[Element], tuple[str, ...]]:
    """Read the header: byte order, elements in the file's order, comments. ValueError if it is invalid."""
    if file.readline(16).strip() != b"ply":
        raise ValueError("it does not begin with 'ply'")
    order: str | None = None
    elements: list[Element] = []
    comments = []
    while (words := file.readline(1024).decode("utf-8", "replace").split())[:1] != ["end_header"]:
        match words:
            case ["format", "ascii" | "binary_little_endian" | "binary_big_endian" as name, *_]:
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[name]
            case ["element", name, number] if number.isdecimal() and len(elements) < _MOST:
                elements.append(Element(name, int(number), {}))
            case ["property", kind, name] if elements and kind in TYPES and name not in elements[-1].types:
                elements[-1].types[name] = TYPES[kind]
            case ["property", *_] if elements and elements[-1].name != "vertex":
                elements[-1] = Element(elements[-1].name, elements[-1].count, {}, lists=True)
            case ["comment" | "obj_info", *text]:
                comments[_MOST_COMMENTS:] = []
                comments.append(" ".join(text))
            case _:
                raise ValueError(f"its header breaks at {' '.join(words)[:60]!r}")
    if order is None:
        raise ValueError("its header names no format or no vertices")
    return order, elements, tuple(comments)
