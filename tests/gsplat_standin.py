"""gsplat's five functions on a CPU, so that all of raster/cuda.py runs where there is no GPU.

Projection, binning and harmonics are gsplat's own torch code, in float64. Pixels are blended here, as its
kernels do: alphas cut at 0.999 and below 1/255, a pixel ends before its transmittance falls to 1e-4. What the
kernels leave unwritten is NaN here.
"""

import functools
import inspect
import math
from collections.abc import Callable
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import conftest
import gsplat
import pytest
import torch
from gsplat.cuda import _torch_impl as impl
from torch import Tensor

from sagesplat.core.gaussians import Gaussians
from sagesplat.raster import Backend, Render, cuda, rasterize
from sagesplat.scene.scene import Camera

NAN = float("nan")


def _project(means, covars, quats, scales, viewmats, Ks, width, height, **options) -> list[Any]:
    """Of the Gaussians that are drawn, one by one in order: their rows, then what gsplat gives of them."""
    assert covars is None
    assert len(means), "gsplat divides by the number of Gaussians"

    def project(rows: Any) -> tuple[Tensor, ...]:
        covar, _ = impl._quat_scale_to_covar_preci(quats[rows].double(), scales[rows].double(), True, False)
        cameras = viewmats.double(), Ks.double(), width, height, options["eps2d"]
        assert covar is not None
        found = impl._fully_fused_projection(
            means[rows].double(), covar, *cameras, options["near_plane"], options["far_plane"], True
        )
        return tuple(each[0] for each in found if each is not None)

    with torch.no_grad():
        _, means2d, depths, conics, compensations = project(slice(None))
        opacities = options["opacities"].double()
        if options["calc_compensations"]:
            opacities = opacities * compensations
        variances = conics[:, [2, 0]] / (conics[:, 0] * conics[:, 2] - conics[:, 1] ** 2)[:, None]
        reach = (2 * (opacities * 255).log()).sqrt().clamp_max(3.33)[:, None] * variances.sqrt()
        radii = reach.nan_to_num(0, 0, 0).ceil().int()
        size = torch.tensor([width, height])
        inside = ((means2d + radii > 0) & (means2d - radii < size)).all(-1)
        drawn = inside & (depths >= options["near_plane"]) & (opacities >= 1 / 255) & (radii > 0).all(-1)
    (rows,) = drawn.nonzero(as_tuple=True)
    found: list[Any] = [each.float() for each in project(rows)[1:]]
    if not options["calc_compensations"]:
        found[-1] = None
    return [rows, radii[rows], *found]


def fully_fused_projection(means, *arguments, packed: bool, **options) -> tuple[Tensor | None, ...]:
    rows, *found = _project(means, *arguments, **options)
    if packed:
        return (torch.zeros_like(rows), torch.zeros_like(rows), rows, *found)
    rest = [0, NAN, NAN, NAN, 0.0]  # the kernels write radii of 0, and compensations begin at zero
    spread = [
        None if each is None else each.new_full((len(means), *each.shape[1:]), fill).index_copy(0, rows, each)
        for each, fill in zip(found, rest, strict=True)
    ]
    return tuple(None if each is None else each[None] for each in spread)


def spherical_harmonics(degrees_to_use, dirs, coeffs, masks):
    colors = impl._spherical_harmonics(degrees_to_use, dirs.double(), coeffs.double()).float()
    return torch.where(masks[:, None], colors, NAN)


def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height):
    drawn = (radii > 0).all(-1)
    means2d = torch.where(drawn[..., None], means2d.detach(), 0.0)
    depths = torch.where(drawn, depths.detach(), 0.0)
    return impl._isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height)


def isect_offset_encode(isect_ids, n_images, tile_width, tile_height):
    return impl._isect_offset_encode(isect_ids, n_images, tile_width, tile_height)


