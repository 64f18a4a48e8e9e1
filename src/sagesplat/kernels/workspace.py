"""Arrays that calls of the `cpu` backend reuse."""

import math
import threading
from typing import Any

import numpy as np


class Workspace(threading.local):
    """Named arrays that successive calls reuse: a call overwrites what the one before returned.

    Each thread has its own. Fresh arrays of these sizes come from the system page by page, which takes as
    long as filling them.
    """

    def __init__(self) -> None:
        self._arrays: dict[tuple[str, np.dtype], np.ndarray] = {}
        self.gradients_of = (0, 0)  # rows and bases of the last gradients

    def take(self, name: str, *shape: int, dtype: Any = np.float32) -> np.ndarray:
        """An array of this name and dtype; it holds what was in it last."""
        key, size = (name, np.dtype(dtype)), math.prod(shape)
        if key not in self._arrays or self._arrays[key].size < size:
            self._arrays.pop(key, None)  # free it before the larger one is allocated
            self._arrays[key] = np.zeros(size + size // 8, dtype)
        return self._arrays[key][:size].reshape(shape)

    def zeros(self, name: str, *shape: int) -> np.ndarray:
        """A float32 array of this name, filled with zeros."""
        array = self.take(name, *shape)
        array.fill(0)
        return array
