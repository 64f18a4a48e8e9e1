"""The oracle: 3D Gaussian splatting in float64 without tiles, differentiated by autograd.

Every pixel meets every Gaussian, so it serves small images only. The fast backends are tested against it.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from sagesplat.core import sh
from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.raster.render import (
    ALPHA_MAX,
    ALPHA_MIN,
    BLUR,
    FRUSTUM_MARGIN,
    NEAR,
    TILE,
    TRANSMITTANCE_MIN,
    Render,
)
from sagesplat.scene.scene import Camera


def rotation_matrices(quats: Tensor) -> Tensor:  # [N, 4] -> [N, 3, 3]
    """Rotations of wxyz quaternions of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _still(values: Tensor, trainable: Tensor) -> Tensor:
    """The same values; rows that are not trainable pass no gradient."""
    return torch.where(trainable.view(-1, *[1] * (values.ndim - 1)), values, values.detach())


def world_to_camera(camera: Camera, pose: Tensor | None) -> Tensor:
    """The camera's matrix [4, 4] in float64, moved by a rotation vector and a translation."""
    w2c = torch.tensor(camera.w2c).double()
    if pose is None:
        return w2c
    zero, (a, b, c, *translation) = w2c.new_zeros(()), pose.double().unbind()
    turn = torch.linalg.matrix_exp(torch.stack([zero, -c, b, c, zero, -a, -b, a, zero]).view(3, 3))
    top = torch.cat([turn, torch.stack(translation)[:, None]], 1)
    return torch.cat([top, w2c.new_tensor([[0, 0, 0, 1]])]) @ w2c


def projected(g: Gaussians, camera: Camera, w2c: Tensor, antialiased: bool):
    """Depths, 2D means, 2D covariances and opacities (EWA splatting as 3DGS uses it)."""
    K = torch.tensor(camera.K).double()
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    x, y, z = (g.means.double() @ w2c[:3, :3].T + w2c[:3, 3]).unbind(-1)
    safe = torch.where(z > NEAR, z, 1.0)
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * camera.width / fx, FRUSTUM_MARGIN * 0.5 * camera.height / fy
    u = (x / safe).clamp(-cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    v = (y / safe).clamp(-cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / safe, zero, -fx * u / safe, zero, fy / safe, -fy * v / safe], -1)
    scaled_axes = rotation_matrices(g.quats.double()) * g.log_scales.double().exp()[:, None, :]
    half = jacobian.reshape(-1, 2, 3) @ w2c[:3, :3] @ scaled_axes
    sharp = half @ half.transpose(-1, -2)
    cov = sharp + BLUR * torch.eye(2, dtype=torch.float64)
    opacity = g.logit_opacities.double().sigmoid()
    if antialiased:
        opacity = opacity * (torch.linalg.det(sharp) / torch.linalg.det(cov)).clamp_min(1e-10).sqrt()
    means2d = torch.stack([fx * x / safe + cx, fy * y / safe + cy], -1)
    return z, means2d, cov, opacity


def shade(g: Gaussians, position: Tensor, degree: int) -> Tensor:
    """Colours [N, 3] seen from a position [3], by spherical harmonics up to `degree`."""
    directions = torch.nn.functional.normalize(g.means.double() - position.double(), dim=-1)
    basis = torch.stack([torch.as_tensor(b).expand(len(g)) for b in sh.bases(*directions.unbind(-1))], -1)
    coefficients = torch.cat([g.sh0, g.shN], 1).double()[:, : sh.num_bases(degree)]
    return ((basis[:, : coefficients.shape[1], None] * coefficients).sum(1) + 0.5).clamp_min(0)


def render(
    g: Gaussians,
    camera: Camera,
    *,
    degree: int,
    background: Tensor,
    features: Tensor | None,
    antialiased: bool,
    tile_mask: np.ndarray | Tensor | None = None,
    trainable: Tensor | None = None,
    pose: Tensor | None = None,
) -> Render:
    """Render in float64; see `sagesplat.raster.rasterize` for the arguments."""
    if trainable is not None:
        parts = {name: _still(getattr(g, name), trainable) for name in PARAMETERS}
        g, features = replace(g, **parts), None if features is None else _still(features, trainable)
    w2c = world_to_camera(camera, pose)
    z, means2d, cov, opacity = projected(g, camera, w2c, antialiased)
    watched = means2d.detach().requires_grad_(means2d.requires_grad)
    if watched.requires_grad and trainable is not None:
        watched.register_hook(lambda grad: torch.where(trainable[:, None], grad, 0.0))
    means2d = means2d + (watched - watched.detach())
    channels = shade(g, -w2c[:3, :3].T @ w2c[:3, 3], degree)
    if features is not None:
        channels = torch.cat([channels, features.double()], -1)
    order = torch.argsort(z, stable=True)
    order = order[z[order] > NEAR]
    rows = torch.arange(camera.height, dtype=torch.float64) + 0.5
    columns = torch.arange(camera.width, dtype=torch.float64) + 0.5
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)
    image = torch.zeros(camera.height, camera.width, channels.shape[1], dtype=torch.float64)
    left = torch.ones(camera.height, camera.width, dtype=torch.float64)
    conics = torch.linalg.inv(cov)
    shown = torch.ones(camera.height, camera.width, dtype=torch.bool)
    if tile_mask is not None:
        tiles = torch.as_tensor(tile_mask)
        shown = tiles.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)[: camera.height, : camera.width]
    for i in order.tolist():
        d = pixels - means2d[i]
        power = 0.5 * torch.einsum("hwi,ij,hwj->hw", d, conics[i], d)
        alpha = (opacity[i] * torch.exp(-power)).clamp_max(ALPHA_MAX)
        alpha = torch.where(shown & (alpha >= ALPHA_MIN) & (left >= TRANSMITTANCE_MIN), alpha, 0.0)
        image = image + (left * alpha)[..., None] * channels[i]
        left = left * (1 - alpha)
    rgb = image[..., :3] + left[..., None] * background.double()
    reach = 2 * torch.log((opacity / ALPHA_MIN).clamp_min(1.0))
    radii = (reach * torch.maximum(cov[:, 0, 0], cov[:, 1, 1])).sqrt() * (z > NEAR)
    return Render(rgb, 1 - left, image[..., 3:] if features is not None else None, watched, radii.detach())
