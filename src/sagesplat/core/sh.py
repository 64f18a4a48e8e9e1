"""Real spherical harmonics up to degree 3, in the order and with the signs of 3DGS."""

import math

from torch import Tensor

C0 = 0.5 / math.sqrt(math.pi)
_C1 = math.sqrt(3 / (4 * math.pi))
_C2 = math.sqrt(15 / (4 * math.pi))  # xy, yz, xz
_C20 = math.sqrt(5 / (16 * math.pi))
_C22 = math.sqrt(15 / (16 * math.pi))
_C33 = math.sqrt(35 / (32 * math.pi))
_C32 = math.sqrt(105 / (4 * math.pi))
_C31 = math.sqrt(21 / (32 * math.pi))
_C30 = math.sqrt(7 / (16 * math.pi))
_C322 = math.sqrt(105 / (16 * math.pi))

BASES = (0, 3, 8, 15)  # basis functions beyond the constant one, by degree 0 to 3


def num_bases(degree: int) -> int:
    """Number of basis functions up to `degree`, including the constant one."""
    return (degree + 1) ** 2


def rgb_to_sh0(rgb: Tensor) -> Tensor:
    """The degree-0 coefficient that gives the colour `rgb`, in [0, 1], in all directions."""
    return (rgb - 0.5) / C0


def sh0_to_rgb(sh0: Tensor) -> Tensor:
    """Inverse of `rgb_to_sh0`."""
    return sh0 * C0 + 0.5


def bases(x, y, z):
    """The 16 basis functions at the unit direction (x, y, z), for floats, tensors or kernel vectors."""
    return (
        C0,
        -_C1 * y,
        _C1 * z,
        -_C1 * x,
        _C2 * x * y,
        -_C2 * y * z,
        _C20 * (2 * z * z - x * x - y * y),
        -_C2 * x * z,
        _C22 * (x * x - y * y),
        -_C33 * y * (3 * x * x - y * y),
        _C32 * x * y * z,
        -_C31 * y * (4 * z * z - x * x - y * y),
        _C30 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -_C31 * x * (4 * z * z - x * x - y * y),
        _C322 * z * (x * x - y * y),
        -_C33 * x * (x * x - 3 * y * y),
    )


def direction_gradient(x, y, z, g):
    """d(sum_k g[k] * basis_k) / d(x, y, z) for 16 weights `g`, for the same types as `bases`."""
    xx, yy, zz = x * x, y * y, z * z
    dx = -_C1 * g[3] + _C2 * y * g[4] - 2 * _C20 * x * g[6] - _C2 * z * g[7] + 2 * _C22 * x * g[8]
    dx += -6 * _C33 * x * y * g[9] + _C32 * y * z * g[10] + 2 * _C31 * x * y * g[11]
    dx += -6 * _C30 * x * z * g[12] - _C31 * (4 * zz - 3 * xx - yy) * g[13]
    dx += 2 * _C322 * x * z * g[14] - _C33 * (3 * xx - 3 * yy) * g[15]
    dy = -_C1 * g[1] + _C2 * x * g[4] - _C2 * z * g[5] - 2 * _C20 * y * g[6] - 2 * _C22 * y * g[8]
    dy += -_C33 * (3 * xx - 3 * yy) * g[9] + _C32 * x * z * g[10]
    dy += -_C31 * (4 * zz - xx - 3 * yy) * g[11] - 6 * _C30 * y * z * g[12]
    dy += 2 * _C31 * x * y * g[13] - 2 * _C322 * y * z * g[14] + 6 * _C33 * x * y * g[15]
    dz = _C1 * g[2] - _C2 * y * g[5] + 4 * _C20 * z * g[6] - _C2 * x * g[7]
    dz += _C32 * x * y * g[10] - 8 * _C31 * y * z * g[11]
    dz += _C30 * (6 * zz - 3 * xx - 3 * yy) * g[12] - 8 * _C31 * x * z * g[13]
    dz += _C322 * (xx - yy) * g[14]
    return dx, dy, dz
