"""Pixels that count: what does not belong to a scene is not trained on, not measured and has no vote.

Pixels do not count where a category is ignored, where a mask of the photo is black (`scene.given_masks`, the
`mask_path` of nerfstudio), where a photo is transparent and that means it (`Scene.alpha`), and where the face
of a cube is beyond what a fisheye saw.
"""

import shutil
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32
from PIL import Image
from scipy.ndimage import minimum_filter

from sagesplat.core.errors import LabelError, SceneError
from sagesplat.io.files import atomic_path
from sagesplat.scene.given_masks import INVERTED_FOLDER, GivenMask, masks_of
from sagesplat.scene.images import cut_out, has_alpha, load_alpha, read_black
from sagesplat.scene.raw_photos import RawPhoto, raw_photos
from sagesplat.scene.scene import Scene, View
from sagesplat.scene.undistort import seen
from sagesplat.segment.fit import fit
from sagesplat.segment.masks import CACHE_BYTES, Masks, mask_path

Pixels = Bool[np.ndarray, "H W"]
_LOOKED_AT = 24  # views whose points tell which pixels of masks count
_FEW = 50  # observations that are too few to tell
_HARDLY_ANY = 0.05  # of those in black, for the area


class ValidPixels:
    """Which pixels of the views count, from a folder that `write_valid` wrote; without one all of them.

    Images are kept until `CACHE_BYTES` are full, as those of `Masks` are.
    """

    def __init__(self, folder: Path | None = None):
        self.folder = folder
        self._cache: dict[str, Pixels] = {}
        self._used = 0

    def __getitem__(self, view: View) -> Pixels | None:
        """True where a pixel counts, at the size of the view's camera; None where all do.

        Shared, so not to be changed.
        """
        if (valid := self._cache.get(view.name)) is not None:
            return valid
        if self.folder is None or not (path := mask_path(self.folder, view)).exists():
            return None
        valid = read_valid(path, view)
        if self._used + valid.nbytes <= CACHE_BYTES:
            self._cache[view.name] = valid
            self._used += valid.nbytes
        return valid

    def rows(self, scene: Scene, rows: Collection[int]) -> list[int]:
        """Those of the rows of `Scene.views` that have a pixel that counts."""
        of_rows = ((int(row), self[scene.views[row]]) for row in rows)
        return [row for row, valid in of_rows if valid is None or valid.any()]


ALL_VALID = ValidPixels()


def read_valid(path: Path, view: View) -> Pixels:
    """One image of a folder that `write_valid` wrote; LabelError where it is no use for the view."""
    valid = read_black(path, view.camera.width * view.camera.height)
    if valid.shape != (view.camera.height, view.camera.width):
        h, w = valid.shape
        raise LabelError(
            f"{path}: {w} x {h} pixels where the scene has {view.camera.width} x {view.camera.height}; "
            "make the masks again"
        )
    return valid


def write_valid(
    scene: Scene,
    target: Path,
    *,
    label_ids: Masks | None = None,
    ignore: Collection[int] = (),
    dilation: int = 0,
    folder: Path | None = None,
    say: Callable[[str], object] = lambda line: None,
) -> Float32[np.ndarray, " V"]:
    """Find the pixels of all views that do not count, and write an image for each view that has some.

    Args:
        scene: The capture: its masks, and its photos where they are transparent.
        target: Folder to write; it is removed where all pixels count.
        label_ids: Label images; needed for `ignore`.
        ignore: Category ids whose pixels do not count.
        dilation: Pixels by which regions that do not count are grown.
        folder: Of masks, besides those that lie beside the photos.
        say: Called with a line on the masks that came with the photos, if any did.

    Returns:
        Share of each view's pixels that do not count; 1 where none does.

    Raises:
        LabelError: For masks that cannot be used, or where no pixel of a training view is left.
    """
    shutil.rmtree(target, ignore_errors=True)
    given, transparent = _Given(scene, folder), ignores_alpha(scene)
    if given.line:
        say(given.line)
    shares = np.zeros(len(scene.views), np.float32)
    for row, view in enumerate(scene.views):
        valid = given(view)
        if ignore and label_ids is not None:
            valid &= ~np.isin(label_ids[view], np.array(sorted(ignore), np.int16))
        if transparent:
            valid &= opaque(view)
        if view.lens is not None and view.lens.face is not None:
            valid &= seen(view.lens, view.camera.K, view.camera.width, view.camera.height)
        if not valid.all():
            if dilation:
                valid = np.asarray(minimum_filter(valid, 2 * dilation + 1, mode="nearest"))
            shares[row] = 1 - valid.mean()
            write_view(target, view, valid)
    if (shares[scene.train_ids] == 1).all():
        raise LabelError(
            f"{scene.path}: no pixel of any training photo counts; ignore fewer categories, or mend the "
            "masks of the photos"
        )
    return shares


