"""The colours of a photo from those of the scene: an affine transform after blending, with its gradients."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numba import prange
from torch import Tensor

from sagesplat.kernels.jit import njit
from sagesplat.kernels.simd import (
    fma,
    load16,
    load_blue,
    load_green,
    load_red,
    maximum,
    minimum,
    splat16,
    store,
    total,
    where,
)

SATURATED = 254 / 255  # of a photo: the scene may be brighter than it shows
_BLACK = 1 / 255  # of a photo: the scene may be darker
_F = np.float32
_HIGH, _LOW, _ZERO = _F(SATURATED - 1e-4), _F(_BLACK + 1e-4), _F(0)
_LANES = 16
_CHUNK = 64 * _LANES  # pixels that a thread works on at a time


def expose(
    rgb: Float[Tensor, "H W 3"],
    exposure: Float[Tensor, "3 4"],
    photo: Float[Tensor, "H W 3"] | UInt8[Tensor, "H W 3"] | None = None,
) -> Float[Tensor, "H W 3"]:
    """Transform the colours of a rendering into those of a photo: E[:, :3] @ rgb + E[:, 3].

    Args:
        rgb: Rendered image.
        exposure: E; both it and `rgb` may require gradients.
        photo: The photo that the result is compared with, in [0, 1], or uint8 on a GPU. Where it is saturated
            and the result is beyond that, the result is the photo, without a gradient: a sensor shows no
            more. None: the result is not limited.

    Returns:
        The image, which is not limited to [0, 1].
    """
    if rgb.device.type == "cpu" and rgb.dtype == torch.float32:
        return _Expose.apply(rgb, exposure, photo)  # type: ignore[return-value]
    exposure = exposure.to(rgb.dtype)
    image = rgb @ exposure[:, :3].T + exposure[:, 3]
    if photo is None:
        return image
    if photo.dtype == torch.uint8:
        photo = photo.to(rgb.dtype) / 255
    beyond = ((photo >= float(_HIGH)) & (image > photo)) | ((photo <= float(_LOW)) & (image < photo))
    return torch.where(beyond, photo.to(rgb.dtype), image)


class _Expose(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rgb: Tensor, exposure: Tensor, photo: Tensor | None) -> Tensor:
        x, matrix = rgb.detach().contiguous().numpy(), exposure.detach().float().contiguous().numpy()
        y = None if photo is None else photo.contiguous().numpy()
        out, limits = np.empty_like(x), np.zeros(0, np.float32) if y is None else y.reshape(-1)
        _forward(x.reshape(-1), matrix, limits, out.reshape(-1))
        ctx.kept = x, matrix, y, out
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor):
        x, matrix, y, out = ctx.kept
        g = grads[0].contiguous().numpy()
        if y is not None:
            kept = np.empty_like(g)
            _keep(g.reshape(-1), out.reshape(-1), y.reshape(-1), kept.reshape(-1))
            g = kept
        by_rgb, sums = np.empty_like(x), np.empty((-(-x.size // (3 * _CHUNK)), 12), np.float32)
        _backward(x.reshape(-1), matrix, g.reshape(-1), by_rgb.reshape(-1), sums)
        return torch.from_numpy(by_rgb), torch.from_numpy(sums.sum(0).reshape(3, 4)), None


@njit(parallel=True, cache=True)
def _forward(x, matrix, photo, out):
    """The transform of x [3 n] into out, limited by the photo where that is not empty."""
    a, b, c, d = matrix[0]
    e, f, g, h = matrix[1]
    i, j, k, l = matrix[2]  # noqa: E741
    pixels = len(x) // 3
    for chunk in prange((pixels + _CHUNK - 1) // _CHUNK):
        first, last = chunk * _CHUNK, min((chunk + 1) * _CHUNK, pixels)
        for p in range(first, last):
            red, green, blue = x[3 * p], x[3 * p + 1], x[3 * p + 2]
            out[3 * p] = a * red + b * green + c * blue + d
            out[3 * p + 1] = e * red + f * green + g * blue + h
            out[3 * p + 2] = i * red + j * green + k * blue + l
        if len(photo):
            _limit(out, photo, 3 * first, 3 * last)


@njit(cache=True)
def _limit(out, photo, first, last):
    """Put the photo where it is saturated and out is beyond it."""
    whole = first + (last - first) // _LANES * _LANES
    for p in range(first, whole, _LANES):
        value, y = load16(out, p), load16(photo, p)
        low = where(y <= _LOW, maximum(value, y), value)
        store(out, p, where(y >= _HIGH, minimum(value, y), low))
    for p in range(whole, last):
        if photo[p] >= _HIGH:
            out[p] = min(out[p], photo[p])
        elif photo[p] <= _LOW:
            out[p] = max(out[p], photo[p])


@njit(cache=True)
def _keep(grad, out, photo, kept):
    """The gradient, but for zeros where the photo limited the image."""
    whole = len(grad) // _LANES * _LANES
    for p in range(0, whole, _LANES):
        value, y, g = load16(out, p), load16(photo, p), load16(grad, p)
        none = splat16(_ZERO)
        low = where(y <= _LOW, where(value <= y, none, g), g)
        store(kept, p, where(y >= _HIGH, where(value >= y, none, g), low))
    for p in range(whole, len(grad)):
        limited = out[p] == photo[p] and (photo[p] >= _HIGH or photo[p] <= _LOW)
        kept[p] = _ZERO if limited else grad[p]


@njit(parallel=True, cache=True)
def _backward(x, matrix, grad, by_rgb, sums):
    """Gradients by x into by_rgb [3 n], and by the matrix into sums [chunks, 12]."""
    a, b, c, _ = matrix[0]
    e, f, g, _ = matrix[1]
    i, j, k, _ = matrix[2]
    pixels = len(x) // 3
    for chunk in prange(len(sums)):
        first, last = chunk * _CHUNK, min((chunk + 1) * _CHUNK, pixels)
        for p in range(first, last):
            red, green, blue = grad[3 * p], grad[3 * p + 1], grad[3 * p + 2]
            by_rgb[3 * p] = a * red + e * green + i * blue
            by_rgb[3 * p + 1] = b * red + f * green + j * blue
            by_rgb[3 * p + 2] = c * red + g * green + k * blue
        _outer_sums(x, grad, first, last, sums[chunk])


@njit(cache=True)
def _outer_sums(x, grad, first, last, out):
    """Sums over pixels of each channel of grad times (red, green, blue of x, 1)."""
    none = splat16(_ZERO)
    r0, r1, r2, r3 = none, none, none, none
    g0, g1, g2, g3 = none, none, none, none
    b0, b1, b2, b3 = none, none, none, none
    whole = first + (last - first) // _LANES * _LANES
    for p in range(first, whole, _LANES):
        red, green, blue = load_red(x, 3 * p), load_green(x, 3 * p), load_blue(x, 3 * p)
        by = load_red(grad, 3 * p)
        r0, r1, r2, r3 = fma(by, red, r0), fma(by, green, r1), fma(by, blue, r2), r3 + by
        by = load_green(grad, 3 * p)
        g0, g1, g2, g3 = fma(by, red, g0), fma(by, green, g1), fma(by, blue, g2), g3 + by
        by = load_blue(grad, 3 * p)
        b0, b1, b2, b3 = fma(by, red, b0), fma(by, green, b1), fma(by, blue, b2), b3 + by
    out[0], out[1], out[2], out[3] = total(r0), total(r1), total(r2), total(r3)
    out[4], out[5], out[6], out[7] = total(g0), total(g1), total(g2), total(g3)
    out[8], out[9], out[10], out[11] = total(b0), total(b1), total(b2), total(b3)
    for p in range(whole, last):
        for c in range(3):
            by = grad[3 * p + c]
            for k in range(3):
                out[4 * c + k] += by * x[3 * p + k]
            out[4 * c + 3] += by
