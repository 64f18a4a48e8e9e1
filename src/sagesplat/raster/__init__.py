"""Rasterising Gaussians: one function, several backends."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Literal, TypeVar

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, Int64
from numba.core import config as numba_config
from torch import Tensor

from sagesplat.core.errors import BackendUnavailable, DataError
from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.kernels.threads import side_by_side
from sagesplat.kernels.workspace import Workspace
from sagesplat.raster.exposure import expose
from sagesplat.raster.render import TILE, Render
from sagesplat.scene.scene import Camera

__all__ = [
    "TILE", "Backend", "Render", "Workspace", "add_weights", "device_of", "each_view", "expose",
    "rasterize", "resolve_backend", "set_threads",
]  # fmt: skip

Item = TypeVar("Item")
Result = TypeVar("Result")
Backend = Literal["auto", "cpu", "cuda", "reference"]


def resolve_backend(backend: Backend, device: str = "auto") -> Backend:
    """The backend that `auto` stands for: `cuda` where the device says so, else `cpu`.

    Raises `BackendUnavailable` where `cuda` is asked for and this machine does not have it.
    """
    if backend not in ("auto", "cpu", "cuda", "reference"):
        raise BackendUnavailable(f"backend {backend!r} is not known; use cpu, cuda or reference")
    if device not in ("auto", "cpu", "cuda"):
        raise BackendUnavailable(f"device {device!r} is not known; use --device cpu or cuda")
    if backend == "auto":
        backend = "cuda" if device == "cuda" else "cpu"
    if device != "auto" and (backend == "cuda") != (device == "cuda"):
        raise BackendUnavailable(f"backend {backend} does not run on {device}; leave one of them out")
    if backend == "cuda":
        from sagesplat.raster import cuda

        if gap := cuda.missing():
            raise BackendUnavailable(gap)
    return backend


def prepared(device: str = "auto", backend: Backend = "auto", threads: int = 0) -> tuple[Backend, int]:
    """What this machine computes with, a GPU where one works and nothing else is asked for; sets the threads.

    As `resolve_backend` and `set_threads`.
    """
    from sagesplat.raster import cuda

    if (device, backend) == ("auto", "auto") and cuda.missing() is None:
        device = "cuda"
    return resolve_backend(backend, device), set_threads(threads)


def device_of(backend: Backend, rank: int = 0) -> torch.device:
    """Where a backend computes; with several GPUs, the one of a process."""
    return torch.device("cuda", rank) if backend == "cuda" else torch.device("cpu")


def each_view(
    function: Callable[[Item], Result], views: Sequence[Item], device: torch.device
) -> Iterator[Result]:
    """The results of a function that renders a view, in the order of `views`; on a CPU several at once."""
    return map(function, views) if device.type == "cuda" else side_by_side(function, views)


def set_threads(threads: int = 0) -> int:
    """Set the number of CPU threads of kernels and torch, for the whole process.

    Args:
        threads: Number of threads; 0: one per core. More than the cores are cut to the cores.

    Returns:
        The number that is used.
    """
    most = numba_config.NUMBA_NUM_THREADS  # type: ignore
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
    pose: Float[Tensor, "6"] | None = None,
    workspace: Workspace | None = None,
    backend: Backend = "auto",
) -> Render:
    """Render Gaussians into a camera, with gradients for all their parameters and for `features`.

    Gaussians are projected by EWA splatting and blended front to back in tiles of 16 x 16 pixels
    (Kerbl et al. 2023, eqs. 3 to 6). Constants are gsplat's: see `raster.render`.

    Args:
        gaussians: N Gaussians, all tensors on one device.
        camera: Pose, intrinsics in pixels, and size of the image (H, W). Its `exposure` is applied to the
            image, background included.
        sh_degree: Harmonics up to this degree are used; None: all there are.
        background: RGB in [0, 1] behind everything, [3]; None: the camera's.
        features: [N, C], blended like colours, over zero; C is any number.
        antialiased: Scale opacities by what the low-pass adds to the area (Mip-Splatting's 2D filter).
        tile_mask: bool [ceil(H/16), ceil(W/16)]; tiles that are False show the background, without gradients.
        trainable: bool [N]; rows that are False are drawn, and their gradients are zero. Pass the same tensor
            at every step: `cuda` caches what it derives from it.
        pose: Zeros [6] that require a gradient; it is that of a small motion of the camera in its own frame:
            x' = R x + t for x in camera coordinates, with the rotation vector `pose[:3]` (rad) and
            t = `pose[3:]` (world units). All Gaussians take part, trainable or not.
        workspace: Memory to use again (`cpu` only). Results and gradients hold until the next call with it.
        backend: "cpu", "cuda", "reference" (float64, slow) or "auto": the one of the device of the means.

    Returns:
        rgb [H, W, 3], alpha [H, W], features [H, W, C] or None, means2d [N, 2] px, radii [N] px (0: not
        drawn). After `backward()`, `means2d.grad` [N, 2] holds the gradient of the loss per pixel.

    Raises:
        DataError: For NaN or Inf (`cpu` only: `cuda` would have to wait for the device), tensors on several
            devices, or shapes that do not fit.
        BackendUnavailable: For a backend that this machine does not have.
        OutOfMemory: From `cuda`.

    Example:
        >>> import numpy as np, torch
        >>> from sagesplat import Camera, Gaussians, rasterize
        >>> K = np.array([[60, 0, 32], [0, 60, 24], [0, 0, 1]], np.float32)  # pixels
        >>> camera = Camera(np.eye(4, dtype=np.float32), K, width=64, height=48)
        >>> g = Gaussians(
        ...     means=torch.tensor([[0.0, 0.0, 4.0]]), quats=torch.tensor([[1.0, 0, 0, 0]]),
        ...     log_scales=torch.full((1, 3), -1.0), logit_opacities=torch.tensor([2.0]),
        ...     sh0=torch.ones(1, 1, 3), shN=torch.zeros(1, 0, 3),
        ...     label_ids=torch.zeros(1, dtype=torch.int16),
        ... )
        >>> render = rasterize(g, camera)
        >>> render.rgb.shape, bool(render.alpha[24, 32] > 0.8)
        (torch.Size([48, 64, 3]), True)
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
        background=background, features=features, tile_mask=tile_mask, trainable=trainable, pose=pose,
    )  # fmt: skip
    shared = {
        "degree": degree,
        "background": background,
        "features": features,
        "antialiased": antialiased,
        "tile_mask": tile_mask,
        "trainable": trainable,
        "pose": pose,
    }
    if backend == "reference":
        from sagesplat.raster import reference

        render = reference.render(gaussians, camera, **shared)
    elif backend == "cuda":
        from sagesplat.raster import cuda

        render = cuda.render(gaussians, camera, **shared)
    else:
        from sagesplat.raster import cpu

        render = cpu.render(gaussians, camera, workspace=workspace, **shared)
    if camera.exposure is None:
        return render
    exposure = torch.from_numpy(camera.exposure).to(render.rgb.device)
    return replace(render, rgb=expose(render.rgb, exposure))


