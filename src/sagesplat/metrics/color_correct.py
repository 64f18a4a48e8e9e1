"""Colour correction before a metric, as gsplat does it for cc_psnr, cc_ssim and cc_lpips."""

import numpy as np
from jaxtyping import Bool, Float32

_FLAT = 1e-8  # variance of a channel below which there is nothing to fit


def color_correct_affine(
    image: Float32[np.ndarray, "H W 3"],
    photo: Float32[np.ndarray, "H W 3"],
    valid: Bool[np.ndarray, "H W"] | None = None,
) -> Float32[np.ndarray, "H W 3"]:
    """The image with the colours of a photo: what is left between both is no exposure or white balance.

    In each channel image = a photo + b is fitted by least squares, and the result is (image - b) / a, limited
    to [0, 1]: the default of gsplat's cc metrics (after Barron et al., multinerf). Fitted to the pixels that
    are `valid`; None: all.

    Example:
        >>> import numpy as np
        >>> from sagesplat.metrics.color_correct import color_correct_affine
        >>> photo = np.random.default_rng(0).random((32, 48, 3), np.float32)
        >>> bool(np.allclose(color_correct_affine(0.6 * photo + 0.1, photo), photo, atol=1e-5))
        True
    """
    counts = np.ones(image.shape[:2], bool) if valid is None or not valid.any() else valid
    x, y = image[counts].astype(np.float64), photo[counts].astype(np.float64)
    mean_x, mean_y = x.mean(0), y.mean(0)
    slope = ((x - mean_x) * (y - mean_y)).mean(0) / np.maximum(y.var(0), _FLAT)
    slope = np.where(np.abs(slope) < _FLAT, 1.0, slope)
    return np.clip((image - mean_x) / slope + mean_y, 0, 1).astype(np.float32)
