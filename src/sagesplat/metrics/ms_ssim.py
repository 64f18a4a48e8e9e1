"""Multi-scale SSIM (Wang, Simoncelli and Bovik 2003), of the SSIM of 3DGS at each scale."""

import numpy as np
from jaxtyping import Float32
from scipy.ndimage import correlate1d

from sagesplat.metrics import ssim_cpu
from sagesplat.metrics.image import ssim_planes

# of the scales, the finest first: the paper's, section 3.2
WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
_C1 = 0.01**2


def ms_ssim(x: Float32[np.ndarray, "H W 3"], y: Float32[np.ndarray, "H W 3"]) -> float:
    """MS-SSIM of two images in [0, 1], the mean over the channels; 1 = the same image.

        MS-SSIM = l_M^w_M  product over the scales j = 1 ... M of cs_j^w_j

    with l the luminance term of SSIM and cs its contrast and structure term, means over the pixels of a scale
    whose window lies inside the image. From scale to scale 2 x 2 pixels are averaged; an odd last row or
    column is left out. M = 5, or as many scales as leave both sides 11 pixels or more (all five: 176 px),
    with the weights of those made to sum to 1. NaN for images with a side below 11 pixels. Negative means of
    cs count as 0.

    Args:
        x: Image in [0, 1].
        y: Image in [0, 1].

    Example:
        >>> import numpy as np
        >>> from sagesplat.metrics.ms_ssim import ms_ssim
        >>> photo = np.random.default_rng(0).random((48, 64, 3), np.float32)
        >>> round(ms_ssim(photo, photo), 5), ms_ssim(photo, 1 - photo) < 0.1
        (1.0, True)
    """
    weights = np.array(WEIGHTS[: num_scales(*x.shape[:2])])
    product = np.full(3, 1.0 if len(weights) else np.nan)
    for scale, weight in enumerate(weights / weights.sum()):
        if scale:
            x, y = halved(x), halved(y)
        quality = ssim_planes(x, y)
        if scale < len(weights) - 1:
            quality = quality / _luminance(x, y)
        inside = quality[:, ssim_cpu.RADIUS : -ssim_cpu.RADIUS, ssim_cpu.RADIUS : -ssim_cpu.RADIUS]
        sums = inside.sum((1, 2), dtype=np.float64)
        product *= np.maximum(sums / inside[0].size, 0) ** weight
    return float(product.mean())


def num_scales(height: int, width: int) -> int:
    """How many scales of an image have 11 pixels or more in both axes, at most five."""
    side = min(height, width)
    return sum(side >> scale >= ssim_cpu.WINDOW for scale in range(len(WEIGHTS)))


def halved(image: Float32[np.ndarray, "H W *C"]) -> Float32[np.ndarray, "h w *C"]:
    """Means of 2 x 2 pixels; an odd last row or column is left out."""
    height, width = (length // 2 * 2 for length in image.shape[:2])
    even, odd = image[0:height:2], image[1:height:2]
    return (even[:, 0:width:2] + even[:, 1:width:2] + odd[:, 0:width:2] + odd[:, 1:width:2]) / 4


def _luminance(
    x: Float32[np.ndarray, "H W 3"], y: Float32[np.ndarray, "H W 3"]
) -> Float32[np.ndarray, "3 H W"]:
    """The factor of SSIM that compares means: (2 mx my + C1) / (mx^2 + my^2 + C1), above 0."""
    mx, my = (
        correlate1d(correlate1d(image, ssim_cpu.TAPS, 0, mode="constant"), ssim_cpu.TAPS, 1, mode="constant")
        for image in (x, y)
    )
    return ((2 * mx * my + _C1) / (mx * mx + my * my + _C1)).transpose(2, 0, 1)
