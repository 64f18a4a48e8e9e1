"""COLMAP's camera models, and undistortion to a pinhole camera.

Implemented from the definitions in COLMAP's documentation (https://colmap.github.io/cameras.html) and in
Kannala & Brandt 2006 (fisheye), Devernay & Faugeras 2001 (FOV), Weng et al. 1992 (thin prism), Fitzgibbon
2001 (division), Khomutenko et al. 2016 (EUCM), Engel et al. 2023 (RAD_TAN_THIN_PRISM_FISHEYE: Project Aria).
"""

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.ndimage import map_coordinates

from sagesplat.scene.scene import Camera, Face, Lens

# A pinhole cannot show a fisheye's rim: it is cropped so that the centre keeps at least half its resolution.
MIN_ZOOM, MAX_ZOOM = 0.5, 4.0
_FARTHEST = np.deg2rad(100)  # from the axis of a fisheye, in the corners of its photo


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
    "RAD_TAN_THIN_PRISM_FISHEYE": CameraModel(11, 2, 12),
    "SIMPLE_DIVISION": CameraModel(12, 1, 1),
    "DIVISION": CameraModel(13, 2, 1),
    "SIMPLE_FISHEYE": CameraModel(14, 1, 0),
    "FISHEYE": CameraModel(15, 2, 0),
    "EUCM": CameraModel(16, 2, 2),
    "EQUIRECTANGULAR": CameraModel(17, 0, 0),  # width and height of the whole sphere, pixels
}
SPHERE = "EQUIRECTANGULAR"
WIDE = frozenset(
    {name for name in CAMERA_MODELS if "FISHEYE" in name} | {"SIMPLE_DIVISION", "DIVISION", "EUCM"}
)
# Axes of a cube's face in those of the lens: columns are x right, y down, z out of the face.
FACES: dict[Face, Float[np.ndarray, "3 3"]] = {
    "front": np.eye(3),
    "right": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "back": np.array([[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]]),
    "left": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "up": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "down": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}


def is_pinhole(lens: Lens) -> bool:
    """Whether the lens has no distortion, by its model or since all coefficients are zero."""
    if lens.model == "EUCM":
        return lens.params[4] == 0
    model = CAMERA_MODELS[lens.model]
    straight = "FISHEYE" not in lens.model and lens.model != SPHERE
    return straight and not any(lens.params[model.num_focal + 2 :])


def intrinsics(lens: Lens) -> Float[np.ndarray, "3 3"]:
    """K of the lens without its distortion, in pixels of the lens; of a sphere: that of its middle."""
    if lens.model == SPHERE:
        w, h = lens.params
        return np.array([[w / (2 * np.pi), 0, w / 2], [0, h / np.pi, h / 2], [0, 0, 1]])
    focal = CAMERA_MODELS[lens.model].num_focal
    cx, cy = lens.params[focal : focal + 2]
    return np.array([[lens.params[0], 0, cx], [0, lens.params[focal - 1], cy], [0, 0, 1]])


def distort(lens: Lens, rays: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N 2"]:
    """Distorted projections, in pixels of the lens, of rays (x / z, y / z) of the pinhole camera.

    With `Lens.face` these are rays of that face. NaN where the lens does not see a ray.
    """
    x, y, z = rays[..., 0], rays[..., 1], np.ones((), rays.dtype)
    if lens.face is not None:
        x, y, z = (a * x + b * y + c for a, b, c in FACES[lens.face].astype(rays.dtype))
    return _project(lens, x, y, z)


def _project(lens: Lens, x, y, z) -> Float[np.ndarray, "*N 2"]:
    """Pixels of directions in the axes of the lens; z counts for models that see more than a half space."""
    coefficients = lens.params[CAMERA_MODELS[lens.model].num_focal + 2 :]
    K = intrinsics(lens).astype(x.dtype)
    if lens.model == SPHERE:
        x, y = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
        return np.stack([K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]], axis=-1)
    if lens.model in WIDE:
        scale = _wide(lens.model, np.hypot(x, y), z, coefficients).astype(x.dtype)
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
    elif lens.model == "RAD_TAN_THIN_PRISM_FISHEYE":
        *radial, p0, p1, s0, s1, s2, s3 = coefficients
        scale = _polynomial(r2, *radial)
        x, y = x * scale, y * scale
        r2 = x * x + y * y  # tangential and thin prism distort what the radial terms have distorted
        dx, dy = _tangential(x, y, r2, p1, p0)
        x, y = x + dx + (s0 + s1 * r2) * r2, y + dy + (s2 + s3 * r2) * r2
    elif lens.model not in ("SIMPLE_DIVISION", "DIVISION", "EUCM"):
        radial = _polynomial(r2, *coefficients)
        x, y = x * radial, y * radial
    return np.stack([K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]], axis=-1)


def _wide(model: str, r, z, coefficients):
    """What x and y are multiplied by, at a distance r from the axis and a depth z; NaN where unseen."""
    if "FISHEYE" in model:  # equidistant: the distance from the centre is the angle
        return np.where(r > 1e-6, np.arctan2(r, z) / np.maximum(r, 1e-6), 1)
    if model == "EUCM":
        alpha, beta = coefficients
        depth = alpha * np.sqrt(beta * r * r + z * z) + (1 - alpha) * z
        return 1 / np.where(depth > 1e-9, depth, np.nan)
    root = z * z - 4 * coefficients[0] * r * r
    depth = (z + np.sqrt(np.where(root >= 0, root, np.nan))) / 2
    return 1 / np.where(depth > 1e-9, depth, np.nan)


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


