"""Image quality: SSIM maps, PSNR, their means over label masks, and the training loss."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numba import prange
from scipy.ndimage import maximum_filter
from torch import Tensor

from sagesplat.kernels.jit import njit
from sagesplat.kernels.planes import to_image, to_planes
from sagesplat.kernels.workspace import Workspace
from sagesplat.metrics import ssim_cpu

SSIM_WEIGHT = 0.2  # of the published 3DGS loss: 0.8 L1 + 0.2 (1 - SSIM)


def _maps(
    x: np.ndarray,
    y: np.ndarray,
    width: int,
    tile_mask: np.ndarray | None,
    space: Workspace,
    values: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float]:
    """SSIM of planes [3, H, W'] into `values`, or its derivatives where that has no elements; these, the
    tiles that count, and the sum over those by the size of all.
    """
    channels, height, _ = x.shape
    sums = np.empty((channels, ssim_cpu.strips(height)))
    derivatives = space.take("ssim derivatives", 0 if values.size else 3, *x.shape)
    tiles = ssim_cpu.all_tiles(height, width) if tile_mask is None else tile_mask
    ssim_cpu.compare(x, y, tiles, width, values, derivatives, sums)
    return derivatives, tiles, float(sums.sum()) / (channels * height * width)


def ssim_map(
    x: Float32[np.ndarray, "H W 3"],
    y: Float32[np.ndarray, "H W 3"],
    tile_mask: Bool[np.ndarray, "h w"] | None = None,
) -> Float32[np.ndarray, "H W"]:
    """Compute SSIM at every pixel, averaged over the channels (Wang et al. 2004).

        SSIM = (2 mx my + C1) (2 sxy + C2) / ((mx^2 + my^2 + C1) (sx^2 + sy^2 + C2))

    with a Gaussian window of 11 x 11 pixels (sigma 1.5), zero padding, C1 = 0.01^2 and C2 = 0.03^2, as in
    3DGS.

    Args:
        x: Image in [0, 1].
        y: Image in [0, 1].
        tile_mask: bool [ceil(H/16), ceil(W/16)]; the result is 0 where it is False.

    Returns:
        SSIM in [-1, 1] at each pixel.

    Example:
        >>> import numpy as np
        >>> from sagesplat.metrics.image import ssim_map
        >>> photo = np.random.default_rng(0).random((32, 48, 3), np.float32)
        >>> bool(np.allclose(ssim_map(photo, photo), 1, atol=1e-5)), ssim_map(photo, 1 - photo).shape
        (True, (32, 48))
    """
    space = Workspace()
    return ssim_between(*_planes(x, y, space), x.shape[1], space, tile_mask)


def _planes(x: np.ndarray, y: np.ndarray, space: Workspace) -> tuple[np.ndarray, np.ndarray]:
    """Two images as planes."""
    return to_planes(torch.from_numpy(x), space, "x"), to_planes(torch.from_numpy(y), space, "y")


def ssim_between(
    x: Float32[np.ndarray, "3 H W2"],
    y: Float32[np.ndarray, "3 H W2"],
    width: int,
    space: Workspace,
    tile_mask: Bool[np.ndarray, "h w"] | None = None,
) -> Float32[np.ndarray, "H W"]:
    """`ssim_map` of images that are planes already (`kernels.planes`), in the workspace's memory."""
    values, out = space.take("ssim of channels", *x.shape), space.take("ssim", x.shape[1], width)
    _maps(x, y, width, tile_mask, space, values)
    _mean_of_channels(values, out)
    return out


@njit(parallel=True, cache=True)
def _mean_of_channels(values, out):
    for row in prange(len(out)):
        for column in range(out.shape[1]):
            red, green, blue = values[0, row, column], values[1, row, column], values[2, row, column]
            out[row, column] = (red + green + blue) / np.float32(3)


def ssim_planes(
    x: Float32[np.ndarray, "H W 3"],
    y: Float32[np.ndarray, "H W 3"],
    tile_mask: Bool[np.ndarray, "h w"] | None = None,
) -> Float32[np.ndarray, "3 H W"]:
    """`ssim_map` of each channel."""
    space, width = Workspace(), x.shape[1]
    one, other = _planes(x, y, space)
    values = np.empty_like(one)
    _maps(one, other, width, tile_mask, space, values)
    return values[..., :width]


def tiles_around(shown: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "h w"]:
    """The tiles of 16 x 16 pixels that SSIM of the `shown` pixels depends on: those within its window."""
    height, width = shown.shape
    rows, columns = ssim_cpu.all_tiles(height, width).shape
    near = np.zeros((rows * ssim_cpu.TILE, columns * ssim_cpu.TILE), bool)
    near[:height, :width] = maximum_filter(shown, 2 * ssim_cpu.RADIUS + 1)
    return np.asarray(near.reshape(rows, ssim_cpu.TILE, columns, ssim_cpu.TILE).any((1, 3)))


def box_of(tile_mask: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """Rows and columns of pixels from the first to the last of some tiles; there is at least one."""
    spans = []
    for axis in (1, 0):
        there = np.flatnonzero(tile_mask.any(axis)) * ssim_cpu.TILE
        spans.append(slice(int(there[0]), int(there[-1]) + ssim_cpu.TILE))
    return spans[0], spans[1]


def squared_error_map(
    x: Float32[np.ndarray, "H W 3"], y: Float32[np.ndarray, "H W 3"]
) -> Float32[np.ndarray, "H W"]:
    """Squared error at every pixel, averaged over the channels."""
    out = np.empty(x.shape[:2], np.float32)
    _squared_errors(x, y, out)
    return out


@njit(parallel=True, cache=True)
def _squared_errors(x, y, out):
    for row in prange(len(out)):
        for column in range(out.shape[1]):
            red = x[row, column, 0] - y[row, column, 0]
            green = x[row, column, 1] - y[row, column, 1]
            blue = x[row, column, 2] - y[row, column, 2]
            out[row, column] = (red * red + green * green + blue * blue) / np.float32(3)


def psnr(mean_squared_error: float | np.ndarray) -> Any:
    """Convert a mean squared error of images in [0, 1] to PSNR: -10 log10(error) dB, at most 100.

    Example:
        >>> from sagesplat.metrics.image import psnr
        >>> round(float(psnr(0.001)), 6)
        30.0
    """
    return -10.0 * np.log10(np.maximum(mean_squared_error, 1e-10))


def pasted(
    photo: Float32[np.ndarray, "H W 3"],
    image: Float32[np.ndarray, "H W 3"],
    valid: Bool[np.ndarray, "H W"] | None,
) -> Float32[np.ndarray, "H W 3"]:
    """The photo with the image itself where pixels do not count, so that windows find no difference there."""
    return photo if valid is None else np.where(valid[..., None], photo, image)


def means_by_label(
    values: Float[np.ndarray, "H W"],
    label_ids: Int[np.ndarray, "H W"],
    valid: Bool[np.ndarray, "H W"] | None = None,
) -> dict[int, tuple[float, int]]:
    """Mean of a map over each label's pixels (the `valid` ones), and how many there are, by label id."""
    if valid is not None:
        values, label_ids = values[valid], label_ids[valid]
    lowest, highest = int(label_ids.min(initial=0)), int(label_ids.max(initial=0))
    sums, counts = np.zeros(highest - lowest + 1), np.zeros(highest - lowest + 1, np.int64)
    _add_by_label(values.ravel(), label_ids.ravel(), lowest, sums, counts)
    return {int(i) + lowest: (float(sums[i] / counts[i]), int(counts[i])) for i in np.flatnonzero(counts)}


@njit(cache=True)
def _add_by_label(values, label_ids, lowest, sums, counts):
    at = 0
    while at < len(values):
        label, first = label_ids[at], at
        added = sums[label - lowest]  # neighbours share their label: a sum in a register
        while at < len(values) and label_ids[at] == label:
            added += values[at]
            at += 1
        sums[label - lowest] = added
        counts[label - lowest] += at - first


class _PhotometricLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        rgb: Tensor,
        photo: Tensor,
        ssim_weight: float,
        tile_mask: np.ndarray | None,
        space: Workspace,
    ) -> Tensor:
        x, y = to_planes(rgb, space, "ssim x"), to_planes(photo, space, "ssim y")
        height, width, channels = rgb.shape
        derivatives, tiles, quality = _maps(x, y, width, tile_mask, space, x[:0])
        grad, errors = space.take("ssim gradient", *x.shape), np.empty((channels, ssim_cpu.strips(height)))
        scales = np.float32(-ssim_weight / rgb.numel()), np.float32((1 - ssim_weight) / rgb.numel())
        ssim_cpu.gradient(x, y, tiles, derivatives, *scales, grad, errors)
        ctx.grad = to_image(grad, width)
        l1, share = float(errors.sum()) / rgb.numel(), ssim_cpu.covered(tiles, height, width)
        return torch.tensor((1 - ssim_weight) * l1 + ssim_weight * (share - quality))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor):
        grad = ctx.grad if grads[0] == 1 else ctx.grad * grads[0]
        return grad, None, None, None, None


