"""A scene in one .npz file: cameras, points and splits, such as those of one block of a large scene."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from sagesplat.core.errors import SceneError, short
from sagesplat.core.geometry import NO_OFFSET, Position
from sagesplat.core.names import check_photo, repaired
from sagesplat.io.files import atomic_path
from sagesplat.io.npz import Npz
from sagesplat.io.typed import parse_json_as
from sagesplat.scene.scene import Camera, Lens, Points, Scene, View, Vignetting

SUFFIX = ".npz"
_Side = Annotated[int, Meta(ge=1, le=2**16 - 1)]  # pixels
_Byte = Annotated[int, Meta(ge=0, le=255)]
_POINTS = {
    "xyz": (np.float32, 2),
    "rgb": (np.uint8, 2),
    "track_points": (np.int64, 1),
    "track_views": (np.int32, 1),
    "track_uv": (np.float32, 2),
}


def write_scene(path: Path, scene: Scene) -> None:
    """Write views, points and splits to a file, which refers to the photos by absolute path."""
    views = [
        {
            "name": view.name,
            "image": str(view.image_path.resolve()),
            "size": [view.camera.width, view.camera.height],
            "background": view.camera.background,
            "lens": asdict(view.lens) if view.lens else None,
            "vignetting": asdict(view.vignetting) if view.vignetting else None,
        }
        for view in scene.views
    ]
    names = [view.name for view in scene.views]
    about = {
        "name": scene.name,
        "views": views,
        "test": [names[i] for i in scene.test_ids],
        "calibration": [names[i] for i in scene.calibration_ids],
        "offset": scene.offset,
    }
    arrays = {name: getattr(scene.points, name) for name in _POINTS}
    with atomic_path(path) as temporary:
        np.savez(
            temporary, about=np.array(json.dumps(about)),
            w2c=np.stack([view.camera.w2c for view in scene.views]),
            K=np.stack([view.camera.K for view in scene.views]), **arrays,
        )  # fmt: skip


@dataclass(frozen=True)
class _View:
    """A view, without its camera's arrays."""

    name: str
    image: Path
    size: tuple[_Side, _Side]
    background: tuple[_Byte, _Byte, _Byte]
    lens: Lens | None = None
    vignetting: Vignetting | None = None

    def __post_init__(self) -> None:
        check_photo(self.name)


@dataclass(frozen=True)
class _About:
    name: str
    views: list[_View]
    test: frozenset[str]
    calibration: frozenset[str]
    offset: Position = NO_OFFSET


def read_scene(path: Path) -> Scene:
    """The scene that `write_scene` wrote; SceneError for anything else."""
    try:
        with Npz(path) as stored:
            about = parse_json_as(str(stored["about"]), _About)
            w2c, K = stored["w2c"].astype(np.float32), stored["K"].astype(np.float32)
            columns = {name: stored[name].astype(kind) for name, (kind, _) in _POINTS.items()}
        views = tuple(_view(*entry) for entry in zip(about.views, w2c, K, strict=True))
        points = Points(**columns)
        _check(points, len(views))
    except FileNotFoundError:
        raise SceneError(f"{path}: no such file; give the path of a capture") from None
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise SceneError(f"{path}: not a stored scene ({short(error)}); make it again") from None
    return Scene(
        repaired(about.name), path, views, points,
        test_names=about.test, calibration_names=about.calibration, offset=about.offset,
    )  # fmt: skip


def _view(about: _View, w2c: np.ndarray, K: np.ndarray) -> View:
    if w2c.shape != (4, 4) or K.shape != (3, 3) or not (np.isfinite(w2c).all() and np.isfinite(K).all()):
        raise ValueError(f"no camera for {about.name}")
    camera = Camera(w2c, K, *about.size, about.background)
    return View(about.name, camera, about.image, about.lens, vignetting=about.vignetting)


def _check(points: Points, num_views: int) -> None:
    """ValueError for arrays of inconsistent shapes, or tracks of missing points or views."""
    n, t = len(points.xyz), len(points.track_points)
    shapes = {"xyz": (n, 3), "rgb": (n, 3), "track_views": (t,), "track_points": (t,), "track_uv": (t, 2)}
    for name, shape in shapes.items():
        if getattr(points, name).shape != shape:
            raise ValueError(f"{name} of shape {getattr(points, name).shape}")
    for rows, most in ((points.track_points, n), (points.track_views, num_views)):
        if t and not 0 <= rows.min() <= rows.max() < most:
            raise ValueError("a track of a missing point or view")
