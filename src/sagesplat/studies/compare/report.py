"""Nested levels beside their baselines: what was measured, what is saved at equal quality, and a walk."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator

from sagesplat.core.gaussians import BYTES_PER_GAUSSIAN
from sagesplat.core.limits import Count, NumberOrNaN
from sagesplat.io.files import write_json, write_text
from sagesplat.io.typed import read_json_as
from sagesplat.output.figures import ACCENT, FAINT, INK, STYLE, caption, panel_grid, save_figure
from sagesplat.output.table import Table
from sagesplat.output.tables import MB

SNAPSHOTS, SAGE, PRUNED, MCMC = "3DGS, snapshots", "SAGE", "3DGS, pruned and tuned", "3DGS-MCMC"
SAME_SHARE, PLANNED = "nested, same share", "nested, planned"
OURS = (SAME_SHARE, PLANNED)
LINES = {  # colour and marker by method
    SNAPSHOTS: (FAINT, "o"), SAGE: (INK, "s"), PRUNED: ("#0f766e", "^"), MCMC: ("#7c3aed", "v"),
    SAME_SHARE: ("#f5b183", "."), PLANNED: (ACCENT, "o"),
}  # fmt: skip
MEASURES = {"ssim": "SSIM", "psnr": "PSNR (dB)", "lpips_alex": "LPIPS (alex)", "lpips_vgg": "LPIPS (vgg)"}
# the same, colour-corrected: measured where photos have an exposure of their own
MEASURES |= {f"cc_{name}": f"cc_{title}" for name, title in MEASURES.items()}
FILE, PAGE = "compare.json", "compare.md"
_MB = "raw MB: 248 bytes a Gaussian; MB: encoded, all with the same settings."
_HOW = (
    "between: interpolated between two neighbouring points of our curve, SSIM over log bytes; smallest: our "
    "smallest set is better already; dash: our curve does not reach that SSIM."
)
# columns that a terminal has room for, by table
CONSOLE = {
    "table_1_targets": (
        "target", "SSIM", "SAGE raw MB", "our raw MB", "our MB", "raw : raw", "encoded : raw"
    ),
    "table_2_baselines": ("method", "which", "as sent", "MB", "our MB", "MB : MB"),
    "table_3_mcmc": ("cap", "Gaussians", "PSNR", "ours", "our PSNR", "difference", "at equal count"),
    "table_4_walk": ("method", "keeps", "first MB", "later MB", "again MB", "replaced MB", "changes"),
}  # fmt: skip
_PANELS = 12  # categories in a figure, the largest ones
Size = Literal["raw", "encoded"]


@dataclass(frozen=True)
class OfLabel:
    """One category of a point."""

    count: Count
    encoded: Count  # bytes
    ssim: NumberOrNaN  # mean over the test views that show it; NaN: none does


@dataclass(frozen=True)
class Point:
    """A set of Gaussians, measured on the test views."""

    method: str
    name: str
    target: NumberOrNaN  # SSIM that it was planned for; NaN: none
    budget: NumberOrNaN  # bytes that it was planned for; NaN: none
    count: Count
    encoded: Count  # bytes of its files
    steps: Count  # training steps that it took, from the start
    ssim: NumberOrNaN
    ssim_sent: NumberOrNaN  # of what a viewer decodes from the files
    psnr: NumberOrNaN  # dB
    lpips_alex: NumberOrNaN  # NaN where it could not be measured
    lpips_vgg: NumberOrNaN
    cc_ssim: NumberOrNaN = math.nan  # colour-corrected, as gsplat; NaN where no photo has an exposure
    cc_psnr: NumberOrNaN = math.nan
    cc_lpips_alex: NumberOrNaN = math.nan
    cc_lpips_vgg: NumberOrNaN = math.nan
    labels: dict[int, OfLabel] = field(default_factory=dict)

    @property
    def raw(self) -> int:
        """Bytes as the paper counts model size: 248 a Gaussian."""
        return self.count * BYTES_PER_GAUSSIAN


@dataclass(frozen=True)
class Walk:
    """What a viewer is sent who goes from view to view, in bytes."""

    method: str
    keeps: bool  # what it was sent once; else it has only what the present view needs
    first: Count  # for the first view
    later: Count  # for all others
    again: Count  # of the later ones, those of files that had been sent before
    replaced: Count  # of files that the viewer held and that a higher level made useless
    changes: Count  # of a category's level
    upgrades: Count  # of these, to a higher one


class Least(NamedTuple):
    """Where a curve reaches a quality."""

    nbytes: float  # NaN: it does not
    how: str = ""  # "between": interpolated between two points; "smallest": the first point is better still


def write_comparison(path: Path, points: Sequence[Point], walks: Sequence[Walk], **more: Any) -> None:
    """compare.json; NaN becomes null, which JSON has."""
    rows = []
    for point in points:
        labels = {str(label): _plain(vars(of)) for label, of in point.labels.items()}
        rows.append({**_plain(vars(point)), "raw": point.raw, "labels": labels})
    write_json(path, {**more, "points": rows, "walks": [asdict(walk) for walk in walks]})


@dataclass(frozen=True)
class _Comparison:
    points: list[Point]
    walks: list[Walk]


def read_comparison(path: Path) -> tuple[list[Point], list[Walk]]:
    """What `write_comparison` wrote; DataError for anything else."""
    made = read_json_as(path, _Comparison, "a comparison", "delete it and compare again")
    return made.points, made.walks


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: None if isinstance(v, float) and math.isnan(v) else v for name, v in values.items()}


def least(points: Sequence[Point], ssim: float, size: Size) -> Least:
    """The least bytes at which a curve through the points has at least this SSIM.

    Between neighbours SSIM is linear in the logarithm of the bytes. Points that are no better than a smaller
    one are left out. Nothing is extrapolated: below the smallest point it is the smallest point.
    """
    front: list[Point] = []
    for point in sorted(points, key=lambda p: (getattr(p, size), -p.ssim)):
        if not front or point.ssim > front[-1].ssim:
            front.append(point)
    at = next((i for i, point in enumerate(front) if point.ssim >= ssim), None)
    if at is None:
        return Least(math.nan)
    high = getattr(front[at], size)
    if front[at].ssim == ssim:
        return Least(float(high))
    if at == 0:
        return Least(float(high), "smallest")
    low, below = getattr(front[at - 1], size), front[at - 1].ssim
    share = (ssim - below) / (front[at].ssim - below)
    return Least(math.exp((1 - share) * math.log(low) + share * math.log(high)), "between")


def walk(
    method: str,
    levels: Sequence[Mapping[int, int]],
    files: Mapping[tuple[int, int], Mapping[str, int]],
    keeps: bool,
) -> Walk:
    """Sum up a walk: `levels` of each category by position, bytes of the `files` of (label id, level).

    A file is sent where a position needs it and the viewer does not have it.
    """
    first = later = again = replaced = changes = upgrades = 0
    held: set[str] = set()
    seen: set[str] = set()
    for position, at in enumerate(levels):
        needed = {uri: n for wanted in at.items() for uri, n in files[wanted].items()}
        sent = {uri: n for uri, n in needed.items() if uri not in held}
        if position == 0:
            first = sum(sent.values())
        else:
            later += sum(sent.values())
            again += sum(n for uri, n in sent.items() if uri in seen)
            for label, old in levels[position - 1].items():
                old_files, new_files = files[label, old], files[label, at[label]]
                changes += old_files.keys() != new_files.keys()
                if at[label] > old and old_files.keys() != new_files.keys():
                    upgrades += 1
                    replaced += sum(n for uri, n in old_files.items() if uri not in new_files)
        held = held | set(needed) if keeps else set(needed)
        seen |= set(needed)
    return Walk(method, keeps, first, later, again, replaced, changes, upgrades)


def targets_table(points: Sequence[Point]) -> Table:
    """The bar: what SAGE's compositions reach, and the least bytes of ours that reach it too."""
    ours, body, marks = _of(points, *OURS), [], {}
    for point in sorted(_of(points, SAGE), key=lambda p: p.target):
        raw, encoded = least(ours, point.ssim, "raw"), least(ours, point.ssim, "encoded")
        marks |= {(len(body), 3 + i): found.how for i, found in enumerate((raw, encoded)) if found.how}
        body.append(
            (point.target, point.ssim, point.raw / MB, raw.nbytes / MB, encoded.nbytes / MB,
             raw.nbytes / max(point.raw, 1), encoded.nbytes / max(point.raw, 1))
        )  # fmt: skip
    return Table(
        "Bytes at the SSIM of SAGE's compositions on test views, ours interpolated",
        ("target", "SSIM", "SAGE raw MB", "our raw MB", "our MB", "raw : raw", "encoded : raw"),
        ("g", ".4f", ".3f", ".3f", ".3f", ".3f", ".3f"), body,
        marks=marks, notes=("Ours is measured as it is sent, SAGE before any encoding.", _MB, _HOW),
    )  # fmt: skip


