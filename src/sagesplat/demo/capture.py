"""Writes the garden as a capture: a COLMAP workspace with label images, clean or with known disturbances."""

import hashlib
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int16, UInt8
from PIL import Image

from sagesplat import __version__
from sagesplat.core.errors import SceneError
from sagesplat.demo.cameras import demo_cameras, grid_cameras
from sagesplat.demo.figures import PERSON, figures_at
from sagesplat.demo.foliage import NO_OBJECT
from sagesplat.demo.off_path import off_path_pictures, write_pictures, write_transforms
from sagesplat.demo.points import Taken, write_points
from sagesplat.demo.render import (
    Lit,
    lit_world,
    render_light,
    take_photo,
    threads_map,
)
from sagesplat.demo.wild import FACING, NOTHING, Wild, camera_gains, kept_views, lens_falloff, noisy_cameras
from sagesplat.demo.world import BRICK, CORE, LABELS, LEAF, ROOF, WOOD, World
from sagesplat.io.files import cache_folder, unwritable, write_json
from sagesplat.scene.scene import Camera


class Shot(NamedTuple):
    """A photo with its truth; without disturbances both are the same arrays."""

    photo: UInt8[np.ndarray, "H W 3"]
    label: UInt8[np.ndarray, "H W"]  # with the figures, where label images show them
    hidden: Bool[np.ndarray, "H W"]  # where a figure stands
    objects: Int16[np.ndarray, "H W"]  # number of the object; NO_OBJECT for none, and behind figures
    true_photo: UInt8[np.ndarray, "H W 3"]
    true_label: UInt8[np.ndarray, "H W"]
    depth: Float32[np.ndarray, "H W"]  # of the scene without figures


def make_capture(
    folder: Path | str,
    *,
    views: int = 60,
    width: int = 480,
    height: int = 360,
    seed: int = 0,
    places: tuple[int, int] = (1, 1),
    wild: Wild = NOTHING,
    on_view: Callable[[int, int], None] | None = None,
) -> None:
    """Render the garden into `folder`: images/*.png, masks/*.png with labels.json, sparse/0/*.bin.

    A single courtyard has instances/*.png too: the object that each pixel shows, 65535 for none. The files
    depend on the arguments only. The folder is written atomically.

    Args:
        folder: The capture to make; it must not exist.
        views: Photos, at least 3; 10 for each place of a grid.
        width: Of the photos, in pixels.
        height: Of the photos, in pixels.
        seed: Of what grows and lies where.
        places: (nx, ny) courtyards: a large capture, with photos from orbits in each and, a fifth of them,
            from the ways in between.
        wild: Disturbances. truth/ then has what they are measured against: exact poses and undisturbed photos
            of the same views (transforms.json, images/), where figures stand (figures/*.png, 255) and
            `off_path` viewpoints (off_path/, see `off_path.write_pictures`).
        on_view: Called after each photo with how many are done, and how many there are.

    Raises:
        SceneError: If `folder` exists or cannot be written, `places` or `views` are too few, or a grid is to
            be disturbed.
    """
    folder = Path(folder)
    if views < 3:
        raise SceneError(f"{folder}: {views} views; a capture needs at least 3")
    if min(places) < 1:
        raise SceneError(f"{folder}: {places[0]} x {places[1]} places; name at least 1 x 1")
    if views < 10 * places[0] * places[1] and places != (1, 1):
        raise SceneError(f"{folder}: {views} views; {places[0]} x {places[1]} places need at least 10 each")
    if folder.exists():
        raise SceneError(f"{folder}: already exists; remove it or name another folder")
    if places != (1, 1) and not wild.quiet:
        raise SceneError(f"{folder}: disturbances need one place, not {places[0]} x {places[1]}")
    if places == (1, 1):
        cameras = demo_cameras(views, width, height, seed, *_arc(wild))
    else:
        cameras = grid_cameras(places, views, width, height, seed)
    temporary = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}-"))
        _write(temporary, cameras, seed, places, wild, on_view)
        temporary.chmod(0o755)
        temporary.rename(folder)
    except OSError as error:
        raise SceneError(unwritable(folder, error)) from error
    finally:
        if temporary:
            shutil.rmtree(temporary, ignore_errors=True)


def cached_capture(
    on_view: Callable[[int, int], None] | None = None,
    places: tuple[int, int] = (1, 1),
    wild: Wild = NOTHING,
) -> Path:
    """Return the folder of the built-in capture, made on the first call.

    It is in the cache (`files.cache_folder`), under a name that changes with the version and with the code
    that draws it.

    Args:
        on_view: Called with (views drawn, views in all).
        places: Courtyards along x and y. (1, 1): one, in photos of full size; else 105 small photos of each.
        wild: Disturbances of a single courtyard.

    Returns:
        A COLMAP workspace with label images.

    Raises:
        SceneError: If the cache cannot be written.
    """
    code = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    release = hashlib.sha256(__version__.encode() + code).hexdigest()[:12]
    size: dict[str, Any] = {}
    name = "courtyard"
    if places != (1, 1):
        nx, ny = places
        name, size = f"courtyards-{nx}x{ny}", {"views": 105 * nx * ny, "width": 192, "height": 144}
    if not wild.quiet:
        name += "-wild-" + hashlib.sha256(repr(wild).encode()).hexdigest()[:8]
    folder = cache_folder() / f"demo-{release}" / name
    if not folder.exists():
        try:
            make_capture(folder, **size, places=places, wild=wild, on_view=on_view)
        except SceneError:
            if not folder.exists():  # else another process was faster
                raise
    return folder


