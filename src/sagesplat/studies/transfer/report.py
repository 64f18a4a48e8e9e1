"""How well the quality models of one run predict another: tables and a figure."""

import math
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sagesplat.core.names import repaired
from sagesplat.output.figures import FAINT, INK, STYLE, panel_grid, shortened
from sagesplat.output.table import Table
from sagesplat.output.tables import mean
from sagesplat.segment.display_names import titles
from sagesplat.studies.transfer.score import (
    NORMALISATIONS,
    PREDICTORS,
    FittedRun,
    Transfer,
    predictors,
    shared_categories,
)

# colour and width: equal curves stay visible, the later ones narrower on top
LINES = {
    "own": (INK, 1.6),
    "raw": ("#5eead4", 4.4),
    "extent": ("#7c3aed", 2.6),
    "footprint": ("#f59e0b", 1.2),
}
AVERAGED = ("ssim_error", "bias", "outside", "iteration_error", "hit", "regret", "regret_share")


def _shown(names: Sequence[str]) -> dict[str, str]:
    """For people, by stored name."""
    stored = list(dict.fromkeys(names))
    return dict(zip(stored, titles(dict(enumerate(stored))).values(), strict=True))


def transfer_table(scores: Transfer) -> Table:
    """Every row of the evaluation."""
    formats = ("", "g", "", "", ",d", ".3f", "+.3f", ".0%", ",d", ",.0f", ".0%", ",d", ",.0f", ".1%")
    columns = {f.name: getattr(scores, f.name).tolist() for f in fields(scores)}
    shown = _shown(columns["category"])
    columns["category"] = [shown[name] for name in columns["category"]]
    return Table(
        "Cross-scene, by category", tuple(columns), formats, list(zip(*columns.values(), strict=True))
    )


def summary_table(scores: Transfer) -> Table:
    """Means over categories and targets (sums for the views missed), by split and predictor."""
    body = []
    for split in ("train", "test"):
        for predictor in PREDICTORS:
            rows = scores.select((scores.split == split) & (scores.predictor == predictor))
            means = [mean(getattr(rows, name)) for name in AVERAGED]
            body.append((split, predictor, *means, int(rows.missed.sum()), int(rows.reachable.sum())))
    formats = ("", "", ".3f", "+.3f", ".0%", ",.0f", ".0%", ",.0f", ".1%", ",d", ",d")
    header = ("split", "predictor", *(name.replace("_", " ") for name in AVERAGED), "missed", "reachable")
    return Table("Cross-scene, mean over categories and targets", header, formats, body)


def headline(summary: Table) -> str:
    """The normalisations by mean SSIM error, the least first, on test views where there are any."""
    errors = {(split, predictor): float(error) for split, predictor, error, *_ in summary.rows}
    split = "train" if math.isnan(errors["test", "own"]) else "test"
    ordered = sorted(NORMALISATIONS, key=lambda n: errors[split, n])
    body = ", ".join(f"{n} {errors[split, n]:.3f}" for n in ordered)
    others = f"without distance {errors[split, 'median']:.3f}, own models {errors[split, 'own']:.3f}"
    return f"SSIM error on {split} views: {body}; {others}"


@rc_context(STYLE)
def transfer_figure(a: FittedRun, b: FittedRun) -> Figure:
    """SSIM over distance at B's last settled level: its views, its own curve, A's under each normalisation.

    A panel per shared category; pale where a distance lies beyond those that a curve was fitted to.
    """
    found = shared_categories(a, b)
    shown = _shown([shared.name for shared in found])
    columns = min(3, math.ceil(math.sqrt(len(found))))
    figure, grid = panel_grid(len(found), columns, (3.6, 2.6), 0.4 + 1.4 / columns)
    rows = b.observations.select(np.isfinite(b.observations.distance))
    for axes, shared in zip(grid, found, strict=True):
        mine = rows.select((rows.label_id == shared.label_b) & (rows.level == shared.levels[-1]))
        test = np.isin(mine.view, b.test_views)
        axes.plot(mine.distance[~test], mine.ssim[~test], ".", color=FAINT, ms=4, alpha=0.6, mew=0)
        axes.plot(mine.distance[test], mine.ssim[test], "o", mfc="none", mec=FAINT, ms=4, mew=0.8)
        axes.set_title(shortened(shown[shared.name]), loc="left", fontweight="bold")
        if not len(mine):
            continue
        distance = np.linspace(mine.distance.min(), mine.distance.max(), 300)
        focal = np.full(len(distance), np.median(b.focals[b.train_views]))
        curves = predictors(a, b, shared, focal)
        for predictor in (*NORMALISATIONS, "own"):  # B's own on top
            models, scale = curves[predictor]
            model, d = models[-1], distance * scale
            fitted = (d >= model.d_range[0]) & (d <= model.d_range[1])
            colour, width = LINES[predictor]
            for part, alpha in ((fitted, 1.0), (~fitted, 0.3)):
                ssim = np.where(part, model(d), np.nan)
                axes.plot(distance, ssim, color=colour, lw=width, alpha=alpha, solid_capstyle="butt")
    of_a, of_b = (shortened(repaired(Path(run.name).resolve().name, "run")) for run in (a, b))
    figure.supxlabel(f"distance to the category in {of_b} (world units)", fontsize=9)
    figure.supylabel("SSIM", fontsize=9)
    says = {"own": f"model of {of_b}", **{n: f"model of {of_a}, {n}" for n in NORMALISATIONS}}
    handles = [
        Line2D([], [], color=FAINT, marker=".", ls="", label=f"{of_b}, training views"),
        Line2D([], [], color=FAINT, marker="o", mfc="none", ls="", ms=4, label=f"{of_b}, test views"),
        *(Line2D([], [], color=c, lw=w, label=says[name]) for name, (c, w) in LINES.items()),
        Line2D([], [], color=INK, lw=1.6, alpha=0.3, label="beyond the fitted distances"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=columns)
    return figure
