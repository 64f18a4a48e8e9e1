"""COLMAP's camera models, and undistortion to a pinhole camera.

Implemented from the definitions in COLMAP's documentation (https://colmap.github.io/cameras.html) and in
Kannala & Brandt 2006 (fisheye), Devernay & Faugeras 2001 (FOV), Weng et al. 1992 (thin prism).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Shaped
from scipy.ndimage import map_coordinates

from sagesplat.scene.scene import Camera, Lens

# A pinhole cannot show a fisheye's rim: it is cropped so that the centre keeps at least half its resolution.
MIN_ZOOM, MAX_ZOOM = 0.5, 4.0


class CameraModel(NamedTuple):
    """A COLMAP camera model; its params are focal lengths, principal point, distortion coefficients."""

    id: int
    num_focal: int  # 1: f, 2: fx and fy
    num_distortion: int

    @property
    def num_params(self) -> int:
        """Number of parameters."""
        return self.num_focal + 2 + self.num_distortion


CAMERA_MODELS = {
    "SIMPLE_PINHOLE": CameraModel(0, 1, 0),
    "PINHOLE": CameraModel(1, 2, 0),
    "SIMPLE_RADIAL": CameraModel(2, 1, 1),
    "RADIAL": CameraModel(3, 1, 2),
    "OPENCV": CameraModel(4, 2, 4),
    "OPENCV_FISHEYE": CameraModel(5, 2, 4),
    "FULL_OPENCV": CameraModel(6, 2, 8),
    "FOV": CameraModel(7, 2, 1),
    "SIMPLE_RADIAL_FISHEYE": CameraModel(8, 1, 1),
    "RADIAL_FISHEYE": CameraModel(9, 1, 2),
    "THIN_PRISM_FISHEYE": CameraModel(10, 2, 8),
}


def is_pinhole(lens: Lens) -> bool:
    """Whether the lens has no distortion, by its model or since all coefficients are zero."""
    model = CAMERA_MODELS[lens.model]
    return "FISHEYE" not in lens.model and not any(lens.params[model.num_focal + 2 :])


def intrinsics(lens: Lens) -> Float[np.ndarray, "3 3"]:
    """K of the lens without its distortion, in pixels of the lens."""
    focal = CAMERA_MODELS[lens.model].num_focal
    cx, cy = lens.params[focal : focal + 2]
    return np.array([[lens.params[0], 0, cx], [0, lens.params[focal - 1], cy], [0, 0, 1]])


def distort(lens: Lens, rays: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N 2"]:
    """Distorted projections, in pixels of the lens, of rays (x / z, y / z)."""
    model = CAMERA_MODELS[lens.model]
    coefficients = lens.params[model.num_focal + 2 :]
    x, y = rays[..., 0], rays[..., 1]
    if "FISHEYE" in lens.model:  # equidistant: the distance from the centre is the angle
        r = np.hypot(x, y)
        scale = np.where(r > 1e-6, np.arctan(r) / np.maximum(r, 1e-6), 1).astype(rays.dtype)
        x, y = x * scale, y * scale
    r2 = x * x + y * y
    if lens.model == "FOV":
        x, y = _fov(x, y, r2, *coefficients)
    elif lens.model in ("OPENCV", "FULL_OPENCV"):
        k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, 0, 0, 0, 0)[:8]
        radial = _polynomial(r2, k1, k2, k3) / _polynomial(r2, k4, k5, k6)
        dx, dy = _tangential(x, y, r2, p1, p2)
        x, y = x * radial + dx, y * radial + dy
    elif lens.model == "THIN_PRISM_FISHEYE":
        k1, k2, p1, p2, k3, k4, sx, sy = coefficients
        radial = _polynomial(r2, k1, k2, k3, k4)
        dx, dy = _tangential(x, y, r2, p1, p2)
        x, y = x * radial + dx + sx * r2, y * radial + dy + sy * r2
    else:
        radial = _polynomial(r2, *coefficients)
        x, y = x * radial, y * radial
    K = intrinsics(lens).astype(rays.dtype)
    return np.stack([K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]], axis=-1)


def _polynomial(r2, *k):
    """1 + k1 r^2 + k2 r^4 + ..."""
    value = 0 * r2
    for coefficient in reversed(k):
        value = (value + coefficient) * r2
    return 1 + value


def _tangential(x, y, r2, p1, p2):
    """Brown's decentring distortion, as OpenCV orders p1 and p2."""
    return 2 * p1 * x * y + p2 * (r2 + 2 * x * x), 2 * p2 * x * y + p1 * (r2 + 2 * y * y)