def baselines_table(points: Sequence[Point]) -> Table:
    """Every baseline beside ours at equal SSIM: raw bytes as it was trained, encoded ones as it is sent."""
    ours, body, marks = _of(points, *OURS), [], {}
    ratios: dict[str, float] = {}
    for point in _of(points, SNAPSHOTS, SAGE, PRUNED, MCMC):
        raw, encoded = least(ours, point.ssim, "raw"), least(ours, point.ssim_sent, "encoded")
        marks |= {(len(body), 7 + i): found.how for i, found in enumerate((raw, encoded)) if found.how}
        ratio = encoded.nbytes / max(point.encoded, 1)
        ratios[f"{point.method} ({point.name})"] = ratio
        body.append(
            (point.method, point.name, point.count, point.ssim, point.ssim_sent, point.raw / MB,
             point.encoded / MB, raw.nbytes / MB, encoded.nbytes / MB, raw.nbytes / max(point.raw, 1), ratio)
        )  # fmt: skip
    header = ("method", "which", "Gaussians", "SSIM", "as sent", "raw MB", "MB", "our raw MB", "our MB")
    return Table(
        "Ours at the SSIM of each baseline on test views, interpolated",
        (*header, "raw : raw", "MB : MB"), ("", "", ",d", ".4f", ".4f", *[".3f"] * 6), body,
        marks=marks, notes=(*_verdict(ratios), _MB, _HOW),
    )  # fmt: skip


