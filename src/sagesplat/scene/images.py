"""Reads photos as 8-bit RGB, at the size of their view's camera."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from sagesplat.core.errors import SceneError
from sagesplat.scene.scene import View
from sagesplat.scene.undistort import undistort

# What Pillow raises for files that are damaged, not images, or too large.
_UNREADABLE = (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError)


def photo_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, before EXIF rotation, from the file's header. Raises SceneError."""
    try:
        with Image.open(path) as image:
            return image.size
    except _UNREADABLE as error:
        raise _unreadable(path, error) from None


def has_alpha(path: Path) -> bool:
    """Whether a photo has an alpha channel, from the file's header. Raises SceneError."""
    try:
        with Image.open(path) as image:
            return image.has_transparency_data
    except _UNREADABLE as error:
        raise _unreadable(path, error) from None


def load_photo(view: View) -> UInt8[np.ndarray, "H W 3"]:
    """The photo as `view.camera` sees it: area-resampled to the camera's size, then undistorted.

    EXIF orientation is not applied, because COLMAP's poses refer to the stored pixels. Grey photos
    become RGB, 16 bits become 8, and alpha is composited over the camera's background. Raises SceneError.
    """
    try:
        with Image.open(view.image_path) as file:
            image = _rgb(file, view.camera.background)
    except _UNREADABLE as error:
        raise _unreadable(view.image_path, error) from None
    size = (view.camera.width, view.camera.height)
    if image.size != size:
        image = image.resize(size, Image.Resampling.BOX)  # first, as undistortion costs more per pixel
    return undistort(np.array(image), view.lens, view.camera, order=1)


class Photos:
    """A sequence of photos, uint8 [H, W, 3], one per view, loaded on access.

    Photos are cached until the cache holds `cache_bytes`; the others are read again on each access. Nothing
    is evicted: training cycles through all views, where an LRU cache would never hit.

    A file that is changed or removed after this was made is a SceneError: results would be of two captures.
    """

    def __init__(self, views: Sequence[View], cache_bytes: int = 2**30):
        self.views, self.cache_bytes = views, cache_bytes
        self._found = [_version(view.image_path) for view in views]
        self._cache: dict[int, np.ndarray] = {}
        self._used = 0

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index: int) -> UInt8[np.ndarray, "H W 3"]:
        index = range(len(self.views))[index]
        if index in self._cache:
            return self._cache[index]
        photo = self._unchanged(index)
        if self._used + photo.nbytes <= self.cache_bytes:
            self._cache[index] = photo
            self._used += photo.nbytes
        return photo

    def check(self) -> None:
        """SceneError if a photo was changed or removed since this was made."""
        for index in range(len(self.views)):
            self._check(index)

    def _unchanged(self, index: int) -> UInt8[np.ndarray, "H W 3"]:
        try:
            photo = load_photo(self.views[index])
        except SceneError:
            self._check(index)  # has the better reason, if it has one
            raise
        self._check(index)
        return photo

    def _check(self, index: int) -> None:
        path, found = self.views[index].image_path, self._found[index]
        now = _version(path)
        if found and now is None:
            raise SceneError(
                f"{path}: gone since this command began; put it back, then give the command again"
            )
        if now != found:
            raise SceneError(
                f"{path}: changed since this command began; put the earlier photo back, then give the "
                "command again, or choose another run folder"
            )


def _version(path: Path) -> tuple[int, int] | None:
    """Changes when a file does: its size and the time of its last change; None where it is not there."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns


def _rgb(image: Image.Image, background: tuple[int, int, int]) -> Image.Image:
    """The image, of any Pillow mode, as 8-bit RGB; alpha is composited over `background`."""
    if image.mode.startswith("I") or image.mode == "F":
        values = np.asarray(image, np.float64)
        # Pillow's own conversion clips 16-bit greys instead of scaling them.
        scale = 257 if image.mode.startswith("I") and values.max() > 255 else 1
        return Image.fromarray((values / scale).round().clip(0, 255).astype(np.uint8)).convert("RGB")
    if image.has_transparency_data:
        image = image.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", image.size, (*background, 255)), image).convert("RGB")
    return image.convert("RGB")


def _unreadable(path: Path, error: BaseException) -> SceneError:
    reason = " ".join(str(error).split())
    return SceneError(
        f"{path}: not readable as a photo ({reason}); replace the file, or remove it from the model"
    )