def _fov(x, y, r2, omega):
    """r' = atan(2 r tan(omega / 2)) / omega, which is r for a small omega or r."""
    if abs(omega) < 1e-6:
        return x, y
    r, slope = np.sqrt(r2), 2 * np.tan(omega / 2)
    near = r < 1e-6
    scale = np.where(near, slope, np.arctan(r * slope) / np.where(near, 1, r)) / omega
    return x * scale.astype(r2.dtype), y * scale.astype(r2.dtype)


@lru_cache(1024)  # computing one takes milliseconds, and the views of a capture share few lenses
def pinhole(lens: Lens) -> Float[np.ndarray, "3 3"]:
    """K of the pinhole camera that replaces the lens, with the same image size and principal point.

    Its own K where it has no distortion; not to be changed, since all who ask get the same array.

    Both focal lengths are scaled by the smallest zoom in [0.5, 4] at which every border pixel still has a
    source pixel: the widest view without blank pixels. Raises ValueError if there is none.
    """
    width, height = lens.width, lens.height
    K = intrinsics(lens)
    if is_pinhole(lens):
        return K
    t = np.linspace(0, 1, 33)
    across, down, zero = t * (width - 1), t * (height - 1), 0 * t
    u = np.concatenate([across, across, zero, zero + width - 1])
    v = np.concatenate([zero, zero + height - 1, down, down])
    rays = (np.stack([u, v], axis=-1) + 0.5 - K[:2, 2]) / K[[0, 1], [0, 1]]
    out = np.append(np.linspace(0, 0.99, 9), 1)[:, None, None]  # from the principal point to the border

    def fits(zoom: float) -> bool:
        uv = distort(lens, out * rays / zoom)
        inside = (uv[-1] > 0.499) & (uv[-1] < np.array([width, height]) - 0.499)
        # Beyond the maximum of its polynomial a model maps rays back into the image. Such pixels are invalid.
        grows = np.diff(np.linalg.norm(uv - K[:2, 2], axis=-1), axis=0) >= 0
        return bool(inside.all() and grows.all())

    low, high = MIN_ZOOM, MAX_ZOOM
    if not fits(high):
        raise ValueError(f"no pinhole view fits into a {lens.model} camera with parameters {lens.params}")
    if fits(low):
        high = low
    while high - low > 1e-6:
        middle = (low + high) / 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return K * np.array([[high, 1, 1], [1, high, 1], [1, 1, 1]])


def undistort(
    image: Shaped[np.ndarray, "h w *C"], lens: Lens | None, camera: Camera, order: int
) -> Shaped[np.ndarray, "H W *C"]:
    """The image resampled for the pinhole `camera`, in the camera's size and the image's dtype.

    The image covers the full frame of the lens, at any resolution. `order` 1 interpolates bilinearly, for
    photos; 0 takes the nearest pixel, for label images. Without a lens the image is returned unchanged.
    """
    if lens is None:
        return image
    u = (np.arange(camera.width, dtype=np.float32) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    v = (np.arange(camera.height, dtype=np.float32) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    uv = distort(lens, np.stack(np.meshgrid(u, v), axis=-1))
    size = np.array([image.shape[1], image.shape[0]], np.float32)
    uv = uv * (size / np.array([lens.width, lens.height], np.float32)) - 0.5
    at = (uv[..., 1], uv[..., 0])
    channels = image[..., None] if image.ndim == 2 else image
    planes = [
        map_coordinates(channels[..., c], at, order=order, mode="nearest") for c in range(channels.shape[2])
    ]
    return np.stack(planes, axis=-1).reshape(camera.height, camera.width, *image.shape[2:])
