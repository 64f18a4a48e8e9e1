"""SSIM and its gradient against a plain float64 implementation differentiated by autograd."""

import numpy as np
import pytest
import torch
from torch import Tensor

from sagesplat.metrics.image import photometric_loss, ssim_map
from sagesplat.raster import Workspace


def plain_ssim(x: Tensor, y: Tensor) -> Tensor:
    """Wang et al. 2004 with an 11x11 Gaussian window, sigma 1.5, zero padding; [H, W, C] -> [H, W, C]."""
    taps = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    window = torch.outer(taps, taps) / taps.sum() ** 2
    x, y = x.permute(2, 0, 1)[:, None], y.permute(2, 0, 1)[:, None]

    def blur(image: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(image, window[None, None], padding=5)

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * mx * my + c1) * (2 * cov + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    return ssim[:, 0].permute(1, 2, 0)


def pair(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(height, width, 3, generator=generator)
    return x, (x + 0.3 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1)


# around the strip of 32 rows that a thread works on, and smaller than the window
SIZES = [(45, 70), (32, 40), (33, 12), (64, 11), (7, 5), (1, 1), (1, 30), (30, 1), (5, 100)]


@pytest.mark.parametrize("size", SIZES)
def test_map_agrees(size):
    x, y = pair(*size)
    actual = ssim_map(x.numpy(), y.numpy())
    assert actual.shape == size
    assert actual.dtype == np.float32
    np.testing.assert_allclose(actual, plain_ssim(x.double(), y.double()).mean(-1).numpy(), atol=1e-5)


@pytest.mark.parametrize("ssim_weight", [0.2, 0.0, 1.0])
@pytest.mark.parametrize("size", SIZES)
def test_loss_and_gradient_agree(size, ssim_weight):
    x, y = pair(*size, seed=1)
    exact = x.double().requires_grad_()
    expected = (1 - ssim_weight) * (exact - y).abs().mean() + ssim_weight * (
        1 - plain_ssim(exact, y.double()).mean()
    )
    (3 * expected).backward()
    rgb = x.clone().requires_grad_()
    loss = photometric_loss(rgb, y, ssim_weight)
    (3 * loss).backward()
    assert float(loss.detach()) == pytest.approx(float(expected.detach()), abs=2e-6)
    assert exact.grad is not None
    assert rgb.grad is not None
    assert (rgb.grad - exact.grad).abs().max() < 2e-4 * exact.grad.abs().max()


def test_the_gradient_of_smooth_images_agrees():
    """Flat regions are where float32 variances cancel."""
    rows, columns = torch.meshgrid(torch.linspace(0, 3, 40), torch.linspace(0, 2, 50), indexing="ij")
    x = torch.stack([0.5 + 0.3 * torch.sin(rows + k * columns) for k in range(3)], -1)
    y = (x * 0.9 + 0.05).contiguous()
    exact = x.double().requires_grad_()
    plain_ssim(exact, y.double()).mean().backward()
    rgb = x.clone().requires_grad_()
    (-photometric_loss(rgb, y, 1.0)).backward()
    assert exact.grad is not None
    assert rgb.grad is not None
    assert (rgb.grad - exact.grad).abs().max() < 2e-3 * exact.grad.abs().max()
    expected = plain_ssim(x.double(), y.double()).mean(-1).numpy()
    np.testing.assert_allclose(ssim_map(x.numpy(), y.numpy()), expected, atol=3e-4)


def test_symmetric_and_blind_to_strides():
    x, y = pair(40, 24)
    forth, back = ssim_map(x.numpy(), y.numpy()), ssim_map(y.numpy(), x.numpy())
    np.testing.assert_allclose(forth, back, atol=1e-6)
    wide = np.repeat(x.numpy(), 2, axis=1)[:, ::2]  # the same image in other memory
    np.testing.assert_array_equal(ssim_map(wide, y.numpy()), forth)
    turned = torch.rot90(x, 1, (0, 1)).numpy(), torch.rot90(y, 1, (0, 1)).numpy()
    np.testing.assert_allclose(ssim_map(*turned), np.rot90(forth), atol=2e-6)


@pytest.mark.parametrize("size", [*SIZES, (70, 90)])
def test_tiles_that_leave_the_loss(size):
    """The definition, in float64: the photo stands in for the render there, and they add nothing."""
    height, width = size
    x, y = pair(height, width, seed=2)
    rng = np.random.default_rng(height)
    for share in (0.0, 0.4, 0.7, 1.0):
        tiles = rng.random((-(-height // 16), -(-width // 16))) < share
        pixels = torch.from_numpy(tiles.repeat(16, 0).repeat(16, 1)[:height, :width])[..., None]
        exact = x.double().requires_grad_()
        seen = torch.where(pixels, exact, y.double())
        quality = plain_ssim(seen, y.double())
        expected = ((0.8 * (seen - y).abs() + 0.2 * (1 - quality)) * pixels).sum() / (3 * height * width)
        expected.backward()
        rgb = x.clone().requires_grad_()
        loss = photometric_loss(rgb, y, 0.2, tiles, space := Workspace())
        loss.backward()
        assert float(loss.detach()) == pytest.approx(float(expected.detach()), abs=2e-6)
        assert exact.grad is not None
        assert rgb.grad is not None
        scale = max(float(exact.grad.abs().max()), 1e-9)
        np.testing.assert_allclose(rgb.grad.numpy() / scale, exact.grad.numpy() / scale, atol=2e-5)
        assert not rgb.grad[~pixels[..., 0]].any()
        masked = ssim_map(x.numpy(), y.numpy(), tiles)
        np.testing.assert_allclose(masked, (quality.mean(-1) * pixels[..., 0]).detach().numpy(), atol=1e-5)
        # what the workspace holds from a call before does not show
        photometric_loss(x + 0.1, y, 0.2, None, space)
        again = x.clone().requires_grad_()
        photometric_loss(again, y, 0.2, tiles, space).backward()
        assert torch.equal(again.grad, rgb.grad)  # type: ignore[arg-type]


@pytest.mark.parametrize("masked", [False, True])
def test_black_surroundings_change_nothing(masked):
    """What is black all around is not blurred: map, loss and gradient are those of the plain formula."""
    x, y = torch.zeros(2, 90, 200, 3)
    x[40:55, 70:85], y[43:60, 72:90] = pair(15, 15)[0], pair(17, 18, 2)[1]
    exact, rgb = x.double().requires_grad_(), x.clone().requires_grad_()
    expected = plain_ssim(exact, y.double())
    np.testing.assert_allclose(ssim_map(x.numpy(), y.numpy()), expected.mean(-1).detach(), atol=1e-5)
    (1 - expected.mean()).backward()
    mask = np.ones((6, 13), bool)
    mask[:, -1] = not masked  # black in both
    photometric_loss(rgb, y, 1.0, mask).backward()
    assert exact.grad is not None
    assert rgb.grad is not None
    assert (rgb.grad - exact.grad).abs().max() < 2e-4 * exact.grad.abs().max()
    assert not rgb.grad[:16].any()
    assert not rgb.grad[:, 128:].any()
