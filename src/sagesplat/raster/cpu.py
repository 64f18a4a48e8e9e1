"""The `cpu` backend: numba kernels behind one autograd function."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagesplat import sh
from sagesplat.errors import DataError
from sagesplat.gaussians import PARAMETERS, Gaussians
from sagesplat.raster import blend, project, tiles
from sagesplat.raster.render import Render
from sagesplat.scene.scene import Camera

_CHUNK = 3  # channels that one blending pass takes

_Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # PARAMETERS


@dataclass(frozen=True)
class _Options:
    camera: Camera
    degree: int
    antialiased: bool
    tile_mask: np.ndarray | None


def _array(tensor: Tensor) -> np.ndarray:
    """A float32 tensor's memory as an array."""
    return tensor.detach().contiguous().numpy()


def _arrays(parameters: Sequence[Tensor]) -> _Arrays:
    means, quats, log_scales, logits, sh0, shN = map(_array, parameters)
    return means, quats, log_scales, logits, sh0, shN


def _project(options: _Options, parameters: _Arrays):
    n = len(parameters[0])
    records = np.empty((n, blend.RECORD), np.float32)
    depths, radii = np.empty(n, np.float32), np.empty(n, np.float32)
    project.forward(
        project.camera_vector(options.camera), *parameters, sh.num_bases(options.degree), options.antialiased,
        records, depths, radii,
    )  # fmt: skip
    if n and radii.min() < 0:
        bad = np.flatnonzero(radii < 0)
        raise DataError(
            f"{len(bad)} of {n} Gaussians hold NaN or Inf (first row {bad[0]}); drop them before rendering"
        )
    return records, depths, radii


class _Rasterize(torch.autograd.Function):
    """(parameters, features, background, means2d leaf) -> rgb, alpha, features; radii and means2d aside."""

    @staticmethod
    def forward(
        ctx: Any,
        options: _Options,
        means2d: Tensor,
        background: Tensor,
        features: Tensor,
        *parameters: Tensor,
    ):
        camera = options.camera
        arrays = _arrays(parameters)
        records, depths, radii = _project(options, arrays)
        means2d.detach().numpy()[:] = np.where(radii[:, None] > 0, records[:, :2], 0)
        tiles_y, tiles_x = -(-camera.height // blend.TILE), -(-camera.width // blend.TILE)
        mask = np.ones(tiles_x * tiles_y, bool) if options.tile_mask is None else options.tile_mask.ravel()
        found = tiles.intersect(records, depths, radii, camera.width, camera.height, mask)
        left = np.empty((camera.height, camera.width), np.float32)
        ends = np.empty(len(found.starts) - 1, np.int64)
        passes = [(records, _array(background))] + [
            (_with_colors(records, chunk), np.zeros(_CHUNK, np.float32))
            for chunk in _chunks(_array(features))
        ]
        images = []
        for painted, behind in passes:
            image = np.empty((camera.height, camera.width, 3), np.float32)
            blend.forward(
                painted,
                found.starts,
                found.ids,
                found.tiles_x,
                camera.width,
                camera.height,
                behind,
                image,
                left,
                ends,
            )
            images.append(image)
        ctx.save_for_backward(*parameters)
        ctx.kept = options, [p for p, _ in passes], radii, found, ends, images, left, features.shape[1]
        extra = np.concatenate([images[0][..., :0], *images[1:]], -1)[..., : features.shape[1]]
        ctx.mark_non_differentiable(out_radii := torch.from_numpy(radii))
        return torch.from_numpy(images[0]), torch.from_numpy(1 - left), torch.from_numpy(extra), out_radii

    @staticmethod
    def backward(ctx: Any, *grads: Tensor):
        options, painted, radii, found, ends, images, left, num_features = ctx.kept
        arrays = _arrays(ctx.saved_tensors)
        g_rgb, g_alpha, g_extra = (_array(g) for g in grads[:3])
        n, camera = len(radii), options.camera
        g_mean2d, g_conic = np.zeros((n, 2), np.float32), np.zeros((n, 3), np.float32)
        g_opacity = np.zeros(n, np.float32)
        g_features = np.zeros((n, num_features), np.float32)
        g_color = np.zeros((n, 3), np.float32)
        sums = np.empty((len(found.ids), blend.SUMS), np.float32)
        no_alpha = np.zeros_like(g_alpha)
        for index, (records, image) in enumerate(zip(painted, images, strict=True)):
            first = index == 0
            g_image = g_rgb if first else _padded(g_extra, _CHUNK * (index - 1))
            blend.backward(
                records, found.starts, ends, found.ids, found.slots, found.tiles_x, camera.width,
                camera.height,
                image, left, g_image, -g_alpha if first else no_alpha, sums,
            )  # fmt: skip
            g_channels = g_color if first else np.zeros((n, 3), np.float32)
            blend.reduce(records, found.offsets, sums, g_mean2d, g_conic, g_opacity, g_channels)
            if not first:
                part = g_features[:, _CHUNK * (index - 1) : _CHUNK * index]
                part[:] = g_channels[:, : part.shape[1]]
        means, quats, log_scales, logits, sh0, shN = map(np.zeros_like, arrays)
        project.backward(
            project.camera_vector(camera), *arrays, sh.num_bases(options.degree), options.antialiased,
            painted[0],
            radii, g_mean2d, g_conic, g_opacity, g_color, means, quats, log_scales, logits, sh0, shN,
        )  # fmt: skip
        return (
            None,
            torch.from_numpy(g_mean2d),
            None,
            torch.from_numpy(g_features),
            *(torch.from_numpy(g) for g in (means, quats, log_scales, logits, sh0, shN)),
        )


def _chunks(features: np.ndarray) -> list[np.ndarray]:
    return [_padded(features, at) for at in range(0, features.shape[-1], _CHUNK)]


def _padded(values: np.ndarray, at: int) -> np.ndarray:
    """Channels at..at+3 of the last axis, with zeros where there are no more."""
    part = values[..., at : at + _CHUNK]
    return np.ascontiguousarray(np.pad(part, [(0, 0)] * (part.ndim - 1) + [(0, _CHUNK - part.shape[-1])]))


def _with_colors(records: np.ndarray, colors: np.ndarray) -> np.ndarray:
    painted = records.copy()
    painted[:, 6:9] = colors
    return painted


def render(
    g: Gaussians,
    camera: Camera,
    *,
    degree: int,
    background: Tensor,
    features: Tensor | None,
    antialiased: bool,
    tile_mask: np.ndarray | None,
) -> Render:
    """Render in float32 on the CPU; see `sagesplat.raster.rasterize` for the arguments."""
    extra = g.means.new_zeros(len(g), 0) if features is None else features
    parameters = [getattr(g, name) for name in PARAMETERS]
    tracked = torch.is_grad_enabled() and any(p.requires_grad for p in (*parameters, extra))
    means2d = torch.zeros(len(g), 2, requires_grad=tracked)
    rgb, alpha, painted, radii = _Rasterize.apply(
        _Options(camera, degree, antialiased, tile_mask), means2d, background, extra, *parameters
    )  # type: ignore[misc]
    return Render(rgb, alpha, None if features is None else painted, means2d, radii)
