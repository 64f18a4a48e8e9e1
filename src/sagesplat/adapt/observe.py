"""Observations: the quality of each category at each level, view by view."""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32

from sagesplat.adapt.columns import read_columns, write_columns

TOTAL = -2  # label id of the rows that average over all pixels of the image


@dataclass(frozen=True, eq=False)
class Observations:
    """One row per (category, level, view); columns of equal length."""

    label_id: Int32[np.ndarray, " R"]  # category id, -1 = unlabelled, -2 = the whole image
    level: Int32[np.ndarray, " R"]  # training step of the level
    view: Int32[np.ndarray, " R"]  # row in Scene.views
    distance: Float32[np.ndarray, " R"]  # d_min of method A, world units; NaN where nothing is in sight
    ssim: Float32[np.ndarray, " R"]  # mean of the SSIM map over the category's pixels
    ssim_eroded: Float32[np.ndarray, " R"]  # the same over the mask eroded by 5 px; NaN if nothing is left
    psnr: Float32[np.ndarray, " R"]  # dB over the category's pixels
    num_pixels: Int32[np.ndarray, " R"]

    def __len__(self) -> int:
        return len(self.label_id)

    def select(self, keep: np.ndarray) -> "Observations":
        """The rows that a boolean mask or an index array names."""
        return Observations(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def write_csv(self, path: Path) -> None:
        """One line per row, a header first; floats so that they read back identical."""
        write_columns(path, self)


def read_observations(path: Path) -> Observations:
    """The table that `write_csv` wrote. DataError where it is not one."""
    return read_columns(path, Observations, "run `sagesplat observe` again")
