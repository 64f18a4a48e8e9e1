"""The figures of the report of a run."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from sagesplat.adapt.observe import TOTAL
from sagesplat.adapt.plan import Plan, quality_title
from sagesplat.output import figures, place_figures, tables
from sagesplat.output.next_steps import view_quality, worst_view
from sagesplat.output.place_figures import Place
from sagesplat.output.report_data import ReportData, main_plan, sizes_of, steps_of

FIT_LEVELS = 4  # levels drawn in the figure of SSIM over distance
FIT_LABELS = 9  # labels drawn there, the largest


def report_figures(data: ReportData, labels: Sequence[int]) -> Iterator[tuple[str, str, figures.Figure]]:
    """(file name, title, Figure) of every plot that the data allow."""
    names, colours, seen, quality = data.names, data.colours, data.observations, data.quality
    unit = "bytes to send (MB)" if data.sizes else figures.RAW
    yield (
        "size_by_target",
        "Model size by target and category",
        figures.size_by_target(data.plans, sizes_of(data), labels, names, colours, unit),
    )
    if data.place is not None:
        yield "cameras", "Map of the cameras", _camera_map(data, data.place)
    if data.drawn and data.sizes:
        levels = sorted({level for _, level in data.counts})
        yield (
            "fidelity_by_size",
            "Fidelity of each category by its size",
            place_figures.fidelity_by_size(
                data.drawn, levels, data.sizes, main_plan(data), labels, names, colours
            ),
        )
    if data.planned and data.drawn_at is not None:
        share = _reached(data, main_plan(data))
        yield "viewpoints", "Map of the drawn viewpoints", place_figures.viewpoint_map(data.drawn_at, share)
    if len(data.evaluation):
        yield (
            "quality_over_size",
            "Quality over size on unseen views",
            figures.quality_over_size(
                _uniform(data),
                sizes_of(data),
                data.plans,
                data.evaluation,
                quality,
                unit,
                data.drawn if quality == "fidelity" else None,
            ),
        )
        yield (
            "asked_and_measured",
            f"Target and measured {quality_title(quality)} on unseen views",
            figures.asked_and_measured(data.evaluation, labels, names, colours, quality),
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
        fitted = tables.by_size(data.counts)
        few = fitted[:FIT_LABELS]
        most = f", the {len(few)} largest of {len(fitted)}" if len(few) < len(fitted) else ""
        yield (
            "ssim_over_distance",
            f"SSIM over distance and its model{most}",
            figures.ssim_over_distance(
                data.observations, data.train_views, few, data.names, colours, data.models, shown
            ),
        )


def _uniform(data: ReportData) -> dict[int, float]:
    """Quality of the whole image on unseen views by level, all categories at one: what plans compare with."""
    if data.quality == "fidelity":
        return data.evaluation.uniform("fidelity")
    rows = data.observations.select(np.isin(data.observations.view, data.test_views))
    levels = [level for level in np.unique(rows.level).tolist() if level not in data.recovering]
    return {level: tables.view_mean(rows, TOTAL, level) for level in levels}


def _reached(data: ReportData, plan: Plan) -> Float[np.ndarray, " V"]:
    """Share of the categories that reach the target at each drawn viewpoint, at the plan's levels."""
    measured = np.column_stack([*data.planned.values()])
    known = np.isfinite(measured)
    counts = known.sum(1)
    return np.where(counts > 0, (known & (measured >= plan.target)).sum(1) / np.maximum(counts, 1), np.nan)


def _camera_map(data: ReportData, place: Place) -> figures.Figure:
    quality = view_quality(data.observations, len(data.view_names))
    test = np.isin(np.arange(len(quality)), data.test_views)
    asked = any(step.title == "More photos" for step in steps_of(data))
    return place_figures.camera_map(
        place, quality, test, worst_view(quality, data.test_views) if asked else None
    )
