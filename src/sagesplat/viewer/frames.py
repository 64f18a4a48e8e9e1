"""Cameras, up direction, floor and scale in a bundle's axes: right, up, back (y and z negated)."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from sagesplat.core import geometry
from sagesplat.scene.scene import Camera

FLIP = np.array([1.0, -1.0, -1.0])  # between COLMAP's axes and the bundle's
EYES = 1.5  # assumed height of cameras above the floor, metres
SCALES = (1e-3, 1e3)  # limits of the guessed scale, metres per unit
_LEVEL = 10.0  # least ratio of eigenvalues at which the horizons determine the up direction


def position(camera: Camera) -> Float[np.ndarray, "3"]:
    """A camera's position."""
    return camera.position.astype(np.float64) * FLIP


def rotation(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """Camera-to-world rotation; the camera looks along -z, y is up."""
    return FLIP[:, None] * camera.w2c[:3, :3].T.astype(np.float64) * FLIP


def quaternion(camera: Camera) -> Float[np.ndarray, "4"]:
    """`rotation` as x y z w with w >= 0."""
    return Rotation.from_matrix(rotation(camera)).as_quat(canonical=True)


def fov_y(camera: Camera) -> float:
    """Vertical field of view, radians."""
    return 2 * math.atan(camera.height / (2 * float(camera.K[1, 1])))


def upward(cameras: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """Unit up vector: perpendicular to the photos' horizons, or the cameras' mean up if those are parallel.

    Photos are rolled less often than tilted. On `garden` and `dinosaur` the result is within 0.2 and 0.9
    degrees of the ground's normal; the mean up is within 0.7 and 4 degrees.
    """
    turned = np.stack([rotation(camera) for camera in cameras])
    mean = turned[:, :, 1].mean(0)
    sizes, axes = np.linalg.eigh(turned[:, :, 0].T @ turned[:, :, 0] / len(turned))
    up = axes[:, 0] * (1.0 if axes[:, 0] @ mean >= 0 else -1.0)
    if sizes[1] < _LEVEL * sizes[0] or sizes[1] < 0.01 or up @ mean < 0.5 * np.linalg.norm(mean):
        up = mean
    size = float(np.linalg.norm(up))
    return up / size if size > 1e-6 else np.array([0.0, 1.0, 0.0])


def floor(
    points: Float[np.ndarray, "P 3"],
    ground: Bool[np.ndarray, " P"],
    cameras: Sequence[Camera],
    up: Float[np.ndarray, "3"],
    extent: float,
) -> float:
    """Height of the ground along `up`: the median over the ground's points around the cameras.

    With too few of these, the 5th percentile over all points; without points, `extent` below the cameras.
    """
    where = np.stack([position(camera) for camera in cameras])
    around = np.linalg.norm(points - np.median(where, axis=0), axis=1) < 1.5 * extent
    for chosen, percentile in ((ground & around, 50.0), (ground, 50.0), (around, 5.0)):
        if chosen.sum() >= 20:
            return float(np.percentile(points[chosen] @ up, percentile))
    lowest = points @ up if len(points) else np.median(where @ up, keepdims=True) - extent
    return float(np.percentile(lowest, 5.0))


def guessed_scale(cameras: Sequence[Camera], up: Float[np.ndarray, "3"], height: float) -> float:
    """Metres per unit if the cameras are EYES metres above the floor; 1 if they are below it."""
    above = float(np.median([position(camera) @ up for camera in cameras])) - height
    return float(np.clip(EYES / above, *SCALES)) if above > 0 else 1.0


def start(
    cameras: Sequence[Camera], points: Float[np.ndarray, "P 3"], extent: float, up: Float[np.ndarray, "3"]
) -> dict[str, Any]:
    """The start view: position, quaternion (without roll) and target of the photo with most points.

    `points` in COLMAP's axes, `up` in the bundle's.
    """
    seen = [_depths(camera, points) for camera in cameras]
    best = max(range(len(cameras)), key=lambda i: len(seen[i][0]))
    camera, central = cameras[best], seen[best][1]
    depth = float(np.median(central)) if len(central) else extent
    where, back = position(camera), rotation(camera)[:, 2]
    right = np.cross(up, back)
    turned = rotation(camera)
    if np.linalg.norm(right) > 1e-3:  # else it looks straight up or down
        right /= np.linalg.norm(right)
        turned = np.stack([right, np.cross(back, right), back], 1)
    q = Rotation.from_matrix(turned).as_quat(canonical=True)
    return {"position": where, "quaternion": q, "target": where - depth * back}


def camera_at(
    where: Float[np.ndarray, "3"], q: Float[np.ndarray, "4"], fov_y: float, width: int, height: int
) -> Camera:
    """A camera in COLMAP's axes, with a centred principal point, of a pose in the bundle's axes."""
    w2c = np.eye(4, dtype=np.float32)
    w2c[:3, :3] = (FLIP[:, None] * Rotation.from_quat(q).as_matrix() * FLIP).T
    w2c[:3, 3] = -w2c[:3, :3] @ (where * FLIP)
    f = height / (2 * math.tan(fov_y / 2))
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]], np.float32)
    return Camera(w2c, K, width, height)


def _depths(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depths of the points in the image, and of those in its central part."""
    pixels, depth = geometry.project(points, camera.w2c, camera.K)
    distance = np.abs(pixels / [camera.width, camera.height] - 0.5).max(1)
    return depth[distance <= 0.5], depth[distance <= 0.2]
