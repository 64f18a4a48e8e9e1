"""Rasterising Gaussians: one function, several backends."""

from typing import Literal

import numba
import numpy as np
import torch
from jaxtyping import Float32, Int64
from numba.core import config as numba_config
from torch import Tensor

from sagesplat.errors import BackendUnavailable
from sagesplat.gaussians import Gaussians
from sagesplat.raster.render import Render
from sagesplat.scene.scene import Camera
from sagesplat.workspace import Workspace

__all__ = ["Backend", "Render", "Workspace", "add_weights", "rasterize", "resolve_backend", "set_threads"]

Backend = Literal["auto", "cpu", "reference"]


def resolve_backend(backend: Backend, device: str = "auto") -> Backend:
    """The backend that `auto` stands for on this machine; a named one must be there."""
    if backend not in ("auto", "cpu", "reference"):
        raise BackendUnavailable(f"backend {backend!r} is not known; use --backend cpu or reference")
    if device not in ("auto", "cpu"):
        raise BackendUnavailable(f"device {device!r} has no rasteriser in this version; use --device cpu")
    return "cpu" if backend == "auto" else backend


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
    tile_mask: np.ndarray | None = None,
    workspace: Workspace | None = None,
    backend: Backend = "auto",
) -> Render:
    """Render Gaussians into a camera, with gradients for all their parameters and for `features`.

    `sh_degree`: harmonics up to this degree (default: all there are). `background` [3] lies behind everything
    (default black). `features` [N, C] are blended like colours, over zero. `antialiased` scales opacities by
    the area that the low-pass adds (Mip-Splatting's 2D filter as gsplat has it). `tile_mask` bool
    [ceil(H/16), ceil(W/16)]: tiles that are false show the background and take no gradient (`cpu` only).
    `workspace`: memory to use again; results and gradients hold until the next call with it (`cpu` only).
    The 2D means of the result carry a `.grad` after `backward()`. Raises `DataError` for NaN or Inf.
    """
    degree = gaussians.sh_degree if sh_degree is None else min(sh_degree, gaussians.sh_degree)
    if background is None:
        background = torch.zeros(3)
    shared = {"degree": degree, "background": background, "features": features, "antialiased": antialiased}
    if resolve_backend(backend) == "reference":
        from sagesplat.raster import reference

        return reference.render(gaussians, camera, **shared)
    from sagesplat.raster import cpu

    return cpu.render(gaussians, camera, tile_mask=tile_mask, workspace=workspace, **shared)


def add_weights(
    gaussians: Gaussians,
    camera: Camera,
    columns_of: Int64[np.ndarray, "H W"],
    out: Float32[np.ndarray, "N C"],
    *,
    antialiased: bool = False,
    workspace: Workspace | None = None,
) -> None:
    """Add each Gaussian's blending weight (alpha times transmittance) over a view's pixels to `out`.

    `columns_of` tells the column of `out` for each pixel, by its label for instance; -1: the pixel counts
    nowhere. It is the gradient of a rendering of features that are 1 where a pixel's column is. `cpu` only.
    """
    from sagesplat.raster import cpu

    cpu.add_weights(gaussians, camera, columns_of, out, antialiased=antialiased, workspace=workspace)
