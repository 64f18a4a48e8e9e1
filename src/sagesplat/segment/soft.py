"""Probabilities of the categories at each pixel, stored small: the most likely ones, coarse, in 8 bits."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int16
from PIL import Image

from sagesplat.core.errors import LabelError, short
from sagesplat.io.files import atomic_path
from sagesplat.io.npz import Npz
from sagesplat.scene.scene import View
from sagesplat.segment.masks import UNLABELLED, mask_path

TOP = 4  # categories kept per pixel
COARSER = 4  # photo pixels per stored pixel, each way


def soft_path(folder: Path, view: View) -> Path:
    """Where a folder keeps the probabilities of a view."""
    return mask_path(folder, view).with_suffix(".npz")


def write_soft(
    path: Path,
    probabilities: Float32[np.ndarray, "C h w"],
    ids: Int16[np.ndarray, " C"],
    photo: tuple[int, int],
) -> None:
    """Store the TOP categories of each pixel at a quarter of the photo's resolution, or at h x w if smaller.

    `ids` are the categories of the rows, `photo` is the photo's height and width, pixels.
    """
    small = _shrink(probabilities, -(-photo[0] // COARSER), -(-photo[1] // COARSER))
    order = np.argsort(-small, axis=0, kind="stable")[:TOP]
    top = (np.take_along_axis(small, order, 0).clip(0, 1) * 255).round().astype(np.uint8)
    # ids[:0] has no entry to take, not even for an empty order
    kept = np.where(top > 0, ids[order] if len(ids) else UNLABELLED, UNLABELLED).astype(np.int16)
    absent = [(0, TOP - len(top)), (0, 0), (0, 0)]
    with atomic_path(path) as temporary:
        np.savez_compressed(
            temporary,
            ids=np.pad(kept, absent, constant_values=UNLABELLED),
            probabilities=np.pad(top, absent),
        )


def read_soft(path: Path) -> tuple[Int16[np.ndarray, "K h w"], Float32[np.ndarray, "K h w"]]:
    """Categories and their probabilities, 0 ... 1, the likeliest first; -1 with 0 where there are fewer.

    The image covers the whole photo, at a resolution of its own. Raises LabelError. Memory: up to eight times
    what the file holds unpacked, and that is at most 1032 times its size.
    """
    try:
        with Npz(path, packed=True) as stored:
            ids, levels = stored["ids"], stored["probabilities"]
    except FileNotFoundError:
        raise LabelError(f"{path}: no such file; segment the photos again") from None
    except (OSError, KeyError, ValueError) as error:
        raise LabelError(f"{path}: not the probabilities of a view ({short(error)}); segment again") from None
    if ids.ndim != 3 or ids.shape != levels.shape or (ids.dtype, levels.dtype) != (np.int16, np.uint8):
        raise LabelError(
            f"{path}: not the probabilities of a view ({ids.shape}, {levels.shape}); segment again"
        )
    return ids, levels.astype(np.float32) / 255


def _shrink(rows: Float32[np.ndarray, "C h w"], height: int, width: int) -> Float32[np.ndarray, "C h2 w2"]:
    """Area means at `height` x `width` pixels, or as many as there are."""
    height, width = min(height, rows.shape[1]), min(width, rows.shape[2])
    small = np.empty((len(rows), height, width), np.float32)
    for row, out in zip(rows, small, strict=True):
        out[:] = np.asarray(Image.fromarray(row).resize((width, height), Image.Resampling.BOX))
    return small
