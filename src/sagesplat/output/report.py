"""The report of a run: one HTML page that opens from disk, its figures and tables beside it as files."""

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jinja2 import Environment, StrictUndefined, Template
from PIL import Image

from sagesplat import __version__
from sagesplat.adapt.eq3 import SsimModel
from sagesplat.adapt.evaluate import Evaluation
from sagesplat.adapt.observe import TOTAL, Observations
from sagesplat.adapt.plan import Choice, Counts, Plan
from sagesplat.core.gaussians import BYTES_PER_GAUSSIAN
from sagesplat.io.files import write_text
from sagesplat.output import figures, tables
from sagesplat.output.by_category import Categories, merged, merged_counts, merged_plan, relabelled
from sagesplat.output.figures import Colours, Panel
from sagesplat.output.tables import MB, Table, name_of
from sagesplat.segment.block_categories import category_of

PICTURE_WIDTH = 1400  # pixels of a picture inside the page; the files beside it keep their size
FIT_LEVELS = 4  # levels drawn in the figure of SSIM over distance
FIT_LABELS = 9  # labels drawn there, the largest
TABLE_ROWS = 200  # of a table inside the page; the file beside it has all

Facts = Sequence[tuple[str, str]]


@dataclass(frozen=True, eq=False)
class ReportData:
    """Everything the page shows, wherever it comes from. Views are rows of `view_names`."""

    title: str
    target: float  # SSIM of the plan that the page leads with; one of `plans` has it
    names: Mapping[int, str]  # label id -> name
    colours: Colours  # label id -> RGB, 0..255
    observations: Observations
    train_views: np.ndarray
    test_views: np.ndarray  # unseen by training and fitting
    view_names: Sequence[str]
    counts: Counts  # (label id, level) -> Gaussians, every level of the ladder
    recovering: frozenset[int]  # levels taken shortly after an opacity reset
    models: Mapping[tuple[int, int], SsimModel]  # by (label id, level)
    plans: Sequence[Plan]  # of the scene, one per target
    evaluation: Evaluation
    panels: Sequence[Panel] = ()  # at the page's target
    scene_facts: Facts = ()
    settings: Facts = ()
    timings: Sequence[tuple[str, float]] = ()  # stage, seconds
    provenance: Facts = ()  # versions, hashes of the inputs
    categories: Categories = field(default_factory=dict)  # of per-block categories


def write_report(folder: Path, data: ReportData) -> Path:
    """Write `folder`/index.html, figures/*.png|svg and tables/*.csv; the path of the page comes back.

    Every number is computed from `data`; evaluation rows of other views than the test views do not count, and
    sections without data (no test views, no panels) are left out. `data.plans` must not be empty. A scene in
    blocks is shown by category; what was fitted and planned per block is in the tables.
    """
    unseen = np.isin(data.evaluation.view, data.test_views)
    per_block = replace(data, evaluation=data.evaluation.select(unseen))
    data, promises = by_category(per_block), relabelled(per_block.evaluation, per_block.categories)
    labels = tables.by_size(data.counts)
    drawn = _figures(data, labels, per_block, promises)
    plots = [(name, title, _save(figure, folder, name)) for name, title, figure in drawn]
    sheets = dict(_tables(data, labels, per_block, promises))
    for name, table in sheets.items():
        table.write_csv(folder / "tables" / f"{name}.csv")
    per_block.observations.write_csv(folder / "tables" / "observations.csv")
    per_block.evaluation.write_csv(folder / "tables" / "evaluation_rows.csv")
    for number, panel in enumerate(data.panels):
        strip = figures.panel_strip(panel, data.colours)
        figures.save_figure(strip, folder / "figures" / f"panel_{number}")
    page = template(Path(__file__).with_name("report.html.j2")).render(
        data=data,
        version=__version__,
        headline=_headline(data, promises),
        categories=_categories(data, labels, promises),
        num_parts=len(per_block.categories),
        table_rows=TABLE_ROWS,
        plots={name: (title, image) for name, title, image in plots},
        sheets=sheets,
        panels=[_pictures(panel, data.colours) for panel in data.panels],
        chips={name_of(i, data.names): _css(data.colours.get(i, (128, 128, 128))) for i in labels},
    )
    write_text(folder / "index.html", page)
    return folder / "index.html"


