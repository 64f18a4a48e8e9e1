"""Simulated structure from motion of the garden: points and tracks."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, UInt8

from sagesplat.demo.paint import dome_distance
from sagesplat.demo.render import FAR, camera_rays, cast_rays, lit_world
from sagesplat.demo.world import World
from sagesplat.scene.colmap_write import ModelCamera, ModelImage, write_model
from sagesplat.scene.scene import Camera

CANDIDATES = 12500  # features sampled over all views, per courtyard
UV_NOISE = 0.4  # standard deviation of a feature's position, pixels
SKY_ID = 187


class Taken(NamedTuple):
    """A disturbed capture, where it differs from the scene."""

    cameras: list[Camera]  # poses as structure from motion gives them
    photos: UInt8[np.ndarray, "V H W 3"]
    hidden: Bool[np.ndarray, "V H W"]  # pixels where something moving hides the scene


def write_points(
    folder: Path,
    names: list[str],
    cameras: list[Camera],
    photos: UInt8[np.ndarray, "V H W 3"],
    labels: UInt8[np.ndarray, "V H W"],
    seed: int,
    places: tuple[int, int] = (1, 1),
    taken: Taken | None = None,
) -> None:
    """Write a simulated COLMAP model: points on textured surfaces, seen in at least 3 views.

    `photos` and `labels` show the scene alone. `taken` are the photos and poses of a disturbed capture. Its
    points and tracks are those of exact poses: structure from motion that errs would err in them as well.
    """
    rng, world = np.random.default_rng([seed, 2]), lit_world(seed, places)
    sought = CANDIDATES * places[0] * places[1]
    xyz, home, distance = _candidates(world, cameras, photos, labels, sought, rng)
    point, view, uv, depth = _matched(world, cameras, xyz, home, distance, rng)
    if taken:
        column, row = uv.astype(int).T
        open_view = ~taken.hidden[view, row, column]
        point, view, uv, depth = (values[open_view] for values in (point, view, uv, depth))
    keep = np.bincount(point, minlength=len(xyz)) >= 3
    xyz, kept = xyz[keep], keep[point]
    point, view, uv, depth = (np.cumsum(keep) - 1)[point[kept]], view[kept], uv[kept], depth[kept]
    noisy = uv + rng.normal(0, UV_NOISE, (len(point), 2))
    size = cameras[0].width, cameras[0].height
    outside = (np.abs(noisy / size - 0.5) >= 0.5).any(1)
    noisy[outside] = uv[outside]
    xyz = _triangulate(cameras, xyz, point, view, noisy, uv, depth)
    again = np.empty_like(noisy)
    for i, camera in enumerate(cameras):
        again[view == i] = project(camera, xyz)[0][point[view == i]]
    error = np.linalg.norm(again - noisy, axis=1)
    column, row = noisy.astype(int).T
    rgb = np.zeros((len(xyz), 3))
    np.add.at(rgb, point, (taken.photos if taken else photos)[view, row, column])
    count = np.bincount(point, minlength=len(xyz))
    K = cameras[0].K
    model = ModelCamera(
        1,
        "PINHOLE",
        cameras[0].width,
        cameras[0].height,
        tuple(map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))),
    )
    posed = taken.cameras if taken else cameras
    images = [
        ModelImage(i + 1, names[i], 1, posed[i].w2c, noisy[view == i], point[view == i])
        for i in range(len(cameras))
    ]
    colour = (rgb / count[:, None]).round().astype(np.uint8)
    write_model(folder, [model], images, xyz, colour, np.bincount(point, error) / count)


def project(camera: Camera, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [n, 2] and camera z [n] of world points."""
    inside = xyz @ camera.w2c[:3, :3].T.astype(float) + camera.w2c[:3, 3]
    z = np.where(np.abs(inside[:, 2]) < 1e-6, 1e-6, inside[:, 2])
    return inside[:, :2] / z[:, None] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2], inside[:, 2]


