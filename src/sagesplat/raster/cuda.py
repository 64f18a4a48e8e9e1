"""The `cuda` backend: gsplat's kernels behind the contract of `sagesplat.raster.rasterize`.

gsplat 1.5.3 to 1.6. What differs from the other backends is compiled into its kernels:

- A pixel ends before the Gaussian that would bring its transmittance to 1e-4 or below; elsewhere that one
  still counts. Under alphas of 0.999 this is up to a tenth of the pixel's light.
- Gaussians at exactly the near plane are drawn; those beyond FAR are not.
- `radii` are whole pixels, rounded up.
- Sums are made by atomic additions, so the last bits of gradients differ between runs.
- Exponentials are `__expf` and, unless gsplat was compiled with NO_FAST_MATH=1, all arithmetic is fast math.
- With `trainable` or PACKED, Gaussians of equal depth keep the order of the rows within each group only.
- NaN and Inf are not looked for: that would wait for the device. A loss that is not finite shows them.

A rendering waits for the device once (gsplat counts the tiles that Gaussians touch), PACKED once more, and
`trainable` once for each new mask.
"""

import importlib.metadata
import importlib.util
import inspect
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad
from torch.utils.weak import WeakTensorKeyDictionary

from sagesplat.core.errors import BackendUnavailable, OutOfMemory
from sagesplat.core.extras import install
from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.core.sh import num_bases
from sagesplat.raster.render import BLUR, NEAR, TILE, Render
from sagesplat.scene.scene import Camera

DEVICE = "cuda"  # where tensors have to be
PACKED = False  # project into lists of what is in view: less memory, one more wait; tests draw both
FAR = 1e30  # gsplat wants one, the other backends have none
VERSIONS = ((1, 5, 3), (1, 7))  # of gsplat: from, below

# Channels that one pass takes: counts that all versions compile. Shared memory holds 32 on any device.
_CHANNELS = (1, 3, 4, 5, 8, 9, 16, 17, 32)
_ROWS = WeakTensorKeyDictionary()  # what `_rows` made of masks that still live


# --- is it there ----------------------------------------------------------------------------------------


def gsplat_version() -> str | None:
    """The installed gsplat's version, without importing it."""
    try:
        return importlib.metadata.version("gsplat")
    except importlib.metadata.PackageNotFoundError:
        return None


def nvcc() -> Path | None:
    """The CUDA compiler, looked for where torch and gsplat look."""
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH") or ""
    folders = [f"{home}/bin"] * bool(home) + [os.environ.get("PATH", ""), "/usr/local/cuda/bin"]
    found = shutil.which("nvcc", path=os.pathsep.join(folders))
    return Path(found) if found else None


def compiled() -> Path | None:
    """gsplat's kernels: beside its code, or where torch keeps what it compiles; None: not compiled yet."""
    spec = importlib.util.find_spec("gsplat")
    if spec is None:
        return None
    from torch.utils.cpp_extension import _get_build_directory

    places = [(Path(folder), "csrc") for folder in spec.submodule_search_locations or ()]
    places.append((Path(_get_build_directory("gsplat_cuda", verbose=False)), "gsplat_cuda"))
    found = (path for folder, name in places for path in folder.glob(f"{name}*"))
    return next((path for path in found if path.suffix in (".so", ".pyd")), None)


def missing() -> str | None:
    """What keeps this machine from the `cuda` backend, with its cure, in one line; None: nothing does."""
    if gap := device_gap() or version_gap():
        return gap
    if compiled() is None and nvcc() is None:
        return (
            "gsplat's kernels are not compiled and there is no nvcc to do it;"
            f" install the CUDA toolkit {torch.version.cuda} and set CUDA_HOME"
        )
    return None


def device_gap() -> str | None:
    """Why there is no device, and the cure."""
    if torch.version.cuda is None:
        return (
            f"torch {torch.__version__} is built without CUDA; install a build with it"
            " (https://pytorch.org/get-started) or use --device cpu"
        )
    if not torch.cuda.is_available():
        return (
            f"torch {torch.__version__} finds no CUDA device or driver; check nvidia-smi or use --device cpu"
        )
    return None


def version_gap() -> str | None:
    """What is wrong with the installed gsplat, and the cure."""
    version = gsplat_version()
    if version is None:
        return f"the cuda backend needs gsplat; {install('sagesplat[cuda]')}"
    numbers = tuple(map(int, re.findall(r"\d+", version.partition("+")[0])[:3]))
    if not VERSIONS[0] <= numbers < VERSIONS[1]:
        return f"gsplat {version} is not supported; {install('gsplat>=1.5.3,<1.7')}"
    return None


