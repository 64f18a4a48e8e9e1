"""Offsets beside a splat file: FILE.offset.xyz, one line such as "412346 5312346 188", as Pix4D writes them.

They are to be added to the positions of the file. Splat formats hold float32 or less, which is too coarse for
coordinates in UTM.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from sagesplat.core.errors import DataError
from sagesplat.core.geometry import NO_OFFSET, Position, offset_text
from sagesplat.formats.splat import Splat
from sagesplat.io.files import atomic_path, regular
from sagesplat.io.ply_header import read_header

_MOST = 1000  # bytes


def beside(path: Path) -> Path:
    """The file with the offset of a splat file."""
    return path.with_name(path.name + ".offset.xyz")


def write_offset(path: Path, offset: Position) -> None:
    """Write the offset of the splat file `path` beside it; without one, remove that of an earlier file."""
    if not any(offset):
        beside(path).unlink(missing_ok=True)
        return
    with atomic_path(beside(path)) as temporary:
        temporary.write_text(f"{offset_text(offset)}\n", encoding="ascii")


def read_offset(path: Path) -> Position:
    """The offset that is beside the splat file `path`; zeros without one. DataError where it is none."""
    file = beside(path)
    if not file.exists():
        return NO_OFFSET
    cure = "delete it, or write three numbers such as 412346 5312346 188"
    try:
        with regular(file).open("rb") as opened:
            words = opened.read(_MOST).split()
        x, y, z = (float(word) for word in words)
    except OSError as error:
        raise DataError(f"{file}: cannot be read ({error.strerror}); {cure}") from None
    except ValueError:
        raise DataError(f"{file}: no offset; {cure}") from None
    if not np.isfinite([x, y, z]).all():
        raise DataError(f"{file}: an offset that is not finite; {cure}")
    return x, y, z


def with_offset(splat: Splat, path: Path) -> Splat:
    """The splat with the offset that is beside its file `path` added to its own."""
    x, y, z = np.add(splat.offset, read_offset(path)).tolist()
    return replace(splat, offset=(x, y, z))


def write_doubles(path: Path, offset: Position) -> None:
    """Make the positions of a PLY that was just written doubles, with the offset added: none is beside it."""
    with path.open("rb") as file:
        header = read_header(file)
        start = file.tell()
        rows = np.fromfile(file, header.dtype, header.count)
        file.seek(0)
        head = file.read(start)
    kinds = [(name, "<f8" if name in "xyz" else header.dtype[name]) for name in header.dtype.names or ()]
    wide = rows.astype(kinds)
    for axis, by in zip("xyz", offset, strict=True):
        wide[axis] += by
        head = head.replace(f"property float {axis}\n".encode(), f"property double {axis}\n".encode())
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(head)
        wide.tofile(file)
    write_offset(path, NO_OFFSET)
