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
    w, x, y, z = _quaternion(rotation)
    a, b, c, d = g.quats.T
    quats = [w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c]
    quats += [w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a]
    means = scale * (g.means @ torch.from_numpy(rotation.T.astype(np.float32)))
    if translation is not None:
        means = means + torch.from_numpy(translation.astype(np.float32))
    turned = torch.from_numpy(_rotation_of_sh(rotation).astype(np.float32))
    turned = turned[: g.shN.shape[1], : g.shN.shape[1]]
    return replace(
        g,
        means=means,
        quats=torch.stack(quats, 1),
        log_scales=g.log_scales + float(np.log(scale)),
        shN=torch.einsum("kj,njc->nkc", turned, g.shN),
    )


def _quaternion(rotation: np.ndarray) -> list[float]:
    """Components w x y z of a rotation matrix: the largest is found first (Shepperd 1978)."""
    m = rotation
    four = np.array(  # 4 q q^T
        [
            [1 + m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[2, 1] + m[1, 2]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ]
    )
    row = four[four.diagonal().argmax()]
    return (row / np.linalg.norm(row)).tolist()


def _rotation_of_sh(rotation: np.ndarray) -> np.ndarray:
    """The matrix [15, 15] that turns SH coefficients of degree 1 to 3: a least-squares fit, exact."""
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = (np.stack(bases(*d.T)[1:], 1) for d in (directions @ rotation, directions))
    whole = np.zeros((15, 15))
    for rows in (slice(0, 3), slice(3, 8), slice(8, 15)):
        whole[rows, rows] = np.linalg.lstsq(after[:, rows], before[:, rows], rcond=None)[0]
    return np.where(np.abs(whole - np.rint(whole)) < 1e-9, np.rint(whole), whole)
