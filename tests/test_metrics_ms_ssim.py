"""MS-SSIM against a plain float64 implementation; small images, and pixels that do not count."""

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d

from sagesplat.metrics.ms_ssim import WEIGHTS, halved, ms_ssim, num_scales


def plain(x: np.ndarray, y: np.ndarray, scales: int) -> float:
    """Wang et al. 2003, section 3: windows inside of the image, 2 x 2 means from scale to scale."""
    taps = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    window = (torch.outer(taps, taps) / taps.sum() ** 2)[None, None]
    a, b = (torch.from_numpy(image).double().permute(2, 0, 1)[:, None] for image in (x, y))
    weights = torch.tensor(WEIGHTS[:scales], dtype=torch.float64)
    weights /= weights.sum()

    def blur(image: Tensor) -> Tensor:
        return conv2d(image, window)

    result = torch.ones(3, dtype=torch.float64)
    for scale in range(scales):
        if scale:
            a, b = avg_pool2d(a, 2), avg_pool2d(b, 2)
        ma, mb = blur(a), blur(b)
        va, vb, cov = blur(a * a) - ma * ma, blur(b * b) - mb * mb, blur(a * b) - ma * mb
        factor = (2 * cov + 0.03**2) / (va + vb + 0.03**2)
        if scale == scales - 1:
            factor = factor * (2 * ma * mb + 0.01**2) / (ma * ma + mb * mb + 0.01**2)
        result *= factor.mean((1, 2, 3)).clamp(min=0) ** weights[scale]
    return float(result.mean())


def pair(height: int, width: int, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Smooth waves, and the same with noise and less contrast."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width] / 9
    waves = np.stack([np.sin(rows + k * columns) + np.sin(0.2 * rows * k) for k in (1, 2, 3)], -1)
    x = (0.5 + 0.2 * waves).clip(0, 1).astype(np.float32)
    return x, (0.1 + 0.8 * x + noise * rng.normal(size=x.shape)).clip(0, 1).astype(np.float32)


@pytest.mark.parametrize("noise", [0.02, 0.3])
@pytest.mark.parametrize(
    ("size", "scales"), [((176, 200), 5), ((181, 207), 5), ((175, 300), 4), ((64, 48), 3), ((11, 40), 1)]
)
def test_agrees_with_the_definition(size: tuple[int, int], scales, noise):
    x, y = pair(*size, noise)
    assert num_scales(*size) == scales
    assert ms_ssim(x, y) == pytest.approx(plain(x, y, scales), abs=2e-5)
    assert ms_ssim(x, x) == pytest.approx(1, abs=1e-5)


def test_opposite_images_have_nothing_in_common():
    x, _ = pair(64, 64, 0)
    assert ms_ssim(x, 1 - x) == 0


def test_images_smaller_than_the_window():
    x, y = pair(10, 400, 0.1)
    assert np.isnan(ms_ssim(x, y))


def test_noise_of_fine_pixels_counts_less_than_for_ssim():
    """Why it falls less on finer screens: coarse scales average the noise away."""
    x, y = pair(192, 192, 0.2)
    assert ms_ssim(x, y) > plain(x, y, 1) + 0.2


def test_halved():
    image = np.arange(15, dtype=np.float32).reshape(3, 5)
    np.testing.assert_array_equal(halved(image), [[3, 5]])
    assert halved(np.zeros((4, 6, 3), np.float32)).shape == (2, 3, 3)
