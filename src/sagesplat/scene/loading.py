"""Shared by the loaders of captures: checks of settings, and cameras at the size of their photos."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from sagesplat.core.errors import SceneError
from sagesplat.scene.images import photo_size
from sagesplat.scene.scene import Camera, Lens

MIN_VIEWS = 3  # posed photos
MAX_SIDE = 10**6  # pixels


def check_settings(path: Path, downscale: int, test_every: int) -> None:
    """SceneError unless `downscale` is at least 1, and `test_every` 0 or at least 2."""
    if downscale < 1 or test_every < 0 or test_every == 1:
        raise SceneError(
            f"{path}: downscale {downscale} and test_every {test_every} cannot be used; "
            "take downscale >= 1 and test_every 0 or >= 2"
        )


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
