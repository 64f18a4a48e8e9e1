"""The photos that structure from motion was given: their lenses, and how they were turned.

Those of its capture are upright and undistorted. Label images of the photos as they were taken follow them
with this (`segment.fit`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from sagesplat.core.errors import RunError, SceneError, short
from sagesplat.io.files import read_json
from sagesplat.scene.colmap_read import camera_of_model, read_model
from sagesplat.scene.scene import Lens

REPORT = "poses.json"
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


def oriented(image: Shaped[np.ndarray, "h w"], orientation: int) -> Shaped[np.ndarray, "H W"]:
    """An image of stored pixels as EXIF says that it is to be looked at; `orientation` is 1 ... 8."""
    if orientation >= 5:
        return upright(image, orientation)
    return {1: image, 2: image[:, ::-1], 3: image[::-1, ::-1], 4: image[::-1]}[orientation]


def upright(image: Shaped[np.ndarray, "h w"], orientation: int) -> Shaped[np.ndarray, "H W"]:
    """An image of stored pixels as EXIF says that it is to be looked at; `orientation` is 5 ... 8."""
    return {5: image.T, 6: np.rot90(image, -1), 7: np.rot90(image, 2).T, 8: np.rot90(image)}[orientation]


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


def raw_photos(capture: Path) -> dict[str, RawPhoto]:
    """The photos of a capture before they were undistorted, by name; empty where that is not known.

    SceneError for a damaged poses.json.
    """
    path = capture / REPORT
    if not path.is_file():
        return {}
    try:
        raw = read_json(path).get("raw", {"lenses": [], "photos": {}})
        lenses = [_lens(i, lens) for i, lens in enumerate(raw["lenses"])]
        return {name: _photo(lenses, *entry) for name, entry in raw["photos"].items()}
    except (RunError, AttributeError, KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        reason = short(str(error).removeprefix(f"{path}: "))
        raise SceneError(f"{path}: not readable ({reason}); find the poses again, or remove it") from None


def _lens(index: int, about: dict[str, Any]) -> Lens:
    params = [float(value) for value in about["params"]]
    c = camera_of_model(index, str(about["model"]), int(about["width"]), int(about["height"]), params)
    return Lens(c.model, c.params, c.width, c.height)


def _photo(lenses: list[Lens], index: int, orientation: int) -> RawPhoto:
    if type(index) is not int or not 0 <= index < len(lenses) or orientation not in range(1, 9):
        raise ValueError(f"lens {index!r}, orientation {orientation!r}")
    return RawPhoto(lenses[index], orientation)