def write_view(folder: Path, view: View, valid: Pixels) -> None:
    """Write which pixels of a view count, as `ValidPixels` reads it."""
    with atomic_path(mask_path(folder, view), sync=False) as temporary:
        Image.fromarray(valid).save(temporary, format="PNG")


class _Given:
    """The masks that came with the photos: in folders (`scene.given_masks`), and those that views name."""

    def __init__(self, scene: Scene, folder: Path | None):
        masks = masks_of(scene, folder)
        self.raw = raw_photos(scene.path) if masks else {}
        found = ((view.name, masks.of(view.photo_name)) for view in scene.views)
        self.found = {name: mask for name, mask in found if mask is not None}
        # structure from motion may have left out all photos with a mask, and wrote the folder itself
        named = any(view.valid_path for view in scene.views)  # by their capture, whatever they are called
        if masks.folders and not self.raw and not self.found and not named:
            name = mask_path(masks.folders[0], scene.views[0]).name
            raise LabelError(
                f"{masks.folders[0]}: no mask of any photo; name them like the photos ({name}, ...)"
            )
        self.line = self._line(scene) if self.found else ""
        if named and not self.found:
            self.line = "masks that the capture names: black pixels do not count"

    def __call__(self, view: View) -> Pixels:
        """Whether the pixels of a view count, at the size of its camera."""
        valid = np.ones((view.camera.height, view.camera.width), bool)
        if (mask := self.found.get(view.name)) is not None:
            valid &= _seen(mask, view, self.raw.get(view.name))
        if view.valid_path is not None:
            valid &= _seen(GivenMask(view.valid_path, inverted=False), view, None)
        return valid

    def _line(self, scene: Scene) -> str:
        """Turn masks that are inverted by all that points tell; what was found, in words."""
        first = next(iter(self.found.values()))
        photos = {view.photo_name: view.name in self.found for view in scene.views}  # not faces of cubes
        count = f"masks of {sum(photos.values())} of {len(photos)} photos, such as {first.path}"
        if any(mask.inverted for mask in self.found.values()):
            return f"{count}: white pixels do not count, as their names say"
        if self._hide_all_points(scene):
            self.found = {name: replace(mask, inverted=True) for name, mask in self.found.items()}
            return f"{count}: white pixels do not count, since the points of the scene are all in black"
        cure = f"if it is the white ones, name the folder {INVERTED_FOLDER}"
        return f"{count}: black pixels do not count ({cure})"

    def _hide_all_points(self, scene: Scene) -> bool:
        """Whether hardly any point was observed where the masks are white, for how much of photos that is."""
        points, seen, area = scene.points, np.zeros(2), np.zeros(2)
        rows = [row for row, view in enumerate(scene.views) if view.name in self.found]
        for row in rows[:: len(rows) // _LOOKED_AT + 1]:
            valid = self(scene.views[row])
            x, y = points.track_uv[points.track_views == row].T.astype(int)
            white = valid[y.clip(0, len(valid) - 1), x.clip(0, valid.shape[1] - 1)]
            seen += [white.sum(), (~white).sum()]
            area += [valid.sum(), (~valid).sum()]
        if seen.sum() < _FEW or not area.all():
            return False
        in_white, in_black = seen / area
        return bool(in_white < _HARDLY_ANY * in_black)


def describe_masks(scene: Scene) -> str:
    """A line on the masks that came with the photos of a scene, and which pixels count; "" without any."""
    try:
        return _Given(scene, None).line
    except (LabelError, SceneError) as error:
        return str(error)


def _seen(mask: GivenMask, view: View, raw: RawPhoto | None) -> Pixels:
    """A mask of a photo as the view's camera sees it."""
    valid = mask.read(view.camera.width * view.camera.height)
    return fit(valid.astype(np.int16), view, raw, mask.path).astype(bool)


def opaque(view: View) -> Pixels:
    """Where the photo of a view is opaque, at the size of its camera."""
    if not has_alpha(view.image_path):
        return np.ones((view.camera.height, view.camera.width), bool)
    alpha = load_alpha(view.image_path)
    return fit((alpha == 255).astype(np.int16), view, None, view.image_path).astype(bool)


def ignores_alpha(scene: Scene) -> bool:
    """Whether transparent pixels of a scene's photos do not count, by its setting or by the photos.

    An object that was cut out has a transparent border in most photos: then the photos are of the object over
    the background.
    """
    if scene.alpha != "auto":
        return scene.alpha == "ignore"
    paths = [view.image_path for view in scene.views if has_alpha(view.image_path)]
    return bool(paths) and not cut_out(paths)