@cache
def kernels() -> Any:
    """gsplat, compiled: about a minute at the first use on a machine. Raises `BackendUnavailable`."""
    if gap := missing():
        raise BackendUnavailable(gap)
    try:
        import gsplat
        from gsplat.cuda import _backend
    except Exception as error:  # ninja, nvcc, the linker: each fails in its own way
        first = str(error).strip().partition("\n")[0] or type(error).__name__
        raise BackendUnavailable(
            f"gsplat's kernels do not compile or load ({first}); `sagesplat doctor --build` shows why"
        ) from error
    if _backend._C is None:
        raise BackendUnavailable("gsplat found no CUDA toolkit; set CUDA_HOME to the one that has nvcc")
    return gsplat


@contextmanager
def named_out_of_memory() -> Iterator[None]:
    """Name torch's out-of-memory error and its cure. A backward pass has to be wrapped by who starts it."""
    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        free, total = (b / 2**30 for b in torch.cuda.mem_get_info()) if torch.cuda.is_available() else (0, 0)
        raise OutOfMemory(
            f"the GPU is out of memory ({free:.1f} of {total:.1f} GiB free);"
            " use smaller photos (--downscale), fewer Gaussians (--train.max-gaussians) or --device cpu"
        ) from error


# --- projection and shading -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Splats:
    """Projected Gaussians, M of them. Rows with radius 0 hold anything, NaN too."""

    radii: Tensor  # int32 [M, 2], px
    means2d: Tensor  # [M, 2], px
    depths: Tensor  # [M]
    conics: Tensor  # [M, 3]
    opacities: Tensor  # [M]
    colors: Tensor  # [M, 3]
    rows: Tensor | None  # int64 [M], which Gaussians they are; None: all, in order

    def spread(self, values: Tensor, n: int) -> Tensor:
        """Values [M, ...] at the rows of N Gaussians, zeros at others."""
        if self.rows is None:
            return values
        return values.new_zeros(n, *values.shape[1:]).index_copy_(0, self.rows, values)


def _take(g: Gaussians, rows: Tensor) -> Gaussians:
    """Rows of the Gaussians. Unlike `select`, the gradient of this needs no sort."""
    return replace(g, **{name: getattr(g, name).index_select(0, rows) for name in (*PARAMETERS, "label_ids")})


def _small_motion(pose: Tensor) -> Tensor:
    """The matrix [4, 4] of a rotation vector and a translation near zero [6]: right to first order."""
    a, b, c, x, y, z = pose.unbind()
    one, zero = torch.ones_like(a), torch.zeros_like(a)
    rows = (one, -c, b, x, c, one, -a, y, -b, a, one, z, zero, zero, zero, one)
    return torch.stack(rows).view(4, 4)


def splat(g: Gaussians, camera: Camera, degree: int, antialiased: bool, pose: Tensor | None = None) -> Splats:
    """Project Gaussians into a view and shade them with harmonics up to `degree`."""
    opacities = g.logit_opacities.sigmoid()
    if len(g) == 0:  # gsplat divides by their number; all parameters take part, so that all get gradients
        none = g.means.new_zeros(0, 2, dtype=torch.int32)
        conics, colors = g.quats[:, :3] * g.log_scales, g.sh0[:, 0] + g.shN.sum(1)
        return Splats(none, g.means[:, :2], g.means[:, 2], conics, opacities, colors, None)
    packed = np.concatenate([camera.w2c.ravel(), camera.K.ravel(), camera.position]).astype(np.float32)
    packed = torch.from_numpy(packed).to(g.means.device, non_blocking=True)  # one copy, too small to wait for
    w2c, K, position = packed[:16].view(4, 4), packed[16:25].view(1, 3, 3), packed[25:]
    if pose is not None:
        w2c = _small_motion(pose) @ w2c
        position = -w2c[:3, :3].T @ w2c[:3, 3]
    found: Any = kernels().fully_fused_projection(
        g.means, None, g.quats, g.log_scales.exp(), w2c[None], K,
        camera.width, camera.height,
        eps2d=BLUR, near_plane=NEAR, far_plane=FAR, packed=PACKED, calc_compensations=antialiased,
        opacities=opacities,  # for tight bounding boxes; their gradient comes from the pixels
    )  # fmt: skip
    rows = None
    if PACKED:  # before the rest: batch, camera, Gaussian, and since 1.6 where each camera's begin
        rows = found[2].long()
        g, opacities = _take(g, rows), opacities.index_select(0, rows)
    else:
        found = [each if each is None else each[0] for each in found]
    radii, means2d, depths, conics, compensations = found[-5:]
    if compensations is not None:
        opacities = opacities * compensations
    coefficients = torch.cat([g.sh0, g.shN[:, : num_bases(degree) - 1]], 1)
    seen = (radii > 0).all(-1)
    colors = kernels().spherical_harmonics(degree, g.means - position, coefficients, masks=seen)
    return Splats(radii, means2d, depths, conics, opacities, (colors + 0.5).clamp_min(0), rows)


