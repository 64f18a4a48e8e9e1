"""Reads photos as 8-bit RGB, at the size of their view's camera."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image, ImageFile

from sagesplat.core.errors import SceneError
from sagesplat.io.colour_profile import in_srgb
from sagesplat.io.pictures import FREE_PIXELS, PictureError, open_picture
from sagesplat.scene.scene import View
from sagesplat.scene.undistort import intrinsics, undistort
from sagesplat.scene.vignetting import corrected

_STRIP = 2**20  # pixels that are converted at a time
_LOOKED_AT = 8  # photos that decide what transparent pixels mean
_HUGE = 180 * 10**6  # pixels


@contextmanager
def _opened(path: Path, decodes: bool = True) -> Iterator[ImageFile.ImageFile]:
    """`open_picture` of a photo; SceneError for what cannot be used."""
    try:
        with open_picture(path, decodes=decodes) as image:
            yield image
    except PictureError as error:
        cure = error.cure or "replace the file, or remove it from the model"
        raise SceneError(f"{path}: not readable as a photo ({error.reason}); {cure}") from None


def photo_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, before EXIF rotation, from the file's header. Raises SceneError."""
    with _opened(path, decodes=False) as image:
        return image.size


def has_alpha(path: Path) -> bool:
    """Whether a photo has an alpha channel, from the file's header. Raises SceneError."""
    with _opened(path, decodes=False) as image:
        return image.has_transparency_data


def load_alpha(path: Path) -> UInt8[np.ndarray, "h w"]:
    """Opacity of each pixel of a photo, 255 where it has no alpha channel. Raises SceneError."""
    with _opened(path) as image:
        if not image.has_transparency_data or image.mode.startswith("I"):
            return np.full((image.height, image.width), 255, np.uint8)
        return np.array(image.convert("RGBA").getchannel("A"))