def _verdict(ratios: Mapping[str, float]) -> list[str]:
    """The baseline that ours does worst against, and those that it does not reach."""
    reached = {who: ratio for who, ratio in ratios.items() if not math.isnan(ratio)}
    lines = []
    if reached:
        worst = max(reached, key=lambda who: reached[who])
        lines.append(f"Worst at equal SSIM: {reached[worst]:.3f} of the encoded bytes of {worst}.")
    if len(reached) < len(ratios):
        others = "; ".join(who for who in ratios if who not in reached)
        lines.append(f"Ours as it is sent does not reach the SSIM of: {others}.")
    return lines


def mcmc_table(points: Sequence[Point]) -> Table:
    """Our prefixes beside 3DGS-MCMC trained at the same count."""
    prefixes = sorted(_of(points, SAME_SHARE), key=lambda p: p.count)
    full, body = prefixes[-1].count, []
    logs = np.log([p.count for p in prefixes])
    for point in sorted(_of(points, MCMC), key=lambda p: p.count):
        near = min(prefixes, key=lambda p: abs(math.log(p.count / point.count)))
        psnr = np.interp(math.log(point.count), logs, [p.psnr for p in prefixes], left=np.nan, right=np.nan)
        body.append(
            (point.name, point.count, point.psnr, near.name, near.count, near.psnr, near.psnr - point.psnr,
             float(psnr) - point.psnr)
        )  # fmt: skip
    tenth = min(range(len(body)), key=lambda i: abs(math.log(body[i][1] / (0.1 * full))), default=None)
    return Table(
        "Our prefixes beside 3DGS-MCMC of the same size, test views",
        ("cap", "Gaussians", "PSNR", "prefix", "ours", "our PSNR", "difference", "at equal count"),
        ("", ",d", ".2f", "", ",d", ".2f", "+.2f", "+.2f"), body,
        marks={} if tenth is None else {(tenth, 6): "a tenth"},
        notes=("at equal count: interpolated between two neighbouring prefixes, PSNR over the log count.",),
    )  # fmt: skip


