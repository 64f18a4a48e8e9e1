"""The photos that structure from motion was given: their lenses, and how they were turned.

Those of its capture are upright and undistorted. Label images of the photos as they were taken follow them
with this (`segment.fit`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Shaped
from msgspec import Meta

from sagesplat.core.errors import SceneError
from sagesplat.core.limits import Count, Number
from sagesplat.io.typed import read_json_as, refused
from sagesplat.scene.colmap_read import CAMERA_MODELS, camera_of_model, read_model
from sagesplat.scene.scene import Lens

REPORT = "poses.json"
_WHAT, _CURE = "a report of poses", "find the poses again, or remove it"
_SIDEWAYS = range(5, 9)  # EXIF orientations that exchange width and height


@dataclass(frozen=True, eq=False)
class RawPhoto:
    """A photo before it was undistorted."""

    lens: Lens  # of the upright photo
    orientation: int  # by EXIF, 1 ... 8; 1: its pixels are stored upright

    @property
    def sideways(self) -> bool:
        """Whether width and height of the stored pixels are those of the upright photo, exchanged."""
        return self.orientation in _SIDEWAYS


def upright(image: Shaped[np.ndarray, "h w"], orientation: int) -> Shaped[np.ndarray, "H W"]:
    """An image of stored pixels as EXIF says that it is to be looked at; `orientation` is 1 ... 8."""
    views = (
        *(image, image[:, ::-1], image[::-1, ::-1], image[::-1]),
        *(image.T, np.rot90(image, -1), np.rot90(image, 2).T, np.rot90(image)),
    )
    return views[orientation - 1]


def same_aspect(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether aspect ratios are equal: the smaller picture may be rounded to whole pixels, by up to one."""
    return abs(size[0] * other[1] - size[1] * other[0]) <= max(*size, *other)


def describe_raw(model: Path, names: Mapping[str, tuple[str, int]]) -> dict[str, Any]:
    """For poses.json: the lenses of a COLMAP model, and of each photo its lens and orientation.

    `names` has the final name and the orientation of each photo by its name in the model.
    """
    cameras, images, _ = read_model(model)
    ids = sorted({image.camera_id for image in images})
    lenses = [
        {"model": c.model, "width": c.width, "height": c.height, "params": list(c.params)}
        for c in (cameras[id] for id in ids)
    ]
    photos = {}
    for image in images:
        final, orientation = names[image.name]
        photos[final] = [ids.index(image.camera_id), orientation]
    return {"lenses": lenses, "photos": photos}


@dataclass(frozen=True)
class _Lens:
    model: str
    width: Count
    height: Count
    params: list[Number]

    def __post_init__(self) -> None:
        if self.model not in CAMERA_MODELS:
            raise ValueError(f"no camera model {self.model!r:.40}")


@dataclass(frozen=True)
class _Raw:
    lenses: list[_Lens] = field(default_factory=list)
    photos: dict[str, tuple[Count, Annotated[int, Meta(ge=1, le=8)]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if any(index >= len(self.lenses) for index, _ in self.photos.values()):
            raise ValueError("a photo of a lens that is not there")


@dataclass(frozen=True)
class _Report:
    raw: _Raw = field(default_factory=_Raw)
    num_photos: Count = 0


def _report(path: Path) -> _Report:
    """The report at a path; an empty one where there is none. SceneError for a damaged one."""
    return read_json_as(path, _Report, _WHAT, _CURE, SceneError) if path.is_file() else _Report()


def photos_before(capture: Path) -> int:
    """How many photos structure from motion was given for a capture; 0 where it did not make it.

    SceneError for a damaged poses.json.
    """
    return _report(capture / REPORT).num_photos


def raw_photos(capture: Path) -> dict[str, RawPhoto]:
    """The photos of a capture before they were undistorted, by name; empty where that is not known.

    SceneError for a damaged poses.json.
    """
    path = capture / REPORT
    raw = _report(path).raw
    with refused(path, _WHAT, _CURE, SceneError):
        lenses = []
        for index, one in enumerate(raw.lenses):
            c = camera_of_model(index, one.model, one.width, one.height, one.params)
            lenses.append(Lens(c.model, c.params, c.width, c.height))
    return {name: RawPhoto(lenses[index], turned) for name, (index, turned) in raw.photos.items()}
