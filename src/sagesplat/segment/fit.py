"""Label images as the cameras of their views see them: upright, undistorted, at the camera's size."""

from pathlib import Path

import numpy as np
from jaxtyping import Int16

from sagesplat.core.errors import LabelError
from sagesplat.scene.images import photo_size
from sagesplat.scene.raw_photos import RawPhoto, same_aspect, upright
from sagesplat.scene.scene import Camera, Lens, View
from sagesplat.scene.undistort import is_pinhole, undistort

Size = tuple[int, int]  # width and height


def fit(
    label_ids: Int16[np.ndarray, "h w"], view: View, raw: RawPhoto | None, path: Path
) -> Int16[np.ndarray, "H W"]:
    """A label image as the view's camera sees it: undistorted, resampled to the nearest pixel.

    Args:
        label_ids: Category ids of the whole photo, at any resolution.
        view: The view, whose lens undistorts it, if it has one.
        raw: The photo before structure from motion undistorted it, where that is known. Then the size tells
            whether the label image shows that photo, upright or as its pixels are stored, or the undistorted
            one. One that fits both is taken for the former if it has its size.
        path: The file, for messages.

    Raises:
        LabelError: If the label image has another aspect ratio than its photo, or fits two that differ.
    """
    size = label_ids.shape[1], label_ids.shape[0]
    if raw is None:
        stored = view.lens or view.camera
        if not same_aspect(size, (stored.width, stored.height)):
            raise _refused(path, size, f"its photo has {stored.width} x {stored.height}")
        return _seen(label_ids, view.lens, view.camera)
    shown = _shown(size, view, raw, path)
    if shown == "undistorted":
        return _seen(label_ids, view.lens, view.camera)
    return _seen(
        upright(label_ids, raw.orientation) if shown == "stored" else label_ids, raw.lens, view.camera
    )


def _shown(size: Size, view: View, raw: RawPhoto, path: Path) -> str:
    """Which form of the photo has the size, or else the aspect ratio: raw, stored or undistorted."""
    width, height = raw.lens.width, raw.lens.height
    sizes = {"raw": (width, height)} | ({"stored": (height, width)} if raw.sideways else {})
    sizes["undistorted"] = photo_size(view.image_path)
    exact = [form for form, other in sizes.items() if size == other]
    matching = exact or [form for form, other in sizes.items() if same_aspect(size, other)]
    flat = "{} x {}".format(*sizes["undistorted"])
    if not matching:
        raise _refused(path, size, f"its photo has {width} x {height}, and {flat} where it is undistorted")
    if not exact and {"raw", "undistorted"} <= set(matching) and not is_pinhole(raw.lens):
        raise LabelError(
            f"{path}: {size[0]} x {size[1]} pixels fit its photo, {width} x {height}, and the undistorted "
            f"one, {flat}; scale it to the size of the one that it shows"
        )
    return matching[0]


def _refused(path: Path, size: Size, photo: str) -> LabelError:
    return LabelError(
        f"{path}: {size[0]} x {size[1]} pixels, but {photo}; label images show the whole photo, at any "
        "resolution"
    )


def _seen(label_ids: Int16[np.ndarray, "h w"], lens: Lens | None, camera: Camera) -> Int16[np.ndarray, "H W"]:
    if lens is not None:
        with np.errstate(all="ignore"):  # numbers of a file may overflow; such pixels are outside
            return undistort(label_ids, lens, camera, order=0)
    h, w = label_ids.shape
    rows = (np.arange(camera.height) + 0.5) * h / camera.height
    columns = (np.arange(camera.width) + 0.5) * w / camera.width
    return label_ids[rows.astype(int)[:, None], columns.astype(int)]
