"""Vignetting: the light that a lens loses towards the corners, taken out of photos as distortion is."""

import numpy as np
from jaxtyping import Float, Float32, UInt8

from sagesplat.scene.scene import Camera, Vignetting

OFFSET, CURVE = 0.055, 2.4  # sRGB: stored = 1.055 light^(1/2.4) - 0.055, but for the darkest colours


def corrected(
    photo: UInt8[np.ndarray, "H W 3"], vignetting: Vignetting, camera: Camera
) -> UInt8[np.ndarray, "H W 3"]:
    """The photo of this camera with the light that the lens lost; what is saturated stays so."""
    share = light(vignetting, camera)[..., None]
    value = np.arange(256) / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + OFFSET) / (1 + OFFSET)) ** CURVE)
    full = np.minimum(linear.astype(np.float32)[photo] / share, 1)
    stored = np.where(full <= 0.0031308, 12.92 * full, (1 + OFFSET) * full ** (1 / CURVE) - OFFSET)
    return (255 * stored + 0.5).astype(np.uint8)


def light(vignetting: Vignetting, camera: Camera) -> Float32[np.ndarray, "H W"]:
    """Share of the light that reaches each pixel of a camera's photos."""
    u, v = (np.arange(size, dtype=np.float32) + 0.5 for size in (camera.width, camera.height))
    x2, y2 = ((u - camera.K[0, 2]) / camera.K[0, 0]) ** 2, ((v - camera.K[1, 2]) / camera.K[1, 1]) ** 2
    at = powers(x2[None] + y2[:, None], vignetting.reach)
    return np.exp(at @ np.array(vignetting.coefficients, np.float32))


def powers(t: Float[np.ndarray, "*S"], reach: float) -> Float[np.ndarray, "*S 2"]:
    """s and s^2 of `Vignetting`, for tan^2 of angles."""
    share = np.minimum(t / reach, 1)
    return np.stack([share, share * share], -1)
