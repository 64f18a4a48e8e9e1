"""Colours of categories, for people: the same in the viewer, the report and its figures."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from sagesplat.segment.masks import UNLABELLED

# readable on light and dark; a category gets the one that is most like its colour in the label images
_PALETTE = (
    *("#e5484d", "#ef7d2b", "#d6a10b", "#94ad1e", "#3f9f4f", "#16a38b", "#1ba3c2", "#3f8fe0"),
    *("#5b6bf0", "#8b5cf0", "#bf52c9", "#e0568f", "#a8744a", "#6dbd6a", "#7f7fb0", "#b38f6d"),
)
_GREY = "#8a94a3"


def colors_of(wanted: Mapping[int, tuple[int, int, int]]) -> dict[int, str]:
    """Colours of the palette, in hue as near as can be to those wanted; all different as long as it lasts."""
    labels = sorted(set(wanted) - {UNLABELLED})
    colors = list(_PALETTE) * (1 + len(labels) // len(_PALETTE))
    away = cdist([_pure(wanted[i]) for i in labels] or np.zeros((0, 3)), [_pure(rgb_of(c)) for c in colors])
    chosen = linear_sum_assignment(away**2)[1]
    return {UNLABELLED: _GREY} | {label: colors[i] for label, i in zip(labels, chosen, strict=True)}


def _pure(rgb: Sequence[int]) -> np.ndarray:
    """RGB as bright as it can be."""
    return np.array(rgb) / max(*rgb, 1)


def rgb_of(color: str) -> tuple[int, int, int]:
    """RGB, 0 to 255, of a colour such as "#e5484d"."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)