def in_sight(
    gaussians: Gaussians,
    camera: Camera,
    *,
    antialiased: bool = False,
    tile_mask: Bool[np.ndarray, "tiles_y tiles_x"] | None = None,
    backend: Backend = "auto",
    workspace: Workspace | None = None,
) -> Bool[Tensor, " N"]:
    """Whether each Gaussian is drawn in a view, hidden behind others or not. Arguments as of `rasterize`.

    With a `tile_mask` those that reach none of its tiles may be said not to be.
    """
    if resolve_backend(backend) == "cpu":
        from sagesplat.raster import cpu

        radii = cpu.radii_of(gaussians, camera, antialiased, workspace or Workspace(), tile_mask)
        return torch.from_numpy(radii > 0)
    with torch.no_grad():
        return rasterize(gaussians, camera, sh_degree=0, antialiased=antialiased, backend=backend).radii > 0


def most_painted(
    gaussians: Gaussians,
    camera: Camera,
    columns_of: Int[Tensor, " N"],
    num_columns: int,
    *,
    antialiased: bool = False,
    tile_mask: Bool[np.ndarray, "tiles_y tiles_x"] | None = None,
    backend: Backend = "auto",
    workspace: Workspace | None = None,
) -> Int64[np.ndarray, "H W"]:
    """Which column's Gaussians paint most of each pixel, as by their blending weights.

    What shines through between them counts for column 0, and so does all of a tile that is masked.
    `columns_of`: of each Gaussian, 0 to `num_columns` - 1. The other arguments are those of `rasterize`.
    """
    if resolve_backend(backend) == "cpu":
        from sagesplat.raster import cpu

        space = workspace or Workspace()
        columns = columns_of.numpy()
        return cpu.most_painted(gaussians, camera, columns, num_columns, antialiased, space, tile_mask)
    one_hot = torch.nn.functional.one_hot(columns_of.long(), num_columns).float()
    with torch.no_grad():
        render = rasterize(
            gaussians, camera,
            features=one_hot, sh_degree=0, antialiased=antialiased, tile_mask=tile_mask, backend=backend,
        )  # fmt: skip
    assert render.features is not None
    painted = render.features.float().cpu().numpy().copy()
    painted[..., 0] += 1 - render.alpha.float().cpu().numpy()
    return painted.argmax(-1)


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
    for name, shape in (("tile_mask", tiles), ("trainable", (len(gaussians),)), ("pose", (6,))):
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
