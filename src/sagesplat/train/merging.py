"""Merges Gaussians by their moments: fewer Gaussians that paint nearly the same, without training.

Pairs of neighbours merge, those of the least cost first, until the wanted number is left. A merged Gaussian
has the mean and the covariance of the two as a mixture, weighted by opacity times area, and the opacity that
keeps that product, at most 1 (as hierarchical 3DGS, arXiv:2406.12080). The cost of a pair is what its merger
changes in the pictures: the squared difference in colour and opacity between the two and the merged one,
integrated over space, blurred by a part of the size, and weighted by how visible the two are in renders.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

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
    variances, axes = np.linalg.eigh(mixture.covs[:, _WHOLE].reshape(-1, 3, 3))
    axes[np.linalg.det(axes) < 0, :, 0] *= -1  # a rotation, not a reflection
    quats = np.roll(Rotation.from_matrix(axes).as_quat(), 1, axis=1)
    opacities = mixture.opacities.clip(1 - _CLOSED, _CLOSED)
    sh = mixture.sh.reshape(len(mixture), -1, 3)
    smallest = variances.max(1, keepdims=True) * 1e-12
    columns = {
        "means": mixture.means,
        "quats": quats,
        "log_scales": np.log(np.maximum(variances, np.maximum(smallest, 1e-30))) / 2,
        "logit_opacities": np.log(opacities / (1 - opacities)),
        "sh0": sh[:, :1],
        "shN": sh[:, 1:],
    }
    values = {name: torch.from_numpy(column.astype(np.float32)) for name, column in columns.items()}
    rows = torch.from_numpy(np.flatnonzero(mixture.origin >= 0))
    same = torch.from_numpy(mixture.origin[mixture.origin >= 0])
    for name, value in values.items():
        value[rows] = getattr(before, name)[same]
    return Gaussians(**values, label_ids=torch.from_numpy(mixture.labels))


def _merge_round(m: _Mixture, most: int) -> _Mixture | None:
    """Merge the cheapest pairs of neighbours, each Gaussian at most once and at most `most` pairs.

    None where every category has one Gaussian left.
    """
    first, second = _neighbours(m.means, m.labels)
    if not len(first):
        return None
    rgb = sh0_to_rgb(torch.from_numpy(m.sh[:, :3])).numpy().astype(np.float64)
    cost = _costs(first, second, m.means, m.covs, m.opacities, rgb, m.mass, m.visible)
    most = min(most, max(1, int(_ROUND * len(m))))
    pairs = _cheapest(np.argsort(cost, kind="stable"), first, second, len(m), most)
    i, j = first[pairs], second[pairs]
    mass = m.mass[i] + m.mass[j]
    share = (m.mass[i] / mass)[:, None]
    apart = m.means[i] - m.means[j]
    spread = (apart[:, :, None] * apart[:, None]).reshape(-1, 9)[:, _UPPER]
    covs = share * m.covs[i] + (1 - share) * m.covs[j] + share * (1 - share) * spread
    opacities = np.minimum(mass / np.maximum(_areas(covs), 1e-300), 1)
    merged = replace(
        m,
        means=share * m.means[i] + (1 - share) * m.means[j],
        covs=covs,
        opacities=opacities,
        sh=(share * m.sh[i] + (1 - share) * m.sh[j]).astype(np.float32),
        labels=m.labels[i],
        mass=mass,
        visible=(m.visible[i] * m.mass[i] + m.visible[j] * m.mass[j]) / mass,
        origin=np.full(len(i), -1),
    )
    alone = np.ones(len(m), bool)
    alone[i] = alone[j] = False
    row = np.empty(len(m), np.int64)
    row[alone] = np.arange(alone.sum())
    row[i] = row[j] = alone.sum() + np.arange(len(i))
    names = ("means", "covs", "opacities", "sh", "labels", "mass", "visible", "origin")
    columns = {name: np.concatenate([getattr(m, name)[alone], getattr(merged, name)]) for name in names}
    return _Mixture(**columns, into=row[m.into])


def _neighbours(means: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of close rows of one label (int64 [P] each), every pair once."""
    pairs = [np.zeros((2, 0), np.int64)]
    for label in np.unique(labels):
        rows = np.flatnonzero(labels == label)
        pairs.append(rows[np.stack(_neighbours_in(means[rows]))])
    first, second = np.concatenate(pairs, axis=1)
    return first, second


