"""Photos of the truth from viewpoints off the path: what a visitor of the photographed region sees."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int16, UInt8
from PIL import Image
from scipy.ndimage import maximum_filter

from sagesplat.core.errors import SceneError
from sagesplat.demo.cameras import looking_cameras
from sagesplat.demo.paint import dome_distance
from sagesplat.demo.points import project
from sagesplat.demo.render import camera_rays, render_view, threads_map
from sagesplat.io.files import write_json
from sagesplat.scene.scene import Camera

BEYOND = np.radians(15)  # farther around than the ends of the path
RADIUS, HEIGHT = (1.2, 5.2), (0.7, 2.6)  # metres; the photos are between 1.3 and 4.9, and 1.2 and 2.1
AIM, AIM_HEIGHT = 0.8, (0.4, 1.5)  # targets: this far from the table's centre along x and y, and this high
APART = 0.4  # metres from the nearest photo
CLEAR = 0.5  # metres in front of the camera without anything
UNSEEN = 0.15  # largest share of a picture that fewer than SEEN_BY photos show
SEEN_BY = 2  # photos: what only one shows has no depth
BATCH = 8  # viewpoints tried at once


class OffPath(NamedTuple):
    """A picture of the truth."""

    camera: Camera
    photo: UInt8[np.ndarray, "H W 3"]
    label: Int16[np.ndarray, "H W"]
    seen: Bool[np.ndarray, "H W"]  # shown by at least SEEN_BY photos of the path


def off_path_pictures(
    cameras: list[Camera],
    depths: list[Float32[np.ndarray, "H W"]],
    count: int,
    seed: int,
    arc: float = 2 * np.pi,
    start: float = 0.0,
) -> Iterator[OffPath]:
    """Pictures from `count` viewpoints around a path (`arc`, `start`) with photos of these exact depths.

    A viewpoint is uniform in angle (the path's, and BEYOND its ends), RADIUS and HEIGHT, and looks level at a
    place near the table. It is drawn again where it is nearer than APART to a photo, where something is
    nearer than CLEAR, or where more than UNSEEN of its picture is not seen by the photos. SceneError where
    hardly any viewpoint passes.
    """
    rng, beyond = np.random.default_rng([seed, 15]), 0.0 if arc >= 2 * np.pi else BEYOND
    centres, farthest = np.stack([c.position for c in cameras]), [maximum_filter(d, 3) for d in depths]
    found = 0

    def look(camera: Camera) -> OffPath | None:
        if np.linalg.norm(centres - camera.position, axis=1).min() < APART:
            return None
        photo, label, depth = render_view(camera, seed)
        if np.quantile(depth, 0.005) < CLEAR:
            return None
        seen = _seen(camera, depth, cameras, farthest)
        return OffPath(camera, photo, label, seen) if seen.mean() >= 1 - UNSEEN else None

    for _ in range(2 + 20 * count // BATCH):
        for picture in list(threads_map(look, _drawn(rng, arc + 2 * beyond, start - beyond, cameras[0]))):
            if picture and found < count:
                found += 1
                yield picture
        if found == count:
            return
    raise SceneError(f"{found} of {count} viewpoints off the path see what the photos show; draw more photos")


def _drawn(rng: np.random.Generator, arc: float, start: float, like: Camera) -> list[Camera]:
    turn, radius = start + rng.uniform(0, arc, BATCH), rng.uniform(*RADIUS, BATCH)
    place = np.stack([radius * np.cos(turn), radius * np.sin(turn), rng.uniform(*HEIGHT, BATCH)], 1)
    target = np.column_stack([rng.uniform(-AIM, AIM, (BATCH, 2)), rng.uniform(*AIM_HEIGHT, BATCH)])
    return looking_cameras(place, target, like.width, like.height)


def _seen(
    camera: Camera, depth: np.ndarray, photos: list[Camera], farthest: list[np.ndarray]
) -> Bool[np.ndarray, "H W"]:
    """Pixels whose surface is the nearest thing in SEEN_BY photos, by their depths (largest of 3 x 3)."""
    v, u = (np.indices(depth.shape) + 0.5).reshape(2, -1)
    origins, directions, z_share = camera_rays(camera, np.stack([u, v], 1))
    t = np.where(np.isinf(depth.ravel()), dome_distance(origins, directions), depth.ravel() / z_share)
    at, times = origins + t[:, None] * directions, np.zeros(depth.size, int)
    for photo, far in zip(photos, farthest, strict=True):
        uv, z = project(photo, at)
        inside = (z > 0) & (uv >= 0).all(1) & (uv < [photo.width, photo.height]).all(1)
        column, row = uv[inside].astype(int).T
        times[inside] += z[inside] < 1.02 * far[row, column] + 0.02
    return (times >= SEEN_BY).reshape(depth.shape)


def write_pictures(folder: Path, pictures: Iterator[OffPath]) -> None:
    """Write images/, masks/ (label ids), seen/ (255: counts) and transforms.json."""
    for below in ("images", "masks", "seen"):
        (folder / below).mkdir(parents=True)
    names, cameras = [], []
    for picture in pictures:
        name = f"off_{len(names):03d}.png"
        Image.fromarray(picture.photo).save(folder / "images" / name)
        Image.fromarray(picture.label.astype(np.uint8)).save(folder / "masks" / name)
        Image.fromarray(255 * picture.seen.astype(np.uint8)).save(folder / "seen" / name)
        names.append(name)
        cameras.append(picture.camera)
    write_transforms(folder, names, cameras)


def write_transforms(folder: Path, names: list[str], cameras: list[Camera]) -> None:
    """Write nerfstudio's transforms.json of photos in images/."""
    K = cameras[0].K
    frames = []
    for name, camera in zip(names, cameras, strict=True):
        c2w = np.linalg.inv(camera.w2c.astype(float)) * [1, -1, -1, 1]  # OpenGL's axes
        frames.append({"file_path": f"images/{name}", "transform_matrix": c2w.tolist()})
    lens: dict[str, float] = {"w": cameras[0].width, "h": cameras[0].height}
    lens |= {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    write_json(folder / "transforms.json", {"camera_model": "PINHOLE", **lens, "frames": frames})
