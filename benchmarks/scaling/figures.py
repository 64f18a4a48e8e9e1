"""The figures of docs/scaling.md."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from benchmarks.scaling.visits import KINDS, Library
from sagesplat.output.figures import INK, STYLE

GREEN, AMBER, RED, BLUE = "#2f6f56", "#d6a10b", "#c2410c", "#3b6ea8"
SHADES = {"viewer": "#b9c2cf", "manifest": INK, "promises": BLUE, "pack": GREEN, "chunk": AMBER}
Row = Mapping[str, Any]


@rc_context(STYLE)
def visits(libraries: Mapping[str, Library]) -> Figure:
    """Bytes of a visit with an empty cache by kind of file, a panel for each library."""
    figure = Figure(figsize=(11, 2.9), layout="constrained")
    panels = np.atleast_1d(np.array(figure.subplots(1, len(libraries), sharey=True)))
    for axes, (title, library) in zip(panels, libraries.items(), strict=True):
        table = library.per_visit().mean(0) / 1e6
        means = np.stack([table[library.profile == p].mean(0) for p in range(len(library.profiles))])
        left = np.zeros(len(means))
        for kind, share in zip(KINDS, means.T, strict=True):
            axes.barh(library.profiles, share, left=left, height=0.62, color=SHADES[kind], label=kind)
            left += share
        axes.set(title=title, xlabel="MB", xlim=(0, None))
        axes.grid(visible=False, axis="y")
        axes.invert_yaxis() if axes is panels[0] else None
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(KINDS))
    return figure


@rc_context(STYLE)
def hits(days: Sequence[Row], sweeps: Mapping[str, Sequence[Row]]) -> Figure:
    """Hit rates and the origin's load by viewers; hit rates by size of a cache, with the closed form."""
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    rates, load, sizes = figure.subplots(1, 3)
    viewers = [row["viewers"] for row in days]
    for name, label, colour in (
        ("pop_hits_bytes", "point of presence, bytes", GREEN),
        ("pop_hits", "point of presence, requests", AMBER),
        ("browser_hits_bytes", "browser, bytes", BLUE),
    ):
        rates.semilogx(viewers, [100 * row[name] for row in days], "o-", ms=4, color=colour, label=label)
    predicted = [100 * row["che_bytes"] for row in days]
    rates.semilogx(viewers, predicted, "--", color=INK, lw=1, label="closed form, bytes")
    rates.set(xlabel="viewers a day", ylabel="answered there (%)", ylim=(0, 102))
    rates.legend(loc="lower right", bbox_to_anchor=(1.0, 0.14))
    load.loglog(viewers, [row["peak_requests_per_s"] for row in days], "o-", ms=4, color=GREEN, label="CDN")
    asked = [row["peak_origin_requests_per_s"] for row in days]
    load.loglog(viewers, asked, "o-", ms=4, color=RED, label="origin, as served (no-cache)")
    fresh = [row["fresh_peak_origin_requests_per_s"] for row in days]
    load.loglog(viewers, fresh, "o-", ms=4, color=BLUE, label="origin, 60 s fresh at the edge")
    load.set(xlabel="viewers a day", ylabel="requests/s in the busiest minute")
    load.legend()
    for (name, rows), colour in zip(sweeps.items(), (AMBER, GREEN, BLUE), strict=False):
        gb = [row["pop_bytes"] / 1e9 for row in rows]
        sizes.semilogx(gb, [100 * row["pop_hits_bytes"] for row in rows], "o", ms=4, color=colour, label=name)
        sizes.semilogx(gb, [100 * row["che_bytes"] for row in rows], "--", lw=1, color=colour)
    sizes.set(xlabel="cache of a point of presence (GB)", ylabel="bytes answered there (%)", ylim=(0, 102))
    sizes.legend(loc="upper left", title="dashed: closed form", title_fontsize=8)
    sizes.xaxis.set_major_formatter("{x:g}")
    _plain(load.yaxis)
    return figure


def _plain(axis: Axis) -> None:
    """Numbers of a logarithmic axis as they are, none between powers of ten."""
    axis.set_major_formatter("{x:,g}")
    axis.set_minor_formatter(NullFormatter())
