"""Renders of a model in place of photos: what levels of a splat that came without a training are made of."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from jaxtyping import UInt8

from sagesplat.adapt.observe import render_rgb
from sagesplat.core.gaussians import Gaussians
from sagesplat.raster import Backend
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import View


class Renders(Photos):
    """What a model shows in each view, uint8 [H, W, 3], rendered on access and cached as photos are."""

    def __init__(
        self,
        g: Gaussians,
        views: Sequence[View],
        backend: Backend,
        antialiased: bool,
        cache_bytes: int = 2**30,
    ):
        super().__init__(views, cache_bytes)
        self._render = partial(render_rgb, g, backend=backend, antialiased=antialiased)

    def _unchanged(self, index: int) -> UInt8[np.ndarray, "H W 3"]:
        return (self._render(self.views[index].camera) * 255).round().astype(np.uint8)
