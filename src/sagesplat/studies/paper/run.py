"""The paper's evaluation of a finished run, in three stages: crossview, same_size, tables and figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sagesplat.adapt.coverage import PREDICTORS, Decisions
from sagesplat.adapt.eq1 import plan_view
from sagesplat.adapt.observe import distances_in_views
from sagesplat.adapt.plan import Plan
from sagesplat.core.config import PaperConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Progress, RunDone
from sagesplat.core.gaussians import Gaussians
from sagesplat.io.columns import from_rows
from sagesplat.output.table import Table
from sagesplat.output.tables import name_of, promise_kept
from sagesplat.run.job import Job
from sagesplat.run.stage import run_stage
from sagesplat.segment.display_names import titles
from sagesplat.stages.compose import compose_inputs, tune_composition
from sagesplat.stages.methods import method_of
from sagesplat.stages.plan import ssim_targets
from sagesplat.stages.results import has_photos, models_of, observations_of, plans_of
from sagesplat.stages.shared import label_colors, observed
from sagesplat.studies.lpips import load_metrics, lpips_hashes
from sagesplat.studies.paper.cross_view import NONE, cross_view, read_cross_view
from sagesplat.studies.paper.report import PaperData, Picture, four_levels, take_pictures, write_paper
from sagesplat.studies.paper.same_size import SameSize, compare, contenders, read_same_size

_IMAGES_A_TRAINING = 50  # a short training takes about as long as measuring so many images


def paper_report(job: Job, config: PaperConfig) -> None:
    """Everything of the paper that one run can show."""
    cross_views(job)
    equal_size(job, config)
    tables_and_figures(job, config)


def cross_views(job: Job) -> None:
    """Plan each unseen view by itself and measure its composition."""
    run, method, targets = job.run, method_of(job), ssim_targets(job.run)
    if not has_photos(run):
        raise RunError(
            f"{run.path}: crossview needs photos, and this splat came without; "
            f"`sagesplat measure {run.path}` needs none"
        )

    def make() -> list[str]:
        table = cross_view(job, method, targets)
        table.write_csv(run.cross_view)
        if scores := method.coverage(targets):
            kept = promises_table(scores, targets)
            kept.write(run.adapted / "promises_kept")
            by_target = targets_table(scores, titles(job.names()))
            by_target.write(run.adapted / "promises_by_target")
            job.emit(kept.event)
        lines = []
        for target in np.unique(table.target):
            fared = promise_kept(table.select(table.target == target))
            lines.append(f"SSIM {target:g}: {fared.kept} of {fared.promised} promises kept on unseen views")
        return lines

    inputs = [*method.files, run.observations, *_made_of(job)]
    run_stage(job, "crossview", {"targets": targets}, inputs, [run.cross_view], make)


_COLUMNS = {  # of `Decisions.totals`, and how they print
    "accepted": ",d", "violated": ",d", "coverage": ".1%", "low": ".1%", "high": ".1%", "excess": ".3f",
    "perfect_excess": ".3f", "false_rejections": ",d", "regret": ",.0f",
}  # fmt: skip
_NOTE = (
    "accepted: (category, view, target) triples whose target is predicted to be met; violated: of them those "
    "that measure less; coverage: the share that does not, with its 95 % interval by bootstrap over views; "
    "excess: SSIM above the target where a level above the lowest was accepted and some level measures the "
    "target, and perfect excess that of a planner that knows the measurement, in the same triples; false "
    "rejections: triples not accepted though a level measures the target; regret: transfer bytes above the "
    "cheapest level that does. All categories are at the same level. "
)


def promises_table(scores: Decisions, targets: Sequence[float]) -> Table:
    """Decisions on test views by predictor: means with means, then each less its own conformal margin."""
    body = [(name, *_totals(scores.by(name))) for name in PREDICTORS]
    note = _NOTE + (
        "constant: mean of each level over the training views; eq3: the paper's model; mean: the viewpoint "
        "model; bound: each less its own conformal margin, by the same calibration; perfect: what was "
        "measured. "
        f"Targets: {', '.join(f'{t:g}' for t in targets)}."
    )
    return _promises("Coverage on unseen views, by what predicts the SSIM", ("by",), body, note)


def targets_table(scores: Decisions, names: Mapping[int, str]) -> Table:
    """The bound's decisions on test views, by target and category."""
    bound, body = scores.by("bound"), []
    for target in np.unique(bound.target):
        rows = bound.select(bound.target == target)
        body.append((f"{target:g}", "all", *_totals(rows)))
        for label in np.unique(rows.label_id).tolist():
            mine = rows.select(rows.label_id == label)
            body.append((f"{target:g}", name_of(label, names), *_totals(mine)))
    title = "Coverage of the bound on unseen views, by target and category"
    return _promises(title, ("target", "category"), body, _NOTE)


def _totals(scores: Decisions) -> tuple[float, ...]:
    totals = scores.totals()
    return tuple(totals[name] for name in _COLUMNS)


def _promises(title: str, first: tuple[str, ...], body: list[tuple], note: str) -> Table:
    header = (*first, *(name.replace("_", " ") for name in _COLUMNS))
    return Table(title, header, ("",) * len(first) + tuple(_COLUMNS.values()), body, notes=(note,))


