"""Writes SOG version 2: PlayCanvas's splats as lossless WebP images; `sog.py` has the layout.

Scales, sh0 and harmonics get codebooks of 256 values by Lloyd's algorithm. Harmonics are rows of a palette of
up to 65,536, found in two steps: clusters of all Gaussians, then of each cluster's own. That takes N sqrt(K)
distances in place of N K.
"""

import io
import json
import math
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int64
from PIL import Image
from scipy.sparse import csr_array

from sagesplat import __version__
from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import morton_order
from sagesplat.core.sh import BASES
from sagesplat.formats.labels import as_json, sidecar, write_or_remove_labels
from sagesplat.formats.quantisation import OTHERS
from sagesplat.formats.sog import META
from sagesplat.formats.splat import SplatWriter, check_writable
from sagesplat.io.files import atomic_folder, atomic_path

GENERATOR = f"sagesplat {__version__}"
_WIDEST = 16383  # pixels of a WebP
_PALETTE = 64  # times 1024 rows, at most
_COARSE = 256  # clusters of the first step
_SAMPLE = 2**15  # Gaussians that these are found from
_ROUNDS = 8  # of Lloyd's algorithm
_BINS = 2**16  # of values, for codebooks
_BLOCK = 2**14  # Gaussians whose distances are computed at a time


def write_sog(
    path: Path,
    g: Gaussians,
    names: Mapping[int, str] | None = None,
    *,
    parents: Mapping[int, str] | None = None,
    antialiased: bool = False,
) -> int:
    """Write Gaussians as a SOG: an archive, or for a path `.../meta.json` its folder, which is replaced.

    Rows are sorted by category and then in Morton order. Labels, if there are any, go into a sidecar beside
    it (`formats/labels.py`). The same input gives the same bytes.

    Args:
        path: The .sog file or meta.json to write.
        g: N Gaussians in COLMAP's axes, on any device.
        names: Category names by label id, for the sidecar.
        parents: Names of the categories that instances are of, by the instance's label id; likewise.
        antialiased: How the scene was trained; a flag for viewers.

    Returns:
        The size in bytes, without the sidecar.

    Raises:
        DataError: For NaN or Inf, a quaternion of zeros, no Gaussians, or more than WebP images hold.
    """
    g = g.detach().to("cpu")
    g = g.select(torch.from_numpy(sog_order(g)))
    files = sog_files(g, name=str(path), antialiased=antialiased)
    if path.name == META:
        with atomic_folder(path.parent) as fresh:
            for name, content in with_labels_beside(files, g, names or {}, parents or {}).items():
                (fresh / name).write_bytes(content)
        return sum(map(len, files.values()))
    nbytes = archived(path, files.items())
    write_or_remove_labels(path, g.label_ids, names or {}, parents or {})
    return nbytes


def archived(path: Path, files: Iterable[tuple[str, bytes]]) -> int:
    """Write names and contents as a ZIP archive, stored, atomically; returns its size in bytes."""
    with atomic_path(path) as temporary:
        with zipfile.ZipFile(temporary, "w") as archive:
            for name, content in files:
                archive.writestr(zipfile.ZipInfo(name), content)  # of 1980: no time stamp
        return temporary.stat().st_size


def with_labels_beside(
    files: Mapping[str, bytes], g: Gaussians, names: Mapping[int, str], parents: Mapping[int, str]
) -> dict[str, bytes]:
    """The files of a SOG scene by name, and its sidecar where rows have labels."""
    if not bool((g.label_ids >= 0).any()):
        return dict(files)
    return {**files, sidecar(Path(META)).name: as_json(g.label_ids, names, parents)}


def sog_order(g: Gaussians) -> Int64[np.ndarray, " N"]:
    """Rows by category, and in Morton order in each: images pack well, and labels are few runs."""
    order = morton_order(g.means.numpy())
    return order[np.argsort(g.label_ids.numpy()[order], kind="stable")]


