"""Images as planes of colours, [3, H, W'] with W' a whole number of vectors, for a training step's kernels.

Taking colours apart costs as much as a pass of SSIM, so that images stay in planes from blending to their
gradient. Outside they are [H, W, 3] all the same: views with other strides.
"""

import numpy as np
import torch
from numba import prange
from torch import Tensor

from sagesplat.kernels.jit import njit
from sagesplat.kernels.simd import load_blue, load_green, load_red, store
from sagesplat.kernels.workspace import Workspace

LANES = 16


def padded(width: int) -> int:
    """A width as a number of whole vectors."""
    return -(-width // LANES) * LANES


def to_image(planes: np.ndarray, width: int) -> Tensor:
    """Planes as an image [H, W, C], in the same memory."""
    return torch.from_numpy(planes[..., :width].transpose(1, 2, 0))


def to_planes(image: Tensor, space: Workspace, name: str) -> np.ndarray:
    """An image [H, W, 3] as float32 planes [3, H, W'] with zeros beyond W.

    In the image's own memory where it holds such planes, else in the array `name` of the workspace.
    """
    height, width, channels = image.shape
    apart = image.detach().permute(2, 0, 1)
    if width % LANES == 0 and apart.is_contiguous():
        return apart.numpy()
    planes = space.take(name, channels, height, padded(width))
    planes[..., width:] = 0
    if image.is_contiguous():
        _take_apart(image.detach().numpy(), planes)
    else:
        planes[..., :width] = apart.numpy()
    return planes


def from_bytes(photo: Tensor) -> Tensor:
    """A uint8 photo [H, W, 3] as float32 in [0, 1], in planes where these are whole vectors."""
    height, width, channels = photo.shape
    if width % LANES:
        return photo.float() / 255
    planes = np.empty((channels, height, width), np.float32)
    _from_bytes(photo.contiguous().numpy(), planes)
    return to_image(planes, width)


@njit(parallel=True, cache=True)
def _from_bytes(photo, planes):
    for y in prange(len(photo)):
        for channel in range(3):
            for x in range(photo.shape[1]):
                planes[channel, y, x] = np.float32(photo[y, x, channel]) / np.float32(255)


@njit(parallel=True, cache=True)
def _take_apart(image, planes):
    height, width, _ = image.shape
    wide = planes.shape[2]
    plane, whole = height * wide, width // LANES * LANES
    for y in prange(height):
        for x in range(0, whole, LANES):
            at, to = 3 * (y * width + x), y * wide + x
            store(planes, to, load_red(image, at))
            store(planes, plane + to, load_green(image, at))
            store(planes, 2 * plane + to, load_blue(image, at))
        for x in range(whole, width):
            for channel in range(3):
                planes[channel, y, x] = image[y, x, channel]