def cut_out(paths: Sequence[Path]) -> bool:
    """Whether photos with alpha show an object that was cut out: most of their border is transparent."""
    some = paths[:: max(1, len(paths) // _LOOKED_AT)]
    return float(np.median([_clear_border(load_alpha(path)) for path in some])) > 0.5


def _clear_border(alpha: UInt8[np.ndarray, "h w"]) -> float:
    """Share of an image's border whose pixels are more transparent than opaque."""
    border = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    return float((border < 128).mean())


def read_black(path: Path, pixels: int) -> Bool[np.ndarray, "h w"]:
    """Where a mask of any mode is not black; `pixels`: of its photo. SceneError for what is no image.

    In formats that compress with loss what is darker than the middle is black. So is what is transparent;
    a mask of one colour is in the alpha channel alone.
    """
    try:
        with open_picture(path, free=max(FREE_PIXELS, 4 * pixels)) as image:
            least = 0 if image.format in ("PNG", "TIFF", "BMP") else 127
            clear = None
            if image.has_transparency_data and not image.mode.startswith("I"):
                clear = np.asarray(image.convert("RGBA").getchannel("A")) < 128
            coloured = image.convert("RGB") if image.mode not in ("1", "L", "LA", "I", "I;16") else image
            values = np.asarray(coloured.getchannel(0) if coloured.mode == "LA" else coloured)
    except PictureError as error:
        cure = error.cure or "export it again"
        raise SceneError(f"{path}: not a readable mask ({error.reason}); {cure}") from None
    if clear is not None and clear.any() and not clear.all() and (values == values[:1, :1]).all():
        return ~clear
    counts = np.array((values > least).any(2) if values.ndim == 3 else values > least, bool)
    return counts if clear is None else counts & ~clear


def load_photo(view: View) -> UInt8[np.ndarray, "H W 3"]:
    """The photo as `view.camera` sees it: area-resampled to the camera's size, then undistorted.

    The view's vignetting, if it is known, is undone.

    EXIF orientation is not applied, because COLMAP's poses refer to the stored pixels. Grey photos
    become RGB, 16 bits become 8, and alpha is composited over the camera's background. Raises SceneError.
    Memory: up to 24 bytes for each pixel of the file, whose number `open_picture` limits.
    """
    size = _size_to_read(view)
    with _opened(view.image_path) as file:
        if file.width * file.height > _HUGE:
            file.draft(None, size)  # JPEG: decodes at a half, a quarter or an eighth of the size
        image = as_rgb(file, view.camera.background)
    if image.size != size and (view.lens is None or not view.lens.face or image.width > 1.5 * size[0]):
        image = image.resize(size, Image.Resampling.BOX)  # first, as undistortion costs more per pixel
    photo = undistort(np.array(image), view.lens, view.camera, order=1)
    return photo if view.vignetting is None else corrected(photo, view.vignetting, view.camera)


def _size_to_read(view: View) -> tuple[int, int]:
    """The size of the whole photo at the view's resolution: that of its camera, unless it shows a part."""
    lens, camera = view.lens, view.camera
    if lens is None or lens.face is None:
        return camera.width, camera.height
    scale = camera.K[0, 0] / intrinsics(lens)[0, 0]
    return max(1, round(lens.width * scale)), max(1, round(lens.height * scale))


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

    def fetch(
        self, rows: Sequence[int], threads: int, on_photo: Callable[[int, int], None] = lambda *_: None
    ) -> None:
        """Load photos side by side ahead of their use, as many as are kept; `on_photo(done, total)`.

        Raises SceneError as access does.
        """
        coming, used = list[int](), self._used
        for row in rows:
            camera = self.views[row].camera
            used += 3 * camera.width * camera.height
            if row not in self._cache and used <= self.cache_bytes:
                coming.append(row)
        pool = ThreadPoolExecutor(max(1, threads))
        try:
            for done, (row, photo) in enumerate(zip(coming, pool.map(self._unchanged, coming), strict=True)):
                self._cache[row] = photo
                self._used += photo.nbytes
                on_photo(done + 1, len(coming))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)  # Ctrl-C does not wait for photos

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


def as_rgb(image: Image.Image, background: tuple[int, int, int]) -> Image.Image:
    """The image, of any Pillow mode, as 8-bit sRGB; alpha is composited over `background`.

    Decodes it. Returns `image` itself where it is RGB already.
    """
    image.load()
    if image.mode.startswith("I") or image.mode == "F":
        return _grey(image).convert("RGB")
    image = in_srgb(image)
    if image.has_transparency_data:
        return _composited(image, background)
    return image if image.mode == "RGB" else image.convert("RGB")


def _grey(image: Image.Image) -> Image.Image:
    """The image, of 16 or 32 bits, in 8 bits."""
    deep = image.mode.startswith("I")
    # Pillow's own conversion clips 16-bit greys instead of scaling them.
    scale = 257 if deep and any(np.asarray(strip).max() > 255 for _, strip in _strips(image)) else 1
    grey = Image.new("L", image.size)
    for top, strip in _strips(image):
        values = np.nan_to_num(np.asarray(strip, np.float64), nan=0)
        grey.paste(Image.fromarray((values / scale).round().clip(0, 255).astype(np.uint8)), (0, top))
    return grey


def _composited(image: Image.Image, background: tuple[int, int, int]) -> Image.Image:
    rgb = Image.new("RGB", image.size)
    for top, strip in _strips(image):
        below = Image.new("RGBA", strip.size, (*background, 255))
        rgb.paste(Image.alpha_composite(below, strip.convert("RGBA")).convert("RGB"), (0, top))
    return rgb


def _strips(image: Image.Image) -> Iterator[tuple[int, Image.Image]]:
    """The first row and the content of each strip: copies of the whole image would take much memory."""
    rows = max(1, _STRIP // image.width)
    for top in range(0, image.height, rows):
        yield top, image.crop((0, top, image.width, min(top + rows, image.height)))
