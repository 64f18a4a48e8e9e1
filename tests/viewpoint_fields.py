"""Captures whose SSIM over the viewpoint is drawn from a known field, for tests of quality models."""

from pathlib import Path

import numpy as np

from sagesplat.adapt.observe import Observations
from sagesplat.adapt.process import inputs_of, matern32
from sagesplat.scene.scene import Camera, Points, Scene, View

LEVELS = (1, 2, 3, 4)


def looking_at(position: np.ndarray) -> Camera:
    """A camera that looks at the origin."""
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.3, 0.2, 1.0])
    right /= np.linalg.norm(right)
    w2c = np.eye(4)
    w2c[:3, :3] = right, np.cross(forward, right), forward
    w2c[:3, 3] = -w2c[:3, :3] @ position
    return Camera(w2c.astype(np.float32), np.eye(3, dtype=np.float32), 64, 64)


def orbit(num_views: int, seed: int = 0, calibrate_every: int = 4, test_every: int = 4) -> Scene:
    """Views in random order around the origin, over half of a sphere."""
    rng = np.random.default_rng(seed)
    angle, height = rng.uniform(0, 2 * np.pi, num_views), rng.uniform(0.1, 0.9, num_views)
    around = np.sqrt(1 - height**2)
    radius = rng.uniform(2, 4, num_views)[:, None]
    position = radius * np.stack([around * np.cos(angle), around * np.sin(angle), height], 1)
    views = tuple(View(f"{i:03}", looking_at(p), Path()) for i, p in enumerate(position))
    none = np.empty(0, np.int64)
    uv = np.empty((0, 2), np.float32)
    xyz = np.empty((0, 3), np.float32)
    points = Points(xyz, xyz.astype(np.uint8), none, none.astype(np.int32), uv)
    return Scene("orbit", Path(), views, points, test_every=test_every, calibrate_every=calibrate_every)


def table(label_id: int, ssim: np.ndarray, distance: np.ndarray, views: np.ndarray) -> Observations:
    """Rows of one category from SSIM [V, K]."""
    V, K = ssim.shape
    real = ssim.ravel().astype(np.float32)
    return Observations(
        label_id=np.full(V * K, label_id, np.int32),
        level=np.tile(np.arange(1, K + 1, dtype=np.int32), V),
        view=np.repeat(views, K).astype(np.int32),
        distance=np.repeat(distance, K).astype(np.float32),
        ssim=real,
        ssim_eroded=real,
        psnr=real,
        num_pixels=np.full(V * K, 100, np.int32),
    )


def together(*parts: Observations) -> Observations:
    """All rows of some tables."""
    return Observations(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in vars(parts[0])})


def viewpoints(scene: Scene, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance, position and direction of some views."""
    cameras = [scene.views[row].camera for row in rows]
    position = np.array([c.position for c in cameras], np.float64).reshape(-1, 3)
    direction = np.array([c.direction for c in cameras], np.float64).reshape(-1, 3)
    return np.linalg.norm(position, axis=1), position, direction


def synthetic(
    scene: Scene, seed: int, label_id: int = 5, drop: float = 0.02, noise: float = 0.01
) -> Observations:
    """A smooth field over the viewpoint, noise, and `drop` for views that training has not seen."""
    rng = np.random.default_rng(seed)
    rows = np.arange(len(scene.views))
    distance, position, direction = viewpoints(scene, rows)
    x = inputs_of(distance, position, direction, scene.extent, 0.0)
    S = matern32(x, x, (0.5, 0.5, 1.0, 1.0)) + 1e-9 * np.eye(len(x))
    field = 0.05 * np.linalg.cholesky(S) @ rng.standard_normal((len(x), 2))
    unseen = ~np.isin(rows, scene.train_ids)
    level = np.array([0.55, 0.66, 0.76, 0.85])
    quality = level + field[:, :1] * [1, 1, 0.7, 0.5] + 0.3 * field[:, 1:] * [1, 0.5, 0, 0]
    quality = quality - drop * unseen[:, None] + noise * rng.standard_normal((len(x), 1))
    return table(label_id, quality, distance, rows)
