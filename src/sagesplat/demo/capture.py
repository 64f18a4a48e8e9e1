"""Writes the garden as a capture: a COLMAP workspace with photos, poses, points and label images."""

import hashlib
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from sagesplat import __version__
from sagesplat.demo.points import write_points
from sagesplat.demo.render import lit_world, render_view, threads_map
from sagesplat.demo.world import LABELS
from sagesplat.errors import SceneError
from sagesplat.files import cache_folder, write_json
from sagesplat.scene.scene import Camera


def make_capture(
    folder: Path,
    *,
    views: int = 60,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    on_view: Callable[[int, int], None] | None = None,
) -> None:
    """Photograph the garden into `folder`: images/*.png, masks/*.png with labels.json, sparse/0/*.bin.

    The bytes depend on the arguments alone. The folder appears when it is complete, so a killed run leaves
    no half capture. `on_view(done, views)` is called after each photo. Raises SceneError where `folder`
    exists or cannot be made.
    """
    if views < 3:
        raise SceneError(f"{folder}: {views} views; a capture needs at least 3")
    if folder.exists():
        raise SceneError(f"{folder}: already exists; remove it or name another folder")
    temporary = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}-"))
        _write(temporary, demo_cameras(views, width, height, seed), seed, on_view)
        temporary.chmod(0o755)
        temporary.rename(folder)
    except OSError as error:
        raise SceneError(f"{folder}: cannot be written ({error.strerror}); name another folder") from error
    finally:
        if temporary:
            shutil.rmtree(temporary, ignore_errors=True)


def cached_capture(on_view: Callable[[int, int], None] | None = None) -> Path:
    """The demo capture's folder, made on the first call.

    It lies in the cache (`files.cache_folder`), under a name that changes with the version and with the code
    that draws it.
    """
    code = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    folder = (
        cache_folder() / f"demo-{hashlib.sha256(__version__.encode() + code).hexdigest()[:12]}" / "courtyard"
    )
    if not folder.exists():
        try:
            make_capture(folder, on_view=on_view)
        except SceneError:
            if not folder.exists():  # else another process was faster
                raise
    return folder


def demo_cameras(views: int, width: int, height: int, seed: int) -> list[Camera]:
    """Two orbits around the table at different heights, and a sixth of the views from nearer or farther."""
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
        [2 * np.pi * (np.arange(ring[0]) + rng.random()) / max(ring[0], 1) for ring in rings]
    )
    radius, z, aim = np.repeat(np.array(rings)[:, 1:], [ring[0] for ring in rings], axis=0).T
    order = turn.argsort(kind="stable")  # by angle, so that every n-th view is of any ring
    place = np.stack([radius * np.cos(turn), radius * np.sin(turn), z], 1)[order]
    target = np.stack([0 * aim, 0 * aim, aim], 1)[order]
    place += rng.uniform(-1, 1, place.shape) * [0.15, 0.15, 0.2]
    target += rng.uniform(-1, 1, target.shape) * [0.25, 0.25, 0.12]
    K = np.array([[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]], np.float32)
    return [Camera(_look(p, t), K, width, height) for p, t in zip(place, target, strict=True)]


def _look(place: np.ndarray, target: np.ndarray) -> np.ndarray:
    """w2c [4, 4] of a level camera at `place` that looks at `target`."""
    z = (target - place) / np.linalg.norm(target - place)
    x = np.cross(z, [0, 0, 1]) / np.hypot(z[0], z[1])
    w2c = np.eye(4)
    w2c[:3, :3] = [x, np.cross(z, x), z]
    w2c[:3, 3] = -w2c[:3, :3] @ place
    return w2c.astype(np.float32)


def _write(
    folder: Path, cameras: list[Camera], seed: int, on_view: Callable[[int, int], None] | None
) -> None:
    names = [f"view_{i:03d}.png" for i in range(len(cameras))]
    for below in ("images", "masks", "sparse/0"):
        (folder / below).mkdir(parents=True)
    lit_world(seed)  # before the threads, which share it
    photos, labels = [], []
    for done, (rgb, label, _) in enumerate(threads_map(lambda c: render_view(c, seed), cameras)):
        Image.fromarray(rgb).save(folder / "images" / names[done])
        Image.fromarray(label.astype(np.uint8)).save(folder / "masks" / names[done])
        photos.append(rgb)
        labels.append(label)
        if on_view:
            on_view(done + 1, len(cameras))
    taxonomy = {str(i): name for i, name in LABELS.items()}
    write_json(
        folder / "masks" / "labels.json", {"taxonomy": "coco-panoptic", "unlabelled": 255, "labels": taxonomy}
    )
    write_points(folder / "sparse" / "0", names, cameras, np.stack(photos), np.stack(labels), seed)