def walk_table(walks: Sequence[Walk], target: float) -> Table:
    """Bytes along a walk."""
    body = []
    for w in walks:
        sizes = (w.first, w.later, w.again, w.replaced, w.first + w.later)
        kept = "all that was sent" if w.keeps else "what is needed"
        body.append((w.method, kept, *(n / MB for n in sizes), w.changes, w.upgrades))
    header = ("method", "keeps", "first MB", "later MB", "again MB", "replaced MB", "all MB")
    return Table(
        f"A walk along all views by name, each planned by itself for SSIM {target:g}, encoded",
        (*header, "changes", "upgrades"), ("", "", *[".3f"] * 5, ",d", ",d"), body,
        notes=(
            "again: sent later though it had been sent before; replaced: what the viewer held of a category "
            "and a higher level made useless, 0 where levels contain each other.",
        ),
    )  # fmt: skip


def points_table(points: Sequence[Point]) -> Table:
    """Everything that was measured."""
    cc = [name for name in MEASURES if name.startswith("cc_") and _measured(points, name)]
    others = ["lpips_alex", "lpips_vgg", *cc]
    body = [
        (p.method, p.name, p.count, p.raw / MB, p.encoded / MB, p.steps, p.ssim, p.ssim_sent, p.psnr,
         *(getattr(p, name) for name in others))
        for p in points
    ]  # fmt: skip
    header = ("method", "which", "Gaussians", "raw MB", "MB", "steps", "SSIM", "as sent", "PSNR")
    formats = ("", "", ",d", ".3f", ".3f", ",d", ".4f", ".4f", ".2f", ".4f", ".4f")
    formats += tuple(".2f" if name == "cc_psnr" else ".4f" for name in cc)
    return Table("All sets, test views", (*header, "LPIPS alex", "LPIPS vgg", *cc), formats, body)


def _measured(points: Sequence[Point], name: str) -> bool:
    return any(np.isfinite(getattr(p, name)) for p in points)


@rc_context(STYLE)
def curves(points: Sequence[Point]) -> Figure:
    """Quality over count and over encoded bytes, a line per method."""
    measures = [name for name in MEASURES if _measured(points, name)]
    figure = Figure(figsize=(3.9 * len(measures) + 0.4, 6.6), layout="constrained")
    grid = figure.subplots(2, len(measures), squeeze=False)
    for line, (size, scale, label) in enumerate((("count", 1, "Gaussians"), ("encoded", MB, "MB encoded"))):
        for axes, name in zip(grid[line], measures, strict=True):
            for method in LINES:
                value = "ssim_sent" if (size, name) == ("encoded", "ssim") else name
                mine = _of(points, method)
                _line(axes, method, [(p, getattr(p, size) / scale, getattr(p, value)) for p in mine])
            _sizes(axes)
            axes.set(xlabel=label, ylabel=MEASURES[name])
    _legend(figure, points, tuple(LINES))
    return figure


