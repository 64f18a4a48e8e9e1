"""Loads COLMAP workspaces: a folder of photos and a sparse model."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sagesplat.core.errors import SceneError, short
from sagesplat.core.geometry import Position, less_offset, offset_of
from sagesplat.core.names import check_photo, repaired
from sagesplat.scene import loading
from sagesplat.scene.colmap_read import ModelPoints, read_model
from sagesplat.scene.colmap_write import ModelCamera, ModelImage
from sagesplat.scene.find_model import FoundModel, find_model
from sagesplat.scene.find_photos import PHOTO_FOLDERS, plain
from sagesplat.scene.points import random_points, read_points, seen_or_random
from sagesplat.scene.raw_photos import photos_before
from sagesplat.scene.scene import Lens, Points, Scene, View
from sagesplat.scene.undistort import FACES, SPHERE, distort, intrinsics

POINT_FILES = ("points3d", "points", "sparse", "sparse_pc", "point_cloud", "pointcloud")  # .ply


def load_colmap(
    path: Path,
    *,
    downscale: int = 1,
    test_every: int = 8,
    images: Path | None = None,
    fisheye: loading.Fisheye = "crop",
) -> Scene:
    """The scene of a COLMAP workspace: a model, usually in `sparse/0`, and its photos, usually in `images/`.

    Both are looked for (`find_model`); `path` may be the folder of a model, too. Photos of the model that
    are gone are left out. With `downscale` N the photos are read from `images_N/` if that folder exists.
    Otherwise they are area-resampled. Distorted cameras are replaced by pinholes (`undistort.pinhole`), or
    by the faces of a cube, and their observations are undistorted. Observations outside the image are
    dropped. Without points, there are random ones. Raises SceneError.
    """
    loading.check_settings(path, downscale, test_every)
    with np.errstate(all="ignore"):  # damaged numbers overflow; the results are checked to be finite
        chosen, notes = find_model(path, images)
        cameras, listed, points = read_model(chosen.folder)
        _check_names(chosen.folder, listed)
        listed = _there(chosen, listed)
        notes += loading.describe_photos(chosen.photos, photos_before(path))
        files, divisor = loading.at_downscale(chosen.photos, downscale)
        listed = sorted(listed, key=lambda image: chosen.photos.files[image.name])
        offset, listed, points = _near_origin(listed, points)
        views, rows = _views(chosen, files, cameras, listed, divisor, fisheye)
        notes += loading.describe_lenses(views)
        tracked = _scene_points(chosen.folder, cameras, [listed[row] for row in rows], views, points)
        if tracked is None:
            tracked, more = _points_beside(path, chosen.folder, views, offset)
            notes += more
        elif not len(tracked.track_points):
            tracked, more = seen_or_random(tracked, views, "the model")
            notes += more
    home = _home(path, chosen.photos.folder)
    name = repaired((home if home.absolute() in path.absolute().parents else path).resolve().name)
    return Scene(name, home, views, tracked, test_every, notes=tuple(notes), offset=offset)


def _near_origin(
    listed: list[ModelImage], points: ModelPoints | None
) -> tuple[Position, list[ModelImage], ModelPoints | None]:
    """The model with an offset subtracted from all positions, where it is far from its origin."""
    w2c = np.stack([image.w2c for image in listed])
    centres = -np.einsum("vji,vj->vi", w2c[:, :3, :3], w2c[:, :3, 3])
    offset = offset_of(centres, *([] if points is None else [points.xyz]))
    if not any(offset):
        return offset, listed, points
    w2c = less_offset(w2c, offset)
    listed = [replace(image, w2c=moved) for image, moved in zip(listed, w2c, strict=True)]
    return offset, listed, None if points is None else points._replace(xyz=points.xyz - offset)


def _home(path: Path, photos: Path) -> Path:
    """The folder that may have masks: the one that was given, or else the one that holds the photos."""
    beside = photos.parent if photos.name in PHOTO_FOLDERS else path
    return path if any((path / name).is_dir() for name in ("images", "masks", "masks_valid")) else beside


def _there(chosen: FoundModel, listed: Sequence[ModelImage]) -> list[ModelImage]:
    """The images of a model whose photos are there. SceneError for too few of them."""
    if len(set(chosen.photos.names)) < len(listed):
        raise SceneError(f"{chosen.folder}: the model lists a photo twice; run COLMAP's mapper again")
    if len(listed) < loading.MIN_VIEWS:
        least = loading.MIN_VIEWS
        raise SceneError(
            f"{chosen.folder}: {len(listed)} posed photos, but it takes {least}; add photos, run COLMAP"
        )
    loading.check_found(chosen.photos, "the model")
    return [image for image in listed if image.name in chosen.photos.files]


def _points_beside(
    path: Path, model: Path, views: Sequence[View], offset: Position
) -> tuple[Points, list[str]]:
    """The points of a capture whose model has none: those of a PLY file beside it, else random ones."""
    for folder in dict.fromkeys((model, model.parent, path)):
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() == ".ply")
        named = [file for file in files if file.stem.lower() in POINT_FILES]
        for file in named or files[: folder == model and len(files) == 1]:
            points, notes = seen_or_random(read_points(file, offset), views, short(file.name))
            line = f"the model has no 3D points: training begins with those of {short(file.name)}"
            return points, notes or [line]
    points = random_points(views)
    return points, [f"no 3D points: training begins with {len(points.xyz):,} random ones that cameras see"]


def _check_names(model: Path, listed: Sequence[ModelImage]) -> None:
    for image in listed:
        try:
            check_photo(plain(image.name).lstrip("./") or "/")
        except ValueError as error:
            raise SceneError(
                f"{model}: photo {short(repr(image.name))}: {error}; rename the photo and run COLMAP again"
            ) from None


def _views(
    chosen: FoundModel, files: dict[str, Path], cameras: dict[int, ModelCamera], listed: Sequence[ModelImage],
    divisor: int, fisheye: loading.Fisheye,
) -> tuple[tuple[View, ...], list[int]]:  # fmt: skip
    """The views, and of each the row of its image: there are several of an image that is shown as a cube."""
    views: list[View] = []
    rows: list[int] = []
    for row, image in enumerate(listed):
        if image.camera_id not in cameras:
            raise SceneError(
                f"{chosen.folder}: a photo names camera {image.camera_id}, which the model does not have; "
                "export it again"
            )
        c = cameras[image.camera_id]
        lens = Lens(c.model, c.params, c.width, c.height)
        name = chosen.photos.files[image.name]
        try:
            views += loading.views_of(name, files[image.name], image.w2c, lens, divisor, fisheye)
        except ValueError as error:
            raise SceneError(
                f"{chosen.folder}: camera {c.id}: {error}; calibrate it again with COLMAP"
            ) from None
        rows += [row] * (len(views) - len(rows))
    return tuple(views), rows


def _scene_points(
    model: Path, cameras: dict[int, ModelCamera], listed: Sequence[ModelImage], views: Sequence[View],
    points: ModelPoints | None,
) -> Points | None:  # fmt: skip
    """The points and their tracks, in pixels of the views; tracks are read from the images' observations.

    None without points.
    """
    if points is None or not len(points.xyz):
        return None
    track_points, track_views, track_uv = [], [], []
    for row, (image, view) in enumerate(zip(listed, views, strict=True)):
        camera, model_camera = view.camera, cameras[image.camera_id]
        seen = image.point_rows >= 0
        at = image.point_rows[seen]
        size = np.array([camera.width, camera.height])
        scale = size / [model_camera.width, model_camera.height]
        uv = image.uv[seen] * scale
        if view.lens is not None:
            xyz = points.xyz[at] @ image.w2c[:3, :3].T + image.w2c[:3, 3]
            if view.lens.face is not None:
                xyz, scale = xyz @ FACES[view.lens.face], np.ones(2)
                uv = image.uv[seen]
            rays = xyz[:, :2] / np.where(xyz[:, 2:] > 0, xyz[:, 2:], np.nan)
            # The pinhole's projection, plus the keypoint's reprojection error in the distorted photo.
            ideal = rays * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
            error = uv - distort(view.lens, rays) * scale
            if view.lens.face is not None:
                if view.lens.model == SPHERE:  # its left side follows the right one
                    turn = view.lens.params[0]
                    error[:, 0] = (error[:, 0] + turn / 2) % turn - turn / 2
                error *= camera.K[0, 0] / intrinsics(view.lens)[0, 0]
            uv = ideal + error
        uv = uv.astype(np.float32)
        inside = ((uv >= 0) & (uv < size)).all(axis=1)
        track_points.append(at[inside])
        track_views.append(np.full(inside.sum(), row, np.int32))
        track_uv.append(uv[inside])
    tracks = (np.concatenate(track_points).astype(np.int64), np.concatenate(track_views))
    return Points(points.xyz.astype(np.float32), points.rgb, *tracks, np.concatenate(track_uv))
