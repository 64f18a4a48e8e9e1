"""Spherical harmonics: orthonormal, in the published order, with the right slope."""

import numpy as np
import torch

from sagesplat.core import sh


def directions(count: int = 30) -> np.ndarray:
    d = np.random.default_rng(0).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def values(x, y, z) -> np.ndarray:  # [16, ...]
    return np.stack([np.broadcast_to(b, np.shape(x)) for b in sh.bases(x, y, z)])


def test_bases_are_orthonormal_on_the_sphere():
    """Gauss-Legendre in z times equal angles around it integrates products up to degree 6 exactly."""
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = np.arange(16) * 2 * np.pi / 16
    x = np.sqrt(1 - z[:, None] ** 2) * np.cos(angle)
    y = np.sqrt(1 - z[:, None] ** 2) * np.sin(angle)
    b = values(x, y, np.broadcast_to(z[:, None], x.shape)).reshape(16, -1)
    gram = (b * np.repeat(weight, 16) * 2 * np.pi / 16) @ b.T
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-13)


def test_order_and_sign_are_those_of_splat_files():
    """Degree 1 is (-y, z, -x) and degree 2 starts with xy (Kerbl et al. 2023); a degree is odd or even."""
    x, y, z = directions().T
    b = values(x, y, z)
    np.testing.assert_allclose(b[0], 0.28209479177387814)
    np.testing.assert_allclose(b[1:4], 0.4886025119029199 * np.stack([-y, z, -x]))
    np.testing.assert_allclose(b[4], 1.0925484305920792 * x * y)
    np.testing.assert_allclose(b[12], 0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y))
    np.testing.assert_allclose(b[15], -0.5900435899266435 * x * (x * x - 3 * y * y))
    degrees = np.repeat([0, 1, 2, 3], [1, 3, 5, 7])
    np.testing.assert_allclose(values(-x, -y, -z), (-1.0) ** degrees[:, None] * b)


def test_direction_gradient_agrees_with_differences():
    rng = np.random.default_rng(1)
    h = 1e-5
    for d in directions(5):
        g = rng.normal(size=16)
        expected = [g @ (values(*(d + s)) - values(*(d - s))) / (2 * h) for s in np.eye(3) * h]
        np.testing.assert_allclose(sh.direction_gradient(d[0], d[1], d[2], g), expected, atol=1e-8)


def test_rgb_is_shown_from_everywhere_and_comes_back():
    rgb = torch.rand(20, 3, generator=torch.Generator().manual_seed(0))
    sh0 = sh.rgb_to_sh0(rgb)
    torch.testing.assert_close(sh.sh0_to_rgb(sh0), rgb)
    torch.testing.assert_close(0.28209479177387814 * sh0 + 0.5, rgb)
