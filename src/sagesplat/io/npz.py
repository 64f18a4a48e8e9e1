"""Reads untrusted .npz files: no pickles, and memory bounded by the file's size."""

import math
import zipfile
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np

_KINDS = "biufU"  # numpy kinds that are read: numbers and text


class Npz:
    """The arrays of an .npz file by name, each read on access.

    All arrays together need no more memory than the file's size: it must not be compressed. OSError if the
    file cannot be opened, KeyError for a missing array, ValueError with a short message for any other defect.
    """

    def __init__(self, path: Path):
        most = path.stat().st_size
        try:
            self._file = zipfile.ZipFile(path)
        except OSError:
            raise
        except Exception as error:  # zipfile raises errors of many kinds for damaged files
            raise ValueError(f"no .npz file: {str(error)[:100]}") from None
        infos = self._file.infolist()
        self._infos = {info.filename.removesuffix(".npy"): info for info in infos}
        try:
            _check(infos, most)
        except ValueError:
            self._file.close()
            raise

    def __enter__(self) -> "Npz":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    @property
    def names(self) -> list[str]:
        """Names of the arrays, in the file's order."""
        return list(self._infos)

    def __contains__(self, name: str) -> bool:
        return name in self._infos

    def __getitem__(self, name: str) -> np.ndarray[Any, Any]:
        info = self._infos[name]
        try:
            opened: Any = self._file.open(info)  # typeshed does not know `readinto`
            with opened as member:
                shape, fortran, dtype = _header(member, info.file_size)
                raw = np.empty(info.file_size - member.tell(), np.uint8)
                if member.readinto(raw.data) != len(raw):
                    raise ValueError("cut short")
            return raw.view(dtype).reshape(shape, order="F" if fortran else "C")
        except Exception as error:  # numpy and zlib raise many kinds, too
            raise ValueError(f"array {name[:40]!r} is damaged: {str(error)[:100]}") from None


def _header(member: IO[bytes], size: int) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, Fortran order and dtype; ValueError if the member's size is not the announced one, which is
    allocated up front.
    """
    if np.lib.format.read_magic(member) != (1, 0):
        raise ValueError("not version 1.0 of the format")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(member)
    if dtype.kind not in _KINDS or not dtype.itemsize:
        raise ValueError(f"type {dtype.str}")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != size - member.tell():
        raise ValueError("its shape does not fit its size")
    return shape, fortran, dtype


def _check(infos: list[zipfile.ZipInfo], most: int) -> None:
    """ValueError if members are compressed, overlap, or announce more than they can hold."""
    if sum(info.compress_size for info in infos) > most:
        raise ValueError("its members are larger than the file")
    for info in infos:
        if info.compress_type != zipfile.ZIP_STORED or info.file_size > info.compress_size:
            raise ValueError(f"{info.filename[:40]!r} is compressed, or larger than it can be")