def by_category(data: ReportData) -> ReportData:
    """The same by category instead of per-block category, models excepted."""
    if not data.categories:
        return data
    to = data.categories
    return replace(
        data,
        observations=merged(data.observations, to, ("level", "view")),
        counts=merged_counts(data.counts, to),
        plans=[merged_plan(plan, to) for plan in data.plans],
        evaluation=merged(data.evaluation, to, ("target", "view")),
        names={label: category_of(name) if label in to else name for label, name in data.names.items()},
    )


def template(path: Path) -> Template:
    """A page's template."""
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(path.read_text("utf-8"))


def main_plan(data: ReportData) -> Plan:
    """The plan that the page leads with: the one whose target is nearest to `data.target`."""
    return min(data.plans, key=lambda plan: abs(plan.target - data.target))


def _headline(data: ReportData, promises: Evaluation) -> dict:
    """The figures at the top of the page, all measured."""
    plan = main_plan(data)
    full = sum(tables.last_counts(data.counts).values())
    rows = data.evaluation.select(data.evaluation.target == np.float32(plan.target))
    whole = rows.select(rows.label_id == TOTAL)
    saved = 1 - plan.count / full if full else 0.0
    return {
        "plan": plan,
        "saved": math.floor(100 * saved),  # percent, never rounded in our favour
        "full_count": full,
        "full_mb": full * BYTES_PER_GAUSSIAN / MB,
        "mb": plan.nbytes / MB,
        "ssim": tables.mean(whole.ssim),
        "psnr": tables.mean(whole.psnr),
        "full_ssim": tables.mean(whole.full_ssim),
        "full_psnr": tables.mean(whole.full_psnr),
        "num_views": len(np.unique(whole.view)),
        "kept": tables.promise_kept(promises.select(promises.target == np.float32(plan.target))),
        "infeasible": [c for c in plan.choices if c.status == "infeasible"],
        "binding": None if plan.binding is None else name_of(plan.binding, data.names),
    }


def _categories(data: ReportData, labels: Sequence[int], promises: Evaluation) -> list[dict]:
    """A line of the page's main table per label, the largest first."""
    plan = main_plan(data)
    full = tables.last_counts(data.counts)
    chosen: dict[int, Choice] = {choice.label_id: choice for choice in plan.choices}
    at_target = data.evaluation.target == np.float32(plan.target)
    promised = promises.select(promises.target == np.float32(plan.target))
    lines = []
    for label_id in labels:
        rows = data.evaluation.select(at_target & (data.evaluation.label_id == label_id))
        choice = chosen.get(label_id)
        lines.append(
            {
                "name": name_of(label_id, data.names),
                "colour": _css(data.colours.get(label_id, (128, 128, 128))),
                "choice": choice,
                "full": full[label_id],
                "share": choice.count / full[label_id] if choice and full[label_id] else math.nan,
                "of_scene": full[label_id] / max(1, *full.values()),
                "measured": tables.mean(rows.ssim),
                "full_ssim": tables.mean(rows.full_ssim),
                "kept": tables.promise_kept(promised.select(promised.label_id == label_id)),
            }
        )
    return lines


