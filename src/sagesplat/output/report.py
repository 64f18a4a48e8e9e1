"""The report of a run: one HTML page that opens from disk, its figures and tables beside it as files."""

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from jinja2 import Environment, StrictUndefined, Template
from PIL import Image

from sagesplat import __version__
from sagesplat.adapt.evaluate import COLOURS, Evaluation
from sagesplat.adapt.observe import TOTAL
from sagesplat.adapt.plan import Choice, Plan, quality_title
from sagesplat.core.qr import qr_address
from sagesplat.io.files import write_text
from sagesplat.output import figures, tables
from sagesplat.output.figures import Colours, Panel
from sagesplat.output.report_data import ReportData, main_plan, nearest, sizes_of, steps_of
from sagesplat.output.report_figures import report_figures
from sagesplat.output.table import Table
from sagesplat.output.tables import MB, bytes_of, name_of

PICTURE_WIDTH = 1400  # pixels of a picture inside the page; the files beside it keep their size
TABLE_ROWS = 200  # of a table inside the page; the file beside it has all


def write_report(folder: Path, data: ReportData) -> Path:
    """Write `folder`/index.html, figures/*.png|svg and tables/*.csv; the path of the page comes back.

    Every number is computed from `data`; evaluation rows of other views than the test views do not count, and
    sections without data (no test views, no panels) are left out. `data.plans` must not be empty.
    """
    unseen = np.isin(data.evaluation.view, data.test_views)
    data = replace(data, evaluation=data.evaluation.select(unseen))
    labels = tables.by_size(data.counts)
    beside = None if data.ssim_target is None else nearest(data, "ssim", data.ssim_target)
    drawn = report_figures(data, labels)
    plots = {
        name: (title, _address(figures.save_figure(figure, folder / "figures" / name), "image/svg+xml"))
        for name, title, figure in drawn
    }
    sheets = dict(_tables(data, labels))
    for name, table in sheets.items():
        table.write_csv(folder / "tables" / f"{name}.csv")
    data.observations.write_csv(folder / "tables" / "observations.csv")
    data.evaluation.write_csv(folder / "tables" / "evaluation_rows.csv")
    for number, panel in enumerate(data.panels):
        strip = figures.panel_strip(panel, data.colours)
        figures.save_figure(strip, folder / "figures" / f"panel_{number}", svg=False)
    page = template(Path(__file__).with_name("report.html.j2")).render(
        data=data,
        version=__version__,
        headline=_headline(data),
        categories=_categories(data, main_plan(data), labels),
        beside=beside,
        beside_categories=_categories(data, beside, labels) if beside else [],
        table_rows=TABLE_ROWS,
        plots=plots,
        steps=steps_of(data),
        bundle=next((at for _, at in data.links if at.split("/")[-2:-1] == ["bundle"]), ""),
        qr=qr_address(data.url) if data.url else "",
        sheets=sheets,
        viewpoints=None if data.viewpoints is None else _picture(data.viewpoints, "JPEG"),
        looks=[(look, look.nbytes / MB, _picture(look.image, "PNG")) for look in data.looks],
        panels=[_pictures(panel, data.colours, data.photos) for panel in data.panels],
        chips={name_of(i, data.names): _css(data.colours.get(i, (128, 128, 128))) for i in labels},
    )
    write_text(folder / "index.html", page)
    return folder / "index.html"


def template(path: Path) -> Template:
    """A page's template."""
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(path.read_text("utf-8"))


def _headline(data: ReportData) -> dict:
    """The figures at the top of the page, all measured."""
    plan = main_plan(data)
    full = sum(tables.last_counts(data.counts).values())
    rows = data.evaluation.of(plan)
    whole = rows.select(rows.label_id == TOTAL)
    mb = sum(map(bytes_of, plan.choices)) / MB
    full_mb = sum(tables.last_counts(sizes_of(data)).values()) / MB
    saved = 1 - mb / full_mb if full_mb else 0.0
    shares = [c.reached for c in plan.choices if c.reached]
    kept, num_views = _kept(plan, rows), len(np.unique(whole.view))
    return {
        "plan": plan,
        "quality": quality_title(plan.quality),
        "saved": math.floor(100 * saved),  # percent, never rounded in our favour
        "full_count": full,
        "full_mb": full_mb,
        "mb": mb,
        "unit": "to send" if data.sizes else "at 248 bytes a Gaussian",
        "fidelity": tables.mean(whole.fidelity),
        "ssim": tables.mean(whole.ssim),
        "psnr": tables.mean(whole.psnr),
        "full_ssim": tables.mean(whole.full_ssim),
        "full_psnr": tables.mean(whole.full_psnr),
        **{f.name: tables.mean(getattr(whole, f.name)) for f in fields(whole) if f.name.endswith(COLOURS)},
        "num_views": num_views,
        "kept": kept,
        "left_out": _left_out(rows, len(plan.choices) * num_views, kept),
        "least": min(shares, key=lambda share: share.share) if shares else None,
        "num_drawn": max((share.num_views for share in shares), default=0),
        "infeasible": [c for c in plan.choices if c.status == "infeasible"],
        "binding": None if plan.binding is None else name_of(plan.binding, data.names),
    }


