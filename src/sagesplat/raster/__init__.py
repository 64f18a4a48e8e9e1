"""Rasterising Gaussians: one function, several backends."""

from typing import Literal

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from numba.core import config as numba_config
from torch import Tensor

from sagesplat.core.errors import BackendUnavailable, DataError
from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.kernels.workspace import Workspace
from sagesplat.raster.render import TILE, Render
from sagesplat.scene.scene import Camera

__all__ = [
    "TILE", "Backend", "Render", "Workspace", "add_weights", "device_of", "rasterize", "resolve_backend",
    "set_threads",
]  # fmt: skip

Backend = Literal["auto", "cpu", "cuda", "reference"]


def resolve_backend(backend: Backend, device: str = "auto") -> Backend:
    """The backend that `auto` stands for: `cuda` where the device says so, else `cpu`.

    Raises `BackendUnavailable` where `cuda` is asked for and this machine does not have it.
    """
    if backend not in ("auto", "cpu", "cuda", "reference"):
        raise BackendUnavailable(f"backend {backend!r} is not known; use --backend cpu, cuda or reference")
    if device not in ("auto", "cpu", "cuda"):
        raise BackendUnavailable(f"device {device!r} is not known; use --device cpu or cuda")
    if backend == "auto":
        backend = "cuda" if device == "cuda" else "cpu"
    if device != "auto" and (backend == "cuda") != (device == "cuda"):
        raise BackendUnavailable(
            f"backend {backend} does not run on {device}; leave out --backend or --device"
        )
    if backend == "cuda":
        from sagesplat.raster import cuda

        if gap := cuda.missing():
            raise BackendUnavailable(gap)
    return backend


def device_of(backend: Backend, rank: int = 0) -> torch.device:
    """Where a backend computes; with several GPUs, the one of a process."""
    return torch.device("cuda", rank) if backend == "cuda" else torch.device("cpu")


def set_threads(threads: int = 0) -> int:
    """Let kernels and torch use so many threads (0: one per core); the number comes back."""
    most = numba_config.NUMBA_NUM_THREADS  # pyright: ignore[reportAttributeAccessIssue]
    threads = min(threads, most) if threads > 0 else most
    numba.set_num_threads(threads)
    torch.set_num_threads(threads)
    return threads


def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    *,
    sh_degree: int | None = None,
    background: Tensor | None = None,
    features: Tensor | None = None,
    antialiased: bool = False,
    tile_mask: Bool[np.ndarray, "tiles_y tiles_x"] | Bool[Tensor, "tiles_y tiles_x"] | None = None,
    trainable: Bool[Tensor, " N"] | None = None,
    absgrad: bool = False,
    workspace: Workspace | None = None,
    backend: Backend = "auto",
) -> Render:
    """Render Gaussians into a camera, with gradients for all their parameters and for `features`.

    `sh_degree`: harmonics up to this degree (default: all there are). `background` [3] lies behind everything
    (default: the camera's). `features` [N, C] are blended like colours, over zero. `antialiased` scales
    opacities by the area that the low-pass adds (Mip-Splatting's 2D filter as gsplat has it). `tile_mask`
    bool [ceil(H/16), ceil(W/16)]: tiles that are false show the background and take no gradient.
    `trainable` bool [N]: rows that are false are drawn, but get no gradient (zeros); pass the same tensor at
    every step, `cuda` keeps what it makes of it. `workspace`: memory to use again; results and gradients hold
    until the next call with it (`cpu` only). `backend` auto: the one of the device that the means are on.

    The 2D means of the result carry a `.grad` after `backward()`: loss per pixel; with `absgrad` the sums
    over pixels of the absolute gradients (AbsGS, arXiv:2404.10484). Raises `DataError` for NaN or Inf (`cpu`
    only: `cuda` does not wait for the device to look), for tensors on several devices and for shapes that do
    not fit, `BackendUnavailable` for what this machine does not have, `OutOfMemory` from `cuda`.
    """
    degree = gaussians.sh_degree if sh_degree is None else min(sh_degree, gaussians.sh_degree)
    if background is None:
        background = gaussians.means.new_zeros(3)
        if any(camera.background):  # copying it to a GPU each time would wait for it
            background += background.new_tensor(camera.background) / 255
    if backend == "auto":
        backend = "cuda" if gaussians.means.is_cuda else "cpu"
    elif backend != "cuda":  # that one says itself what it misses
        backend = resolve_backend(backend)
    _check(
        backend, gaussians, camera,
        background=background, features=features, tile_mask=tile_mask, trainable=trainable,
    )  # fmt: skip
    shared = {
        "degree": degree,
        "background": background,
        "features": features,
        "antialiased": antialiased,
        "tile_mask": tile_mask,
        "trainable": trainable,
        "absgrad": absgrad,
    }
    if backend == "reference":
        from sagesplat.raster import reference

        return reference.render(gaussians, camera, **shared)
    if backend == "cuda":
        from sagesplat.raster import cuda

        return cuda.render(gaussians, camera, **shared)
    from sagesplat.raster import cpu

    return cpu.render(gaussians, camera, workspace=workspace, **shared)


def _check(
    backend: Backend, gaussians: Gaussians, camera: Camera, **others: Tensor | np.ndarray | None
) -> None:
    """Refuse what no kernel checks: tensors that lie elsewhere and masks of another size."""
    home = "cpu"
    if backend == "cuda":
        from sagesplat.raster import cuda

        home = cuda.DEVICE
    means = gaussians.means.device
    if means.type != home:
        raise DataError(
            f"means is on {means}, but backend {backend} draws what is on {home}; move the Gaussians there"
        )
    tensors = {name: getattr(gaussians, name) for name in PARAMETERS} | others
    for name, tensor in tensors.items():
        if isinstance(tensor, Tensor) and tensor.device != means:
            raise DataError(f"{name} is on {tensor.device}, means is on {means}; move them to one device")
    tiles = (-(-camera.height // TILE), -(-camera.width // TILE))
    for name, shape in (("tile_mask", tiles), ("trainable", (len(gaussians),))):
        given = others.get(name)
        if given is not None and tuple(given.shape) != shape:
            raise DataError(f"{name} has shape {tuple(given.shape)}, not {shape}; make it for this view")


def add_weights(
    gaussians: Gaussians,
    camera: Camera,
    columns_of: Int64[np.ndarray, "H W"] | Int64[Tensor, "H W"],
    out: Float32[np.ndarray, "N C"] | Float32[Tensor, "N C"],
    *,
    antialiased: bool = False,
    workspace: Workspace | None = None,
) -> None:
    """Add each Gaussian's blending weight (alpha times transmittance) over a view's pixels to `out`.

    `columns_of` tells the column of `out` for each pixel, by its label for instance; -1: the pixel counts
    nowhere. It is the gradient of a rendering of features that are 1 where a pixel's column is, and on a GPU
    (where the means are on one) it is computed as that. Arrays or tensors, wherever they are.
    """
    if gaussians.means.is_cuda:
        from sagesplat.raster import cuda

        cuda.add_weights(gaussians, camera, columns_of, out, antialiased=antialiased)
        return
    from sagesplat.raster import cpu

    arrays = [a.detach().cpu().numpy() if isinstance(a, Tensor) else a for a in (columns_of, out)]
    cpu.add_weights(gaussians, camera, *arrays, antialiased=antialiased, workspace=workspace)
    if isinstance(out, Tensor) and out.device.type != "cpu":
        out.copy_(torch.from_numpy(arrays[1]))