def _neighbours_in(means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same among all rows: at least one pair of two rows or more."""
    n = len(means)
    near = np.asarray(KDTree(means).query(means, min(_NEIGHBOURS + 1, n), workers=-1)[1]).reshape(n, -1)
    one = np.repeat(np.arange(n), near.shape[1])
    other = near.ravel()
    keys = np.sort(np.minimum(one, other) * n + np.maximum(one, other))
    keys = keys[np.append(True, keys[1:] != keys[:-1])]  # several times as fast as np.unique
    first, second = keys // n, keys % n
    apart = first != second
    if not apart.any():  # more than a neighbourhood of them in one place
        return np.arange(n - 1), np.arange(1, n)
    return first[apart], second[apart]


def _areas(covs: np.ndarray) -> np.ndarray:
    """About the mean area that Gaussians cover, without pi: the root of the sum of the 2 x 2 minors."""
    a, b, c, d, e, f = covs.T
    return np.sqrt(np.maximum(a * d - b * b + a * f - c * c + d * f - e * e, 0))


@njit(cache=True)
def _cheapest(order, first, second, count, most):  # type: ignore[no-untyped-def]
    """Numbers of the pairs that merge, in the given order, without a row that has merged before."""
    used, chosen, n = np.zeros(count, np.bool_), np.empty(most, np.int64), 0
    for pair in order:
        if n == most:
            break
        if not used[first[pair]] and not used[second[pair]]:
            used[first[pair]] = used[second[pair]] = True
            chosen[n] = pair
            n += 1
    return chosen[:n]


@njit(cache=True, fastmath=True)
def _area(c):  # type: ignore[no-untyped-def]
    minors = c[0] * c[3] - c[1] * c[1] + c[0] * c[5] - c[2] * c[2] + c[3] * c[5] - c[4] * c[4]
    return np.sqrt(max(minors, 1e-300))


@njit(cache=True, fastmath=True)
def _overlap(a, b, x, y, z, blur):  # type: ignore[no-untyped-def]
    """Integral of the product of two Gaussians of height 1 at distance (x, y, z), over (2 pi)^1.5."""
    one = _determinant(a[0] + blur, a[1], a[2], a[3] + blur, a[4], a[5] + blur)
    other = _determinant(b[0] + blur, b[1], b[2], b[3] + blur, b[4], b[5] + blur)
    p, q, r = a[0] + b[0] + 2 * blur, a[1] + b[1], a[2] + b[2]
    s, t, u = a[3] + b[3] + 2 * blur, a[4] + b[4], a[5] + b[5] + 2 * blur
    both = _determinant(p, q, r, s, t, u)
    if both <= 0:
        return 0.0
    xx, yy, zz = s * u - t * t, p * u - r * r, p * s - q * q
    xy, xz, yz = r * t - q * u, q * t - r * s, q * r - p * t
    far = (xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)) / both
    return np.sqrt(max(one, 0.0) * max(other, 0.0) / both) * np.exp(-0.5 * far)


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
        ii = _overlap(covs[i], covs[i], 0.0, 0.0, 0.0, blur)
        jj = _overlap(covs[j], covs[j], 0.0, 0.0, 0.0, blur)
        mm = _overlap(cov, cov, 0.0, 0.0, 0.0, blur)
        ij = _overlap(covs[i], covs[j], x, y, z, blur)
        to_i, to_j = 1 - share, share  # of the way from the one to the other lies the merged one
        im = _overlap(covs[i], cov, to_i * x, to_i * y, to_i * z, blur)
        jm = _overlap(covs[j], cov, to_j * x, to_j * y, to_j * z, blur)
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
