"""Merges Gaussians by their moments: fewer Gaussians that paint nearly the same, without training.

Pairs of neighbours merge, those of the least cost first, until the wanted number is left. A merged Gaussian
has the mean and the covariance of the two as a mixture, weighted by opacity times area, and the opacity that
keeps that product, at most 1 (as hierarchical 3DGS, arXiv:2406.12080). The cost of a pair is what its merger
changes in the pictures: the squared difference in colour and opacity between the two and the merged one,
integrated over space, blurred by a part of the size, and weighted by how visible the two are in renders.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int16, Int64
from numba import prange
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from sagesplat.core.gaussians import Gaussians
from sagesplat.core.sh import sh0_to_rgb
from sagesplat.kernels.jit import njit

_NEIGHBOURS = 12
_ROUND = 0.35  # pairs that merge in a round at most, as a share of the Gaussians
_BLUR = 0.25  # variance that differences are blurred by, as a share of the merged one's area
_HIDDEN = 1e-3  # visibility of what no render shows
_OPACITY = 2.0  # weight of a difference in opacity, beside one in a colour channel
_SORTED = 2  # cheapest pairs that are sorted at a time, for each that merges
_SAMPLED = 16  # one of so many pairs is looked at to find which are the cheapest
_ITSELF = 8**0.5  # volume of a Gaussian over its overlap with itself: covariances add
_CLOSED = 0.9999  # opacity of what hides all behind it, so that its logit is finite
_UPPER = [0, 1, 2, 4, 5, 8]  # entries of a symmetric 3 x 3 matrix that are stored
_WHOLE = [0, 1, 2, 1, 3, 4, 2, 4, 5]


@dataclass(frozen=True, eq=False)
class Merged:
    """What Gaussians merged into."""

    gaussians: Gaussians
    into: Int64[np.ndarray, " M"]  # row of `gaussians` that each of those before is now part of


@dataclass(frozen=True, eq=False)
class _Mixture:
    means: Float64[np.ndarray, "N 3"]
    covs: Float64[np.ndarray, "N 6"]  # upper triangle
    opacities: Float64[np.ndarray, " N"]
    sh: Float32[np.ndarray, "N C"]  # all SH coefficients
    labels: Int16[np.ndarray, " N"]
    mass: Float64[np.ndarray, " N"]  # opacity times area
    visible: Float64[np.ndarray, " N"]  # share of the mass that renders show, relative to the mean
    origin: Int64[np.ndarray, " N"]  # row before, -1: merged
    into: Int64[np.ndarray, " M"]

    def __len__(self) -> int:
        return len(self.means)


def merge(g: Gaussians, weights: Float32[np.ndarray, " N"], counts: Sequence[int]) -> Iterator[Merged]:
    """Merge Gaussians down to each of `counts` in turn; those of different categories never merge.

    Args:
        g: N Gaussians on the CPU.
        weights: Blending weight of each over some renders (`importance` by "weight").
        counts: Descending, each at least 1.

    Yields:
        For each count as many Gaussians, or all there are, or one of each category. Those that did not merge
        keep their values.
    """
    mixture = _mixture(g, weights)
    for count in counts:
        while len(mixture) > count:
            fewer = _merge_round(mixture, len(mixture) - count)
            if fewer is None:
                break
            mixture = fewer
        yield Merged(_gaussians(mixture, g), mixture.into)


def _mixture(g: Gaussians, weights: np.ndarray) -> _Mixture:
    n = len(g)
    scales = np.exp(g.log_scales.numpy().astype(np.float64))
    axes = Rotation.from_quat(np.roll(g.quats.numpy(), -1, axis=1)).as_matrix() * scales[:, None]
    covs = (axes @ axes.swapaxes(1, 2)).reshape(n, 9)[:, _UPPER]
    opacities = torch.sigmoid(g.logit_opacities).numpy().astype(np.float64)
    mass = opacities * _areas(covs)
    shown = weights * (mass.sum() / max(float(weights.sum()), 1e-30)) / np.maximum(mass, 1e-300)
    sh = torch.cat([g.sh0, g.shN], 1).reshape(n, -1).numpy()
    rows = np.arange(n)
    return _Mixture(
        g.means.numpy().astype(np.float64), covs, opacities, sh, g.label_ids.numpy(), mass,
        np.maximum(shown, _HIDDEN), rows, rows,
    )  # fmt: skip


def _gaussians(mixture: _Mixture, before: Gaussians) -> Gaussians:
    new = np.flatnonzero(mixture.origin < 0)
    variances, axes = np.linalg.eigh(mixture.covs[new][:, _WHOLE].reshape(-1, 3, 3))
    axes[np.linalg.det(axes) < 0, :, 0] *= -1  # a rotation, not a reflection
    quats = np.roll(Rotation.from_matrix(axes).as_quat(), 1, axis=1) if len(new) else np.zeros((0, 4))
    opacities = mixture.opacities[new].clip(1 - _CLOSED, _CLOSED)
    smallest = variances.max(1, keepdims=True) * 1e-12
    sh = mixture.sh[new].reshape(len(new), mixture.sh.shape[1] // 3, 3)
    merged = {
        "means": mixture.means[new],
        "quats": quats,
        "log_scales": np.log(np.maximum(variances, np.maximum(smallest, 1e-30))) / 2,
        "logit_opacities": np.log(opacities / (1 - opacities)),
        "sh0": sh[:, :1],
        "shN": sh[:, 1:],
    }
    values, same = dict[str, torch.Tensor](), torch.from_numpy(np.maximum(mixture.origin, 0))
    for name, column in merged.items():
        values[name] = getattr(before, name)[same]
        values[name][torch.from_numpy(new)] = torch.from_numpy(column.astype(np.float32))
    return Gaussians(**values, label_ids=torch.from_numpy(mixture.labels))


def _merge_round(m: _Mixture, most: int) -> _Mixture | None:
    """Merge the cheapest pairs of neighbours, each Gaussian at most once and at most `most` pairs.

    What merged stands where the first of the two stood: neighbours in space stay neighbours in memory.
    None where every category has one Gaussian left.
    """
    first, second = _neighbours(m.means, m.labels)
    if not len(first):
        return None
    rgb = sh0_to_rgb(torch.from_numpy(m.sh[:, :3])).numpy().astype(np.float64)
    cost = _costs(first, second, m.means, m.covs, m.opacities, rgb, m.mass, m.visible)
    pairs = _cheapest(cost, first, second, len(m), min(most, max(1, int(_ROUND * len(m)))))
    i, j = first[pairs], second[pairs]
    del first, second, cost, rgb
    mass = m.mass[i] + m.mass[j]
    share = (m.mass[i] / mass)[:, None]
    apart = m.means[i] - m.means[j]
    spread = (apart[:, :, None] * apart[:, None]).reshape(-1, 9)[:, _UPPER]
    covs = share * m.covs[i] + (1 - share) * m.covs[j] + share * (1 - share) * spread
    narrow = share.astype(np.float32)
    merged = {
        "means": share * m.means[i] + (1 - share) * m.means[j],
        "covs": covs,
        "opacities": np.minimum(mass / np.maximum(_areas(covs), 1e-300), 1),
        "sh": narrow * m.sh[i] + (1 - narrow) * m.sh[j],
        "labels": m.labels[i],
        "mass": mass,
        "visible": (m.visible[i] * m.mass[i] + m.visible[j] * m.mass[j]) / mass,
        "origin": -1,
    }
    kept = np.ones(len(m), bool)
    kept[j] = False
    row = np.cumsum(kept) - 1
    row[j] = row[i]
    columns = dict[str, Any]()
    for name, values in merged.items():
        columns[name] = getattr(m, name)[kept]
        columns[name][row[i]] = values
    return _Mixture(**columns, into=row[m.into])


def _neighbours(means: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of close rows of one label (int64 [P] each), every pair once."""
    pairs = [(np.zeros(0, np.int64),) * 2]
    for label in np.unique(labels):
        rows = np.flatnonzero(labels == label)
        first, second = _neighbours_in(means[rows])
        pairs.append((first, second) if len(rows) == len(labels) else (rows[first], rows[second]))
    first, second = (np.concatenate(some) for some in zip(*pairs, strict=True))
    return first, second


