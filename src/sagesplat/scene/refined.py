"""Cameras that training refined: poses and exposure of each view, written beside the given ones."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from sagesplat.core.errors import RunError, short
from sagesplat.io.files import atomic_path
from sagesplat.io.npz import Npz
from sagesplat.scene.scene import Scene

_FORMAT = 1
_MAX_SHEAR = 1e-3  # largest entry of R R^T - I
_LARGEST = 1e6  # of positions and exposures


@dataclass(frozen=True, eq=False)
class RefinedCameras:
    """What was refined of the cameras of all V views of a scene, in its order."""

    w2c: Float32[np.ndarray, "V 4 4"]  # world to camera, world units
    exposure: Float32[np.ndarray, "V 3 4"]  # affine colour transform of what is rendered; identity: none
    fitted: Bool[np.ndarray, " V"]  # fitted to the view's own photo after training: held-out views


def given_cameras(scene: Scene) -> RefinedCameras:
    """The cameras of a scene as they are, nothing refined."""
    w2c = np.stack([view.camera.w2c for view in scene.views])
    neutral = np.tile(np.eye(3, 4, dtype=np.float32), (len(w2c), 1, 1))
    return RefinedCameras(w2c, neutral, np.zeros(len(w2c), bool))


def with_cameras(scene: Scene, cameras: RefinedCameras) -> Scene:
    """The scene with refined cameras; ValueError where they are of another number of views."""
    if len(cameras.w2c) != len(scene.views):
        raise ValueError(f"{len(cameras.w2c)} cameras for {len(scene.views)} views")
    views = []
    for view, w2c, exposure in zip(scene.views, cameras.w2c, cameras.exposure, strict=True):
        neutral = (exposure == np.eye(3, 4)).all()
        camera = replace(view.camera, w2c=w2c, exposure=None if neutral else exposure)
        views.append(replace(view, camera=camera))
    return replace(scene, views=tuple(views))


def write_refined(path: Path, cameras: RefinedCameras) -> None:
    """Write refined cameras to a .npz file."""
    with atomic_path(path) as temporary:
        np.savez(
            temporary, format=np.array(_FORMAT), w2c=cameras.w2c, exposure=cameras.exposure,
            fitted=cameras.fitted,
        )  # fmt: skip


def read_refined(path: Path, views: int) -> RefinedCameras:
    """The cameras of `views` views that `write_refined` wrote; RunError for anything else."""
    try:
        with Npz(path) as file:
            if int(file["format"]) != _FORMAT:
                raise ValueError("another format")
            cameras = RefinedCameras(file["w2c"], file["exposure"], file["fitted"])
        _check(cameras, views)
        return cameras
    except (OSError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise RunError(
            f"{path}: not the refined cameras of {views} views ({short(error)}); "
            "run `sagesplat train` again with --force"
        ) from None


def _check(cameras: RefinedCameras, views: int) -> None:
    """ValueError for wrong shapes and types, or what is no camera."""
    kinds = {"w2c": (np.float32, (4, 4)), "exposure": (np.float32, (3, 4)), "fitted": (np.bool_, ())}
    for name, (kind, shape) in kinds.items():
        array = getattr(cameras, name)
        if array.dtype != kind or array.shape != (views, *shape):
            raise ValueError(f"{name} of shape {array.shape} and type {array.dtype}")
        if not (np.abs(array.astype(np.float64)) <= _LARGEST).all():
            raise ValueError(f"{name} is not finite or above {_LARGEST:g}")
    rotation = cameras.w2c[:, :3, :3].astype(np.float64)
    rigid = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(initial=0) <= _MAX_SHEAR
    if not rigid or (np.linalg.det(rotation) < 0).any() or (cameras.w2c[:, 3] != [0, 0, 0, 1]).any():
        raise ValueError("a pose that is no rotation and translation")
