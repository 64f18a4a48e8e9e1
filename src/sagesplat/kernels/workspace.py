"""Memory that calls of the `cpu` backend share."""

import math
from typing import Any

import numpy as np


class Workspace:
    """Give one to calls that follow each other: what one call returned is overwritten by the next.

    Fresh arrays of these sizes come from the system page by page, which takes as long as filling them.
    """

    def __init__(self) -> None:
        self._arrays: dict[str, np.ndarray] = {}
        self.gradients_of = (0, 0)  # rows and bases of the last gradients

    def take(self, name: str, *shape: int, dtype: Any = np.float32) -> np.ndarray:
        """An array with whatever was in it last."""
        size = math.prod(shape)
        if name not in self._arrays or self._arrays[name].size < size:
            self._arrays.pop(name, None)  # before the larger one comes
            self._arrays[name] = np.zeros(size + size // 8, dtype)
        return self._arrays[name][:size].reshape(shape)

    def zeros(self, name: str, *shape: int) -> np.ndarray:
        """The same, with zeros in it."""
        array = self.take(name, *shape)
        array.fill(0)
        return array
