"""Corrections of the distances that a viewer has of a category: it knows points, and no Gaussians."""

from dataclasses import replace

import numpy as np

from sagesplat.adapt.cells import label_distances
from sagesplat.viewer.manifest import Contents


def with_corrections(contents: Contents) -> Contents:
    """The contents with `Seen.corrections`: the log of d_min over the distance by points, per photo."""
    by_points = label_distances(contents.cells, [entry.camera for entry in contents.cameras])
    columns = {label: i for i, label in enumerate(np.unique(contents.cells.labels).tolist())}
    categories = []
    for category in contents.categories:
        seen = category.seen
        if seen is not None and category.label_id in columns:
            far = by_points[:, columns[category.label_id]]
            valid = (seen.distance > 0) & (far > 0)
            corrections = np.log(np.where(valid, seen.distance / np.where(valid, far, 1), np.nan))
            seen = replace(seen, corrections=corrections)
        categories.append(replace(category, seen=seen))
    return replace(contents, categories=categories)
