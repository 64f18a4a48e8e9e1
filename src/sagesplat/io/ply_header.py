"""Headers of PLY files (Turk 1994): byte order, and the properties of a vertex."""

from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

TYPES = {  # names of the specification, and those that other software writes
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}


@dataclass(frozen=True)
class PlyHeader:
    """The description of a PLY file's vertices."""

    order: str  # byte order: "<", ">", or "" for text
    types: dict[str, str]  # property -> numpy type
    count: int

    @property
    def dtype(self) -> np.dtype:
        """Numpy type of a vertex in a binary file."""
        return np.dtype([(name, self.order + kind) for name, kind in self.types.items()])


def read_header(file: BinaryIO) -> PlyHeader:
    """Read the header; the file is then at the first vertex. ValueError for an invalid header."""
    if file.readline(16).strip() != b"ply":
        raise ValueError("it does not begin with 'ply'")
    order, count, element, types = None, -1, "", {}
    while (words := file.readline(1024).decode("utf-8", "replace").split())[:1] != ["end_header"]:
        match words:
            case ["format", "ascii" | "binary_little_endian" | "binary_big_endian" as name, *_]:
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[name]
            case ["element", element, number] if number.isdecimal():
                if element == "vertex":
                    count = int(number)
                elif count < 0:
                    raise ValueError(f"element {element} comes before the vertices")
            case ["property", *_] if element != "vertex":
                pass  # faces after the vertices are never read
            case ["property", kind, name] if kind in TYPES and name not in types:
                types[name] = TYPES[kind]
            case ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"its header breaks at {' '.join(words)[:60]!r}")
    if order is None or count < 0:
        raise ValueError("its header names no format or no vertices")
    return PlyHeader(order, types, count)
