"""The training loss and SSIM on a GPU, in Triton: the mathematics of `ssim_cpu.py` and `image.py`.

An image [H, W, 3] is a matrix [H, 3 W] whose neighbouring pixels are three columns apart. The window is
separable: every kernel blurs along one axis. A program works on a tile of 16x16 pixels. There are no atomics,
so the same input gives the same bits, and the host waits for nothing.
"""

import math
from collections.abc import Callable
from typing import Any, cast

import torch
import triton  # pyright: ignore[reportMissingImports] - installed with torch where there is a GPU
import triton.language as tl  # pyright: ignore[reportMissingImports]
from jaxtyping import Bool, Float32, UInt8
from torch import Tensor

_jit = cast(Callable[..., Any], triton.jit)  # without Triton pyright takes a kernel for its function
TILE = 16  # pixels along a side of a tile of `tile_mask`
_WARPS = 8  # with four, threads need up to 255 registers and some spill
_ROWS = tl.constexpr(TILE)
_COLUMNS = tl.constexpr(3 * TILE)
_LANES = tl.constexpr(4 * TILE)  # ranges are powers of two: the last quarter idles
_WINDOW = tl.constexpr(11)
_RADIUS = tl.constexpr(5)
_taps = [math.exp(-((i - 5) ** 2) / (2 * 1.5**2)) for i in range(11)]
_TAPS = tl.constexpr(tuple(tap / sum(_taps) for tap in _taps))
_C1 = tl.constexpr(0.01**2)
_C2 = tl.constexpr(0.03**2)


@_jit
def _tile(height, width):
    """Rows [16, 1], columns [1, 64] and which of their values are of this program's tile and of the image."""
    rows = tl.program_id(1) * _ROWS + tl.arange(0, _ROWS)[:, None]
    lanes = tl.arange(0, _LANES)[None, :]
    columns = tl.program_id(0) * _COLUMNS + lanes
    return rows, columns, (rows < height) & (columns < width) & (lanes < _COLUMNS)


@_jit
def _in_loss(tile_mask, row, column):
    """Whether the tile at a row and column of tiles, moved into the image, is in the loss."""
    row = tl.minimum(tl.maximum(row, 0), tl.num_programs(1) - 1)
    column = tl.minimum(tl.maximum(column, 0), tl.num_programs(0) - 1)
    return tl.load(tile_mask + row * tl.num_programs(0) + column) != 0


@_jit
def _in_reach(tile_mask):
    """Whether a column of the window from this program's tile may reach a pixel in the loss."""
    row, column = tl.program_id(1), tl.program_id(0)
    above, below = _in_loss(tile_mask, row - 1, column), _in_loss(tile_mask, row + 1, column)
    return _in_loss(tile_mask, row, column) | above | below