def _blend(pixels, xy, conics, colors, opacities, background):
    """Colours [P, C] and alphas [P] of pixels [P, 2]; Gaussians front to back, with a mean for each pixel."""
    d = xy - pixels[:, None]
    sigma = 0.5 * (conics[:, 0] * d[..., 0] ** 2 + conics[:, 2] * d[..., 1] ** 2)
    sigma = sigma + conics[:, 1] * d[..., 0] * d[..., 1]
    alpha = (opacities * torch.exp(-sigma)).clamp_max(0.999)
    alpha = torch.where((sigma >= 0) & (alpha >= 1 / 255), alpha, 0.0)
    alpha = torch.where((1 - alpha).cumprod(1) > 1e-4, alpha, 0.0)
    after = (1 - alpha).cumprod(1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    left = before[:, -1:] * (1 - alpha[:, -1:]) if alpha.shape[1] else before.new_ones(len(pixels), 1)
    return (alpha * before) @ colors + left * background, 1 - left[:, 0]


class _RasterizeToPixels(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, conics, colors, opacities, background, masks, size, tile_size, offsets, ids):
        width, height = size
        image = torch.full((1, height, width, colors.shape[-1]), NAN)
        alphas = torch.full((1, height, width, 1), NAN)
        for window, pixels, rows in _tiles(size, tile_size, offsets, ids):
            if masks is not None and not masks[0][window[2]]:
                image[0][window[:2]] = background[0]
                continue
            xy, *others = [each[0][rows].double() for each in (means2d, conics, colors, opacities)]
            xy = xy.expand(len(pixels), -1, 2)
            painted, alpha = _blend(pixels, xy, *others, background=background[0].double())
            for whole, part in ((image[0], painted), (alphas[0], alpha)):
                whole[window[:2]] = part.reshape(whole[window[:2]].shape).float()
        ctx.save_for_backward(means2d, conics, colors, opacities, background, masks, offsets, ids)
        ctx.kept = size, tile_size
        return image, alphas

    @staticmethod
    def backward(ctx, g_image, g_alphas):  # type: ignore
        means2d, conics, colors, opacities, background, masks, offsets, ids = ctx.saved_tensors
        size, tile_size = ctx.kept
        grads = [torch.zeros_like(each[0]).double() for each in (means2d, conics, colors, opacities)]
        for window, pixels, rows in _tiles(size, tile_size, offsets, ids):
            if len(rows) == 0 or (masks is not None and not masks[0][window[2]]):
                continue
            with torch.enable_grad():
                inputs = [each[0][rows].double() for each in (means2d, conics, colors, opacities)]
                inputs[0] = inputs[0].expand(len(pixels), -1, 2).clone()
                inputs = [each.detach().requires_grad_() for each in inputs]
                xy, *others = inputs
                painted, alpha = _blend(pixels, xy, *others, background=background[0].double())
            wanted = (
                g_image[0][window[:2]].reshape(painted.shape),
                g_alphas[0][window[:2]].reshape(alpha.shape),
            )
            xy, *others = torch.autograd.grad((painted, alpha), inputs, [w.double() for w in wanted])
            for grad, part in zip(grads, (xy.sum(0), *others), strict=True):
                grad.index_add_(0, rows, part)
        return (*(grad.float()[None] for grad in grads), *[None] * 6)


def _tiles(size, tile_size: int, offsets: Tensor, ids: Tensor):
    """For every tile: where its pixels are (and the tile), their centres, its Gaussians front to back."""
    ends = [*offsets.flatten().tolist()[1:], len(ids)]
    for tile, (start, end) in enumerate(zip(offsets.flatten().tolist(), ends, strict=True)):
        y, x = divmod(tile, offsets.shape[-1])
        rows = slice(y * tile_size, min((y + 1) * tile_size, size[1]))
        columns = slice(x * tile_size, min((x + 1) * tile_size, size[0]))
        grid = torch.meshgrid(
            torch.arange(rows.start, rows.stop) + 0.5,
            torch.arange(columns.start, columns.stop) + 0.5,
            indexing="ij",
        )
        pixels = torch.stack([grid[1].flatten(), grid[0].flatten()], -1).double()
        yield (rows, columns, (y, x)), pixels, ids[start:end].long()


def rasterize_to_pixels(
    means2d, conics, colors, opacities, width, height, tile_size, offsets, ids, *, backgrounds, masks
):
    assert colors.shape[-1] in (1, 3, 4, 5, 8, 9, 16, 17, 32), "a count that is compiled"
    assert masks is None or masks.shape == offsets.shape
    assert offsets.shape == (1, math.ceil(height / tile_size), math.ceil(width / tile_size))
    assert means2d.shape[:-1] == conics.shape[:-1] == colors.shape[:-1] == opacities.shape
    inputs = [each.contiguous() for each in (means2d, conics, colors, opacities)]
    size = width, height
    return _RasterizeToPixels.apply(*inputs, backgrounds, masks, size, tile_size, offsets, ids)


FUNCTIONS = (
    fully_fused_projection,
    spherical_harmonics,
    isect_tiles,
    isect_offset_encode,
    rasterize_to_pixels,
)


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the `cuda` backend run here, on tensors on the CPU."""

    def checked(function: Callable[..., Any]) -> Callable[..., Any]:
        signature = inspect.signature(getattr(gsplat, function.__name__))  # type: ignore

        @functools.wraps(function)
        def call(*arguments: Any, **options: Any) -> Any:
            signature.bind(*arguments, **options)  # gsplat itself takes it too
            return function(*arguments, **options)

        return call

    functions = SimpleNamespace(**{function.__name__: checked(function) for function in FUNCTIONS})
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    monkeypatch.setattr(cuda, "kernels", lambda: functions)


def use_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let tests render on the real device, if there is one: what they hold stays on the CPU."""
    if gap := cuda.missing():
        pytest.skip(gap)

    def there(value: Any) -> Any:
        return value.cuda() if isinstance(value, Tensor) else value

    def rasterize_there(g: Gaussians, camera: Camera, **options: Any) -> Render:
        moved = {f.name: there(getattr(g, f.name)) for f in fields(g)}
        render = rasterize(Gaussians(**moved), camera, **{name: there(o) for name, o in options.items()})
        back = {f.name: getattr(render, f.name) for f in fields(render) if f.name != "means2d"}
        return replace(render, **{name: None if each is None else each.cpu() for name, each in back.items()})

    def either(g: Gaussians, camera: Camera, backend: Backend = "auto", **options: Any) -> Render:
        draw = rasterize_there if backend == "cuda" else rasterize
        return draw(g, camera, backend=backend, **options)

    monkeypatch.setattr(conftest, "rasterize", either)