def _neighbours_in(means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same among all rows: at least one pair of two rows or more."""
    n = len(means)
    near = np.asarray(KDTree(means).query(means, min(_NEIGHBOURS + 1, n), workers=-1)[1]).reshape(n, -1)
    first, second = _pairs(near.astype(np.int32))
    if not len(first):  # more than a neighbourhood of them in one place
        return np.arange(n - 1), np.arange(1, n)
    return first, second


def _areas(covs: np.ndarray) -> np.ndarray:
    """About the mean area that Gaussians cover, without pi: the root of the sum of the 2 x 2 minors."""
    a, b, c, d, e, f = covs.T
    return np.sqrt(np.maximum(a * d - b * b + a * f - c * c + d * f - e * e, 0))


@njit(forceinline=True, cache=True)
def _pair_of(near, i, j):  # type: ignore[no-untyped-def]
    """Whether row i is the one to name its pair with j: of two that are near each other, the first is."""
    if i < j:
        return True
    for other in near[j]:
        if other == i:
            return False
    return i != j


@njit(parallel=True, cache=True)
def _pairs(near):  # type: ignore[no-untyped-def]
    """The pairs of each row [n] and the rows near it, near [n, k]; every pair once, the lower row first."""
    starts = np.zeros(len(near) + 1, np.int64)
    for i in prange(len(near)):
        for j in near[i]:
            starts[i + 1] += _pair_of(near, i, j)
    starts = np.cumsum(starts)
    first, second = np.empty(starts[-1], np.int64), np.empty(starts[-1], np.int64)
    for i in prange(len(near)):
        at = starts[i]
        for j in near[i]:
            if _pair_of(near, i, j):
                first[at], second[at] = min(i, j), max(i, j)
                at += 1
    return first, second


def _cheapest(cost: np.ndarray, first: np.ndarray, second: np.ndarray, count: int, most: int) -> np.ndarray:
    """Numbers of the pairs that merge, the cheapest first, at most `most` and no row of `count` twice."""
    used, chosen, found = np.zeros(count, bool), np.empty(most, np.int64), 0
    left = np.arange(len(cost))
    cost = np.where(np.isnan(cost), np.inf, cost)  # of the hugest: last, and never below a quantile otherwise
    while found < most and len(left):  # to sort some at a time saves what their mergers rule out
        costs = cost[left]
        cheap = costs <= np.quantile(costs[::_SAMPLED], min(_SORTED * most / len(left), 1), method="lower")
        found = _choose(
            left[cheap][np.argsort(costs[cheap], kind="stable")], first, second, used, chosen, found
        )
        left = left[~cheap]
        left = left[~used[first[left]] & ~used[second[left]]]
    return chosen[:found]


@njit(cache=True)
def _choose(order, first, second, used, chosen, n):  # type: ignore[no-untyped-def]
    """Take pairs in the given order, without a row that is `used`, until `chosen` is full; how many are."""
    for pair in order:
        if n == len(chosen):
            break
        if not used[first[pair]] and not used[second[pair]]:
            used[first[pair]] = used[second[pair]] = True
            chosen[n] = pair
            n += 1
    return n


@njit(cache=True, fastmath=True)
def _area(c):  # type: ignore[no-untyped-def]
    minors = c[0] * c[3] - c[1] * c[1] + c[0] * c[5] - c[2] * c[2] + c[3] * c[5] - c[4] * c[4]
    return np.sqrt(max(minors, 1e-300))


@njit(cache=True, fastmath=True)
def _volume(c, blur):  # type: ignore[no-untyped-def]
    """Root of the determinant of a covariance that is blurred."""
    return np.sqrt(max(_determinant(c[0] + blur, c[1], c[2], c[3] + blur, c[4], c[5] + blur), 0.0))


@njit(cache=True, fastmath=True)
def _overlap(a, b, volumes, x, y, z, blur):  # type: ignore[no-untyped-def]
    """Integral of the product of two Gaussians of height 1 at distance (x, y, z), over (2 pi)^1.5.

    `volumes`: the product of their `_volume`.
    """
    p, q, r = a[0] + b[0] + 2 * blur, a[1] + b[1], a[2] + b[2]
    s, t, u = a[3] + b[3] + 2 * blur, a[4] + b[4], a[5] + b[5] + 2 * blur
    both = _determinant(p, q, r, s, t, u)
    if both <= 0:
        return 0.0
    xx, yy, zz = s * u - t * t, p * u - r * r, p * s - q * q
    xy, xz, yz = r * t - q * u, q * t - r * s, q * r - p * t
    far = (xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)) / both
    return volumes / np.sqrt(both) * np.exp(-0.5 * far)


@njit(cache=True, fastmath=True)
def _determinant(a, b, c, d, e, f):  # type: ignore[no-untyped-def]
    return a * (d * f - e * e) - b * (b * f - e * c) + c * (b * e - d * c)


@njit(cache=True, fastmath=True, parallel=True)
def _costs(first, second, means, covs, opacities, rgb, mass, visible):  # type: ignore[no-untyped-def]
    """What the merger of each pair changes in the pictures; float64 [P]."""
    cost = np.empty(len(first))
    for pair in prange(len(first)):
        i, j = first[pair], second[pair]
        share = mass[i] / (mass[i] + mass[j])
        apart, cov = means[i] - means[j], np.empty(6)
        place = 0
        for row in range(3):
            for column in range(row, 3):
                cov[place] = share * covs[i, place] + (1 - share) * covs[j, place]
                cov[place] += share * (1 - share) * apart[row] * apart[column]
                place += 1
        area = _area(cov)
        opacity = min((mass[i] + mass[j]) / area, 1.0)
        blur, x, y, z = _BLUR * area, apart[0], apart[1], apart[2]
        size_i, size_j, size = _volume(covs[i], blur), _volume(covs[j], blur), _volume(cov, blur)
        ii, jj, mm = size_i / _ITSELF, size_j / _ITSELF, size / _ITSELF
        ij = _overlap(covs[i], covs[j], size_i * size_j, x, y, z, blur)
        to_i, to_j = 1 - share, share  # of the way from the one to the other lies the merged one
        im = _overlap(covs[i], cov, size_i * size, to_i * x, to_i * y, to_i * z, blur)
        jm = _overlap(covs[j], cov, size_j * size, to_j * x, to_j * y, to_j * z, blur)
        change = 0.0
        for channel in range(4):
            one, other, weight = 1.0, 1.0, _OPACITY
            if channel < 3:
                one, other, weight = rgb[i, channel], rgb[j, channel], 1.0
            both = opacity * (share * one + (1 - share) * other)
            one, other = opacities[i] * one, opacities[j] * other
            squares = one * one * ii + other * other * jj + both * both * mm
            change += weight * (squares + 2 * (one * other * ij - one * both * im - other * both * jm))
        shown = (visible[i] * mass[i] + visible[j] * mass[j]) / (mass[i] + mass[j])
        cost[pair] = max(change, 0.0) / np.sqrt(area) * shown
    return cost
