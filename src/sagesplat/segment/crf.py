"""Fully connected CRF (Kraehenbuehl and Koltun, NeurIPS 2011, arXiv:1210.5644): labels that follow edges.

The energy has a Potts term with two Gaussian kernels between all pairs of pixels: one of place and colour,
one of place alone. Mean-field inference filters the probabilities with both in each iteration. The first
filter is a permutohedral lattice (Adams et al., Eurographics 2010), the second is separable.
"""

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt8
from scipy.ndimage import gaussian_filter
from scipy.special import softmax

from sagesplat.kernels.jit import njit

_LEAST = 1e-5  # probability: no label is impossible
# the parameters of DeepLabV2's public checkpoints
ITERATIONS = 10
BILATERAL_WEIGHT = 4.0
BILATERAL_XY_STD, BILATERAL_RGB_STD = 67.0, 3.0  # pixels; of 0 ... 255
SPATIAL_WEIGHT = 3.0
SPATIAL_XY_STD = 1.0  # pixels


def refine(
    probabilities: Float32[np.ndarray, "C H W"], photo: UInt8[np.ndarray, "H W 3"]
) -> Float32[np.ndarray, "C H W"]:
    """The marginals after mean-field inference (Algorithm 1) from a network's probabilities.

    Kernels are normalised symmetrically, D^-1/2 K D^-1/2 with D the row sums of K, and a pixel counts itself,
    as in the authors' code, to which the weights belong.
    """
    shape = probabilities.shape
    log_p = np.log(np.maximum(probabilities, _LEAST, dtype=np.float32)).reshape(len(probabilities), -1)
    bilateral = Lattice(bilateral_features(photo))
    ones = np.ones((1, log_p.shape[1]), np.float32)
    bilateral_scale = 1 / np.sqrt(bilateral(ones))
    spatial_scale = 1 / np.sqrt(_blur(ones, shape))
    q = softmax(log_p, axis=0)
    for _ in range(ITERATIONS):
        near = spatial_scale * _blur(q * spatial_scale, shape)
        similar = bilateral_scale * bilateral(q * bilateral_scale)
        q = softmax(log_p + SPATIAL_WEIGHT * near + BILATERAL_WEIGHT * similar, axis=0)
    return q.reshape(shape)


def bilateral_features(photo: UInt8[np.ndarray, "H W 3"]) -> Float64[np.ndarray, "N 5"]:
    """x, y and RGB of each pixel in standard deviations of the bilateral kernel."""
    v, u = np.indices(photo.shape[:2])
    place = np.stack([u, v], 2) / BILATERAL_XY_STD
    return np.concatenate([place, photo / BILATERAL_RGB_STD], 2).reshape(-1, 5)


def _blur(x: Float32[np.ndarray, "C N"], shape: tuple[int, ...]) -> Float32[np.ndarray, "C N"]:
    """The Gaussian filter of place; nothing lies outside of the image."""
    images = x.reshape(-1, *shape[1:])
    return gaussian_filter(images, (0, SPATIAL_XY_STD, SPATIAL_XY_STD), mode="constant", truncate=4).reshape(
        x.shape
    )


class Lattice:
    """A Gaussian filter of points in D dimensions: lattice(x) is about K x, up to one factor for all points.

    `features` are in standard deviations: K[i, j] = exp(-|features[i] - features[j]|^2 / 2).
    """

    def __init__(self, features: Float64[np.ndarray, "N D"]):
        keys, self._weights = _embed(np.ascontiguousarray(features, np.float64))
        n, corners, d = keys.shape
        codes, steps = _pack(keys.reshape(-1, d))
        touched, corner = np.unique(codes, return_inverse=True)
        # The blur also goes through vertices that no point touches: errors are a third with those between two
        # that points do touch.
        ring = np.concatenate([touched + sign * step for step in steps for sign in (-1, 1)])
        between, times = np.unique(ring, return_counts=True)
        vertices = np.union1d(touched, between[times > 1])
        self._corner = _find(vertices, touched)[corner].reshape(n, corners)
        self._neighbours = np.stack(
            [[_find(vertices, vertices + sign * step) for sign in (-1, 1)] for step in steps]
        )

    def __call__(self, x: Float32[np.ndarray, "C N"]) -> Float32[np.ndarray, "C N"]:
        """Splat to the lattice, blur along each of its axes, slice."""
        rows = np.ascontiguousarray(x.T, np.float32)
        return _filter(rows, self._corner, self._weights, self._neighbours).T