def _kept(plan: Plan, rows: Evaluation) -> tables.Kept:
    """Measurements at or above the target: of all views for fidelity, else of those whose bound is there.

    A plan of a scene for fidelity promises a share of all viewpoints, whatever the bound of each.
    """
    if plan.quality == "fidelity":
        known = np.isin(rows.label_id, [c.label_id for c in plan.choices if c.status == "ok"])
        rows = replace(rows, predicted=np.where(known, np.float32(np.inf), np.float32(np.nan)))
    return tables.promise_kept(rows.of_own_quality())


def _left_out(rows: Evaluation, possible: int, kept: tables.Kept) -> str:
    """Why fewer than all pairs of a category and a view are counted, in words."""
    measured = int((np.isfinite(rows.of_own_quality().ssim) & (rows.label_id != TOTAL)).sum())
    reasons = [
        (possible - measured, "that show too little of a category to measure it"),
        (measured - kept.promised, "without a promise for it"),
    ]
    told = [f"{count} {reason}" for count, reason in reasons if count > 0]
    return f" (not counted: {', '.join(told)})" if told else ""


def _categories(data: ReportData, plan: Plan, labels: Sequence[int]) -> list[dict]:
    """A line of one of the page's tables of categories per label, the largest first."""
    sizes = tables.last_counts(sizes_of(data))
    chosen: dict[int, Choice] = {choice.label_id: choice for choice in plan.choices}
    at_target = data.evaluation.of(plan)
    lines = []
    for label_id in labels:
        rows = at_target.select(at_target.label_id == label_id)
        choice, full = chosen.get(label_id), sizes.get(label_id, 0)
        lines.append(
            {
                "name": name_of(label_id, data.names),
                "colour": _css(data.colours.get(label_id, (128, 128, 128))),
                "choice": choice,
                "mb": bytes_of(choice) / MB if choice else math.nan,
                "share": bytes_of(choice) / full if choice and full else math.nan,
                "of_scene": full / max(1, *sizes.values()),
                "fidelity": tables.mean(rows.fidelity),
                "measured": tables.mean(rows.ssim),
                "full_ssim": tables.mean(rows.full_ssim),
                "kept": _kept(plan, rows),
            }
        )
    return lines


def _tables(data: ReportData, labels: Sequence[int]):
    """(file name, Table) of every table that the data allow."""
    names = data.names
    yield "plan", tables.plan_table(main_plan(data), data.counts, data.names)
    if data.ssim_target is not None:
        beside = nearest(data, "ssim", data.ssim_target)
        yield "plan_ssim", tables.plan_table(beside, data.counts, data.names)
    yield "size_by_target", tables.targets_table(data.plans, data.counts, labels, names, data.sizes)
    if len(data.evaluation):
        yield "evaluation", tables.evaluation_table(data.evaluation, labels, names)
    yield "gaussians_by_level", tables.counts_table(data.counts, labels, names)
    for which, views in (("training", data.train_views), ("test", data.test_views)):
        if len(views):
            table = tables.quality_table(data.observations, views, labels, names, which)
            yield f"ssim_by_level_{which}", table
    if data.models:
        yield "models", tables.models_table(data.models, data.names)
    if data.panels:
        rows = [(p.name, p.ssim, p.psnr, p.full_ssim, p.full_psnr) for p in data.panels]
        header = ("view", "SSIM", "PSNR", "full model SSIM", "full model PSNR")
        yield "panels", Table("Views shown above", header, ("", ".3f", ".2f", ".3f", ".2f"), rows)
    if data.timings:
        yield "timings", Table("Time by stage", ("stage", "seconds"), ("", ",.1f"), list(data.timings))


def _pictures(panel: Panel, colours: Colours, photos: bool) -> dict:
    """A panel with its pictures as data addresses."""
    labels = figures.label_image(panel.label_ids, colours)
    error = figures.error_image(panel.composed, panel.photo, panel.valid)
    return {
        "panel": panel,
        "ratio": f"{panel.photo.shape[1]} / {panel.photo.shape[0]}",
        "pictures": [
            ("full model", _picture(panel.full, "JPEG")),
            ("photo" if photos else "as it came in", _picture(panel.photo, "JPEG")),
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
