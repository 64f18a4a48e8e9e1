"""Sky on a far shell: Gaussians of the sky begin on a sphere around the cameras, and stay on it.

Structure from motion finds no points in a sky. Without any, training paints it with blobs of whatever is near,
which hang in front of cameras that no photo was taken from. A sphere beyond everything else has no parallax
that could explain the nearer content, and nothing on it can stand in anybody's way.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, Int16
from scipy.spatial import cKDTree

from sagesplat.core.gaussians import Gaussians
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera, Points, Scene
from sagesplat.segment.masks import Masks, Taxonomy

_FAR_POINTS = 99.0  # percentile of the points' distances that the shell lies beyond
_BEYOND, _LEAST, _MOST = 1.5, 10.0, 100.0  # times that distance; radius at least and at most, scene extents
_PER_VIEW = 24  # points of the shell along the longer side of a photo
_MARGIN = 20.0  # degrees around the sky in the photos that get points too: held-out views see more of it
_PIXELS = 20_000  # of a photo's sky that are looked at, at most


@dataclass(frozen=True, eq=False)
class Shell:
    """The sphere that the Gaussians of the sky lie on."""

    centre: Float32[np.ndarray, "3"]  # world
    radius: float  # world units
    label_ids: tuple[int, ...]  # the categories that are sky

    def rows(self, g: Gaussians) -> torch.Tensor:
        """Indices of the Gaussians of the sky."""
        return torch.nonzero(torch.isin(g.label_ids, g.label_ids.new_tensor(self.label_ids)))[:, 0]

    def hold(self, g: Gaussians) -> None:
        """Move the Gaussians of the sky back onto the sphere, along their directions; in place."""
        rows = self.rows(g)
        centre = g.means.new_tensor(self.centre)
        away = g.means[rows] - centre
        g.means[rows] = centre + away * (self.radius / away.norm(dim=1, keepdim=True).clamp_min(1e-12))


def sky_labels(taxonomy: Taxonomy) -> tuple[int, ...]:
    """The ids of the categories that are sky, by name: "sky", "sky-other-merged", "sky 2" ..."""
    return tuple(i for i, name in taxonomy.names.items() if name.split("-")[0].split(" ")[0].lower() == "sky")


def with_sky(
    scene: Scene, photos: Photos, masks: Masks, label_ids: Int16[np.ndarray, " P"]
) -> tuple[Scene, Int16[np.ndarray, " Q"], Shell | None]:
    """The scene with points on a far shell where training photos show sky, their labels, and the shell."""
    labels = sky_labels(masks.taxonomy)
    if not labels:
        return scene, label_ids, None
    centre = np.median([scene.views[i].camera.position for i in scene.train_ids], axis=0)
    seen, rgb = _seen(scene, photos, masks, labels)
    if not len(seen):
        return scene, label_ids, None
    points = scene.points
    sky = np.isin(label_ids, labels)
    distances = np.linalg.norm(points.xyz[~sky] - centre, axis=1)
    radius = _radius(distances, scene.scale)
    shell = Shell(centre.astype(np.float32), radius, labels)
    directions, colors = _filled(seen, rgb, _spacing(scene))
    xyz = points.xyz.copy()
    away = points.xyz[sky] - centre
    xyz[sky] = centre + away * (radius / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12))
    new = (centre + radius * directions).astype(np.float32)
    points = replace(
        points,
        xyz=np.concatenate([xyz, new]),
        rgb=np.concatenate([points.rgb, colors.round().clip(0, 255).astype(np.uint8)]),
    )
    label_ids = np.concatenate([label_ids, np.full(len(new), labels[0], np.int16)])
    return replace(scene, points=points), label_ids, shell


def _radius(distances: np.ndarray, extent: float) -> float:
    far = np.percentile(distances, _FAR_POINTS) if len(distances) else 0.0
    return float(np.clip(_BEYOND * far, _LEAST * extent, _MOST * extent))


def _spacing(scene: Scene) -> float:
    """Angle between neighbouring points of the shell, radians."""
    cameras = [scene.views[i].camera for i in scene.train_ids]
    fov = np.median([2 * np.arctan(max(c.width / c.K[0, 0], c.height / c.K[1, 1]) / 2) for c in cameras])
    return float(fov / _PER_VIEW)


def _seen(scene, photos, masks, labels):
    """Directions in which training photos show sky, one per cell of the grid, and their mean colours."""
    spacing = _spacing(scene)
    sums: dict[tuple[int, int, int], np.ndarray] = {}
    for row in scene.train_ids.tolist():
        view = scene.views[row]
        v, u = np.nonzero(np.isin(masks[view], labels))
        if not len(v):
            continue
        step = max(1, len(v) // _PIXELS)
        v, u = v[::step], u[::step]
        d = directions(view.camera, np.stack([u + 0.5, v + 0.5], 1))
        key = np.floor(d / spacing).astype(np.int64)
        cells, index = np.unique(key, axis=0, return_inverse=True)
        values = np.concatenate([d, photos[row][v, u].astype(np.float64), np.ones((len(v), 1))], 1)
        total = np.zeros((len(cells), 7))
        np.add.at(total, index.ravel(), values)
        for cell, value in zip(map(tuple, cells.tolist()), total, strict=True):
            sums[cell] = sums.get(cell, 0) + value
    if not sums:
        return np.zeros((0, 3)), np.zeros((0, 3))
    table = np.array(list(sums.values()))
    d = table[:, :3] / np.linalg.norm(table[:, :3], axis=1, keepdims=True)
    return d, table[:, 3:6] / table[:, 6:]


def directions(camera: Camera, uv):
    inward = np.concatenate([(uv - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]], np.ones((len(uv), 1))], 1)
    d = inward @ camera.w2c[:3, :3]
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def _filled(seen, rgb, spacing):
    """The directions that were seen, and a margin around them in the colours of the nearest."""
    n = int(4 * np.pi / spacing**2)
    k = np.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, np.pi * (1 + 5**0.5) * k
    grid = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    tree = cKDTree(seen)
    distance, nearest = tree.query(grid)
    margin = (distance > 0.7 * spacing) & (distance < 2 * np.sin(np.radians(_MARGIN) / 2))
    return np.concatenate([seen, grid[margin]]), np.concatenate([rgb, rgb[nearest[margin]]])
