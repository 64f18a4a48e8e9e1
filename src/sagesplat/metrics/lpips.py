"""LPIPS: the distance of two images in the features of a network (Zhang et al. 2018, version 0.1)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor
from torch.nn import functional as F

from sagesplat.core.errors import BackendUnavailable, DataError, short
from sagesplat.io.files import cache_folder
from sagesplat.io.npz import Npz

Net = Literal["alex", "vgg"]

SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)  # of RGB in -1 ... 1
SCALE = np.array([0.458, 0.448, 0.450], np.float32)


@dataclass(frozen=True)
class _Layout:
    """The convolutions of a network, in blocks; what leaves a block is compared."""

    kernels: tuple[int, ...]  # side of the kernels, by block
    channels: tuple[tuple[int, ...], ...]  # output channels of each convolution, by block
    pooled: tuple[int, ...]  # blocks that a maximum over `window` x `window` pixels, step 2, goes before
    window: int
    stride: int  # of the first convolution; 1 for the others
    smallest: int  # side of an image of which every block still has a pixel, px


_LAYOUTS: dict[Net, _Layout] = {
    "alex": _Layout((11, 5, 3, 3, 3), ((64,), (192,), (384,), (256,), (256,)), (1, 2), 3, 4, 31),
    "vgg": _Layout(
        (3,) * 5, ((64,) * 2, (128,) * 2, (256,) * 3, (512,) * 3, (512,) * 3), (1, 2, 3, 4), 2, 1, 16
    ),
}


@dataclass(frozen=True, eq=False)
class Features:
    """What a network sees in an image; 122 (vgg) or 11 (alex) floats per pixel."""

    shape: tuple[int, ...]  # of the image
    blocks: tuple[Float32[Tensor, "_ _ _"], ...]  # [C, h, w] of unit length over C; none: image too small


@dataclass(frozen=True, eq=False)
class Lpips:
    """The metric: 0 = the same image, about 1 = nothing in common. `load_lpips` makes it.

    Images are RGB in [0, 1]. To compare several images with one, keep that one's features:

        photo = lpips.features(image)
        values = [lpips.distance(photo, lpips.features(render)) for render in renders]
    """

    net: Net
    weights: dict[str, Float32[Tensor, "..."]]  # names and shapes: `shapes`
    as_3dgs: bool = False  # leave out the map from [0, 1] to [-1, 1]

    def __call__(self, x: Float[np.ndarray, "H W 3"], y: Float[np.ndarray, "H W 3"]) -> float:
        """The `distance` of two images of one size."""
        return self.distance(self.features(x), self.features(y))

    @torch.inference_mode()
    def features(self, image: Float[np.ndarray, "H W 3"]) -> Features:
        """What `distance` compares: the network's features after each block, scaled to unit length."""
        layout, k, blocks = _LAYOUTS[self.net], 0, []
        if image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(f"an image of shape {image.shape}, but [H, W, 3] is needed")
        if min(image.shape[:2]) < layout.smallest:
            return Features(image.shape, ())
        rgb = np.asarray(image, np.float32)
        rgb = ((rgb if self.as_3dgs else 2 * rgb - 1) - SHIFT) / SCALE
        x = torch.from_numpy(rgb)[None].permute(0, 3, 1, 2)  # channels stay last in memory: a third faster
        for i, (kernel, channels) in enumerate(zip(layout.kernels, layout.channels, strict=True)):
            if i in layout.pooled:
                x = F.max_pool2d(x, layout.window, 2)
            for _ in channels:
                stride = layout.stride if k == 0 else 1
                weight, bias = self.weights[f"conv{k}.weight"], self.weights[f"conv{k}.bias"]
                x = F.conv2d(x, weight, bias, stride, min(kernel // 2, 2)).relu_()
                k += 1
            length = torch.linalg.vector_norm(x, dim=1, keepdim=True)
            blocks.append((x / (length + 1e-10))[0])
        return Features(image.shape, tuple(blocks))

    @torch.inference_mode()
    def distance(self, x: Features, y: Features) -> float:
        """Eq. 1 of the paper: squared differences, weighted by channel, mean over pixels, sum over blocks.

        Takes what this metric's `features` gave. NaN for images too small for the network: with a side below
        16 px (vgg) or 31 px (alex). Raises ValueError for images of different size.
        """
        if x.shape != y.shape:
            raise ValueError(f"images of shape {x.shape} and {y.shape} cannot be compared")
        if not x.blocks:
            return float("nan")
        pairs = enumerate(zip(x.blocks, y.blocks, strict=True))
        return sum(float((a - b).square_().mean((1, 2)) @ self.weights[f"lin{i}"]) for i, (a, b) in pairs)


def load_lpips(net: Net, folder: Path | None = None, *, as_3dgs: bool = False) -> Lpips:
    """The metric with the weights in lpips_{net}.npz of `folder` (default: the cache); or name the file.

    The default is the metric as its authors define it: images are mapped from [0, 1] to [-1, 1] first. The
    evaluation of 3DGS leaves that out for vgg, and so do gsplat and nerfbaselines (for alex, they do not):
    `as_3dgs` gives numbers to put beside theirs. Raises BackendUnavailable where the file is missing and
    DataError where it is damaged.
    """
    path = folder if folder and folder.suffix == ".npz" else weights_path(net, folder)
    cure = "run `sagesplat download lpips` or give --lpips FOLDER"
    try:
        with Npz(path) as arrays:
            weights = {name: checked(name, arrays[name], shape) for name, shape in shapes(net).items()}
    except (FileNotFoundError, NotADirectoryError):
        raise BackendUnavailable(f"{path}: no such file, but LPIPS needs it; {cure}") from None
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: not the weights of LPIPS {net} ({short(error)}); {cure}") from None
    return Lpips(net, {name: torch.from_numpy(array) for name, array in weights.items()}, as_3dgs)


def weights_path(net: Net, folder: Path | None = None) -> Path:
    """Where the weights of `net` lie in `folder` (default: the cache)."""
    return (folder or cache_folder() / "lpips") / f"lpips_{net}.npz"


def shapes(net: Net) -> dict[str, tuple[int, ...]]:
    """Shape of each array in the file of weights: convK.weight [out, in, k, k], convK.bias, linK."""
    result: dict[str, tuple[int, ...]] = {}
    layout, inputs, k = _LAYOUTS[net], 3, 0
    for i, (kernel, channels) in enumerate(zip(layout.kernels, layout.channels, strict=True)):
        for outputs in channels:
            result[f"conv{k}.weight"], result[f"conv{k}.bias"] = (outputs, inputs, kernel, kernel), (outputs,)
            inputs, k = outputs, k + 1
        result[f"lin{i}"] = (inputs,)
    return result


def checked(name: str, array: Any, shape: tuple[int, ...]) -> Float32[np.ndarray, "..."]:
    """`array` as float32. Raises ValueError where it is of another shape or not finite."""
    if tuple(array.shape) != shape:  # first: a few bytes can stand for an array of any size
        raise ValueError(f"{name} is of shape {list(array.shape)}, not {list(shape)}")
    with np.errstate(all="ignore"):  # infinite then
        array = np.asarray(array, np.float32)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has values that are not finite")
    return array