def _rows(trainable: Tensor) -> tuple[Tensor, Tensor]:
    """Indices of the rows that are true and of those that are false, kept as long as the mask lives."""
    kept = _ROWS.get(trainable)
    if kept is None or kept[0] != trainable._version:
        kept = trainable._version, trainable.nonzero()[:, 0], (~trainable).nonzero()[:, 0]
        _ROWS[trainable] = kept
    _, moving, still = kept
    return moving, still


def _project(
    g: Gaussians,
    camera: Camera,
    degree: int,
    antialiased: bool,
    trainable: Tensor | None,
    pose: Tensor | None = None,
) -> Splats:
    """All Gaussians; those that are not trainable in a call of their own, without a graph.

    With a pose in one call, without gradients of their parameters: that of the pose comes from all.
    """
    if trainable is None or len(_rows(trainable)[1]) == 0:
        return splat(g, camera, degree, antialiased, pose)
    if pose is not None:
        parts = {}
        for name in PARAMETERS:
            p = getattr(g, name)
            parts[name] = torch.where(trainable.view(-1, *[1] * (p.ndim - 1)), p, p.detach())
        return splat(replace(g, **parts), camera, degree, antialiased, pose)
    moving, still = _rows(trainable)
    parts = [splat(_take(g, moving), camera, degree, antialiased)]
    with torch.no_grad():
        parts.append(splat(_take(g, still), camera, degree, antialiased))
    groups = [
        rows if p.rows is None else rows[p.rows] for rows, p in zip((moving, still), parts, strict=True)
    ]
    names = [f.name for f in fields(Splats) if f.name != "rows"]
    return Splats(**{n: torch.cat([getattr(p, n) for p in parts]) for n in names}, rows=torch.cat(groups))


# --- pixels ---------------------------------------------------------------------------------------------


class _Watch(torch.autograd.Function):
    """2D means on their way to the pixels; the leaf beside them takes their gradient too."""

    @staticmethod
    def forward(ctx: Any, means2d: Tensor, leaf: Tensor):
        return means2d.view_as(means2d)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor):
        return grads[0], grads[0]


@cache
def _takes_conics(isect_tiles: Callable[..., Any]) -> bool:
    """Whether it lists the tiles of the ellipse (1.6), not of its box. To ask takes 0.1 ms."""
    return "conics" in inspect.signature(isect_tiles).parameters


