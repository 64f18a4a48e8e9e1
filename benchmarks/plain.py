"""What one would write in an afternoon: a differentiable rasteriser of torch operations, tile by tile."""

import torch
from torch import Tensor

from sagesplat.core import sh
from sagesplat.core.gaussians import Gaussians
from sagesplat.raster.reference import rotation_matrices
from sagesplat.raster.render import ALPHA_MAX, ALPHA_MIN, BLUR, NEAR
from sagesplat.scene.scene import Camera

_TILE = 32


def render(g: Gaussians, camera: Camera, degree: int = 0) -> Tensor:  # [H, W, 3]
    """Project all Gaussians, sort them by depth, and blend each tile's as one [pixels, Gaussians] matrix."""
    w2c, K = torch.from_numpy(camera.w2c), torch.from_numpy(camera.K)
    points = g.means @ w2c[:3, :3].T + w2c[:3, 3]
    visible = torch.nonzero(points[:, 2].detach() > NEAR)[:, 0]
    visible = visible[torch.argsort(points[visible, 2].detach())]
    x, y, z = points[visible].unbind(-1)
    fx, fy = K[0, 0], K[1, 1]
    zero = torch.zeros_like(z)
    width, height = 1.3 * camera.width / 2, 1.3 * camera.height / 2  # slopes are kept near the image
    u = (x / z).clamp(-(K[0, 2] - camera.width / 2 + width) / fx, (camera.width / 2 - K[0, 2] + width) / fx)
    v = (y / z).clamp(
        -(K[1, 2] - camera.height / 2 + height) / fy, (camera.height / 2 - K[1, 2] + height) / fy
    )
    jacobian = torch.stack([fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z], -1).reshape(-1, 2, 3)
    axes = rotation_matrices(g.quats[visible]) * g.log_scales[visible].exp()[:, None]
    half = jacobian @ w2c[:3, :3] @ axes
    cov = half @ half.transpose(-1, -2) + BLUR * torch.eye(2)
    conics = torch.linalg.inv(cov)
    centres = torch.stack([fx * x / z + K[0, 2], fy * y / z + K[1, 2]], -1)
    opacities = g.logit_opacities[visible].sigmoid()
    directions = torch.nn.functional.normalize(g.means[visible] - torch.from_numpy(camera.position), dim=-1)
    bases = torch.stack([torch.as_tensor(b).expand(len(z)) for b in sh.bases(*directions.unbind(-1))], -1)
    bases = bases[:, : sh.num_bases(degree)].float()
    coefficients = torch.cat([g.sh0, g.shN], 1)[visible, : bases.shape[1]]
    colors = ((bases[..., None] * coefficients).sum(1) + 0.5).clamp_min(0)

    reach = (2 * (opacities / ALPHA_MIN).clamp_min(1).log())[:, None] * torch.diagonal(cov, dim1=1, dim2=2)
    low, high = (centres - reach.sqrt()).detach(), (centres + reach.sqrt()).detach()
    rows = []
    for top in range(0, camera.height, _TILE):
        row = []
        for left in range(0, camera.width, _TILE):
            height, width = min(_TILE, camera.height - top), min(_TILE, camera.width - left)
            inside = (high > torch.tensor([left, top])) & (low < torch.tensor([left + width, top + height]))
            ids = torch.nonzero(inside.all(-1))[:, 0]
            v, u = torch.meshgrid(torch.arange(height) + top, torch.arange(width) + left, indexing="ij")
            d = torch.stack([u, v], -1).reshape(-1, 1, 2) + 0.5 - centres[ids]  # [P, G, 2]
            power = 0.5 * torch.einsum("pgi,gij,pgj->pg", d, conics[ids], d)
            alpha = (opacities[ids] * torch.exp(-power)).clamp_max(ALPHA_MAX)
            alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
            left_over = torch.cumprod(torch.cat([torch.ones(len(d), 1), 1 - alpha], 1), 1)[:, :-1]
            row.append(((alpha * left_over) @ colors[ids]).reshape(height, width, 3))
        rows.append(torch.cat(row, 1))
    return torch.cat(rows, 0)
