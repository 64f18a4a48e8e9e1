"""Loads COLMAP workspaces: a folder of photos and a sparse model."""

import os.path
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sagesplat.core.errors import SceneError, short
from sagesplat.core.geometry import Position, offset_of
from sagesplat.core.names import check_photo, repaired
from sagesplat.scene.colmap_read import ModelPoints, read_model
from sagesplat.scene.colmap_write import ModelCamera, ModelImage
from sagesplat.scene.loading import MIN_VIEWS, camera_of, check_settings
from sagesplat.scene.scene import Lens, Points, Scene, View
from sagesplat.scene.undistort import distort, is_pinhole, pinhole

MODEL_FILES = ("sparse/0/cameras.bin", "sparse/0/cameras.txt", "sparse/cameras.bin", "sparse/cameras.txt")


def load_colmap(path: Path, *, downscale: int = 1, test_every: int = 8) -> Scene:
    """The scene of a COLMAP workspace: `images/` and `sparse/0` (or `sparse`) below `path`.

    With `downscale` N the photos are read from `images_N/` if that folder exists. Otherwise they are read
    from `images/` and area-resampled. Distorted cameras are replaced by pinholes (`undistort.pinhole`), and
    their observations are undistorted. Observations outside the image are dropped. Raises SceneError.
    """
    check_settings(path, downscale, test_every)
    model = _find_model(path)
    with np.errstate(all="ignore"):  # damaged numbers overflow; the results are checked to be finite
        cameras, listed, points = read_model(model)
        if len(listed) < MIN_VIEWS:
            raise SceneError(
                f"{model}: {len(listed)} posed photos, but it takes {MIN_VIEWS}; add photos, run COLMAP"
            )
        if not len(points.xyz):
            raise SceneError(f"{model}: no 3D points; run COLMAP's mapper or point_triangulator again")
        _check_names(model, listed)
        listed = sorted(listed, key=lambda image: image.name)
        offset, listed, points = _near_origin(listed, points)
        folder, divisor = _find_photos(path, downscale)
        _check_photos(folder, listed)
        views = _views(model, folder, cameras, listed, divisor)
        tracked = _scene_points(cameras, listed, views, points)
    return Scene(repaired(path.resolve().name), path, views, tracked, test_every, offset=offset)


def _near_origin(
    listed: list[ModelImage], points: ModelPoints
) -> tuple[Position, list[ModelImage], ModelPoints]:
    """The model with an offset subtracted from all positions, where it is far from its origin."""
    w2c = np.stack([image.w2c for image in listed])
    offset = offset_of(-np.einsum("vji,vj->vi", w2c[:, :3, :3], w2c[:, :3, 3]), points.xyz)
    if not any(offset):
        return offset, listed, points
    w2c[:, :3, 3] += w2c[:, :3, :3] @ offset
    listed = [replace(image, w2c=moved) for image, moved in zip(listed, w2c, strict=True)]
    return offset, listed, points._replace(xyz=points.xyz - offset)


def _find_model(path: Path) -> Path:
    if not path.is_dir():
        raise SceneError(f"{path}: no such folder; give the folder that holds images/ and sparse/")
    for name in MODEL_FILES:
        if (path / name).is_file():
            return (path / name).parent
    raise SceneError(
        f"{path}: no COLMAP model (looked for {', '.join(MODEL_FILES)}); "
        "run COLMAP on the photos first, or give the folder that holds images/ and sparse/"
    )


def _find_photos(path: Path, downscale: int) -> tuple[Path, int]:
    """The folder of the photos, and the factor by which they are still to be downscaled."""
    if downscale > 1 and (path / f"images_{downscale}").is_dir():
        return path / f"images_{downscale}", 1
    folder = path / "images"
    if not folder.is_dir():
        raise SceneError(f"{folder}: no such folder; put the photos that COLMAP was run on there")
    return folder, downscale


def _check_names(model: Path, listed: Sequence[ModelImage]) -> None:
    for image in listed:
        try:
            check_photo(image.name)
        except ValueError as error:
            raise SceneError(
                f"{model}: photo {short(repr(image.name))}: {error}; rename the photo and run COLMAP again"
            ) from None


def _check_photos(folder: Path, listed: Sequence[ModelImage]) -> None:
    missing = [i.name for i in listed if not os.path.isfile(folder / i.name)]
    if missing:
        raise SceneError(
            f"{folder}: {len(missing)} of the model's {len(listed)} photos are missing, "
            f"first {short(repr(missing[0]))}; add the files, or remove them from the model with COLMAP's "
            "image_deleter"
        )
    names = {i.name for i in listed}
    if len(names) < len(listed):
        raise SceneError(f"{folder}: the model lists a photo twice; run COLMAP's mapper again")


def _views(
    model: Path, folder: Path, cameras: dict[int, ModelCamera], listed: Sequence[ModelImage], divisor: int
) -> tuple[View, ...]:
    lenses, Ks = {}, {}
    for id in sorted({i.camera_id for i in listed}):
        if id not in cameras:
            raise SceneError(
                f"{model}: a photo names camera {id}, which the model does not have; export it again"
            )
        c = cameras[id]
        lenses[id] = Lens(c.model, c.params, c.width, c.height)
        try:
            Ks[id] = pinhole(lenses[id])
        except ValueError as error:
            raise SceneError(f"{model}: camera {id}: {error}; calibrate it again with COLMAP") from None
    views = []
    for image in listed:
        lens = lenses[image.camera_id]
        camera = camera_of(folder / image.name, image.w2c, lens, Ks[image.camera_id], divisor)
        distorted = None if is_pinhole(lens) else lens
        views.append(View(image.name, camera, folder / image.name, distorted))
    return tuple(views)


def _scene_points(
    cameras: dict[int, ModelCamera], listed: Sequence[ModelImage], views: Sequence[View], points: ModelPoints
) -> Points:
    """The points and their tracks, in pixels of the views; tracks are read from the images' observations."""
    track_points, track_views, track_uv = [], [], []
    for row, (image, view) in enumerate(zip(listed, views, strict=True)):
        camera, model = view.camera, cameras[image.camera_id]
        seen = image.point_rows >= 0
        at = image.point_rows[seen]
        size = np.array([camera.width, camera.height])
        scale = size / [model.width, model.height]
        uv = image.uv[seen] * scale
        if view.lens is not None:
            xyz = points.xyz[at] @ image.w2c[:3, :3].T + image.w2c[:3, 3]
            rays = xyz[:, :2] / np.where(xyz[:, 2:] > 0, xyz[:, 2:], np.nan)
            # The pinhole's projection, plus the keypoint's reprojection error in the distorted photo.
            ideal = rays * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
            uv = ideal + (uv - distort(view.lens, rays) * scale)
        uv = uv.astype(np.float32)
        inside = ((uv >= 0) & (uv < size)).all(axis=1)
        track_points.append(at[inside])
        track_views.append(np.full(inside.sum(), row, np.int32))
        track_uv.append(uv[inside])
    tracks = (np.concatenate(track_points).astype(np.int64), np.concatenate(track_views))
    return Points(points.xyz.astype(np.float32), points.rgb, *tracks, np.concatenate(track_uv))
