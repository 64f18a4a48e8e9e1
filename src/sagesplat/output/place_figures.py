"""Figures of where photos were taken, and of what the levels are worth at the viewpoints between them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sagesplat.adapt.plan import Plan
from sagesplat.output.figures import ACCENT, FAINT, INK, STYLE, Colours, Sizes, caption, ink, panel_grid
from sagesplat.output.tables import bytes_of

_DOTS = 30_000  # points on the map
_AROUND = 0.8  # points farther from the cameras than so many times their spread are not aimed at
_MAP_WIDTH = 9.0  # inches
_MAP_HEIGHTS = (3.0, 5.6)  # inches, least and most
_MARGIN = 0.07  # of the map around what it shows
_ARROW = 0.045  # of the map's width, length of a viewing direction
_SHOWN = 9  # categories with a panel of their own, the largest


@dataclass(frozen=True, eq=False)
class Place:
    """A scene seen from above: its points and where its photos were taken."""

    points: Float[np.ndarray, "P 2"]  # world units, along two level axes
    colours: Float[np.ndarray, "P 3"]  # RGB, 0 to 1
    at: Float[np.ndarray, "V 2"]  # cameras
    towards: Float[np.ndarray, "V 2"]  # viewing directions, shorter where they point up or down


@rc_context(STYLE)
def camera_map(
    place: Place, quality: Float[np.ndarray, " V"], test: Bool[np.ndarray, " V"], worst: int | None
) -> Figure:
    """The cameras from above, coloured by the SSIM of the full model in their photos (`quality`; NaN: none).

    Those of `test` views have a ring, and `worst` a note: beside it more photos help most.
    """
    figure = _from_above(place, quality, test, "SSIM of the full model in this photo")
    axes = figure.axes[0]
    if worst is not None:
        axes.annotate(
            "more photos from here", place.at[worst], (0, 16), textcoords="offset points", ha="center",
            fontsize=10, fontweight="bold", color=ACCENT, zorder=5,
            arrowprops={"arrowstyle": "-", "color": ACCENT},
            bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.85},
        )  # fmt: skip
    handles = [_camera(INK, 9, "test photo (unseen)"), _camera("white", 7, "training photo")]
    axes.legend(
        handles=handles if test.any() else handles[1:], loc="lower left", framealpha=0.85, frameon=True
    )
    return figure


@rc_context(STYLE)
def viewpoint_map(place: Place, share: Float[np.ndarray, " V"]) -> Figure:
    """Drawn viewpoints from above, coloured by the share of their categories that reach the target."""
    return _from_above(place, share, np.zeros(len(share), bool), "categories that reach the target here")


def _from_above(
    place: Place, values: Float[np.ndarray, " V"], ringed: Bool[np.ndarray, " V"], says: str
) -> Figure:
    """Points and cameras from above, these coloured by values (NaN: none), with their directions."""
    low, high = _window(place)
    size = high - low
    height = float(np.clip(_MAP_WIDTH * size[1] / size[0], *_MAP_HEIGHTS))
    figure = Figure(figsize=(_MAP_WIDTH, height + 0.3), layout="constrained")
    axes = figure.subplots()
    some = np.linspace(0, len(place.points) - 1, min(len(place.points), _DOTS)).astype(int)
    axes.scatter(*place.points[some].T, s=4, c=place.colours[some], linewidths=0, rasterized=True)
    ends = place.at + _ARROW * size[0] * place.towards
    axes.plot(*np.stack([place.at, ends], axis=1).transpose(2, 1, 0), color=INK, lw=0.8, zorder=3)
    known = np.isfinite(values)
    limits = values[known].min(initial=1.0), values[known].max(initial=0.0)
    if limits[0] >= limits[1]:  # none, or all alike: the whole scale
        limits = 0.0, 1.0
    for rows, ring, dot in ((~ringed, "white", 42), (ringed, INK, 90)):
        dots = axes.scatter(
            *place.at[rows].T, s=dot, c=values[rows], cmap="RdYlBu", vmin=limits[0], vmax=limits[1],
            edgecolors=ring, linewidths=1.6 if ring == INK else 0.6, zorder=4, plotnonfinite=True,
        )  # fmt: skip
    if known.any():
        figure.colorbar(dots, ax=axes, label=says, shrink=0.8, pad=0.01)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="world units")
    axes.grid(visible=False)
    return figure


def _camera(ring: str, size: float, label: str) -> Line2D:
    return Line2D([], [], marker="o", ls="", ms=size, mfc="#9bb7d4", mec=ring, mew=1.4, label=label)


def outline(at: Float[np.ndarray, "V 2"], points: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "N 2"]:
    """What a map has to show: all cameras, and the corners of the points around them without the farthest."""
    reach = _AROUND * float(np.ptp(at, axis=0).max()) or np.inf  # else a far sky decides
    near = points[((points > at.min(0) - reach) & (points < at.max(0) + reach)).all(1)]
    return np.concatenate([at, *([np.quantile(near, [0.02, 0.98], axis=0)] if len(near) else [])])


def _window(place: Place) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The corners of the map."""
    shown = outline(place.at.astype(np.float64), place.points)
    low, high = shown.min(0), shown.max(0)
    least = max(float((high - low).max()), 1e-6 * float(np.abs(shown).max()) + 1e-30)
    half = np.maximum(high - low, 0.3 * least) * (0.5 + _MARGIN)
    return (low + high) / 2 - half, (low + high) / 2 + half


