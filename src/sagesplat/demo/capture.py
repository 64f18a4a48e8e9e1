"""Writes the garden as a capture: a COLMAP workspace with label images."""

import hashlib
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from sagesplat import __version__
from sagesplat.core.errors import SceneError
from sagesplat.demo.cameras import demo_cameras, grid_cameras
from sagesplat.demo.points import write_points
from sagesplat.demo.render import lit_world, render_view, threads_map
from sagesplat.demo.world import LABELS
from sagesplat.io.files import cache_folder, unwritable, write_json
from sagesplat.scene.scene import Camera


def make_capture(
    folder: Path,
    *,
    views: int = 60,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    places: tuple[int, int] = (1, 1),
    on_view: Callable[[int, int], None] | None = None,
) -> None:
    """Render the garden into `folder`: images/*.png, masks/*.png with labels.json, sparse/0/*.bin.

    `places` (nx, ny) makes a large capture: a grid of different courtyards, with photos from orbits in each
    and, a fifth of them, from the ways in between. The files depend on the arguments only. The folder is
    written atomically. `on_view(done, views)` is called after each photo. SceneError if `folder` exists or
    cannot be written, or `places` or `views` are too few.
    """
    if views < 3:
        raise SceneError(f"{folder}: {views} views; a capture needs at least 3")
    if min(places) < 1:
        raise SceneError(f"{folder}: {places[0]} x {places[1]} places; name at least 1 x 1")
    if views < 10 * places[0] * places[1] and places != (1, 1):
        raise SceneError(f"{folder}: {views} views; {places[0]} x {places[1]} places need at least 10 each")
    if folder.exists():
        raise SceneError(f"{folder}: already exists; remove it or name another folder")
    if places == (1, 1):
        cameras = demo_cameras(views, width, height, seed)
    else:
        cameras = grid_cameras(places, views, width, height, seed)
    temporary = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}-"))
        _write(temporary, cameras, seed, places, on_view)
        temporary.chmod(0o755)
        temporary.rename(folder)
    except OSError as error:
        raise SceneError(unwritable(folder, error)) from error
    finally:
        if temporary:
            shutil.rmtree(temporary, ignore_errors=True)


def cached_capture(
    on_view: Callable[[int, int], None] | None = None, places: tuple[int, int] = (1, 1)
) -> Path:
    """Return the folder of the built-in capture, made on the first call.

    It is in the cache (`files.cache_folder`), under a name that changes with the version and with the code
    that draws it.

    Args:
        on_view: Called with (views drawn, views in all).
        places: Courtyards along x and y. (1, 1): one, in photos of full size; else 105 small photos of each.

    Returns:
        A COLMAP workspace with label images.

    Raises:
        SceneError: If the cache cannot be written.
    """
    code = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    release = hashlib.sha256(__version__.encode() + code).hexdigest()[:12]
    name, size = "courtyard", {}
    if places != (1, 1):
        nx, ny = places
        name, size = f"courtyards-{nx}x{ny}", {"views": 105 * nx * ny, "width": 192, "height": 144}
    folder = cache_folder() / f"demo-{release}" / name
    if not folder.exists():
        try:
            make_capture(folder, **size, places=places, on_view=on_view)
        except SceneError:
            if not folder.exists():  # else another process was faster
                raise
    return folder


def _write(
    folder: Path,
    cameras: list[Camera],
    seed: int,
    places: tuple[int, int],
    on_view: Callable[[int, int], None] | None,
) -> None:
    digits = max(3, len(str(len(cameras) - 1)))
    names = [f"view_{i:0{digits}d}.png" for i in range(len(cameras))]
    for below in ("images", "masks", "sparse/0"):
        (folder / below).mkdir(parents=True)
    lit_world(seed, places)  # cached here, before threads use it
    shape = len(cameras), cameras[0].height, cameras[0].width
    photos, labels = np.empty((*shape, 3), np.uint8), np.empty(shape, np.uint8)
    for done, (rgb, label, _) in enumerate(threads_map(lambda c: render_view(c, seed, places), cameras)):
        photos[done], labels[done] = rgb, label
        Image.fromarray(rgb).save(folder / "images" / names[done])
        Image.fromarray(labels[done]).save(folder / "masks" / names[done])
        if on_view:
            on_view(done + 1, len(cameras))
    taxonomy = {str(i): name for i, name in LABELS.items()}
    write_json(
        folder / "masks" / "labels.json", {"taxonomy": "coco-panoptic", "unlabelled": 255, "labels": taxonomy}
    )
    write_points(folder / "sparse" / "0", names, cameras, photos, labels, seed, places)
