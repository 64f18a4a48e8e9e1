"""Arrays in a temporary file: the system holds it in memory as long as nothing else needs that."""

import weakref
from collections.abc import Sequence
from tempfile import TemporaryFile
from threading import Lock
from typing import Any, NamedTuple

import numpy as np


class Stored(NamedTuple):
    """Where an array is in the file."""

    offset: int
    shape: tuple[int, ...]
    dtype: np.dtype


class ArrayFile:
    """A file in the folder for temporary files, which goes with this object. Threads may share it."""

    def __init__(self) -> None:
        self._file: Any = None
        self._lock = Lock()

    def add(self, *arrays: np.ndarray) -> tuple[Stored, ...]:
        """Append arrays. OSError where there is no room for them; those before stay."""
        with self._lock:
            if self._file is None:
                self._file = TemporaryFile(buffering=0)  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            return tuple(map(self._add, arrays))

    def _add(self, array: np.ndarray) -> Stored:
        stored = Stored(self._file.seek(0, 2), array.shape, array.dtype)
        left = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
        while left:
            left = left[self._file.write(left) :]
        return stored

    def read(self, stored: Sequence[Stored]) -> list[np.ndarray]:
        """The arrays again, in memory of their own. OSError if the disk fails."""
        with self._lock:
            return [self._read(one) for one in stored]

    def _read(self, stored: Stored) -> np.ndarray:
        array = np.empty(stored.shape, stored.dtype)
        left = array.reshape(-1).view(np.uint8).data
        self._file.seek(stored.offset)
        while left:
            if not (taken := self._file.readinto(left)):
                raise OSError("a temporary file is shorter than what was written to it")
            left = left[taken:]
        return array
