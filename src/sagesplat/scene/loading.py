"""Shared by the loaders of captures: checks of settings, views of photos, and what is said about them."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from jaxtyping import Float

from sagesplat.core.errors import SceneError, short
from sagesplat.scene.find_photos import PHOTO_FOLDERS, Found, PhotoFolder
from sagesplat.scene.given_masks import is_mask_among
from sagesplat.scene.images import photo_size
from sagesplat.scene.scene import Camera, Lens, View
from sagesplat.scene.undistort import (
    FACES,
    SPHERE,
    WIDE,
    cube_faces,
    intrinsics,
    is_pinhole,
    pinhole,
    shown_share,
)

MIN_VIEWS = 3  # posed photos
MAX_SIDE = 10**6  # pixels
Fisheye = Literal["crop", "faces"]
_CROPPED = 0.1  # share of a photo's area from which on it is said that a wide lens is cropped


def check_settings(path: Path, downscale: int, test_every: int) -> None:
    """SceneError unless `downscale` is at least 1, and `test_every` 0 or at least 2."""
    if downscale < 1 or test_every < 0 or test_every == 1:
        raise SceneError(
            f"{path}: downscale {downscale} and test_every {test_every} cannot be used; "
            "take downscale >= 1 and test_every 0 or >= 2"
        )


def check_found(photos: Found, of: str) -> None:
    """SceneError unless enough of the photos that `of` lists are there."""
    if len(photos.files) >= min(MIN_VIEWS, len(photos.names)) and photos.files:
        return
    missing = photos.missing
    raise SceneError(
        f"{photos.folder}: {len(missing)} of the {len(photos.names)} photos of {of} are missing, first "
        f"{short(repr(missing[0]))}; add the files, or give their folder with --images"
    )


def at_downscale(photos: Found, downscale: int) -> tuple[dict[str, Path], int]:
    """The files of photos, by name as written, and by what their size is still to be divided.

    Those in images_N beside images/, where the capture has them. SceneError where some are missing there.
    """
    small = photos.folder.with_name(f"images_{downscale}")
    if downscale == 1 or photos.folder.name not in PHOTO_FOLDERS or not small.is_dir():
        return {name: photos.folder / file for name, file in photos.files.items()}, downscale
    found = PhotoFolder(small).find(list(photos.files.values()))
    if found.missing:
        raise SceneError(
            f"{small}: {len(found.missing)} of the {len(found.names)} photos in {photos.folder.name}/ are "
            f"missing, first {short(repr(found.missing[0]))}; add them, or move this folder away: then the "
            "photos themselves are made smaller"
        )
    return {name: small / found.files[file] for name, file in photos.files.items()}, 1


def describe_photos(photos: Found, least: int = 0) -> list[str]:
    """Lines on the photos that poses are for: how many of how many have one, which are gone or renamed.

    `least`: photos that there were, of which those without poses may have been left out.
    """
    posed = set(photos.files.values())
    rest = [Path(file.written) for file in PhotoFolder(photos.folder).files if file.written not in posed]
    beside: dict[Path, set[str]] = defaultdict(set)
    for file in (*map(Path, posed), *rest):
        beside[file.parent].add(file.name.lower())
    rest = [file for file in rest if not is_mask_among(photos.folder / file, frozenset(beside[file.parent]))]
    lines = [f"{len(posed)} of {max(least, len(posed) + len(rest))} photos have poses"]
    if missing := photos.missing:
        first = short(repr(missing[0]))
        lines.append(
            f"{len(missing)} of {len(photos.names)} posed photos are gone and left out, first {first}"
        )
    if changed := photos.written_differently:
        lines.append(changed)
    return lines


def describe_lenses(views: Sequence[View]) -> list[str]:
    """Lines on lenses that see more than a pinhole shows: what is cropped, or how it is kept."""
    lines = []
    whole = {view.lens for view in views if view.lens and view.lens.model in WIDE and not view.lens.face}
    shown, lens = min(
        ((shown_share(lens), lens) for lens in whole), default=(1.0, None), key=lambda one: one[0]
    )
    if lens is not None and shown <= 1 - _CROPPED:
        K = pinhole(lens)
        across, down = np.rad2deg(2 * np.arctan([lens.width, lens.height] / K[[0, 1], [0, 1]] / 2))
        keep = "; --fisheye faces keeps it" if len(cube_faces(lens)) > 1 else ""
        lines.append(
            f"{lens.model}: the views show {across:.0f} x {down:.0f} degrees, {1 - shown:.0%} of the photo "
            f"is cropped{keep}"
        )
    faces = [view.lens for view in views if view.lens and view.lens.face]
    if faces:
        count = len({view.image_path for view in views if view.lens and view.lens.face})
        lines.append(f"{count} photos by {faces[0].model} are shown as {len(faces)} faces of cubes")
    spheres = {lens for lens in faces if lens.model == SPHERE and lens.params[0] != 2 * lens.params[1]}
    if spheres:
        w, h = next(iter(spheres)).params
        lines.append(f"{w:.0f} x {h:.0f} px are taken as 360 x 180 degrees, though they are not 2:1")
    return lines


def views_of(
    name: str, photo: Path, w2c: Float[np.ndarray, "4 4"], lens: Lens, divisor: int, fisheye: Fisheye,
    valid: Path | None = None,
) -> list[View]:  # fmt: skip
    """The views of a posed photo: one, or of a sphere (with `fisheye` faces of a wide lens) those of a cube.

    Raises:
        ValueError: If no pinhole fits into the lens.
        SceneError: As of `camera_of`.
    """
    if lens.model != SPHERE and (fisheye == "crop" or lens.model not in WIDE or is_pinhole(lens)):
        camera = camera_of(photo, w2c, lens, pinhole(lens), divisor)
        return [View(name, camera, photo, None if is_pinhole(lens) else lens, valid)]
    width = camera_of(photo, w2c, lens, np.eye(3), 1).width
    focal = intrinsics(lens)[0, 0] * width / lens.width / divisor  # as sharp as in the middle of the photo
    side = max(1, round(2 * focal))
    if side > MAX_SIDE:
        raise ValueError(
            f"{lens.model}: focal length {lens.params[0]:g} of {lens.width} px is no wide lens's"
        )
    K = np.array([[side / 2, 0, side / 2], [0, side / 2, side / 2], [0, 0, 1]], np.float32)
    path, views = PurePosixPath(name), []
    for face in cube_faces(lens):
        turned = np.eye(4)
        turned[:3, :3] = FACES[face].T
        camera = Camera((turned @ w2c).astype(np.float32), K, side, side)
        of_face = path.with_name(f"{path.stem}_{face}{path.suffix}").as_posix()
        views.append(View(of_face, camera, photo, replace(lens, face=face), valid))
    if not views:
        raise ValueError(f"no pinhole view fits into a {lens.model} camera with parameters {lens.params}")
    return views


def camera_of(
    photo: Path, w2c: Float[np.ndarray, "4 4"], lens: Lens, K: Float[np.ndarray, "3 3"], divisor: int
) -> Camera:
    """The pinhole camera of a photo: `K`, in pixels of `lens`, scaled to the photo's size over `divisor`.

    SceneError where the photo is unreadable, or its aspect ratio is not the lens's.
    """
    width, height = photo_size(photo)
    # images_N are rounded to whole pixels: both sides may be off by one, but not the aspect ratio.
    if abs(width / lens.width - height / lens.height) > 1 / lens.width + 1 / lens.height:
        raise SceneError(
            f"{photo}: {width} x {height} pixels, but its camera has another aspect ratio, "
            f"{lens.width} x {lens.height}; use the photos that the poses were computed from, not rotated or "
            "cropped"
        )
    width, height = (max(1, round(side / divisor)) for side in (width, height))
    scale = np.array([[width / lens.width], [height / lens.height], [1.0]])
    return Camera(w2c.astype(np.float32), (K * scale).astype(np.float32), width, height)
