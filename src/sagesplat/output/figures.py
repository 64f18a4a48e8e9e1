"""The figures of a run, after the paper's Figs. 2 to 5; each is a matplotlib Figure."""

import io
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int, UInt8
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from sagesplat.adapt.eq3 import SsimModel
from sagesplat.adapt.evaluate import QUALITIES, Evaluation
from sagesplat.adapt.observe import TOTAL, Observations
from sagesplat.adapt.plan import Plan, quality_title
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.io.files import atomic_path
from sagesplat.output.tables import MB, bytes_of, last_counts, name_of, view_mean

Colours = Mapping[int, tuple[int, int, int]]  # label id -> RGB, 0..255
Sizes = Mapping[tuple[int, int], int]  # bytes of each (label id, level)
RAW = "model size (MB, 248 bytes a Gaussian)"

INK, FAINT, ACCENT = "#1d2530", "#8a94a3", "#c2410c"
_REFERENCE, _RESET = "#b8c0cb", "#f1e4d3"  # the line to compare with; levels after a reset of opacities
PAIR = (5.4, 4.9)  # inches, of two figures side by side
_IGNORED = 110  # grey of pixels that count nowhere
_LONGEST = 28  # characters of a name
_LONG = 20  # characters of a name, above which a legend has fewer columns
STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#c3cad4",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e8ebf0",
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "text.parse_math": False,  # a category may have a dollar sign in its name
    "svg.hashsalt": "sagesplat",  # the same data give the same file
}


@dataclass(frozen=True, eq=False)
class Panel:
    """One view in pictures: the photo, the full model, the composed scene, the label map."""

    name: str
    photo: UInt8[np.ndarray, "H W 3"]
    full: UInt8[np.ndarray, "H W 3"]
    composed: UInt8[np.ndarray, "H W 3"]
    label_ids: Int[np.ndarray, "H W"]
    ssim: float  # of the composed image
    psnr: float  # dB
    full_ssim: float
    full_psnr: float
    valid: Bool[np.ndarray, "H W"] | None = None  # pixels that count; None: all


def ink(label_id: int, colours: Colours) -> tuple[float, float, float]:
    """A label's colour, 0..1, darkened where lines of it would be pale on white."""
    rgb = np.array(colours.get(label_id, (128, 128, 128)), np.float64) / 255
    luminance = float(rgb**2.2 @ [0.2126, 0.7152, 0.0722])
    r, g, b = rgb * min(1.0, (0.32 / max(luminance, 1e-6)) ** (1 / 2.2))
    return r, g, b


def caption(label_id: int, names: Mapping[int, str]) -> str:
    """A category's name, cut where the figure would have no room left beside it."""
    return shortened(name_of(label_id, names))


def shortened(text: str) -> str:
    """A text cut to the length that a legend or a title has room for."""
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def _columns(typical: int, of_long: int, labels: Sequence[int], names: Mapping[int, str]) -> int:
    """Columns of a legend of these names: `typical`, or `of_long` where a name is long."""
    longest = max((len(caption(label, names)) for label in labels), default=0)
    return typical if longest <= _LONG else of_long