def _pack(keys: Int32[np.ndarray, "M D"]) -> tuple[Int64[np.ndarray, " M"], list[int]]:
    """One integer for each key, and what to add to it for one step along each of the D + 1 axes.

    A step is -D in one coordinate and +1 in all others; the last coordinate, minus the sum of the rest, is
    left out of the keys.
    """
    d = keys.shape[1]
    low = keys.min(0) - 2 * (d + 1)  # room for two steps: a ring's neighbours
    spans = (keys.max(0) + 2 * (d + 1) - low + 1).astype(np.int64)
    radix = np.concatenate([[1], np.cumprod(spans[:-1])])
    assert np.prod(spans.astype(float)) < 2**62, "features lie too far apart"
    axes = 1 - (d + 1) * np.eye(d + 1, d, dtype=np.int64)
    return (keys - low).astype(np.int64) @ radix, (axes @ radix).tolist()


@njit(cache=True)
def _embed(features):  # type: ignore[no-untyped-def]
    """Corners [N, D + 1, D] of the simplex around each point, and its barycentric coordinates [N, D + 1].

    Sec. 3 of Adams et al.: the points are taken to the plane of sum zero in D + 1 dimensions. Its lattice is
    the integer points whose coordinates have one remainder modulo D + 1.
    """
    n, d = features.shape
    keys = np.empty((n, d + 1, d), np.int32)
    weights = np.zeros((n, d + 1), np.float32)
    place, base, above = np.empty(d + 1), np.empty(d + 1, np.int64), np.empty(d + 1)
    rank, share = np.empty(d + 1, np.int64), np.empty(d + 2)
    # the blur's variance, 2/3 (D + 1)^2, becomes one
    scale = (d + 1) * np.sqrt(2 / 3) / np.sqrt(np.arange(1, d + 1) * np.arange(2, d + 2))
    for i in range(n):
        total = 0.0
        for k in range(d, 0, -1):
            value = features[i, k - 1] * scale[k - 1]
            place[k] = total - k * value
            total += value
        place[0] = total
        excess = 0
        for k in range(d + 1):
            nearest = int(np.floor(place[k] / (d + 1) + 0.5))
            base[k] = nearest * (d + 1)
            above[k] = place[k] - base[k]
            excess += nearest
        for k in range(d + 1):  # how many coordinates lie farther above their base; ties by number
            rank[k] = 0
            for j in range(d + 1):
                if above[j] > above[k] or (above[j] == above[k] and j < k):
                    rank[k] += 1
        for k in range(d + 1):  # back to sum zero where rounding was least sure
            rank[k] += excess
            if rank[k] < 0:
                rank[k] += d + 1
                base[k] += d + 1
            elif rank[k] > d:
                rank[k] -= d + 1
                base[k] -= d + 1
        share[:] = 0
        for k in range(d + 1):
            value = (place[k] - base[k]) / (d + 1)
            share[d - rank[k]] += value
            share[d + 1 - rank[k]] -= value
        share[0] += 1 + share[d + 1]
        for corner in range(d + 1):
            weights[i, corner] = share[corner]
            for k in range(d):
                keys[i, corner, k] = base[k] + corner - (d + 1 if rank[k] > d - corner else 0)
    return keys, weights


@njit(cache=True)
def _find(vertices, wanted):  # type: ignore[no-untyped-def]
    """Row of each of `wanted` in `vertices`, both rising; -1 where it is none."""
    rows = np.full(len(wanted), -1, np.int32)
    row = 0
    for i in range(len(wanted)):
        while row < len(vertices) and vertices[row] < wanted[i]:
            row += 1
        if row < len(vertices) and vertices[row] == wanted[i]:
            rows[i] = row
    return rows


@njit(cache=True)
def _filter(x, corner, weights, neighbours):  # type: ignore[no-untyped-def]
    n, channels = x.shape
    corners, m = corner.shape[1], neighbours.shape[2]
    values = np.zeros((m + 1, channels), np.float32)  # the last row stays zero: neighbours that do not exist
    for i in range(n):
        for k in range(corners):
            for c in range(channels):
                values[corner[i, k], c] += weights[i, k] * x[i, c]
    blurred = np.zeros_like(values)
    for axis in range(corners):
        for v in range(m):
            a, b = neighbours[axis, 0, v], neighbours[axis, 1, v]
            for c in range(channels):
                blurred[v, c] = 0.5 * values[v, c] + 0.25 * (values[a, c] + values[b, c])
        values, blurred = blurred, values
    out = np.zeros_like(x)
    for i in range(n):
        for k in range(corners):
            for c in range(channels):
                out[i, c] += weights[i, k] * values[corner[i, k], c]
    return out