@rc_context(STYLE)
def fidelity_by_size(
    drawn: Mapping[int, Float32[np.ndarray, "V K"]],
    levels: Sequence[int],
    sizes: Sizes,
    plan: Plan,
    labels: Sequence[int],
    names: Mapping[int, str],
    colours: Colours,
) -> Figure:
    """Fidelity of each category over the bytes of its levels, at the viewpoints that show it; a panel each.

    `labels`: the largest first, of which the first nine are drawn; `plan`: whose levels are marked.
    """
    drawn = {label: values[np.isfinite(values).all(1)] for label, values in drawn.items()}
    shown = [label for label in labels if label in drawn and len(drawn[label])][:_SHOWN]
    columns = max(1, min(3, len(shown)))
    figure, grid = panel_grid(len(shown), columns, (3.2, 2.1), 0.6, sharey=True)
    chosen = {choice.label_id: choice for choice in plan.choices}
    for axes, label in zip(grid, shown, strict=True):
        colour = ink(label, colours)
        kilobytes = [sizes[label, level] / 1e3 for level in levels]
        low, middle = np.quantile(drawn[label], [0.05, 0.5], axis=0)
        axes.fill_between(kilobytes, low, middle, color=colour, alpha=0.18, lw=0)
        axes.plot(kilobytes, middle, color=colour, lw=1)
        axes.plot(kilobytes, low, color=colour, lw=2, marker=".", ms=5)
        axes.axhline(plan.target, color=FAINT, lw=1, ls="--")
        if choice := chosen.get(label):
            promised = choice.predicted if np.isfinite(choice.predicted) else low[levels.index(choice.level)]
            at = bytes_of(choice) / 1e3
            axes.plot(at, promised, "o", ms=9, mfc="none", mec=ACCENT, mew=2, clip_on=False, zorder=4)
        axes.set_title(caption(label, names), loc="left", color=colour, fontweight="bold")
        axes.set_ylim(max(0.0, float(min(drawn[one][:, 0].min() for one in shown)) - 0.05), 1.02)
    figure.supxlabel("kB to send, level by level", fontsize=9)
    figure.supylabel("fidelity", fontsize=9)
    handles = [
        Line2D([], [], color=INK, lw=2, marker=".", label="95 % of viewpoints reach this"),
        Line2D([], [], color=INK, lw=1, label="half of them reach this"),
        Line2D([], [], color=FAINT, ls="--", label=f"target {plan.target:g}"),
        Line2D(
            [], [], marker="o", ls="", ms=9, mfc="none", mec=ACCENT, mew=2, label="plan, and what it promises"
        ),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2 if columns < 3 else 4)
    return figure
