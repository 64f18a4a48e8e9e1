"""Reads numpy's .npz files that may come from anybody: no pickles, and no more memory than they can fill."""

import math
import zipfile
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

_DEFLATE = 1032  # times its size is all that a deflate stream can hold
_KINDS = "biufU"  # of numbers, and of text


class Npz:
    """The arrays of an .npz file by name, each read when it is asked for.

    Memory for all of them together stays within the file's size; `packed` files may be compressed, and then
    within 1032 times the size. OSError where there is no such file, KeyError where there is no such array,
    ValueError with a short line for everything else.
    """

    def __init__(self, path: Path, *, packed: bool = False):
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
            _check(infos, most, packed)
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
        """Of the arrays, in the file's order."""
        return list(self._infos)

    def __getitem__(self, name: str) -> np.ndarray[Any, Any]:
        info = self._infos[name]
        try:
            self._check_header(info)
            with self._file.open(info) as member:
                return np.lib.format.read_array(member, allow_pickle=False)
        except Exception as error:  # of many kinds too
            raise ValueError(f"array {name[:40]!r} is damaged: {str(error)[:100]}") from None

    def _check_header(self, info: zipfile.ZipInfo) -> None:
        """ValueError where an array is not as large as its header says, which numpy allocates first."""
        with self._file.open(info) as member:
            if np.lib.format.read_magic(member) != (1, 0):
                raise ValueError("not version 1.0 of the format")
            shape, _, dtype = np.lib.format.read_array_header_1_0(member)
            if dtype.kind not in _KINDS or not dtype.itemsize:
                raise ValueError(f"type {dtype.str}")
            if (
                min(shape, default=0) < 0
                or math.prod(shape) * dtype.itemsize != info.file_size - member.tell()
            ):
                raise ValueError("its shape does not fit its size")


def _check(infos: list[zipfile.ZipInfo], most: int, packed: bool) -> None:
    """ValueError where members are packed in other ways, overlap, or promise more than they can hold."""
    allowed = {zipfile.ZIP_STORED: 1} | ({zipfile.ZIP_DEFLATED: _DEFLATE} if packed else {})
    if sum(info.compress_size for info in infos) > most:
        raise ValueError("its members are larger than the file")
    for info in infos:
        if info.file_size > allowed.get(info.compress_type, 0) * info.compress_size:
            raise ValueError(f"{info.filename[:40]!r} is compressed, or larger than it can be")