def photometric_loss(
    rgb: Float[Tensor, "H W 3"],
    photo: Float[Tensor, "H W 3"] | UInt8[Tensor, "H W 3"],
    ssim_weight: float = SSIM_WEIGHT,
    tile_mask: Bool[np.ndarray, "h w"] | Bool[Tensor, "h w"] | None = None,
    workspace: Workspace | None = None,
    valid: Bool[Tensor, "H W"] | None = None,
) -> Tensor:
    """Compute the training loss of 3DGS: (1 - w) L1 + w (1 - SSIM); differentiable by `rgb`.

    Args:
        rgb: Rendered image, [H, W, 3].
        photo: The photo in [0, 1]; on a GPU it may be uint8.
        ssim_weight: w, 0.2 in Kerbl et al. 2023, eq. 7.
        tile_mask: bool [ceil(H/16), ceil(W/16)], a tensor on a GPU. Tiles that are False add nothing to the
            sum, which is divided by the number of all pixels; windows of other tiles see the photo there.
        workspace: Memory to use again (CPU only). Go backward before the next call with it.
        valid: bool [H, W]; None: all. Of other pixels the photo is not looked at, and their gradient is zero:
            windows see the rendering in both images there. The sum is divided by the number of all pixels.

    Returns:
        The loss, a scalar.

    Example:
        >>> import torch
        >>> from sagesplat.metrics.image import photometric_loss
        >>> rgb, photo = torch.full((32, 32, 3), 0.5, requires_grad=True), torch.full((32, 32, 3), 0.6)
        >>> loss = photometric_loss(rgb, photo)
        >>> loss.backward()
        >>> bool(loss > 0), rgb.grad.shape
        (True, torch.Size([32, 32, 3]))
    """
    if valid is not None:
        counts, rendered = valid[..., None], rgb.detach()
        photo = photo if photo.is_floating_point() else photo.float() / 255
        rgb, photo = torch.where(counts, rgb, rendered), torch.where(counts, photo, rendered)
    if rgb.is_cuda:
        from sagesplat.metrics import ssim_triton

        assert not isinstance(tile_mask, np.ndarray)
        return ssim_triton.photometric_loss(rgb, photo, ssim_weight, tile_mask)
    return _PhotometricLoss.apply(rgb, photo, ssim_weight, tile_mask, workspace or Workspace())  # type: ignore[return-value]