def sog_files(g: Gaussians, *, name: str = "SOG", antialiased: bool = False) -> dict[str, bytes]:
    """The files of a SOG scene by name, of Gaussians on the CPU in their order; errors as in `write_sog`."""
    if not 0 < len(g) <= (_WIDEST - 4) ** 2:
        raise DataError(
            f"{name}: {len(g)} Gaussians; a SOG holds 1 to {(_WIDEST - 4) ** 2}, write other levels"
        )
    check_writable(g, name)
    count = len(g)
    width = 4 * math.ceil(math.sqrt(count) / 4)

    def webp(values: np.ndarray) -> bytes:
        """An image of values [count, 3 or 4]."""
        pixels = np.full((math.ceil(count / width / 4) * 4 * width, 4), 255, np.uint8)
        pixels[:count, : values.shape[1]] = values
        return _webp(pixels.reshape(-1, width, 4))

    fixed, ends = _positions(g.means.double().numpy())
    scales, scale_book = _coded(g.log_scales.numpy())
    colours, colour_book = _coded(g.sh0[:, 0].numpy())
    alphas = (torch.sigmoid(g.logit_opacities) * 255).round().numpy()[:, None]
    files = {
        "means_l.webp": webp(fixed & 255),
        "means_u.webp": webp(fixed >> 8),
        "quats.webp": webp(_rotations(g.quats.double().numpy())),
        "scales.webp": webp(scales),
        "sh0.webp": webp(np.concatenate([colours, alphas], 1)),
    }
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": GENERATOR}, "count": count}
    meta |= {"antialias": True, "model": "antialiased"} if antialiased else {}
    meta["means"] = ends | {"files": ["means_l.webp", "means_u.webp"]}
    meta["scales"] = {"codebook": scale_book, "files": ["scales.webp"]}
    meta["quats"] = {"files": ["quats.webp"]}
    meta["sh0"] = {"codebook": colour_book, "files": ["sh0.webp"]}
    if bases := g.shN.shape[1]:
        palette, rows = _palette(g.shN.reshape(count, -1).numpy())
        codes, book = _coded(palette)
        files["shN_centroids.webp"] = _webp(_centroids(codes, bases))
        files["shN_labels.webp"] = webp(np.stack([rows & 255, rows >> 8, 0 * rows], 1))
        names = ["shN_centroids.webp", "shN_labels.webp"]
        meta["shN"] = {"count": len(palette), "bands": BASES.index(bases), "codebook": book, "files": names}
    return {META: json.dumps(meta).encode(), **files}


def _webp(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "WEBP", lossless=True, exact=True, quality=75, method=4)
    return buffer.getvalue()


