"""Image quality: SSIM maps, PSNR, their means over label masks, and the training loss."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from sagesplat import ssim

SSIM_WEIGHT = 0.2  # of the published 3DGS loss: 0.8 L1 + 0.2 (1 - SSIM)


def _maps(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    height, width, channels = x.shape
    values = np.empty((channels, height, width), np.float32)
    derivatives = np.empty((3, channels, height, width), np.float32)
    ssim.compare(x, y, values, derivatives)
    return values, derivatives


def ssim_map(x: Float32[np.ndarray, "H W 3"], y: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
    """SSIM at every pixel, averaged over the channels; images in [0, 1], 11x11 window, zero padding."""
    return _maps(np.ascontiguousarray(x), np.ascontiguousarray(y))[0].mean(0)


def squared_error_map(
    x: Float32[np.ndarray, "H W 3"], y: Float32[np.ndarray, "H W 3"]
) -> Float32[np.ndarray, "H W"]:
    """Squared error at every pixel, averaged over the channels."""
    return np.square(x - y).mean(-1)


def psnr(mean_squared_error: float | np.ndarray) -> Any:
    """Decibels of a mean squared error of images in [0, 1]; at most 100."""
    return -10.0 * np.log10(np.maximum(mean_squared_error, 1e-10))


def means_by_label(
    values: Float[np.ndarray, "H W"], label_ids: Int[np.ndarray, "H W"]
) -> dict[int, tuple[float, int]]:
    """Mean of a map over each label's pixels, and how many there are, by label id."""
    lowest = int(label_ids.min(initial=0))
    shifted = label_ids.ravel().astype(np.int64) - lowest
    counts = np.bincount(shifted)
    sums = np.bincount(shifted, weights=values.ravel())
    return {int(i) + lowest: (float(sums[i] / counts[i]), int(counts[i])) for i in np.flatnonzero(counts)}


class _PhotometricLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rgb: Tensor, photo: Tensor, ssim_weight: float) -> Tensor:
        x, y = rgb.detach().contiguous().numpy(), photo.contiguous().numpy()
        values, derivatives = _maps(x, y)
        grad = np.zeros_like(x)
        ssim.gradient(
            x, y, derivatives, np.float32(-ssim_weight / x.size), np.float32((1 - ssim_weight) / x.size), grad
        )
        ctx.grad = torch.from_numpy(grad)
        l1 = float(np.abs(x - y).mean())
        return torch.tensor((1 - ssim_weight) * l1 + ssim_weight * (1 - float(values.mean())))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor):
        return ctx.grad * grads[0], None, None


def photometric_loss(
    rgb: Float[Tensor, "H W 3"], photo: Float[Tensor, "H W 3"], ssim_weight: float = SSIM_WEIGHT
) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM), as 3DGS trains; differentiable by `rgb`."""
    return _PhotometricLoss.apply(rgb, photo, ssim_weight)  # type: ignore[return-value]
