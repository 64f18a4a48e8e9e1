"""The tables and figures of the paper, from a finished run: CSV, Markdown, LaTeX, PNG and SVG."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from matplotlib import rc_context
from matplotlib.figure import Figure

from sagesplat.adapt.eq3 import SsimModel
from sagesplat.adapt.observe import TOTAL, Observations, as_unit, render_rgb
from sagesplat.adapt.plan import Counts, Plan
from sagesplat.core.gaussians import BYTES_PER_GAUSSIAN, Gaussians
from sagesplat.io.files import write_text
from sagesplat.metrics.image import psnr, squared_error_map
from sagesplat.metrics.lpips import Lpips
from sagesplat.output import figures
from sagesplat.output.figures import STYLE, Colours
from sagesplat.output.report import template
from sagesplat.output.table import Table, markdown_text
from sagesplat.output.tables import MB, by_size, last_counts, mean, name_of, promise_kept, view_mean
from sagesplat.run.job import Job
from sagesplat.studies.paper.cross_view import NONE, CrossView
from sagesplat.studies.paper.same_size import FULL, METHODS, SameSize

ITERATIONS = (1 / 6, 1 / 3, 1 / 2, 1.0)  # of the run: the paper's 5000, 10 000, 15 000 and 30 000

_KINDS = ("constant", "one regime", "two regimes")  # of models


@dataclass(frozen=True, eq=False)
class Picture:
    """One image of a panel, with its quality."""

    title: str
    rgb: UInt8[np.ndarray, "H W 3"]
    psnr: float  # dB; NaN for the photo
    lpips: float  # Alex; NaN where not measured


@dataclass(frozen=True, eq=False)
class PaperData:
    """Everything that the paper's tables and figures show. Views are rows of `view_names`."""

    title: str
    names: Mapping[int, str]  # label id -> name
    colours: Colours
    observations: Observations
    fitted: Observations  # those of views that show enough of a category, as models are fitted to
    train_views: np.ndarray
    test_views: np.ndarray
    view_names: Sequence[str]
    counts: Counts
    recovering: frozenset[int]
    models: Mapping[tuple[int, int], SsimModel]
    iterations: Sequence[int]  # the four levels that Tables I to III and Fig. 3 show
    view: int  # the view of Table III and Fig. 4
    distances: Mapping[str, Mapping[int, float]]  # "min", "5 %", "mean" -> label id -> world units, in `view`
    view_plans: Sequence[Plan]  # for `view`, one per target, from `iterations` alone
    cross_view: CrossView
    same_size: SameSize
    panels: Mapping[str, Sequence[Picture]]  # view name -> photo, 3DGS, one per target


def four_levels(levels: Sequence[int]) -> list[int]:
    """The levels nearest to the shares of a run at which the paper's tables look."""
    return sorted({min(levels, key=lambda level: abs(level - share * levels[-1])) for share in ITERATIONS})


def write_paper(folder: Path, data: PaperData) -> Path:
    """Write every table and figure into `folder`, with index.html (its path comes back) and paper.md."""
    labels = by_size(data.counts)
    tables = list(_tables(data, labels))
    for name, table in tables:
        table.write(folder / name)
    pictures = []
    for name, title, figure in _figures(data, labels):
        figures.save_figure(figure, folder / name)
        pictures.append((name, title))
    title = f"{data.title}: tables and figures of the paper"
    shown = [(markdown_text(table.title), table) for _, table in tables]
    parts = [f"# {markdown_text(title)}\n", *(f"## {title}\n\n{table.markdown()}" for title, table in shown)]
    captions = [(name, markdown_text(caption)) for name, caption in pictures]
    parts += [f"## {caption}\n\n![{caption}]({name}.png)\n" for name, caption in captions]
    write_text(folder / "paper.md", "\n".join(parts))
    page = template(Path(__file__).with_name("paper.html.j2")).render(
        title=title, tables=tables, pictures=pictures
    )
    write_text(folder / "index.html", page)
    return folder / "index.html"