def _arc(wild: Wild) -> tuple[float, float]:
    """How far around the path goes, and from where; radians."""
    return (np.pi, FACING) if wild.half_circle else (2 * np.pi, 0.0)


def _write(
    folder: Path,
    cameras: list[Camera],
    seed: int,
    places: tuple[int, int],
    wild: Wild,
    on_view: Callable[[int, int], None] | None,
) -> None:
    digits = max(3, len(str(len(cameras) - 1)))
    gains, rows = camera_gains(wild, len(cameras), seed), kept_views(wild, len(cameras), seed)
    names, cameras = [f"view_{i:0{digits}d}.png" for i in rows], [cameras[i] for i in rows]
    one = places == (1, 1)  # whose objects are numbered
    for below in ("images", "masks", "sparse/0", *["instances"] * one):
        (folder / below).mkdir(parents=True)
    lit_world(seed, places)  # cached here, before threads use it

    def take(i: int) -> Shot:
        shot = _take_shot(cameras[i], rows[i], seed, places, wild, gains[rows[i]])
        Image.fromarray(shot.photo).save(folder / "images" / names[i])
        Image.fromarray(shot.label).save(folder / "masks" / names[i])
        if one:
            Image.fromarray(shot.objects.astype(np.uint16)).save(folder / "instances" / names[i])
        return shot

    shots = []
    for i, shot in enumerate(threads_map(take, range(len(cameras)))):
        shots.append(shot)
        if on_view:
            on_view(i + 1, len(cameras))
    people = {PERSON: "person"} if wild.figures and wild.figure_masks else {}
    write_taxonomy(folder, people | LABELS)
    photos, labels = np.stack([s.true_photo for s in shots]), np.stack([s.true_label for s in shots])
    taken = None
    if not wild.quiet:
        photo, hidden = np.stack([s.photo for s in shots]), np.stack([s.hidden for s in shots])
        taken = Taken(noisy_cameras(wild, cameras, seed), photo, hidden)
        _write_truth(folder / "truth", names, cameras, shots, seed, wild)
    write_points(folder / "sparse" / "0", names, cameras, photos, labels, seed, places, taken)


def _take_shot(
    camera: Camera,
    number: int,
    seed: int,
    places: tuple[int, int],
    wild: Wild,
    gains: Float64[np.ndarray, "3"],
) -> Shot:
    """The photo of this number on the path; `gains` are its factors of linear RGB.

    Light is disturbed before the tone curve, as in a camera, and the sensor's noise is that of the
    undisturbed photo.
    """
    lit = render_light(camera, seed, places)
    light, objects = lit.rgb, _objects(lit_world(seed, places), lit)
    true_photo, true_label = take_photo(light, camera, seed), lit.label.astype(np.uint8)
    label = true_label
    hidden = np.zeros(label.shape, bool)
    if wild.quiet:
        return Shot(true_photo, label, hidden, objects, true_photo, true_label, lit.depth)
    if wild.figures:
        figures = figures_at(number, camera.position, wild.figures, seed)
        with_figures = render_light(camera, seed, places, figures)
        light, hidden = with_figures.rgb, with_figures.label == PERSON
        label = with_figures.label.astype(np.uint8) if wild.figure_masks else true_label
    photo = take_photo(light * gains * lens_falloff(wild, camera), camera, seed)
    objects = np.where(hidden, NO_OBJECT, objects).astype(np.int16)
    return Shot(photo, label, hidden, objects, true_photo, true_label, lit.depth)


def _objects(world: World, lit: Lit) -> Int16[np.ndarray, "H W"]:
    """The object of `build_world` at each pixel, NO_OBJECT where there is none."""
    found = np.full(lit.part.shape, NO_OBJECT, np.int16)
    bodies, leaves = np.isin(lit.material, (BRICK, ROOF, CORE)), lit.material == LEAF
    solids = (lit.material >= WOOD) & ~bodies & ~leaves
    found[leaves] = world.leaf_object[lit.part[leaves]]
    found[bodies] = world.body_object[lit.part[bodies] // 8]
    found[solids] = world.solid_object[lit.part[solids]]
    return found


def _write_truth(
    folder: Path, names: list[str], cameras: list[Camera], shots: list[Shot], seed: int, wild: Wild
) -> None:
    """Undisturbed photos, exact poses, figures and viewpoints off the path."""
    for below in ("images", "figures"):
        (folder / below).mkdir(parents=True)
    for name, shot in zip(names, shots, strict=True):
        Image.fromarray(shot.true_photo).save(folder / "images" / name)
        Image.fromarray(255 * shot.hidden.astype(np.uint8)).save(folder / "figures" / name)
    write_transforms(folder, names, cameras)
    if wild.off_path:
        depths = [shot.depth for shot in shots]
        pictures = off_path_pictures(cameras, depths, wild.off_path, seed, *_arc(wild))
        write_pictures(folder / "off_path", pictures)
        write_taxonomy(folder / "off_path", LABELS)


def write_taxonomy(folder: Path, labels: dict[int, str]) -> None:
    """Write the names of the ids in label images: masks/labels.json."""
    taxonomy = {str(i): name for i, name in labels.items()}
    write_json(
        folder / "masks" / "labels.json", {"taxonomy": "coco-panoptic", "unlabelled": 255, "labels": taxonomy}
    )