def equal_size(job: Job, config: PaperConfig) -> None:
    """Compare compositions with 3DGS of the same size, on the test views and in one view."""
    run = job.run
    view = _view(job, config)
    settings = {"view": view, "tune_steps": config.tune_steps, "lpips": lpips_hashes(config.lpips)}

    def make() -> list[str]:
        tests = job.valid.rows(job.scene, job.scene.test_ids)
        comparisons = [(NONE, plans_of(job), tests), (view, _view_plans(job, view), [view])]
        comparisons = [c for c in comparisons if c[2]]
        images = sum(len(views) * (4 * len(plans) + 1) for _, plans, views in comparisons)
        trainings = sum(2 * len(plans) for _, plans, _ in comparisons)
        done, total = 0, trainings * _IMAGES_A_TRAINING + images

        def advance(by: int) -> None:
            nonlocal done
            done += by
            job.emit(Progress("same_size", done, total))

        def tuned(g: Gaussians) -> Gaussians:
            result = tune_composition(job, g, config.tune_steps)
            advance(_IMAGES_A_TRAINING)
            return result

        metrics = load_metrics(job.emit, config.lpips)
        rows: list[dict[str, float]] = []
        for of_view, plans, views in comparisons:
            sets = contenders(job, plans, tuned)
            for row in compare(job, views, sets, metrics, of_view):
                rows.append(row)
                advance(1)
        from_rows(SameSize, rows).write_csv(run.same_size)
        return [f"{len(rows)} images measured"]

    inputs = [run.levels, run.models, run.observations, *_made_of(job)]
    run_stage(job, "same_size", settings, inputs, [run.same_size], make)


def tables_and_figures(job: Job, config: PaperConfig) -> None:
    """Write report/paper."""
    run = job.run
    view = _view(job, config)

    def make() -> list[str]:
        ladder = job.ladder
        view_plans = _view_plans(job, view)
        reduced = {"min": 0.0, "5 %": 5.0, "mean": None}
        by_statistic = {
            name: distances_in_views(job.scene, job.point_labels, percentile)
            for name, percentile in reduced.items()
        }
        data = PaperData(
            title=job.scene.name,
            names=titles(job.names()),
            colours=label_colors(job),
            observations=observations_of(job),
            fitted=observed(job),
            train_views=job.scene.train_ids,
            test_views=job.scene.test_ids,
            view_names=[v.name for v in job.scene.views],
            counts=ladder.counts,
            recovering=ladder.recovering,
            models=models_of(job),
            iterations=four_levels(ladder.levels),
            view=view,
            distances={n: {i: float(d[view]) for i, d in table.items()} for n, table in by_statistic.items()},
            view_plans=view_plans,
            cross_view=read_cross_view(run.cross_view),
            same_size=read_same_size(run.same_size),
            panels=_panels(job, config, view),
        )
        write_paper(run.paper, data)
        return []

    inputs = [run.levels, run.observations, run.models, run.cross_view, run.same_size, *_made_of(job)]
    run_stage(job, "paper", {"view": view}, inputs, [run.paper / "index.html"], make)
    job.emit(RunDone(run.paper / "index.html"))


def _made_of(job: Job) -> list[Path]:
    """What each of these stages reads besides its own inputs: labels, plan and the records behind them."""
    run = job.run
    return [run.labels, run.provenance("observe"), run.provenance("fit"), *compose_inputs(job)]


def _view_plans(job: Job, view: int) -> list[Plan]:
    """Plans for one view at every target, as the paper's Table III makes them: from its four iterations."""
    levels = four_levels(job.ladder.levels)
    counts = {key: n for key, n in job.ladder.counts.items() if key[1] in levels}
    seen = job.distances(job.fit_config.distance)
    here = {label: float(d[view]) for label, d in seen.items()}
    models = models_of(job)
    return [plan_view(models, counts, here, target, view) for target in ssim_targets(job.run)]


def _view(job: Job, config: PaperConfig) -> int:
    """The view to look at: the one named, or the middle one of the test views (or of all)."""
    names = [view.name for view in job.scene.views]
    if config.view is None:
        views = job.scene.test_ids if len(job.scene.test_ids) else np.arange(len(names))
        return int(views[len(views) // 2])
    matching = [row for row, name in enumerate(names) if config.view in (name, name.rpartition(".")[0])]
    if not matching:
        raise RunError(f"{job.scene.path}: no photo {config.view!r}; there are {names[0]} to {names[-1]}")
    return matching[0]


def _panels(job: Job, config: PaperConfig, view: int) -> dict[str, list[Picture]]:
    """The view of Table III, and for cross-view two test views, in pictures."""
    tests = job.scene.test_ids
    rows = [view, *(int(tests[len(tests) * i // 4]) for i in (1, 3) if len(tests))]
    metric = load_metrics(job.emit, config.lpips, ["alex"]).get("lpips_alex")
    full = job.ladder.load(job.ladder.levels[-1])
    panels = {}
    for row in dict.fromkeys(rows):
        sets = {f"3DGS, {len(full):,}": full}
        sets |= {f"t={p.target:g}, {p.count:,}": p.compose(job.ladder) for p in _view_plans(job, row)}
        panels[job.scene.views[row].name] = take_pictures(job, row, sets, metric)
    return panels