def _tables(data: PaperData, labels: Sequence[int]):
    for which, views in (("training", data.train_views), ("test", data.test_views)):
        if len(views):
            yield f"table_1_{which}", quality_and_counts(data, labels, views, which)
    yield "table_3_view", one_view(data, labels)
    yield "table_4_view", equal_size(data.same_size, data.view, data.view_names[data.view])
    if len(data.test_views):
        yield "table_4_test", equal_size(data.same_size, NONE, "mean of the test views")
        yield "cross_view", cross_view_table(data.cross_view, labels, data.names, data.counts)
    if data.models:
        yield "equation_3", curves_and_constants(data, labels)


def _figures(data: PaperData, labels: Sequence[int]):
    named, seen = (labels, data.names, data.colours), data.observations
    over_levels = figures.ssim_over_levels(seen, data.train_views, data.test_views, *named, data.recovering)
    over_distance = figures.ssim_over_distance(seen, data.train_views, *named, data.models, data.iterations)
    yield "figure_2", "Fig. 2: SSIM over iterations", over_levels
    yield "figure_3", "Fig. 3: SSIM over distance", over_distance
    for number, (name, pictures) in enumerate(data.panels.items(), 4):
        yield f"figure_{number}", f"Figs. 4, 5: view {name}", panel(pictures)


def quality_and_counts(data: PaperData, labels: Sequence[int], views: np.ndarray, which: str) -> Table:
    """Tables I and II: SSIM averaged over views, and Gaussians, per label at four iterations."""
    rows = data.observations.select(np.isin(data.observations.view, views))
    body = []
    for label in [*labels, TOTAL]:
        cells: list[str | int | float] = [name_of(label, data.names)]
        for level in data.iterations:
            here = [n for (i, at), n in data.counts.items() if at == level and label in (TOTAL, i)]
            cells += [view_mean(rows, label, level), sum(here)]
        body.append(tuple(cells))
    return Table(
        f"Tables I, II: SSIM and Gaussians over iterations, {len(views)} {which} views",
        ("category", *("SSIM", "Gaussians") * len(data.iterations)),
        ("", *(".3f", "k") * len(data.iterations)),
        body,
        groups=tuple((f"{level:,}", 2) for level in data.iterations),
        notes=_recovering(data),
    )


def _recovering(data: PaperData) -> tuple[str, ...]:
    late = [f"{level:,}" for level in data.iterations if level in data.recovering]
    return (f"Recovering from an opacity reset: {', '.join(late)}.",) if late else ()


def curves_and_constants(data: PaperData, labels: Sequence[int]) -> Table:
    """What distance explains: the error of Eq. 3 beside that of the median of the training views."""
    rows = data.fitted.select(~np.isin(data.fitted.level, list(data.recovering)))
    body = []
    for label in labels:
        errors: dict[tuple[str, str], list[np.ndarray]] = {}
        models = [m for (i, level), m in data.models.items() if i == label and level not in data.recovering]
        for model in models:
            here = rows.select((rows.label_id == label) & (rows.level == model.level))
            for split, views in (("train", data.train_views), ("test", data.test_views)):
                at = here.select(np.isin(here.view, views) & np.isfinite(here.ssim))
                errors.setdefault((split, "constant"), []).append(np.abs(at.ssim - model.median))
                errors.setdefault((split, "Eq. 3"), []).append(np.abs(at.ssim - model(at.distance)))
        if not models:
            continue
        means = [
            mean(np.concatenate(errors[split, name]))
            for split in ("train", "test")
            for name in ("constant", "Eq. 3")
        ]
        statuses = [model.status for model in models]
        body.append((name_of(label, data.names), *means, *map(statuses.count, _KINDS)))
    return Table(
        "Eq. 3 beside a constant: mean error of SSIM over all settled levels",
        ("category", *("constant", "Eq. 3") * 2, *_KINDS),
        ("", *[".3f"] * 4, *["d"] * 3),
        body,
        groups=(("training views", 2), ("test views", 2), ("models by kind", 3)),
    )


