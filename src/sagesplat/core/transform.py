"""Moves Gaussians from one frame of reference to another."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64

from sagesplat.core.gaussians import Gaussians
from sagesplat.core.sh import bases


def transformed(
    g: Gaussians,
    rotation: Float64[np.ndarray, "3 3"],
    scale: float = 1.0,
    translation: Float64[np.ndarray, " 3"] | None = None,
) -> Gaussians:
    """Gaussians at `scale` * `rotation` x + `translation`, with their shapes and colours turned alike."""
    if scale == 1 and translation is None and np.array_equal(rotation, np.eye(3)):
        return g
    w, x, y, z = _quaternions(rotation[None])[0].tolist()
    a, b, c, d = g.quats.T
    quats = [w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c]
    quats += [w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a]
    means = scale * (g.means @ torch.from_numpy(rotation.T.astype(np.float32)))
    if translation is not None:
        means = means + torch.from_numpy(translation.astype(np.float32))
    return replace(
        g,
        means=means,
        quats=torch.stack(quats, 1),
        log_scales=g.log_scales + float(np.log(scale)),
        shN=_turned_sh(g, rotation),
    )


def placed(g: Gaussians, matrix: Float64[np.ndarray, "4 4"]) -> Gaussians:
    """Gaussians where an affine map puts them, also one that mirrors, or scales axes differently.

    Covariances become M S M^T, with the map's linear part M; colours turn with the orthogonal matrix nearest
    to M. ValueError for a map that flattens space.
    """
    linear, moved = matrix[:3, :3], matrix[:3, 3]
    u, sizes, vt = np.linalg.svd(linear)
    if not sizes[-1] > 1e-9 * sizes[0]:
        raise ValueError("a transform that flattens what it moves")
    turn = np.where(np.abs(u @ vt - np.rint(u @ vt)) < 1e-9, np.rint(u @ vt), u @ vt)  # quarters stay exact
    even = sizes[0] < sizes[-1] * (1 + 1e-5)
    if even and np.linalg.det(turn) > 0:
        scale = float(sizes.mean())
        scale = 1.0 if abs(scale - 1) < 1e-9 else scale
        return transformed(g, turn, scale, moved if moved.any() else None)
    axes = _matrices(g.quats.numpy()) * np.exp(g.log_scales.numpy().astype(np.float64))[:, None]
    whole = np.isfinite(axes).all((1, 2))  # others cannot be drawn, and stay so
    directions, lengths, _ = np.linalg.svd(linear @ axes[whole])
    directions *= np.sign(np.linalg.det(directions))[:, None, None]
    quats, log_scales = np.zeros((len(g), 4)), np.full((len(g), 3), np.nan)
    with np.errstate(divide="ignore"):
        quats[whole], log_scales[whole] = _quaternions(directions), np.log(lengths)
    means = g.means.numpy().astype(np.float64) @ linear.T + moved
    made = {"means": means, "quats": quats, "log_scales": log_scales}
    tensors = {name: torch.from_numpy(values.astype(np.float32)) for name, values in made.items()}
    return replace(g, **tensors, shN=_turned_sh(g, turn))


def _turned_sh(g: Gaussians, rotation: np.ndarray) -> torch.Tensor:
    """SH coefficients [N, K, 3] after a rotation, or a reflection."""
    turned = torch.from_numpy(_rotation_of_sh(rotation).astype(np.float32))
    turned = turned[: g.shN.shape[1], : g.shN.shape[1]]
    return torch.einsum("kj,njc->nkc", turned, g.shN)


def _matrices(quats: np.ndarray) -> np.ndarray:
    """Rotation matrices [N, 3, 3] of quaternions wxyz [N, 4] of any length; NaN for zeros."""
    with np.errstate(all="ignore"):
        w, x, y, z = (quats / np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)).T
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]]
    rows += [[2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]]
    rows += [[2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]
    return np.moveaxis(np.array(rows), -1, 0)


def _quaternions(rotations: np.ndarray) -> np.ndarray:
    """Quaternions wxyz [N, 4] of rotation matrices [N, 3, 3]: the largest is found first (Shepperd 1978)."""
    m = np.moveaxis(rotations, 0, -1)
    four = np.array(  # 4 q q^T
        [
            [1 + m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[2, 1] + m[1, 2]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ]
    )
    rows = np.moveaxis(four, -1, 0)
    largest = np.einsum("nii->ni", rows).argmax(1)
    row = rows[np.arange(len(rows)), largest]
    return row / np.linalg.norm(row, axis=1, keepdims=True)


def _rotation_of_sh(rotation: np.ndarray) -> np.ndarray:
    """The matrix [15, 15] that turns SH coefficients of degree 1 to 3: a least-squares fit, exact."""
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = (np.stack(bases(*d.T)[1:], 1) for d in (directions @ rotation, directions))
    whole = np.zeros((15, 15))
    for rows in (slice(0, 3), slice(3, 8), slice(8, 15)):
        whole[rows, rows] = np.linalg.lstsq(after[:, rows], before[:, rows], rcond=None)[0]
    return np.where(np.abs(whole - np.rint(whole)) < 1e-9, np.rint(whole), whole)
