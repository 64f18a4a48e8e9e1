"""The oracle itself: its formulas written down once more by hand, its gradients against differences."""

import numpy as np
import pytest
import torch
from conftest import pinhole, random_gaussians
from scipy.spatial.transform import Rotation
from torch import Tensor

from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.raster import rasterize
from sagesplat.raster.reference import rotation_matrices

CENTRE = np.array([20.5, 13.5])  # px, the centre of pixel (20, 13)


def single(camera, logit: float, depth: float = 3.0) -> Gaussians:
    """One Gaussian that projects exactly onto CENTRE."""
    K, w2c = camera.K.astype(float), camera.w2c.astype(float)
    local = depth * np.array([(CENTRE[0] - K[0, 2]) / K[0, 0], (CENTRE[1] - K[1, 2]) / K[1, 1], 1.0])
    mean = w2c[:3, :3].T @ (local - w2c[:3, 3])
    return Gaussians(
        means=torch.tensor(mean[None], dtype=torch.float32),
        quats=torch.tensor([[0.6, -0.3, 1.1, 0.4]]),
        log_scales=torch.tensor([[-1.0, -2.5, -1.6]]),
        logit_opacities=torch.tensor([logit]),
        sh0=torch.tensor([[[1.2, -0.4, 0.3]]]),
        shN=torch.zeros(1, 0, 3),
        label_ids=torch.zeros(1, dtype=torch.int16),
    )


def expected_alpha(g: Gaussians, camera, logit: float) -> np.ndarray:
    """sigmoid(logit) exp(-d^T C^-1 d / 2), C = J W Sigma W^T J^T + 0.3 I (EWA splatting), cut at 1/255."""
    K, W = camera.K.astype(float), camera.w2c[:3, :3].astype(float)
    R = Rotation.from_quat(g.quats[0].double().numpy(), scalar_first=True).as_matrix()
    S = np.diag(np.exp(g.log_scales[0].double().numpy()))
    x, y, z = W @ g.means[0].double().numpy() + camera.w2c[:3, 3]
    J = np.array([[K[0, 0] / z, 0, -K[0, 0] * x / z**2], [0, K[1, 1] / z, -K[1, 1] * y / z**2]])
    C = J @ W @ R @ S @ S @ R.T @ W.T @ J.T + 0.3 * np.eye(2)
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    d = np.stack([columns, rows], -1) - CENTRE
    alpha = np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", d, np.linalg.inv(C), d)) / (1 + np.exp(-logit))
    return np.where(alpha >= 1 / 255, alpha, 0)


@torch.no_grad()
@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("logit", [-1.0, 2.0])
def test_one_gaussian_by_hand(backend, logit):
    camera, background = pinhole(48, 32), torch.tensor([0.1, 0.5, 0.9])
    g = single(camera, logit)
    render = rasterize(g, camera, background=background, backend=backend)
    alpha = expected_alpha(g, camera, logit)
    assert 20 < (alpha > 0).sum() < alpha.size  # the cut is in the picture
    np.testing.assert_allclose(render.alpha.numpy(), alpha, atol=2e-6)
    assert float(render.alpha[13, 20]) == pytest.approx(1 / (1 + np.exp(-logit)), abs=1e-6)
    color = 0.5 + 0.28209479177387814 * np.array([1.2, -0.4, 0.3])
    expected = alpha[..., None] * color + (1 - alpha[..., None]) * background.numpy()
    np.testing.assert_allclose(render.rgb.numpy(), expected, atol=2e-6)


@torch.no_grad()
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_two_gaussians_are_composited_front_to_back(backend):
    camera = pinhole(48, 32)
    near, far = single(camera, 0.5, depth=2.0), single(camera, 1.0, depth=5.0)
    far.sh0[:] = torch.tensor([-0.5, 1.0, 0.2])
    both = Gaussians(*(torch.cat([getattr(far, f), getattr(near, f)]) for f in (*PARAMETERS, "label_ids")))
    render = rasterize(both, camera, backend=backend)
    a, b = 1 / (1 + np.exp(-0.5)), 1 / (1 + np.exp(-1.0))
    C0 = 0.28209479177387814
    front, back = 0.5 + C0 * np.array([1.2, -0.4, 0.3]), 0.5 + C0 * np.array([-0.5, 1.0, 0.2])
    np.testing.assert_allclose(render.rgb[13, 20].numpy(), a * front + (1 - a) * b * back, atol=1e-6)
    assert float(render.alpha[13, 20]) == pytest.approx(a + (1 - a) * b, abs=1e-6)


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_against_central_differences(antialiased):
    """In float64, with Gaussians so broad that no pixel meets a cut, a clamp or a change of order."""
    camera = pinhole(4, 3)
    g = random_gaussians(3, seed=3, log_scale=0.8)
    leaves = [p.double() for p in g.parameters().values()]
    leaves[0] = torch.tensor([[0.1, 0.2, 3.0], [-0.3, 0.1, 4.0], [0.2, -0.2, 5.0]], dtype=torch.float64)
    leaves[3] = torch.tensor([-1.0, 0.3, 0.8], dtype=torch.float64)
    leaves[4] = leaves[4] * 0.3
    features = torch.rand(3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def images(features: Tensor, pose: Tensor, *parameters: Tensor) -> Tensor:
        moved = Gaussians(*parameters, label_ids=g.label_ids)
        options = {"features": features, "antialiased": antialiased, "pose": pose}
        render = rasterize(moved, camera, backend="reference", **options)
        assert render.features is not None
        return torch.cat([render.rgb, render.alpha[..., None], render.features], -1)

    pose = torch.zeros(6, dtype=torch.float64)
    drawn = images(features, pose, *leaves)
    assert drawn[..., :3].min() > 0.01
    assert drawn[..., 3].min() > 0.2
    assert drawn[..., 3].max() < 0.99
    inputs = [leaf.requires_grad_() for leaf in (features, pose, *leaves)]
    # fast mode takes a random direction in each input at once; a wrong entry anywhere shows
    assert torch.autograd.gradcheck(images, inputs, eps=1e-5, atol=1e-7, rtol=1e-5, fast_mode=True)


def test_rotation_matrices_against_scipy():
    quats = torch.randn(20, 4, generator=torch.Generator().manual_seed(0)).double() * 3
    expected = Rotation.from_quat(quats.numpy(), scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotation_matrices(quats).numpy(), expected, atol=1e-12)