def _figures(data: ReportData, labels: Sequence[int], per_block: ReportData, promises: Evaluation):
    """(file name, title, Figure) of every plot that the data allow."""
    names, colours, seen = data.names, data.colours, data.observations
    yield (
        "size_by_target",
        "Model size by target and category",
        figures.size_by_target(data.plans, data.counts, labels, names, colours),
    )
    if len(data.evaluation):
        yield (
            "quality_over_size",
            "Quality over size on unseen views",
            figures.quality_over_size(
                seen, data.test_views, data.counts, data.plans, data.evaluation, data.recovering
            ),
        )
        yield (
            "promised_and_measured",
            "Promised and measured SSIM on unseen views",
            figures.promised_and_measured(promises, labels, names, colours),
        )
    if len(seen):
        yield (
            "ssim_over_levels",
            "SSIM of each category by level",
            figures.ssim_over_levels(
                seen, data.train_views, data.test_views, labels, names, colours, data.recovering
            ),
        )
    if data.models:
        levels = sorted({level for _, level in data.models if level not in data.recovering})
        picked = np.geomspace(1, max(len(levels), 1), FIT_LEVELS).round().astype(int) - 1
        shown = [levels[i] for i in np.unique(picked)] if levels else []
        fitted = tables.by_size(per_block.counts)
        few = fitted[:FIT_LABELS]
        most = f", the {len(few)} largest of {len(fitted)}" if len(few) < len(fitted) else ""
        yield (
            "ssim_over_distance",
            f"SSIM over distance and its model{most}",
            figures.ssim_over_distance(
                per_block.observations, data.train_views, few, per_block.names, colours, data.models, shown
            ),
        )


def _tables(data: ReportData, labels: Sequence[int], per_block: ReportData, promises: Evaluation):
    """(file name, Table) of every table that the data allow."""
    names = data.names
    yield "plan", tables.plan_table(main_plan(per_block), per_block.counts, per_block.names)
    yield "size_by_target", tables.targets_table(data.plans, data.counts, labels, names)
    if len(data.evaluation):
        yield "evaluation", tables.evaluation_table(promises, labels, names)
    yield "gaussians_by_level", tables.counts_table(data.counts, labels, names)
    for which, views in (("training", data.train_views), ("test", data.test_views)):
        if len(views):
            table = tables.quality_table(data.observations, views, labels, names, which)
            yield f"ssim_by_level_{which}", table
    if data.models:
        yield "models", tables.models_table(data.models, per_block.names)
    if data.panels:
        rows = [(p.name, p.ssim, p.psnr, p.full_ssim, p.full_psnr) for p in data.panels]
        header = ("view", "SSIM", "PSNR", "full model SSIM", "full model PSNR")
        yield "panels", Table("Views shown above", header, ("", ".3f", ".2f", ".3f", ".2f"), rows)
    if data.timings:
        yield "timings", Table("Time by stage", ("stage", "seconds"), ("", ",.1f"), list(data.timings))


def _save(figure: figures.Figure, folder: Path, name: str) -> str:
    """Save a figure; its SVG as a data address for the page."""
    return _address(figures.save_figure(figure, folder / "figures" / name), "image/svg+xml")


def _pictures(panel: Panel, colours: Colours) -> dict:
    """A panel with its pictures as data addresses."""
    labels = figures.label_image(panel.label_ids, colours)
    error = figures.error_image(panel.composed, panel.photo)
    return {
        "panel": panel,
        "ratio": f"{panel.photo.shape[1]} / {panel.photo.shape[0]}",
        "pictures": [
            ("full model", _picture(panel.full, "JPEG")),
            ("photo", _picture(panel.photo, "JPEG")),
            ("categories", _picture(labels, "PNG")),
            ("error", _picture(error, "JPEG")),
            ("composed", _picture(panel.composed, "JPEG")),
        ],
    }


def _picture(pixels: np.ndarray, kind: str) -> str:
    image = Image.fromarray(pixels)
    if image.width > PICTURE_WIDTH:
        size = (PICTURE_WIDTH, round(image.height * PICTURE_WIDTH / image.width))
        image = image.resize(size, Image.Resampling.NEAREST if kind == "PNG" else Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, kind, quality=92) if kind == "JPEG" else image.save(buffer, kind)
    return _address(buffer.getvalue(), f"image/{kind.lower()}")


def _address(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _css(colour: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)