@rc_context(STYLE)
def label_curves(points: Sequence[Point], names: Mapping[int, str]) -> Figure:
    """SSIM of each category over its own encoded bytes, a panel each, the largest first."""
    methods = (PLANNED, SAGE, PRUNED)
    shown = _of(points, *methods)
    largest: dict[int, int] = {}
    for label, of in (item for p in shown for item in p.labels.items()):
        if np.isfinite(of.ssim):
            largest[label] = max(of.encoded, largest.get(label, 0))
    labels = sorted(largest, key=lambda label: (-largest[label], label))[:_PANELS]
    figure, grid = panel_grid(len(labels), max(1, min(4, len(labels))), (3.1, 2.4), 0.5)
    for axes, label in zip(grid, labels, strict=True):
        for method in methods:
            own = [(p, p.labels[label]) for p in _of(points, method) if label in p.labels]
            _line(axes, method, [(p, of.encoded / MB, of.ssim) for p, of in own])
        _sizes(axes)
        axes.set_title(caption(label, names), loc="left", fontweight="bold")
    figure.supxlabel("MB of the category, encoded", fontsize=9)
    figure.supylabel("SSIM of the category, test views", fontsize=9)
    _legend(figure, points, methods)
    return figure


def make_tables(points: Sequence[Point], walks: Sequence[Walk], target: float) -> dict[str, Table]:
    """All tables by file name; `target` is the one that the walk was planned for."""
    return {
        "table_1_targets": targets_table(points),
        "table_2_baselines": baselines_table(points),
        "table_3_mcmc": mcmc_table(points),
        "table_4_walk": walk_table(walks, target),
        "points": points_table(points),
    }


def write_report(
    folder: Path, tables: Mapping[str, Table], points: Sequence[Point], names: Mapping[int, str]
) -> None:
    """The tables, the figures, and compare.md that shows them."""
    page = ["# The nested ladder beside its baselines", ""]
    for stem, figure in (("curves", curves(points)), ("labels", label_curves(points, names))):
        save_figure(figure, folder / stem)
        page += [f"![{stem}]({stem}.png)", ""]
    for stem, table in tables.items():
        table.write(folder / stem)
        page += [f"## {table.title}", "", table.markdown()]
    write_text(folder / PAGE, "\n".join(page))


def _of(points: Sequence[Point], *methods: str) -> list[Point]:
    """Points of some methods, in the order of the methods."""
    return [point for method in methods for point in points if point.method == method]


def _line(axes: Any, method: str, points: Sequence[tuple[Point, float, float]]) -> None:
    """A method's (point, size, quality): a line, but plans for a target beside it, as they are no series."""
    colour, marker = LINES[method]
    front = 3 if method in OURS else 2
    known = sorted((x, y, p.target) for p, x, y in points if x > 0 and math.isfinite(y))
    series = [(x, y) for x, y, target in known if method != PLANNED or math.isnan(target)]
    axes.plot(*np.array(series).reshape(-1, 2).T, marker=marker, color=colour, ms=4.5, lw=1.4, zorder=front)
    if method == PLANNED:
        others = [(x, y) for x, y, target in known if not math.isnan(target)]
        axes.plot(*np.array(others).reshape(-1, 2).T, "D", mfc="white", mec=colour, ms=4.5, zorder=front)


def _sizes(axes: Any) -> None:
    """A logarithmic axis with numbers that people read, rather than powers of ten."""
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}" if value < 1e4 else f"{value / 1e3:g}k")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.tick_params("x", labelsize=8)


def _legend(figure: Figure, points: Sequence[Point], methods: Sequence[str]) -> None:
    there = {p.method for p in points}
    handles = [
        Line2D([], [], color=LINES[m][0], marker=LINES[m][1], ms=4.5, label=m) for m in methods if m in there
    ]
    if PLANNED in there:
        label = f"{PLANNED} for a target"
        handles.append(
            Line2D([], [], marker="D", ls="", mfc="white", mec=LINES[PLANNED][0], ms=4.5, label=label)
        )
    columns = max(1, min(len(handles), int(figure.get_figwidth() / 2.1)))
    figure.legend(handles=handles, loc="outside upper center", ncols=columns)