@_jit
def _blur_images_across(x, y, tile_mask, blurred, height, width, UNIT: tl.constexpr):
    """Horizontal window over x, y, x x + y y and x y into blurred [4, H, 3 W]; y is in units of `UNIT`."""
    if tile_mask is not None and not _in_reach(tile_mask):
        return
    rows, columns, inside = _tile(height, width)
    mx = tl.zeros((_ROWS, _LANES), tl.float32)
    my = tl.zeros((_ROWS, _LANES), tl.float32)
    squares = tl.zeros((_ROWS, _LANES), tl.float32)
    product = tl.zeros((_ROWS, _LANES), tl.float32)
    at = rows * width + columns
    for k in tl.static_range(_WINDOW):  # pyright: ignore[reportGeneralTypeIssues]
        column = columns + 3 * (k - _RADIUS)
        here = inside & (column >= 0) & (column < width)
        b = tl.load(y + at + 3 * (k - _RADIUS), mask=here, other=0).to(tl.float32) * UNIT
        if tile_mask is None:
            a = tl.load(x + at + 3 * (k - _RADIUS), mask=here, other=0.0)
        else:
            seen = _in_loss(tile_mask, tl.program_id(1), column // _COLUMNS)
            a = tl.where(seen, tl.load(x + at + 3 * (k - _RADIUS), mask=here & seen, other=0.0), b)
        mx += _TAPS[k] * a
        my += _TAPS[k] * b
        squares += _TAPS[k] * (a * a + b * b)
        product += _TAPS[k] * (a * b)
    plane = (height * width).to(tl.int64)
    tl.store(blurred + at, mx, mask=inside)
    tl.store(blurred + plane + at, my, mask=inside)
    tl.store(blurred + 2 * plane + at, squares, mask=inside)
    tl.store(blurred + 3 * plane + at, product, mask=inside)


@_jit
def _compare(blurred, tile_mask, ssim, derivatives, losses, height, width, scale):
    """SSIM into ssim [H, 3 W]; or its derivatives by the blurred images into derivatives [3, H, 3 W].

    With the derivatives: scale * (sum of 1 - SSIM) of every tile into losses [tiles].
    """
    if tile_mask is not None and not _in_loss(tile_mask, tl.program_id(1), tl.program_id(0)):
        tl.store(losses + tl.program_id(1) * tl.num_programs(0) + tl.program_id(0), 0.0)
        return
    rows, columns, inside = _tile(height, width)
    plane = (height * width).to(tl.int64)
    at = rows * width + columns
    mx = tl.zeros((_ROWS, _LANES), tl.float32)
    my = tl.zeros((_ROWS, _LANES), tl.float32)
    squares = tl.zeros((_ROWS, _LANES), tl.float32)
    product = tl.zeros((_ROWS, _LANES), tl.float32)
    for k in tl.static_range(_WINDOW):  # pyright: ignore[reportGeneralTypeIssues]
        row = rows + (k - _RADIUS)
        here = inside & (row >= 0) & (row < height)
        tap = blurred + (k - _RADIUS) * width + at
        mx += _TAPS[k] * tl.load(tap, mask=here, other=0.0)
        my += _TAPS[k] * tl.load(tap + plane, mask=here, other=0.0)
        squares += _TAPS[k] * tl.load(tap + 2 * plane, mask=here, other=0.0)
        product += _TAPS[k] * tl.load(tap + 3 * plane, mask=here, other=0.0)
    a1, b1 = 2 * mx * my + _C1, mx * mx + my * my + _C1
    a2, b2 = 2 * (product - mx * my) + _C2, squares - mx * mx - my * my + _C2
    inverse = 1 / (b1 * b2)
    value = a1 * a2 * inverse
    if ssim is not None:
        tl.store(ssim + at, value, mask=inside)
    else:
        by_covariance = 2 * a1 * inverse
        by_variance = -value * b1 * inverse
        by_mean = 2 * (my * a2 * inverse - mx * value * b2 * inverse - mx * by_variance) - my * by_covariance
        tl.store(derivatives + at, by_mean, mask=inside)
        tl.store(derivatives + plane + at, by_variance, mask=inside)
        tl.store(derivatives + 2 * plane + at, by_covariance, mask=inside)
        loss = scale * tl.sum(tl.where(inside, 1 - value, 0.0))
        tl.store(losses + tl.program_id(1) * tl.num_programs(0) + tl.program_id(0), loss)


@_jit
def _blur_derivatives_across(derivatives, tile_mask, blurred, height, width):
    """Horizontal window over derivatives [3, H, 3 W], zero outside the loss, into blurred."""
    if tile_mask is not None and not _in_reach(tile_mask):
        return
    rows, columns, inside = _tile(height, width)
    plane = (height * width).to(tl.int64)
    at = rows * width + columns
    by_mean = tl.zeros((_ROWS, _LANES), tl.float32)
    by_variance = tl.zeros((_ROWS, _LANES), tl.float32)
    by_covariance = tl.zeros((_ROWS, _LANES), tl.float32)
    for k in tl.static_range(_WINDOW):  # pyright: ignore[reportGeneralTypeIssues]
        column = columns + 3 * (k - _RADIUS)
        here = inside & (column >= 0) & (column < width)
        if tile_mask is not None:
            here &= _in_loss(tile_mask, tl.program_id(1), column // _COLUMNS)
        tap = derivatives + 3 * (k - _RADIUS) + at
        by_mean += _TAPS[k] * tl.load(tap, mask=here, other=0.0)
        by_variance += _TAPS[k] * tl.load(tap + plane, mask=here, other=0.0)
        by_covariance += _TAPS[k] * tl.load(tap + 2 * plane, mask=here, other=0.0)
    tl.store(blurred + at, by_mean, mask=inside)
    tl.store(blurred + plane + at, by_variance, mask=inside)
    tl.store(blurred + 2 * plane + at, by_covariance, mask=inside)


@_jit
def _gradient(
    x, y, blurred, tile_mask, out, losses, height, width, ssim_scale, l1_scale, UNIT: tl.constexpr
):  # fmt: skip
    """The loss by x into out [H, 3 W]; l1_scale * (sum of |x - y|) of every tile into losses [tiles]."""
    rows, columns, inside = _tile(height, width)
    at = rows * width + columns
    losses += tl.program_id(1) * tl.num_programs(0) + tl.program_id(0)
    if tile_mask is not None and not _in_loss(tile_mask, tl.program_id(1), tl.program_id(0)):
        tl.store(out + at, tl.zeros((_ROWS, _LANES), tl.float32), mask=inside)
        tl.store(losses, 0.0)
        return
    plane = (height * width).to(tl.int64)
    a = tl.load(x + at, mask=inside, other=0.0)
    b = tl.load(y + at, mask=inside, other=0).to(tl.float32) * UNIT
    by_ssim = tl.zeros((_ROWS, _LANES), tl.float32)
    for k in tl.static_range(_WINDOW):  # pyright: ignore[reportGeneralTypeIssues]
        row = rows + (k - _RADIUS)
        here = inside & (row >= 0) & (row < height)
        tap = blurred + (k - _RADIUS) * width + at
        by_mean = tl.load(tap, mask=here, other=0.0)
        by_variance = tl.load(tap + plane, mask=here, other=0.0)
        by_covariance = tl.load(tap + 2 * plane, mask=here, other=0.0)
        by_ssim += _TAPS[k] * (by_mean + 2 * a * by_variance + b * by_covariance)
    sign = (a > b).to(tl.float32) - (a < b).to(tl.float32)
    tl.store(out + at, l1_scale * sign - ssim_scale * by_ssim, mask=inside)
    tl.store(losses, l1_scale * tl.sum(tl.abs(a - b)))


def _prepare(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, float, tuple[int, int], tuple[int, int]]:
    """Contiguous images, the unit of the second, [H, 3 W] and the grid of tiles, columns first."""
    height, width, _ = x.shape
    if y.shape != x.shape:
        raise ValueError(f"images of {tuple(x.shape)} and {tuple(y.shape)} cannot be compared")
    unit = 1 / 255 if y.dtype == torch.uint8 else 1.0
    grid = -(-width // TILE), -(-height // TILE)
    return x.detach().contiguous(), y.contiguous(), unit, (height, 3 * width), grid


def ssim_map(
    x: Float32[Tensor, "H W 3"], y: Float32[Tensor, "H W 3"] | UInt8[Tensor, "H W 3"]
) -> Float32[Tensor, "H W"]:
    """SSIM at every pixel, averaged over the channels; images in [0, 1] (or bytes), zero padding."""
    x, y, unit, size, grid = _prepare(x, y)
    blurred, ssim = x.new_empty(4, *size), torch.empty_like(x)
    _blur_images_across[grid](x, y, None, blurred, *size, UNIT=unit, num_warps=_WARPS)
    _compare[grid](blurred, None, ssim, None, None, *size, 0.0, num_warps=_WARPS)
    return ssim.mean(-1)


class _PhotometricLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rgb: Tensor, photo: Tensor, ssim_weight: float, tile_mask: Tensor | None) -> Tensor:
        x, y, unit, size, grid = _prepare(rgb, photo)
        if tile_mask is not None:
            if tile_mask.shape != grid[::-1]:
                raise ValueError(f"tile_mask is {tuple(tile_mask.shape)}, the image has {grid[::-1]} tiles")
            tile_mask = tile_mask.contiguous().view(torch.uint8)
        blurred, derivatives, grad = x.new_empty(4, *size), x.new_empty(3, *size), torch.empty_like(x)
        losses = x.new_empty(2, *grid)
        ssim_scale, l1_scale = ssim_weight / x.numel(), (1 - ssim_weight) / x.numel()
        _blur_images_across[grid](x, y, tile_mask, blurred, *size, UNIT=unit, num_warps=_WARPS)
        _compare[grid](blurred, tile_mask, None, derivatives, losses[0], *size, ssim_scale, num_warps=_WARPS)
        _blur_derivatives_across[grid](derivatives, tile_mask, blurred, *size, num_warps=_WARPS)
        _gradient[grid](
            x, y, blurred, tile_mask, grad, losses[1], *size, ssim_scale, l1_scale,
            UNIT=unit, num_warps=_WARPS,
        )  # fmt: skip
        ctx.grad = grad
        return losses.sum(dtype=torch.float64).float()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor):
        return ctx.grad * grads[0], None, None, None


def photometric_loss(
    rgb: Float32[Tensor, "H W 3"],
    photo: Float32[Tensor, "H W 3"] | UInt8[Tensor, "H W 3"],
    ssim_weight: float,
    tile_mask: Bool[Tensor, "h w"] | None = None,
) -> Float32[Tensor, ""]:
    """(1 - w) L1 + w (1 - SSIM), as 3DGS trains, a mean over the 3 H W values; differentiable by `rgb`.

    The photo is in [0, 1] or in bytes. `tile_mask` [ceil(H/16), ceil(W/16)]: tiles that are false leave the
    loss: they add nothing to the sum (which is divided by the number of all pixels) and have no gradient, and
    the windows of others see the photo there.
    ValueError: shapes that do not fit.
    """
    return _PhotometricLoss.apply(rgb, photo, ssim_weight, tile_mask)  # type: ignore[return-value]
