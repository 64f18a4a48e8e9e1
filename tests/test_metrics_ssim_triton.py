"""The GPU's loss against plain float64 and the CPU's; on a machine without one, in Triton's interpreter."""

import os

import pytest
import torch
from test_metrics_ssim_cpu import pair, plain_ssim
from torch import Tensor

from sagesplat.metrics import image

GPU = torch.cuda.is_available()
DEVICE = "cuda" if GPU else "cpu"
if not GPU:
    os.environ.setdefault("TRITON_INTERPRET", "1")  # read when kernels are defined, Triton's own too
pytest.importorskip("triton", reason="needs Triton, which comes with torch where there is a GPU")
from sagesplat.metrics.ssim_triton import photometric_loss, ssim_map  # noqa: E402

# around tiles of 16 and smaller than the window; the interpreter takes a third of a second for a tile
SIZES = [(1, 1), (5, 7), (16, 16), (17, 20), *([(33, 50), (100, 37), (1, 70), (1000, 1601)] if GPU else [])]


def plain_loss(x: Tensor, y: Tensor, ssim_weight: float, tile_mask: Tensor) -> Tensor:
    """The definition: where the mask is false the photo stands in for the render and nothing is added."""
    height, width, _ = x.shape
    pixels = tile_mask.repeat_interleave(16, 0).repeat_interleave(16, 1)[:height, :width, None]
    quality = plain_ssim(torch.where(pixels, x, y), y)
    return (((1 - ssim_weight) * (x - y).abs() + ssim_weight * (1 - quality)) * pixels).mean()


def tiles(height: int, width: int) -> Tensor:
    return torch.ones(-(-height // 16), -(-width // 16), dtype=torch.bool)


def loss_and_gradient(x: Tensor, y: Tensor, ssim_weight: float, tile_mask: Tensor | None = None):
    rgb = x.clone().to(DEVICE).requires_grad_()
    mask = None if tile_mask is None else tile_mask.to(DEVICE)
    loss = photometric_loss(rgb, y.to(DEVICE), ssim_weight, mask)
    assert loss.dtype == torch.float32
    (3 * loss).backward()
    assert rgb.grad is not None
    return loss.detach().cpu(), rgb.grad.cpu() / 3


def check(x: Tensor, y: Tensor, ssim_weight: float, tile_mask: Tensor | None = None) -> Tensor:
    loss, grad = loss_and_gradient(x, y, ssim_weight, tile_mask)
    photo = y / 255 if y.dtype == torch.uint8 else y
    exact = x.double().requires_grad_()
    expected = plain_loss(
        exact, photo.double(), ssim_weight, tiles(*x.shape[:2]) if tile_mask is None else tile_mask
    )
    expected.backward()
    assert exact.grad is not None
    assert float(loss) == pytest.approx(float(expected.detach()), abs=2e-7)
    assert (grad - exact.grad).abs().max() < 3e-6 * exact.grad.abs().max()

    rgb = x.clone().requires_grad_()
    mask = None if tile_mask is None else tile_mask.numpy()
    of_cpu = image.photometric_loss(rgb, photo, ssim_weight, mask)
    of_cpu.backward()
    assert rgb.grad is not None
    assert float(loss) == pytest.approx(float(of_cpu.detach()), abs=3e-7)
    assert (grad - rgb.grad).abs().max() < 3e-6 * exact.grad.abs().max()
    return grad


@pytest.mark.parametrize("size", SIZES)
def test_loss_and_gradient_agree(size):
    check(*pair(*size, seed=1), 0.2)


@pytest.mark.parametrize("ssim_weight", [0.0, 1.0])
def test_a_photo_in_bytes_and_the_ends_of_the_weight(ssim_weight):
    x, y = pair(9, 12)
    check(x, (y * 255).round().to(torch.uint8), ssim_weight)


@pytest.mark.parametrize("size", [(5, 7), *SIZES[3:]])
def test_map_agrees(size):
    x, y = pair(*size)
    actual = ssim_map(x.to(DEVICE), y.to(DEVICE)).cpu()
    assert actual.shape == size
    assert actual.dtype == torch.float32
    expected = plain_ssim(x.double(), y.double()).mean(-1)
    torch.testing.assert_close(actual.double(), expected, atol=2e-6, rtol=0)
    of_cpu = torch.from_numpy(image.ssim_map(x.numpy(), y.numpy()))
    torch.testing.assert_close(actual, of_cpu, atol=1e-5, rtol=0)


@pytest.mark.slow
def test_tiles_out_of_the_loss():
    """The render there is seen by nothing; their neighbours are, across edges and corners."""
    x, y = pair(35, 40, seed=2)
    tile_mask = torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 0]], dtype=torch.bool)
    photo = (y * 255).round().to(torch.uint8)
    grad = check(x, photo, 0.2, tile_mask)
    outside = ~tile_mask.repeat_interleave(16, 0).repeat_interleave(16, 1)[:35, :40]
    assert grad[~outside].abs().min() > 0
    assert not grad[outside].any()
    other = torch.where(outside[..., None], torch.nan, x)
    torch.use_deterministic_algorithms(True)  # fills new memory with nan
    try:
        _, of_other = loss_and_gradient(other, photo, 0.2, tile_mask)
    finally:
        torch.use_deterministic_algorithms(False)
    torch.testing.assert_close(of_other, grad, rtol=0, atol=0)


def test_all_tiles_and_none():
    x, y = pair(16, 20)
    loss, grad = loss_and_gradient(x, y, 0.2)
    masked_loss, masked_grad = loss_and_gradient(x, y, 0.2, torch.ones(1, 2, dtype=torch.bool))
    torch.testing.assert_close(masked_grad, grad, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(masked_loss, loss, rtol=1e-6, atol=0)
    loss, grad = loss_and_gradient(x, y, 0.2, torch.zeros(1, 2, dtype=torch.bool))
    assert float(loss) == 0
    assert not grad.any()


def test_central_differences():
    x, _ = pair(6, 5, seed=3)
    x, y = 0.2 + 0.4 * x, 0.9 - 0.1 * x  # apart, so that L1 has no kink on the way
    _, grad = loss_and_gradient(x, y, 0.5)
    direction = torch.randn(x.shape, generator=torch.Generator().manual_seed(0))
    step = 1e-2
    ahead, _ = loss_and_gradient(x + step * direction, y, 0.5)
    behind, _ = loss_and_gradient(x - step * direction, y, 0.5)
    slope = float(ahead - behind) / (2 * step)
    assert float((grad * direction).sum()) == pytest.approx(slope, rel=2e-3)


def test_shapes_that_do_not_fit():
    x, y = (image.to(DEVICE) for image in pair(20, 20))
    with pytest.raises(ValueError, match="cannot be compared"):
        photometric_loss(x, y[:-1], 0.2)
    with pytest.raises(ValueError, match="tile_mask"):
        photometric_loss(x, y, 0.2, torch.ones(1, 2, dtype=torch.bool, device=DEVICE))
