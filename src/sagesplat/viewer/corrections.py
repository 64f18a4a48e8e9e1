"""How well a category's boxes give its distance, and corrections in the known views."""

from dataclasses import replace

import numpy as np

from sagesplat.viewer import boxes
from sagesplat.viewer.frames import fov_y, position, quaternion
from sagesplat.viewer.manifest import Category, Contents


def with_corrections(contents: Contents) -> Contents:
    """The contents with `Category.corrections`: the log of d_min over the distance by boxes, per camera."""
    views = []
    for entry in contents.cameras:
        camera = entry.camera
        where = position(camera)
        planes = boxes.frustum(where, quaternion(camera), fov_y(camera), camera.width / camera.height)
        views.append((where, planes))

    def corrections(category: Category) -> np.ndarray:
        by_boxes = np.array([boxes.distance(category.boxes, *view) for view in views])
        known = np.full(len(views), np.nan) if category.distance is None else category.distance
        valid = (known > 0) & (by_boxes > 0)
        return np.log(np.where(valid, known / np.where(by_boxes > 0, by_boxes, 1), np.nan))

    return replace(contents, categories=[replace(c, corrections=corrections(c)) for c in contents.categories])


def distance_error(contents: Contents) -> tuple[dict[int, tuple[float, float]], tuple[float, float]]:
    """Median and 95th percentile of the relative error of distances by boxes: by label id, and over all.

    The reference is d_min, in the views that show enough of a category.
    """
    by_id = {
        c.label_id: np.abs(np.expm1(-c.corrections[c.shares > 0]))
        for c in contents.categories
        if c.shares is not None and c.corrections is not None
    }
    by_label = {label: _median_and_95th(errors) for label, errors in by_id.items()}
    return by_label, _median_and_95th(np.concatenate([*by_id.values(), np.zeros(0)]))


def _median_and_95th(errors: np.ndarray) -> tuple[float, float]:
    if not np.isfinite(errors).any():
        return float("nan"), float("nan")
    median, high = np.nanpercentile(errors, [50, 95])
    return float(median), float(high)