class Tiles:
    """Which Gaussians touch which tiles of a view, and passes over its pixels."""

    def __init__(self, splats: Splats, camera: Camera, tile_mask: Tensor | None) -> None:
        self.size = camera.width, camera.height
        self.mask, self.pixels = None, None
        across, down = -(-camera.width // TILE), -(-camera.height // TILE)
        if tile_mask is not None:
            self.mask = tile_mask[None]
            pixels = (
                tile_mask[:, None, :, None].expand(-1, TILE, -1, TILE).reshape(down * TILE, across * TILE)
            )
            self.pixels = pixels[: camera.height, : camera.width]
        exact: dict[str, Tensor] = {}
        if _takes_conics(kernels().isect_tiles):
            exact = {"conics": splats.conics[None], "opacities": splats.opacities[None]}
        _, pairs, self.ids = kernels().isect_tiles(
            splats.means2d[None], splats.radii[None], splats.depths[None], TILE, across, down, **exact
        )
        self.offsets = kernels().isect_offset_encode(pairs, 1, across, down)

    def blend(
        self,
        means2d: Tensor,  # [1, M, 2]
        conics: Tensor,  # [M, 3]
        opacities: Tensor,  # [M]
        colors: Tensor,  # [M, C]
        behind: Tensor,  # [C]
    ) -> tuple[Tensor, Tensor]:
        """Channels [H, W, C] of colours over what is behind, and alpha [H, W]."""
        channels = colors.shape[1]
        if more := next(c for c in _CHANNELS if c >= channels) - channels:
            colors, behind = pad(colors, (0, more)), pad(behind, (0, more))
        image, alpha = kernels().rasterize_to_pixels(
            means2d, conics[None], colors[None], opacities[None], *self.size, TILE, self.offsets, self.ids,
            backgrounds=behind[None], masks=self.mask,
        )  # fmt: skip
        image, alpha = image[0, ..., :channels], alpha[0, ..., 0]
        if self.pixels is not None:  # gsplat leaves alpha as it finds it in tiles that it does not draw
            image = torch.where(self.pixels[..., None], image, behind[:channels])
            alpha = torch.where(self.pixels, alpha, 0.0)
        return image, alpha


@named_out_of_memory()
def render(
    g: Gaussians,
    camera: Camera,
    *,
    degree: int,
    background: Tensor,
    features: Tensor | None,
    antialiased: bool,
    tile_mask: np.ndarray | Tensor | None,
    trainable: Tensor | None,
    pose: Tensor | None,
) -> Render:
    """Render in float32 on a GPU; see `sagesplat.raster.rasterize` for the arguments.

    Raises `OutOfMemory`; a backward pass raises it where `named_out_of_memory` stands around it.
    """
    splats = _project(g, camera, degree, antialiased, trainable, pose)
    drawn = (splats.radii > 0).all(-1)
    radii = splats.spread(torch.where(drawn, splats.radii.amax(-1), 0).float(), len(g))
    leaf = splats.spread(torch.where(drawn[:, None], splats.means2d.detach(), 0.0), len(g))
    channels = splats.colors
    if features is not None:
        if trainable is not None:
            features = torch.where(trainable[:, None], features, features.detach())
        rows = splats.rows
        channels = torch.cat([channels, features if rows is None else features.index_select(0, rows)], 1)
    limit = _CHANNELS[-1]
    mask = None if tile_mask is None else torch.as_tensor(tile_mask, device=g.means.device)
    tiles = Tiles(splats, camera, mask)
    behind = pad(background.detach().float(), (0, channels.shape[1] - 3))
    shapes = splats.means2d[None], splats.conics, splats.opacities
    parameters = [getattr(g, name) for name in PARAMETERS]
    graphs = (*parameters, channels, splats.means2d)
    tracked = torch.is_grad_enabled() and any(p.requires_grad for p in graphs)
    if tracked:
        leaf.requires_grad_()
        if trainable is not None:
            leaf.register_hook(lambda grad: torch.where(trainable[:, None], grad, 0.0))
        watched = (leaf if splats.rows is None else leaf.index_select(0, splats.rows))[None]
        means2d: Any = _Watch.apply(shapes[0], watched)
        shapes = means2d, splats.conics, splats.opacities
    image, alpha = tiles.blend(*shapes, channels[:, :limit], behind[:limit])
    images = [image]
    for at in range(limit, channels.shape[1], limit):
        images.append(tiles.blend(*shapes, channels[:, at : at + limit], behind[at : at + limit])[0])
    image = torch.cat(images, -1) if len(images) > 1 else image
    return Render(image[..., :3], alpha, None if features is None else image[..., 3:], leaf, radii)


@named_out_of_memory()
def add_weights(
    g: Gaussians,
    camera: Camera,
    columns_of: np.ndarray | Tensor,  # int64 [H, W]
    out: np.ndarray | Tensor,  # float32 [N, columns], changed in place
    *,
    antialiased: bool,
) -> None:
    """See `sagesplat.raster.add_weights`. Each 32 columns are a forward and a backward pass."""
    with torch.no_grad():
        splats = _project(g, camera, 0, antialiased, None)
        tiles = Tiles(splats, camera, None)
    columns = torch.as_tensor(columns_of, device=g.means.device)
    for start in range(0, out.shape[1], _CHANNELS[-1]):
        some = torch.arange(start, min(start + _CHANNELS[-1], out.shape[1]), device=columns.device)
        with torch.enable_grad():
            ones = torch.zeros(len(splats.radii), len(some), device=columns.device, requires_grad=True)
            shapes = splats.means2d[None], splats.conics, splats.opacities
            image, _ = tiles.blend(*shapes, ones, ones.new_zeros(len(some)))
        (sums,) = torch.autograd.grad(image, ones, (columns[..., None] == some).float())
        sums = splats.spread(sums, len(g))
        part = out[:, start : start + len(some)]
        part += sums.to(part.device) if isinstance(part, Tensor) else sums.cpu().numpy()
