"""Cells: the compact parts of a category that have levels of their own.

Categories are split by place. Far things are split by direction: coordinates beyond the scene's middle are
contracted into a ball of twice its radius (Mip-NeRF 360, Eq. 10).
"""

import warnings
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Int16
from scipy.cluster.vq import kmeans2, vq

MOST = 64  # cells of a scene that is split automatically
FEWEST = 300  # Gaussians of a cell, about, at least
_OF_ONE = 1500  # Gaussians for each cell in small scenes: of fewer, streams and plans cost more than is saved
_MIDDLE = 0.8  # share of the Gaussians inside the radius from which on coordinates are contracted
_SAMPLE = 20_000  # Gaussians of a category that its centres are found from


def cells_wanted(count: int, asked: int | Literal["auto"] = "auto") -> int:
    """Cells of a scene of `count` Gaussians: as asked for, or by their number."""
    return min(MOST, count // _OF_ONE) if asked == "auto" else asked


def split_cells(
    means: Float[np.ndarray, "N 3"],
    label_ids: Int16[np.ndarray, " N"],
    count: int,
    inside: Bool[np.ndarray, " N"] | None = None,
) -> tuple[Int16[np.ndarray, " N"], dict[int, int]]:
    """Split each category into compact cells, about `count` in all; 0: every category is one cell.

    Only Gaussians `inside` count, and decide where cells are; others join the nearest. None: all are inside.

    Returns:
        The cell of each Gaussian, numbered from 0 by category, and the label id of each cell.
    """
    labels, column = np.unique(label_ids, return_inverse=True)
    places = contracted(means)
    inside = np.ones(len(means), bool) if inside is None else inside
    total = max(int(inside.sum()), 1)
    cells, label_of = np.empty(len(means), np.int16), dict[int, int]()
    label: int
    for number, label in enumerate(labels.tolist()):
        rows = np.flatnonzero(column == number)
        counted = rows[inside[rows]]
        parts = max(min(round(count * len(counted) / total), len(counted) // FEWEST), 1)
        nearest = _nearest_centres(places[rows], places[counted], parts)
        _, own = np.unique(nearest, return_inverse=True)  # a centre may be nearest to none
        cells[rows] = len(label_of) + own
        label_of |= dict.fromkeys(range(len(label_of), len(label_of) + int(own.max()) + 1), label)
    return cells, label_of


def k_means(
    places: Float[np.ndarray, "n 3"], parts: int
) -> tuple[Float[np.ndarray, "p 3"], Int[np.ndarray, " n"]]:
    """Centres, some of which may be nearest to none of the places, and the nearest one to each place."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of such centres
        centres, nearest = kmeans2(places, parts, minit="++", missing="warn", seed=0)  # pyright: ignore[reportCallIssue]
    return centres, nearest


def contracted(means: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Positions around the scene's middle, in a ball of radius 2."""
    if not len(means):
        return np.zeros((0, 3))
    centred = means.astype(np.float64) - np.median(means, 0)
    radius = np.linalg.norm(centred, axis=1)
    scaled = centred / max(float(np.quantile(radius, _MIDDLE)), 1e-12)
    far = np.maximum(np.linalg.norm(scaled, axis=1, keepdims=True), 1)
    return scaled / far * (2 - 1 / far)


def _nearest_centres(
    places: Float[np.ndarray, "n 3"], counted: Float[np.ndarray, "m 3"], parts: int
) -> Int[np.ndarray, " n"]:
    """The nearest of `parts` centres, found by k-means among those counted; always the same."""
    if parts == 1:
        return np.zeros(len(places), np.int64)
    some = counted[np.linspace(0, len(counted) - 1, min(len(counted), _SAMPLE)).astype(int)]
    parts = min(parts, len(np.unique(some, axis=0)))  # equal places are no two centres
    centres, _ = k_means(some, parts)
    return vq(places, centres, check_finite=False)[0]
