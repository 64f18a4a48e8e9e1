"""A contact sheet of viewpoints: what each of them sees, and where they are around the splat."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from sagesplat.adapt.free_poses import level_axes
from sagesplat.adapt.observe import render_rgb
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.sh import sh0_to_rgb
from sagesplat.io.files import atomic_path
from sagesplat.io.pictures import open_picture
from sagesplat.output.figures import ACCENT, FAINT, INK, STYLE, shortened
from sagesplat.output.place_figures import outline
from sagesplat.raster import Backend, Workspace
from sagesplat.scene.scene import Camera

MOST = 60  # viewpoints that are shown as pictures; maps show all
_COLUMNS = 10
_WIDTH = 14.0  # inches
_MAPS = 4.2  # inches, height of the maps
_SIDE = 200  # px, longer side of a picture
_DOTS = 20_000  # Gaussians on a map
_MARGIN = 0.08  # of a map around what it shows
_ARROW = 0.25  # inches, length of a viewing direction
_MAP_WIDTH, _MAP_HEIGHT = 0.46, 0.84  # of a map, as shares of the sheet's width and of _MAPS


def contact_sheet(
    path: Path,
    g: Gaussians,
    cameras: Sequence[Camera],
    up: Float[np.ndarray, "3"],
    lines: Sequence[str] = (),
    names: Sequence[str] | None = None,
    *,
    antialiased: bool = False,
    backend: Backend = "cpu",
    rendered: Sequence[Path] = (),
) -> None:
    """Write viewpoints as a PNG: maps from above and from the side, and small renders of the first ones.

    `up`: unit vector, world; `lines`: put over it; `names`: of the cameras; None: their numbers; `rendered`:
    the cameras' renders in files, which are made smaller; none: they are rendered.
    """
    shown, workspace = cameras[:MOST], Workspace()
    pictures = [_smaller(path) for path in rendered[:MOST]] or [
        render_rgb(
            g, camera.neutral.within(_SIDE), backend=backend, antialiased=antialiased, workspace=workspace
        ).copy()
        for camera in shown
    ]
    titles = list(names or map(str, range(1, len(cameras) + 1)))
    heights = [(_WIDTH / _COLUMNS) * p.shape[0] / p.shape[1] + 0.2 for p in pictures]
    rows = [slice(i, i + _COLUMNS) for i in range(0, len(shown), _COLUMNS)]
    tall = [max(heights[row]) for row in rows]
    head = 0.25 * (len(lines) + 1)
    total = head + _MAPS + sum(tall)
    with rc_context(STYLE):
        figure = Figure(figsize=(_WIDTH, total))
        for i, line in enumerate(lines):
            figure.text(0.01, 1 - (0.25 * (i + 1)) / total, line, fontsize=9, color=INK, va="center")
        _maps(figure, g, cameras, up, 1 - head / total, _MAPS / total)
        top = 1 - (head + _MAPS) / total
        for row, height in zip(rows, tall, strict=True):
            for column, (picture, title) in enumerate(zip(pictures[row], titles[row], strict=False)):
                _picture(figure, picture, title, column, top, total)
            top -= height / total
        with warnings.catch_warnings(), atomic_path(path) as temporary:
            warnings.filterwarnings("ignore", message="Glyph .* missing from font")  # names in Chinese
            figure.savefig(temporary, format="png", dpi=100)


def _smaller(path: Path) -> Float32[np.ndarray, "H W 3"]:
    with open_picture(path) as image:
        image.thumbnail((_SIDE, _SIDE), Image.Resampling.BOX)
        return np.asarray(image.convert("RGB"), np.float32) / 255


def _picture(
    figure: Figure, picture: Float32[np.ndarray, "H W 3"], title: str, column: int, top: float, total: float
) -> None:
    width = 0.98 / _COLUMNS
    height = width * _WIDTH * picture.shape[0] / picture.shape[1] / total
    axes = figure.add_axes((0.01 + column * width, top - height, 0.97 * width, height))
    axes.imshow(picture, aspect="auto")
    axes.set_axis_off()
    axes.text(0.03, 0.95, shortened(title), transform=axes.transAxes, fontsize=7, color="w", va="top")


def _maps(
    figure: Figure,
    g: Gaussians,
    cameras: Sequence[Camera],
    up: Float[np.ndarray, "3"],
    top: float,
    height: float,
) -> None:
    first, second = level_axes(up)
    some = np.linspace(0, len(g) - 1, min(len(g), _DOTS)).astype(int)
    means = g.means.detach().cpu().numpy()[some].astype(np.float64)
    rgba = torch.cat([sh0_to_rgb(g.sh0[:, 0]).clamp(0, 1), torch.sigmoid(g.logit_opacities)[:, None]], 1)
    colours = rgba.detach().cpu().numpy()[some]
    position = np.stack([camera.position for camera in cameras]).astype(np.float64)
    direction = np.stack([camera.direction for camera in cameras]).astype(np.float64)
    for i, (title, across, upward) in enumerate(
        [("from above", first, second), ("from the side", first, np.asarray(up, np.float64))]
    ):
        axes = figure.add_axes((0.03 + 0.49 * i, top - 0.92 * height, _MAP_WIDTH, _MAP_HEIGHT * height))
        plane = np.stack([across, upward], axis=1)
        _map(axes, means @ plane, colours, position @ plane, direction @ plane)
        axes.set_title(title, loc="left", color=FAINT)


def _map(
    axes: Axes,
    dots: Float[np.ndarray, "P 2"],
    colours: Float[np.ndarray, "P 4"],
    at: Float[np.ndarray, "V 2"],
    towards: Float[np.ndarray, "V 2"],
) -> None:
    shown = outline(at, dots)
    low, high = shown.min(0), shown.max(0)
    shape = np.array([_MAP_WIDTH * _WIDTH, _MAP_HEIGHT * _MAPS])  # inches
    least = 1e-6 * float(np.abs(shown).max()) + 1e-30  # of one point
    scale = max(float(((high - low) / shape).max()), least) * (1 + 2 * _MARGIN)  # world units per inch
    (left, bottom), (right, top) = (low + high) / 2 - scale * shape / 2, (low + high) / 2 + scale * shape / 2
    axes.scatter(*dots.T, s=1.5, c=colours, linewidths=0, rasterized=True)
    axes.scatter(*at.T, s=9, color=ACCENT, linewidths=0, zorder=3)
    ends = at + _ARROW * scale * towards
    axes.plot(*np.stack([at, ends], axis=1).transpose(2, 1, 0), color=ACCENT, lw=0.7, zorder=3)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.tick_params(labelsize=6)