def shown_share(lens: Lens) -> float:
    """Share of the photo's area that its `pinhole` shows; the rest is cropped."""
    if is_pinhole(lens):
        return 1.0
    K, side = pinhole(lens), np.linspace(0, 1, 65)[:-1]
    border = np.concatenate([np.stack(each, -1) for each in ((side, 0 * side), (0 * side + 1, side))])
    border = np.concatenate([border, 1 - border]) * [lens.width, lens.height]
    x, y = distort(lens, (border - K[:2, 2]) / K[[0, 1], [0, 1]]).T
    area = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2  # of the polygon that the border becomes
    return float(min(1.0, abs(area) / (lens.width * lens.height)))


def cube_faces(lens: Lens) -> tuple[Face, ...]:
    """The faces of the cube around a wide lens of which the photo shows at least 2 %."""
    if lens.model == SPHERE:
        return tuple(FACES)
    K = np.array([[16.0, 0, 16], [0, 16, 16], [0, 0, 1]])
    return tuple(face for face in FACES if seen(replace(lens, face=face), K, 32, 32).mean() >= 0.02)


def seen(lens: Lens, K: Float[np.ndarray, "3 3"], width: int, height: int) -> Bool[np.ndarray, "H W"]:
    """Which pixels of a face, with the intrinsics K, the photo shows."""
    rays = _rays(K, width, height)
    with np.errstate(all="ignore"):  # a damaged lens overflows, and shows nothing then
        uv = distort(lens, rays)
        inside = np.all((uv >= 0) & (uv <= [lens.width, lens.height]), axis=-1)
    if lens.model == SPHERE or lens.face is None:
        return inside
    axis = FACES[lens.face][2]  # of the lens, in the axes of the face
    cosine = (rays @ axis[:2] + axis[2]) / np.sqrt(1 + (rays * rays).sum(axis=-1))
    return inside & (cosine >= np.cos(_reach(lens)))


@lru_cache(1024)
def _reach(lens: Lens) -> float:
    """Largest angle from the axis that a photo of a wide lens shows, radians.

    A model may be of no use beyond: its polynomial falls there. And a circular fisheye fills the width of its
    photo, not the corners, which would be farther out than any lens sees.
    """
    angle = np.linspace(0, np.pi, 721)[:, None]
    corner = np.arctan2(lens.height, lens.width)
    around = np.array([0, corner, np.pi / 2, np.pi - corner])
    around = np.append(around, around + np.pi)  # to the middles of the sides, and to the corners
    with np.errstate(all="ignore"):
        uv = _project(
            lens, np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle) + 0 * around
        )
        out = np.linalg.norm(uv - intrinsics(lens)[:2, 2], axis=-1)
        grows = np.cumprod(np.append(np.ones((1, 8), bool), np.diff(out, axis=0) > 0, axis=0), axis=0)
        inside = grows * np.all((uv >= 0) & (uv <= [lens.width, lens.height]), axis=-1)
    falls = float(angle[int(grows.sum(axis=0).min()) - 1, 0])
    across = float(angle[int(inside[:, [0, 2, 4, 6]].sum(axis=0).max()) - 1, 0])
    farthest = float(angle[int(inside.sum(axis=0).max()) - 1, 0])
    return min(falls, across) if farthest > _FARTHEST else falls


def _rays(K: Float[np.ndarray, "3 3"], width: int, height: int) -> Float[np.ndarray, "H W 2"]:
    """x / z and y / z of the pixels of a pinhole camera."""
    u = (np.arange(width, dtype=np.float32) + 0.5 - K[0, 2]) / K[0, 0]
    v = (np.arange(height, dtype=np.float32) + 0.5 - K[1, 2]) / K[1, 1]
    return np.stack(np.meshgrid(u, v), axis=-1)


def undistort(
    image: Shaped[np.ndarray, "h w *C"], lens: Lens | None, camera: Camera, order: int
) -> Shaped[np.ndarray, "H W *C"]:
    """The image resampled for the pinhole `camera`, in the camera's size and the image's dtype.

    The image covers the full frame of the lens, at any resolution. `order` 1 interpolates bilinearly, for
    photos; 0 takes the nearest pixel, for label images. Without a lens the image is returned unchanged.
    """
    if lens is None:
        return image
    uv = distort(lens, _rays(camera.K, camera.width, camera.height))
    size = np.array([image.shape[1], image.shape[0]], np.float32)
    uv = uv * (size / np.array([lens.width, lens.height], np.float32)) - 0.5
    at = (uv[..., 1], uv[..., 0])
    channels = image[..., None] if image.ndim == 2 else image
    mode = "grid-wrap" if lens.model == SPHERE else "nearest"  # a sphere's left side follows its right one
    planes = [map_coordinates(channels[..., c], at, order=order, mode=mode) for c in range(channels.shape[2])]
    return np.stack(planes, axis=-1).reshape(camera.height, camera.width, *image.shape[2:])
