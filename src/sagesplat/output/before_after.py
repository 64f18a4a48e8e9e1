"""A picture of what an operation removes: views before and after it, and what goes, alone."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32
from matplotlib import rc_context
from matplotlib.figure import Figure

from sagesplat.adapt.observe import render_rgb
from sagesplat.core.gaussians import Gaussians
from sagesplat.io.files import atomic_path
from sagesplat.output.figures import INK, STYLE
from sagesplat.raster import Backend, Workspace
from sagesplat.scene.scene import Camera

ROWS = 4  # views that are shown, those that change most
_LOOKED = 12  # cameras that are compared
_SIDE = 640  # px, longer side of a picture
_GREY = (110, 110, 110)  # behind what goes: bright and dark Gaussians are seen
_WIDTH = 15.0  # inches
_HEAD = 0.3


def before_after(
    path: Path,
    g: Gaussians,
    keep: Bool[np.ndarray, " N"],
    cameras: Sequence[Camera],
    title: str,
    *,
    antialiased: bool = False,
    backend: Backend = "cpu",
) -> None:
    """Write a PNG of the cameras whose pictures change most: before, after, and only what goes."""
    stays = torch.from_numpy(keep)
    parts, space = (g, g.select(stays), g.select(~stays)), Workspace()

    def render(part: Gaussians, camera: Camera) -> Float32[np.ndarray, "H W 3"]:
        options: dict[str, Any] = {"backend": backend, "antialiased": antialiased, "workspace": space}
        return render_rgb(part, camera, **options).copy()

    some = np.unique(np.linspace(0, len(cameras) - 1, min(_LOOKED, len(cameras))).round().astype(int))
    looked = [cameras[i].neutral.within(_SIDE) for i in some]
    change = [float(np.abs(render(parts[0], c) - render(parts[1], c)).mean()) for c in looked]
    shown = [looked[i] for i in np.argsort(change)[::-1][:ROWS]]
    heights = [_WIDTH / 3 * camera.height / camera.width for camera in shown]
    total, top = _HEAD + sum(heights), _HEAD
    with rc_context(STYLE):
        figure = Figure(figsize=(_WIDTH, total))
        figure.text(0.01, 1 - _HEAD / 2 / total, title, fontsize=11, color=INK, va="center")
        for camera, height in zip(shown, heights, strict=True):
            of = (camera, camera, replace(camera, background=_GREY))
            for column, (part, name) in enumerate(zip(parts, ("before", "after", "what goes"), strict=True)):
                axes = figure.add_axes(
                    (column / 3, 1 - (top + height) / total, 0.995 / 3, 0.99 * height / total)
                )
                axes.imshow(render(part, of[column]), aspect="auto")
                axes.set_axis_off()
                axes.text(0.02, 0.97, name, transform=axes.transAxes, fontsize=9, color="w", va="top")
            top += height
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="png", dpi=100)