def label_image(label_ids: Int[np.ndarray, "H W"], colours: Colours) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a label map in the colours of its taxonomy.

    Args:
        label_ids: [H, W], category ids; -1: unlabelled.
        colours: RGB, 0 to 255, by category id; grey where there is none.

    Returns:
        uint8 [H, W, 3].
    """
    image = np.full((*label_ids.shape, 3), 128, np.uint8)
    for label_id in np.unique(label_ids).tolist():
        image[label_ids == label_id] = colours.get(label_id, (128, 128, 128))
    return image


def error_image(
    image: UInt8[np.ndarray, "H W 3"],
    photo: UInt8[np.ndarray, "H W 3"],
    valid: Bool[np.ndarray, "H W"] | None = None,
) -> np.ndarray:
    """Mean absolute difference over RGB as uint8 [H, W, 3]: black = none, white = half the range or more.

    Pixels that are not `valid` are grey.
    """
    difference = np.abs(image.astype(np.float32) - photo).mean(axis=2) / 127.5
    error = colormaps["inferno"](np.clip(difference, 0, 1), bytes=True)[..., :3].copy()
    if valid is not None:
        error[~valid] = _IGNORED
    return error


def panel_grid(
    count: int, columns: int, cell: tuple[float, float], beside: float, **shared: Any
) -> tuple[Figure, list[Axes]]:
    """A figure with `count` panels, line by line; `cell`: inches of one, `beside`: height of all else."""
    lines = max(1, math.ceil(count / columns))
    figure = Figure(figsize=(cell[0] * columns, cell[1] * lines + beside), layout="constrained")
    grid = figure.subplots(lines, columns, squeeze=False, **shared).ravel()
    for axes in grid[count:]:
        axes.set_axis_off()
    return figure, list(grid[:count])


@rc_context(STYLE)
def ssim_over_levels(
    observations: Observations,
    train_views: np.ndarray,
    test_views: np.ndarray,
    labels: Sequence[int],
    names: Mapping[int, str],
    colours: Colours,
    recovering: frozenset[int],
) -> Figure:
    """Fig. 2: mean SSIM over the levels, a panel for the whole image and for each label.

    Training views are solid, test views dashed. Each label's panel has the whole image's line too, in grey.
    """
    levels = np.unique(observations.level)
    lines = {
        (label_id, line): [view_mean(rows, label_id, level) for level in levels.tolist()]
        for views, line in ((train_views, "-"), (test_views, "--"))
        for rows in [observations.select(np.isin(observations.view, views))]
        for label_id in [TOTAL, *labels]
    }
    shown = [TOTAL, *labels]
    columns = min(len(shown), _columns(4, 3, labels, names))
    figure, grid = panel_grid(len(shown), columns, (2.4, 1.75), 0.7, sharex=True, sharey=True)
    half = np.min(np.diff(levels)) / 2 if len(levels) > 1 else 0.5
    reset = sorted(recovering & set(levels.tolist()))
    for at, (axes, label_id) in enumerate(zip(grid, shown, strict=True)):
        colour = INK if label_id == TOTAL else ink(label_id, colours)
        for level in reset:
            axes.axvspan(level - half, level + half, color=_RESET, lw=0, zorder=0)
        if label_id != TOTAL:
            axes.plot(levels, lines[TOTAL, "-"], color=_REFERENCE, lw=1.2)
        for line in ("--", "-"):
            axes.plot(levels, lines[label_id, line], line, color=colour, lw=1.5, marker=".", ms=3.5)
        axes.set_title(caption(label_id, names), color=colour, loc="left", fontweight="bold", fontsize=9)
        axes.tick_params(labelbottom=at + columns >= len(shown))
        axes.locator_params(axis="x", nbins=4)
    figure.supxlabel("level", fontsize=9)
    figure.supylabel("SSIM", fontsize=9)
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=INK, label="training views"),
        Line2D([], [], color=INK, ls="--", label="test views (unseen)"),
        Line2D([], [], color=_REFERENCE, label=f"{caption(TOTAL, names)}, training views"),
    ]
    if reset:
        handles += [Patch(color=_RESET, label="recovering from a reset")]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    return figure


@rc_context(STYLE)
def ssim_over_distance(
    observations: Observations,
    train_views: np.ndarray,
    labels: Sequence[int],
    names: Mapping[int, str],
    colours: Colours,
    models: Mapping[tuple[int, int], SsimModel],
    levels: Sequence[int],
) -> Figure:
    """Fig. 3: SSIM of the training views (dots) and Eq. 3 (lines) over distance, a panel per label."""
    shown = [i for i in labels if any((i, level) in models for level in levels)]
    figure, grid = panel_grid(len(shown), max(1, min(3, len(shown))), (3.3, 2.3), 0.5)
    shades = colormaps["viridis"](np.linspace(0.85, 0.05, len(levels)))
    seen = np.isin(observations.view, train_views) & np.isfinite(observations.distance)
    for axes, label_id in zip(grid, shown, strict=True):
        for level, shade in zip(levels, shades, strict=True):
            rows = observations.select(
                seen & (observations.label_id == label_id) & (observations.level == level)
            )
            axes.plot(rows.distance, rows.ssim, ".", color=shade, ms=3.5, alpha=0.55, mew=0)
            if model := models.get((label_id, level)):
                distance = np.linspace(*model.d_range, 200)
                axes.plot(distance, model(distance), color=shade, lw=1.6)
        axes.set_title(caption(label_id, names), color=ink(label_id, colours), loc="left", fontweight="bold")
    figure.supxlabel("distance to the category (world units)", fontsize=9)
    figure.supylabel("SSIM", fontsize=9)
    handles = [Line2D([], [], color=c, label=f"level {i:,}") for i, c in zip(levels, shades, strict=True)]
    figure.legend(handles=handles, loc="outside upper center", ncols=max(1, len(levels)))
    return figure


@rc_context(STYLE)
def size_by_target(
    plans: Sequence[Plan],
    sizes: Sizes,
    labels: Sequence[int],
    names: Mapping[int, str],
    colours: Colours,
    unit: str = RAW,
) -> Figure:
    """Size of the full model and of each target's plan, stacked by label; hatched = target out of reach.

    `sizes`: bytes of each (label id, level), named by `unit`.
    """
    figure = Figure(figsize=(9, 0.52 * (len(plans) + 1) + 1.6), layout="constrained")
    axes = figure.subplots()
    full = last_counts(sizes)
    bars = [("full model", full, set())]
    for plan in plans:
        infeasible = {c.label_id for c in plan.choices if c.status == "infeasible"}
        asked = f"{quality_title(plan.quality)} ≥ {plan.target:g}"
        bars.append((asked, {c.label_id: bytes_of(c) for c in plan.choices}, infeasible))
    whole = max(sum(full.values()), 1)
    for row, (_, nbytes, infeasible) in enumerate(bars):
        left = 0.0
        for label_id in labels:
            width = nbytes.get(label_id, 0) / MB
            hatch = "////" if label_id in infeasible else None
            colour = ink(label_id, colours)
            axes.barh(row, width, 0.72, left=left, color=colour, hatch=hatch, edgecolor="white", lw=0.6)
            left += width
        note = f" {left:,.{2 if whole < 10 * MB else 1}f} MB" + (
            f" · {sum(nbytes.values()) / whole:.0%}" if row else ""
        )
        axes.text(left, row, note, va="center", fontsize=9, fontweight="bold")
    axes.set_yticks(range(len(bars)), [bar[0] for bar in bars])
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.set(xlabel=unit, xlim=(0, 1.16 * whole / MB))
    handles = [Patch(color=ink(i, colours), label=caption(i, names)) for i in labels]
    if any(bar[2] for bar in bars):
        handles.append(
            Patch(facecolor="#cccccc", hatch="////", edgecolor="white", label="target out of reach")
        )
    figure.legend(handles=handles, loc="outside lower center", ncols=_columns(6, 3, labels, names))
    return figure


@rc_context(STYLE)
def asked_and_measured(
    evaluation: Evaluation,
    labels: Sequence[int],
    names: Mapping[int, str],
    colours: Colours,
    quality: QualityKind,
) -> Figure:
    """Measured quality over the target on unseen views, a dot per (label, view, target)."""
    figure = Figure(figsize=PAIR, layout="constrained")
    axes = figure.subplots()
    evaluation = evaluation.select(evaluation.quality == QUALITIES.index(quality)).of_own_quality()
    known = np.isfinite(evaluation.ssim + evaluation.target)  # no target: a budget
    rows = evaluation.select((evaluation.label_id != TOTAL) & known)
    handles = []
    for place, label_id in enumerate(labels):
        mine = rows.select(rows.label_id == label_id)
        beside = 0.02 * ((place + 0.5) / len(labels) - 0.5)  # so that categories do not hide each other
        colour = ink(label_id, colours)
        axes.plot(mine.target + beside, mine.ssim, "o", color=colour, ms=5, alpha=0.75, mew=0)
        if len(mine):
            handles.append(Line2D([], [], marker="o", ls="", color=colour, label=caption(label_id, names)))
    values = np.concatenate([rows.ssim, rows.target, np.array([0.5 if quality == "ssim" else 0.9])])
    ends = np.array([values.min() - 0.03, min(1.0, values.max() + 0.03)])
    axes.plot(ends, ends, color=FAINT, lw=1)
    axes.fill_between(ends, ends, ends[0], color="#f7ecec", lw=0, zorder=0)
    axes.text(ends[1], ends[0], "target missed ", ha="right", va="bottom", color=FAINT)
    named = quality_title(quality)
    axes.set(xlabel=f"{named} asked for", ylabel=f"measured {named}", xlim=ends, ylim=ends)
    columns = _columns(3, 2, labels, names)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=7.5)
    return figure


@rc_context(STYLE)
def quality_over_size(
    uniform: Mapping[int, float],
    sizes: Sizes,
    plans: Sequence[Plan],
    evaluation: Evaluation,
    quality: QualityKind,
    unit: str = RAW,
    drawn: Mapping[int, np.ndarray] | None = None,
) -> Figure:
    """Quality on unseen views over model size: all categories at one level, and each target's plan.

    `uniform`: mean quality of the whole image by level; `sizes`: bytes of each (label id, level); `drawn`:
    fidelity [V, K] of each label's levels at drawn viewpoints, which adds the lowest category's.
    """
    figure = Figure(figsize=PAIR, layout="constrained")
    axes = figure.subplots()
    size = [sum(n for (_, i), n in sizes.items() if i == level) / MB for level in uniform]
    axes.plot(size, list(uniform.values()), "o-", color=FAINT, ms=4, label="all categories at one level")
    composed: list[tuple[float, float, Plan]] = []
    for plan in plans:
        rows = evaluation.of(plan).of_own_quality()
        whole = rows.ssim[rows.label_id == TOTAL]
        if len(whole) and plan.quality == quality:
            composed.append((sum(map(bytes_of, plan.choices)) / MB, float(np.nanmean(whole)), plan))
    at = [x for x, _, _ in composed]
    axes.plot(at, [y for _, y, _ in composed], "o-", color=ACCENT, ms=6, label="composed by plan")
    if drawn and composed:
        means = {label: np.nanmean(values, 0) for label, values in drawn.items() if np.isfinite(values).any()}
        levels = sorted({level for _, level in sizes})
        lowest = np.min([*means.values()], axis=0)
        axes.plot(size, lowest[[levels.index(level) for level in uniform]], "--", color=FAINT)
        planned = [
            min(means[label][levels.index(level)] for label, level in plan.levels.items() if label in means)
            if plan.cells is None
            else np.nan  # only equal levels of cells were measured there
            for _, _, plan in composed
        ]
        axes.plot(at, planned, "--", color=ACCENT)
        axes.plot([], [], "--", color=INK, label="the same, lowest category")
    for x, y, plan in composed:
        axes.annotate(f"t = {plan.target:g}", (x, y), (7, -11), textcoords="offset points", color=ACCENT)
    of = "against the full model" if quality == "fidelity" else "against photos"
    axes.set(xlabel=unit, ylabel=f"SSIM of the whole image {of}")
    axes.margins(0.08, 0.12)
    axes.legend(loc="lower right")
    return figure


@rc_context(STYLE)
def panel_strip(panel: Panel, colours: Colours) -> Figure:
    """Figs. 4 and 5, side by side: photo, full model, composed scene, label map, its error."""
    pictures = [
        ("photo", panel.photo),
        (f"full model  {panel.full_psnr:.2f} dB / {panel.full_ssim:.3f}", panel.full),
        (f"composed  {panel.psnr:.2f} dB / {panel.ssim:.3f}", panel.composed),
        ("categories", label_image(panel.label_ids, colours)),
        ("error of composed", error_image(panel.composed, panel.photo, panel.valid)),
    ]
    height, width = panel.photo.shape[:2]
    figure = Figure(figsize=(15, 2.96 * height / width + 0.3))
    share = 2.96 * height / width / figure.get_figheight()  # the rest holds the titles
    for column, (title, picture) in enumerate(pictures):
        axes = figure.add_axes((column / 5 + 0.001, 0, 0.198, share))
        axes.imshow(picture, aspect="auto")
        axes.set_title(title, loc="left", pad=4)
        axes.set_axis_off()
    return figure


def save_figure(figure: Figure, path: Path, *, svg: bool = True) -> bytes:
    """Write `path` with the suffixes .png and, with `svg`, .svg; the SVG is also returned, else nothing."""
    buffer = io.BytesIO()
    with rc_context(STYLE), warnings.catch_warnings():
        # the font has no Chinese and no emoji: names in these are boxes here, and text in the tables
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        with atomic_path(path.with_suffix(".png")) as temporary:
            # the strongest compression takes half of the report's time
            figure.savefig(temporary, format="png", dpi=160, pil_kwargs={"compress_level": 2})
        if not svg:
            return b""
        figure.set_layout_engine("none")  # the layout just found also holds for the SVG
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    with atomic_path(path.with_suffix(".svg")) as temporary:
        temporary.write_bytes(buffer.getvalue())
    return buffer.getvalue()
