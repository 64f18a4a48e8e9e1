"""Camera poses for the photos of the garden."""

import numpy as np

from sagesplat.demo.places import centres_of, ways_of
from sagesplat.scene.scene import Camera


def demo_cameras(
    views: int, width: int, height: int, seed: int, arc: float = 2 * np.pi, start: float = 0.0
) -> list[Camera]:
    """Cameras on two orbits around the table at different heights; a sixth of them nearer or farther.

    The orbits go around by `arc` radians from the angle `start`.
    """
    rng = np.random.default_rng([seed, 1])
    others = views // 6
    near, lower = (others + 1) // 2, (views - others) // 2
    rings = (  # views, radius, height of the camera, height of the target
        (lower, 2.4, 1.4, 0.95),
        (views - others - lower, 3.5, 1.9, 0.85),
        (near, 1.5, 1.65, 0.95),
        (others - near, 4.7, 1.6, 1.25),
    )
    turn = np.concatenate(
        [arc * (np.arange(ring[0]) + rng.random()) / max(ring[0], 1) + start for ring in rings]
    )
    radius, z, aim = np.repeat(np.array(rings)[:, 1:], [ring[0] for ring in rings], axis=0).T
    order = turn.argsort(kind="stable")  # by angle, so that every n-th view comes from all rings
    place = np.stack([radius * np.cos(turn), radius * np.sin(turn), z], 1)[order]
    target = np.stack([0 * aim, 0 * aim, aim], 1)[order]
    place += rng.uniform(-1, 1, place.shape) * [0.15, 0.15, 0.2]
    target += rng.uniform(-1, 1, target.shape) * [0.25, 0.25, 0.12]
    return looking_cameras(place, target, width, height)


def looking_cameras(place: np.ndarray, target: np.ndarray, width: int, height: int) -> list[Camera]:
    """Level cameras at places [n, 3] that look at targets [n, 3]."""
    K = _intrinsics(width, height)
    return [Camera(_look(p, t), K, width, height) for p, t in zip(place, target, strict=True)]


def _intrinsics(width: int, height: int) -> np.ndarray:
    return np.array([[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]], np.float32)


def _look(place: np.ndarray, target: np.ndarray) -> np.ndarray:
    """w2c [4, 4] of a level camera at `place` that looks at `target`."""
    z = (target - place) / np.linalg.norm(target - place)
    x = np.cross(z, [0, 0, 1]) / np.hypot(z[0], z[1])
    w2c = np.eye(4)
    w2c[:3, :3] = [x, np.cross(z, x), z]
    w2c[:3, 3] = -w2c[:3, :3] @ place
    return w2c.astype(np.float32)


def grid_cameras(places: tuple[int, int], views: int, width: int, height: int, seed: int) -> list[Camera]:
    """Cameras on orbits in every courtyard of a grid, and a fifth of them on the ways in between."""
    centres, ways = centres_of(places), ways_of(places)
    walking = views // 5
    K, cameras = _intrinsics(width, height), []
    for i, count in enumerate(_shares(views - walking, len(centres))):
        for camera in demo_cameras(count, width, height, seed + 1000 * (i + 1)):
            cameras.append(_moved(camera, centres[i]))
    rng = np.random.default_rng([seed, 5])
    for way, count in zip(ways, _shares(walking, len(ways)), strict=True):
        for k in range(count):
            start, end = centres[way[:: 1 - 2 * (k % 2)]]
            share = 0.17 + 0.66 * (k + rng.random()) / count
            here, target = start + share * (end - start), end
            if k % 3 == 1:  # from behind one courtyard, over both
                here = start + (0.35 * share - 0.5) * (end - start)
            elif k % 3 == 2:  # across the grid, which is centred at the origin
                target = -here
            if np.linalg.norm(target - here) < 2.5:
                target = start
            here = here + rng.uniform(-0.7, 0.7, 2)
            aim = target + rng.uniform(-0.6, 0.6, 2)
            low, high = rng.uniform(0.7, 1.2), rng.uniform(1.45, 2.2)
            cameras.append(Camera(_look(np.array([*here, high]), np.array([*aim, low])), K, width, height))
    return cameras


def _shares(total: int, parts: int) -> list[int]:
    """`total` as a sum of `parts` nearly equal integers."""
    return [total * (i + 1) // parts - total * i // parts for i in range(parts)]


def _moved(camera: Camera, offset: np.ndarray) -> Camera:
    """The camera moved by `offset` [2] over the ground."""
    w2c = camera.w2c.astype(float)
    w2c[:3, 3] -= w2c[:3, :2] @ offset
    return Camera(w2c.astype(np.float32), camera.K, camera.width, camera.height)