def _candidates(
    world: World,
    cameras: list[Camera],
    photos: np.ndarray,
    labels: np.ndarray,
    sought: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Surface points [n, 3] at textured pixels, the view [n] of each, and its distance [n] from that view."""
    per_view = min(sought // len(cameras), labels[0].size // 2)
    sampled = []
    for i, camera in enumerate(cameras):
        grey = photos[i].mean(2)
        slope = np.hypot(*np.gradient(grey))
        slope[[0, -1]] = slope[:, [0, -1]] = 0
        weight = np.minimum(slope, 30.0).ravel() + 0.3
        weight[labels[i].ravel() == SKY_ID] *= 4  # clouds are faint
        pick = rng.choice(weight.size, per_view, replace=False, p=weight / weight.sum())
        uv = np.stack([pick % camera.width, pick // camera.width], 1) + 0.5
        origins, directions, _ = camera_rays(camera, uv)
        t = cast_rays(world, origins, directions, FAR, float(1 / camera.K[0, 0]))[0]
        t = np.where(labels[i].ravel()[pick] == SKY_ID, dome_distance(origins, directions), t)
        sampled.append((origins + t[:, None] * directions, np.full(per_view, i), t))
    xyz, home, distance = (np.concatenate(c) for c in zip(*sampled, strict=True))
    return xyz, home, distance


def _matched(
    world: World,
    cameras: list[Camera],
    xyz: np.ndarray,
    home: np.ndarray,
    distance: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Observations, sorted by point: point [T], view [T], pixel [T, 2], camera z [T].

    A view observes a point that is in the image, not occluded, and similar in viewing angle and scale to the
    view that it was sampled in.
    """
    centres = np.stack([c.position for c in cameras]).astype(float)
    towards_home, observed = (centres[home] - xyz) / distance[:, None], []
    for i, camera in enumerate(cameras):
        offset = xyz - centres[i]
        away = np.linalg.norm(offset, axis=1)
        cosine = -np.einsum("ij,ij->i", offset / away[:, None], towards_home)
        scale = np.abs(np.log(away / distance))
        uv, z = project(camera, xyz)
        framed = (z > 0) & (np.abs(uv / [camera.width, camera.height] - 0.5) < 0.495).all(1)
        # Matchers lose features beyond about 40 degrees or a scale factor of 1.8, and some at random.
        likely = framed & (cosine > 0.77) & (scale < 0.6) & (rng.random(len(xyz)) < 0.75)
        rows = np.flatnonzero(likely & (home != i))
        start = np.tile(centres[i], (len(rows), 1))
        t = cast_rays(world, start, offset[rows] / away[rows, None], away[rows], float(1 / camera.K[0, 0]))[0]
        seen = home == i
        seen[rows] = t > away[rows] - 0.01 - 0.004 * away[rows]
        rows = np.flatnonzero(seen)
        observed.append((rows, np.full(len(rows), i), uv[rows], z[rows]))
    point, view, uv, z = (np.concatenate(c) for c in zip(*observed, strict=True))
    order = point.argsort(kind="stable")
    return point[order], view[order], uv[order], z[order]


def _triangulate(
    cameras: list[Camera],
    xyz: np.ndarray,
    point: np.ndarray,
    view: np.ndarray,
    noisy: np.ndarray,
    uv: np.ndarray,
    z: np.ndarray,
) -> np.ndarray:
    """Points [n, 3] triangulated from noisy features: one Gauss-Newton step from the ground truth."""
    w2c, focal = np.stack([c.w2c for c in cameras])[view].astype(float), float(cameras[0].K[0, 0])
    centred = (uv - cameras[0].K[:2, 2]) / focal
    J = focal / z[:, None, None] * (w2c[:, :2, :3] - centred[:, :, None] * w2c[:, 2:3, :3])
    normal, right = np.zeros((len(xyz), 3, 3)), np.zeros((len(xyz), 3))
    np.add.at(normal, point, J.transpose(0, 2, 1) @ J)
    np.add.at(right, point, np.einsum("tij,ti->tj", J, noisy - uv))
    # A weak prior keeps points of tracks with a small baseline (the far sky) from diverging along their rays.
    prior = 1e-3 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return xyz + np.linalg.solve(normal + prior, right[..., None])[..., 0]
