"""Evaluation: composed scenes measured on views that nothing was fitted to, beside the promise."""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32

from sagesplat.adapt.columns import read_columns, write_columns


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One row per (target, view, category) and one per (target, view) for the whole image; equal lengths."""

    target: Float32[np.ndarray, " R"]  # SSIM asked for
    view: Int32[np.ndarray, " R"]  # row in Scene.views
    label_id: Int32[np.ndarray, " R"]  # category id, -1 = unlabelled, -2 = the whole image
    level: Int32[np.ndarray, " R"]  # the level chosen, a training step; -1 for the whole image
    predicted: Float32[np.ndarray, " R"]  # promised SSIM; NaN for the whole image
    ssim: Float32[np.ndarray, " R"]  # measured on the composed scene, over the category's pixels
    psnr: Float32[np.ndarray, " R"]  # dB, the same
    full_ssim: Float32[np.ndarray, " R"]  # 3DGS at its last level, the same pixels
    full_psnr: Float32[np.ndarray, " R"]  # dB, the same
    num_pixels: Int32[np.ndarray, " R"]

    def __len__(self) -> int:
        return len(self.label_id)

    def select(self, keep: np.ndarray) -> "Evaluation":
        """The rows that a boolean mask or an index array names."""
        return Evaluation(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def write_csv(self, path: Path) -> None:
        """One line per row, a header first; floats so that they read back identical."""
        write_columns(path, self)


def read_evaluation(path: Path) -> Evaluation:
    """The table that `write_csv` wrote. DataError where it is not one."""
    return read_columns(path, Evaluation, "run `sagesplat evaluate` again")