def one_view(data: PaperData, labels: Sequence[int]) -> Table:
    """Table III: distances, SSIM at each iteration, counts and sizes for 3DGS and each target, in a view.

    An SSIM carries the targets for which its iteration was selected.
    """
    rows = data.observations.select(data.observations.view == data.view)
    full = last_counts(data.counts)
    plans = [{c.label_id: c for c in plan.choices} for plan in data.view_plans]
    targets = [f"t={plan.target:g}" for plan in data.view_plans]
    columns = len(data.distances), len(data.iterations)
    body, marks = [], {}
    for label in labels:
        counts = [full[label], *(plan[label].count for plan in plans)]
        cells = [data.distances[name].get(label, np.nan) for name in data.distances]
        cells += [view_mean(rows, label, level) for level in data.iterations]
        cells += [*counts, *(n * BYTES_PER_GAUSSIAN / MB for n in counts)]
        for i, level in enumerate(data.iterations):
            chosen = [f"{p.target:g}" for p in data.view_plans if p.levels[label] == level]
            if chosen:
                marks[len(body), 1 + columns[0] + i] = ", ".join(chosen)
        body.append((name_of(label, data.names), *cells))
    totals = [sum(full.values()), *(plan.count for plan in data.view_plans)]
    whole = [view_mean(rows, TOTAL, level) for level in data.iterations]
    nbytes = [n * BYTES_PER_GAUSSIAN / MB for n in totals]
    body.append((name_of(TOTAL, data.names), *[np.nan] * columns[0], *whole, *totals, *nbytes))
    out = [
        f"t={plan.target:g}: {', '.join(name_of(label, data.names) for label in plan.infeasible)}"
        for plan in data.view_plans
        if plan.infeasible
    ]
    notes = (
        "A marked SSIM is of the level selected for the targets named; selected by the models fitted on the "
        "training views, measured in this view.",
    )
    notes += (f"Out of reach, best taken: {'; '.join(out)}.",) if out else ()
    return Table(
        f"Table III: view {data.view_names[data.view]}",
        ("category", *data.distances, *(f"{i:,}" for i in data.iterations), *("3DGS", *targets) * 2),
        ("", *[".3f"] * sum(columns), *[",d"] * (1 + len(plans)), *[".2f"] * (1 + len(plans))),
        body,
        groups=(
            ("distance", columns[0]),
            ("SSIM at", columns[1]),
            ("Gaussians", 1 + len(plans)),
            ("MB", 1 + len(plans)),
        ),
        marks=marks,
        notes=notes + _recovering(data),
    )


def equal_size(same_size: SameSize, of_view: int, where: str) -> Table:
    """Table IV: compositions and 3DGS of the same size; `of_view` as in `SameSize`."""
    rows = same_size.select(same_size.of_view == of_view)
    body, best = [], {}
    quality = {"ssim": 1, "psnr": 1, "lpips_alex": -1, "lpips_vgg": -1}  # larger or smaller is better
    for target in sorted(t for t in np.unique(rows.target) if not np.isnan(t)):
        first = len(body)
        for method in range(FULL):
            here = rows.select((rows.target == target) & (rows.method == method))
            values = [mean(getattr(here, name)) for name in quality]
            megabytes = mean(here.count.astype(float)) * BYTES_PER_GAUSSIAN / MB
            body.append((f"t={target:g}", METHODS[method], megabytes, *values))
        for column, sign in enumerate(quality.values(), 3):
            scores = [sign * float(row[column]) for row in body[first:]]
            if not np.isnan(scores).all():
                best[first + int(np.nanargmax(scores)), column] = "best"
    here = rows.select(rows.method == FULL)
    values = [mean(getattr(here, name)) for name in quality]
    megabytes = mean(here.count.astype(float)) * BYTES_PER_GAUSSIAN / MB
    body.append(("", METHODS[FULL], megabytes, *values))
    notes = (
        "LPIPS (VGG) is fed images in [0, 1], as the evaluation of 3DGS feeds it; Alex as its authors do.",
    )
    if np.isnan(rows.lpips_alex).all() or np.isnan(rows.lpips_vgg).all():
        notes += ("LPIPS not measured: no weights; run `sagesplat download lpips` and report again.",)
    return Table(
        f"Table IV: quality at equal model size, {where}",
        ("size of", "method", "MB", "SSIM", "PSNR", "LPIPS (Alex)", "LPIPS (VGG)"),
        ("", "", ".2f", ".3f", ".2f", ".3f", ".3f"),
        body,
        marks=best,
        notes=notes,
    )