def _positions(means: np.ndarray) -> tuple[np.ndarray, dict[str, list[float]]]:
    """Positions as integers of 16 bits [N, 3], and the ends of their logarithms."""
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    fixed = np.rint((logs - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    return fixed, {"mins": low.tolist(), "maxs": high.tolist()}


def _rotations(quats: np.ndarray) -> np.ndarray:
    """Pixels [N, 4] from quaternions wxyz of any length."""
    rows, largest = np.arange(len(quats)), np.abs(quats).argmax(1)
    unit = quats / (np.linalg.norm(quats, axis=1) * np.sign(quats[rows, largest]))[:, None]
    others = np.take_along_axis(unit, OTHERS[largest], axis=1)
    return np.concatenate([np.rint((others * 2**0.5 + 1) * 127.5).clip(0, 255), 252 + largest[:, None]], 1)


def _coded(values: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """Rows of a codebook of at most 256 values for each value, and the codebook.

    Lloyd's algorithm on a histogram, from quantiles and equal steps, half each: rare values stay within such
    a step. At most 256 different values are kept as they are.
    """
    book = np.unique(values[:: max(1, values.size // _SAMPLE)])
    if len(book) > 256 or len(book := np.unique(values)) > 256:
        book = _codebook(values.ravel().astype(np.float64))
    codes = np.searchsorted((book[1:].astype(np.float64) + book[:-1]) / 2, values)
    return codes.astype(np.uint8), book.astype(np.float32).tolist()


def _codebook(values: np.ndarray) -> np.ndarray:
    low, high = values.min(), values.max()
    bins = ((values - low) / (high - low) * _BINS).astype(np.int64).clip(0, _BINS - 1)
    counts, sums = np.bincount(bins, minlength=_BINS), np.bincount(bins, values, _BINS)
    counts, sums = counts[counts > 0], sums[counts > 0]
    means, quantiles = sums / counts, np.quantile(values, np.linspace(0, 1, 128))
    book = np.unique(np.concatenate([quantiles, np.linspace(low, high, 128)]))
    for _ in range(_ROUNDS):
        nearest = np.searchsorted((book[1:] + book[:-1]) / 2, means)
        totals = np.bincount(nearest, counts, len(book))
        book = (np.bincount(nearest, sums, len(book)) / totals.clip(1))[totals > 0]
    return book


def _centroids(codes: np.ndarray, bases: int) -> np.ndarray:
    """The palette's image: 64 rows of it, each of `bases` pixels, in a row of pixels."""
    height = math.ceil(len(codes) / 64)
    pixels = np.full((height * 64, bases, 4), 255, np.uint8)
    pixels[: len(codes), :, :3] = codes.reshape(-1, bases, 3)
    return pixels.reshape(height, 64 * bases, 4)


def _palette(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A palette [K, D] for points [N, D], and the row of each."""
    size = round(min(_PALETTE, 2 ** math.floor(math.log2(len(points) / 1024))) * 1024)
    different, inverse = np.unique(points, axis=0, return_inverse=True)
    if len(different) <= size:
        return different, inverse
    rng = np.random.default_rng(0)
    coarse = _clusters(points[rng.permutation(len(points))[:_SAMPLE]], min(_COARSE, size), rng)
    of, distances = _nearest(different, coarse)
    spread = np.bincount(of, np.sqrt(distances), len(coarse))  # a cluster gets more rows where it is wide
    shares = _shares(spread, np.bincount(of, minlength=len(coarse)), size)
    rows, palette, begun = np.empty(len(different), np.int64), [], 0
    for i, share in enumerate(shares):
        if share:
            members = np.flatnonzero(of == i)
            palette.append(_clusters(different[members], share, rng))
            rows[members] = begun + _nearest(different[members], palette[-1])[0]
            begun += len(palette[-1])
    return np.concatenate(palette), rows[inverse]


def _shares(weights: np.ndarray, most: np.ndarray, size: int) -> np.ndarray:
    """Whole numbers [C] in proportion to weights, from 1 to `most`, of `size` in total or less."""
    shares = np.minimum(most, 1)
    for _ in range(_ROUNDS):  # what some cannot take is for the others
        room = np.where(shares < most, weights + 1e-12, 0)
        shares = np.minimum(shares + (size - shares.sum()) * room / max(room.sum(), 1e-12), most)
    return np.maximum(shares.astype(np.int64), np.minimum(most, 1))


def _clusters(points: np.ndarray, size: int, rng: np.random.Generator) -> np.ndarray:
    """At most `size` centres of points, by Lloyd's algorithm."""
    if size >= len(points):
        return points
    centres = points[rng.permutation(len(points))[:size]]
    for _ in range(_ROUNDS if size > 1 else 1):
        of = _nearest(points, centres)[0]
        members = csr_array(
            (np.ones(len(points), np.float32), (of, np.arange(len(points)))), (len(centres), len(points))
        )
        totals = np.bincount(of, minlength=len(centres))
        centres = (members @ points)[totals > 0] / totals[totals > 0, None].astype(np.float32)
    return centres


def _nearest(points: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest centre of each point, and the squared distance."""
    lengths = np.square(centres).sum(1)
    of, distances = np.empty(len(points), np.int64), np.empty(len(points))
    for start in range(0, len(points), _BLOCK):
        block = points[start : start + _BLOCK]
        table = lengths - 2 * (block @ centres.T)
        nearest = table.argmin(1)
        of[start : start + _BLOCK] = nearest
        found = table[np.arange(len(block)), nearest] + np.square(block).sum(1)
        distances[start : start + _BLOCK] = found.clip(0)
    return of, distances


WRITER = SplatWriter(
    lambda path, g, names, parents, antialiased: write_sog(
        path, g, names, parents=parents, antialiased=antialiased
    )
)
