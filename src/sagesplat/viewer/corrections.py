"""How well a category's boxes give its distance, and corrections in the known views."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sagesplat.scene.scene import Camera
from sagesplat.viewer import boxes
from sagesplat.viewer.frames import fov_y, position, quaternion
from sagesplat.viewer.manifest import QUALITIES, Category, Contents
from sagesplat.viewer.promises import Seen


def with_corrections(contents: Contents) -> Contents:
    """The contents with `Seen.corrections`: the log of d_min over the distance by boxes, per viewpoint."""
    views = {quality: [_view(camera) for camera in contents.viewpoints(quality)] for quality in QUALITIES}

    def corrected(category: Category) -> Category:
        seen = {
            quality: replace(one, corrections=_corrections(category, one, views[quality]))
            for quality, one in category.seen.items()
        }
        return replace(category, seen=seen)

    return replace(contents, categories=[corrected(category) for category in contents.categories])


def _view(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Position and half spaces of a camera, in the bundle's axes."""
    where = position(camera)
    planes = boxes.frustum(where, quaternion(camera), fov_y(camera), camera.width / camera.height)
    return where, planes


def _corrections(
    category: Category, seen: Seen, views: Sequence[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    by_boxes = np.array([boxes.distance(category.boxes, *view) for view in views])
    valid = (seen.distance > 0) & (by_boxes > 0)
    return np.log(np.where(valid, seen.distance / np.where(by_boxes > 0, by_boxes, 1), np.nan))


def distance_error(contents: Contents) -> tuple[dict[int, tuple[float, float]], tuple[float, float]]:
    """Median and 95th percentile of the relative error of distances by boxes: by label id, and over all.

    The reference is d_min, in the photos that show enough of a category; without photos in drawn viewpoints.
    """
    seen = {c.label_id: c.seen.get("ssim") or c.seen.get("fidelity") for c in contents.categories}
    by_id = {
        label: np.abs(np.expm1(-one.corrections[one.shares > 0]))
        for label, one in seen.items()
        if one is not None and one.corrections is not None
    }
    by_label = {label: _median_and_95th(errors) for label, errors in by_id.items()}
    return by_label, _median_and_95th(np.concatenate([*by_id.values(), np.zeros(0)]))


def _median_and_95th(errors: np.ndarray) -> tuple[float, float]:
    if not np.isfinite(errors).any():
        return float("nan"), float("nan")
    median, high = np.nanpercentile(errors, [50, 95])
    return float(median), float(high)