def cross_view_table(
    table: CrossView, labels: Sequence[int], names: Mapping[int, str], counts: Counts
) -> Table:
    """Cross-view: promise, measurement, error of the prediction and regret per target and category."""
    full, body = last_counts(counts), []
    for target in np.unique(table.target):
        here = table.select(table.target == target)
        groups = [(name_of(i, names), here.select(here.label_id == i), full[i]) for i in labels]
        groups += [("all categories", here.select(here.label_id != TOTAL), 0)]
        groups += [(name_of(TOTAL, names), here.select(here.label_id == TOTAL), 0)]
        for name, rows, size in groups:
            if not len(rows):
                continue
            fared = promise_kept(rows)
            regret = mean(rows.regret) if size else np.nan
            body.append((
                f"{target:g}", name, len(rows),
                fared.promised, fared.kept, int((rows.ssim >= target).sum()),
                mean(rows.predicted), mean(rows.level_ssim), mean(rows.ssim), mean(rows.full_ssim),
                mean(np.abs(rows.predicted - rows.level_ssim)), mean(np.abs(rows.predicted - rows.ssim)),
                regret, regret / max(1, size),
            ))  # fmt: skip
    header = ("target", "category", "views", "promised", "kept", "met", "predicted", "at its level")
    header += ("composed", "3DGS", "error at level", "error composed", "regret", "of category")
    formats = ("", "", "d", "d", "d", "d", *[".3f"] * 6, ",.0f", ".1%")
    notes = (
        "Masks are the 3D labels rendered into each unseen view; each view has a plan of its own.",
        "promised: predicted to reach the target; kept: measured there too, in the composition; met: "
        "measured, promised or not. regret: Gaussians above the cheapest level that measures the target in "
        "that view, where the chosen one does.",
    )
    return Table("Cross-view: plans for unseen views", header, formats, body, notes=notes)


def take_pictures(job: Job, row: int, sets: Mapping[str, Gaussians], metric: Lpips | None) -> list[Picture]:
    """The photo of a view (row of Scene.views), and sets of Gaussians (by title) as its camera sees them."""
    photo, camera = job.photos[row], job.scene.views[row].camera
    pictures = [Picture("photo", photo, np.nan, np.nan)]
    unit = as_unit(photo)
    of_photo = metric.features(unit) if metric else None
    for title, g in sets.items():
        image = render_rgb(g, camera, backend=job.backend, antialiased=job.antialiased)
        decibels = float(psnr(squared_error_map(image, unit).mean()))
        lpips = metric.distance(of_photo, metric.features(image)) if metric and of_photo else np.nan
        pictures.append(Picture(title, np.round(image * 255).astype(np.uint8), decibels, lpips))
    return pictures


@rc_context(STYLE)
def panel(pictures: Sequence[Picture]) -> Figure:
    """Figs. 4 and 5: the photo, 3DGS and the composition for each target, with PSNR and LPIPS."""
    height, width = pictures[0].rgb.shape[:2]
    inches = 15 / len(pictures) * height / width
    figure = Figure(figsize=(15, inches + 0.5))
    for column, picture in enumerate(pictures):
        axes = figure.add_axes(
            (column / len(pictures) + 0.001, 0, 1 / len(pictures) - 0.002, inches / (inches + 0.5))
        )
        axes.imshow(picture.rgb, aspect="auto")
        quality = "" if np.isnan(picture.psnr) else f"\n{picture.psnr:.2f} dB"
        quality += "" if np.isnan(picture.lpips) else f" / LPIPS {picture.lpips:.3f}"
        axes.set_title(picture.title + quality, loc="left", pad=4)
        axes.set_axis_off()
    return figure
