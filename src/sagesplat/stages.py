"""The stages, one function each, in the order of the paper; each skips what is done and says what it did."""

import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sagesplat import nesting
from sagesplat.adapt.evaluate import evaluate
from sagesplat.adapt.model import read_models, write_models
from sagesplat.adapt.observe import (
    TOTAL,
    Observations,
    large_enough,
    merge,
    observe,
    read_observations,
)
from sagesplat.adapt.plan import Plan, plan_scene, plan_view, read_budget_plan, read_plans, write_plans
from sagesplat.adapt.promise import write_promises
from sagesplat.adapt.promised import plan_for_scene, plan_for_view, plan_within
from sagesplat.config import FitConfig, PlanConfig, PosesConfig, SceneConfig, TrainConfig
from sagesplat.errors import RunError
from sagesplat.events import Progress, RunDone, TableMade, Training, Warned
from sagesplat.executor import split
from sagesplat.files import read_json, write_json
from sagesplat.gaussians import Gaussians
from sagesplat.job import Job, distances, fingerprint, fusion, label_images, run_stage, work_all
from sagesplat.output import tables
from sagesplat.output.chunks import INDEX
from sagesplat.output.ply import read_ply, write_ply
from sagesplat.output.report import write_report
from sagesplat.output.summary import report_data
from sagesplat.output.tables import Table
from sagesplat.run_dir import RunDir, file_hash, settings_of
from sagesplat.scene import load_scene
from sagesplat.scene.detect import detect
from sagesplat.train import memory
from sagesplat.train.checkpoint import latest_checkpoint, remove_checkpoints
from sagesplat.train.parallel import train_together
from sagesplat.train.stepper import tune
from sagesplat.train.trainer import LabelFrozen, LevelSaved, Resumed, Step, Trained, train


def open_scene(job: Job, path: Path, config: SceneConfig, poses: PosesConfig | None = None) -> None:
    """Read a capture and write scene.json; of photos without poses, or a video, a capture is made first."""
    run = job.run
    ours = run.scene.exists() or run.capture.exists()
    if run.path.exists() and not ours and any(not p.name.startswith(".") for p in run.path.iterdir()):
        raise RunError(f"{run.path}: not empty and not a run folder; choose a new folder")
    if detect(path) in ("photos", "video"):
        capture = run.capture / path.resolve().stem  # the scene will have that name
        _find_poses(job, path, capture, poses or PosesConfig())
        path = capture
    scene = load_scene(path, **asdict(config))
    settings = {"path": str(path.resolve()), **asdict(config), "fingerprint": fingerprint(scene)}

    def make() -> list[str]:
        write_json(
            run.scene,
            {
                "path": str(path.resolve()),
                "settings": asdict(config),
                "fingerprint": settings["fingerprint"],
                "extent": scene.extent,
                "points": len(scene.points.xyz),
                "views": [
                    {
                        "name": view.name,
                        "split": scene.split(row),
                        "width": view.camera.width,
                        "height": view.camera.height,
                        "K": view.camera.K.tolist(),
                        "w2c": view.camera.w2c.tolist(),
                    }
                    for row, view in enumerate(scene.views)
                ],
            },
        )
        size = scene.views[0].camera
        return [
            f"{len(scene.train_ids)} training, {len(scene.test_ids)} test views, {size.width}x{size.height}",
            f"{len(scene.points.xyz):,} points",
        ]

    run_stage(job, "scene", settings, [], [run.scene], make)


HIGH_ERROR = 0.8  # px; what one camera leaves where each photo has its own (dinosaur: 0.97, then 0.42)
_POSES = ("prepare", "features", "matches", "mapping", "undistortion")


def _poses_progress(stage: str, done: float) -> Progress:
    """One bar for all parts of structure from motion; mapping may go back where a model grows anew."""
    return Progress("poses", round(100 * (_POSES.index(stage) + done)), 100 * len(_POSES), stage)


def _find_poses(job: Job, source: Path, capture: Path, config: PosesConfig) -> None:
    """Make a capture of photos or a video: cameras and points by structure from motion."""
    from sagesplat.scene.photos import reconstruct

    if job.run.path.resolve().is_relative_to(source.resolve()):
        raise RunError(f"{job.run.path}: lies among the photos; name a run folder outside of {source}")
    files = sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]
    state = [(str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in files]
    digest = hashlib.sha256(repr(state).encode()).hexdigest()
    settings = {"source": str(source.resolve()), **asdict(config), "files": digest}

    def make() -> list[str]:
        found = reconstruct(
            source, capture, config,
            lambda stage, done, total: job.emit(_poses_progress(stage, done / max(total, 1))),
        )  # fmt: skip
        for name, reason in list(found.unregistered.items())[:5]:
            job.emit(Warned(f"{name}: {reason}"))
        if len(found.unregistered) > 5:
            job.emit(Warned(f"{len(found.unregistered)} photos in all left out; see {capture}/poses.json"))
        if found.reprojection_error > HIGH_ERROR and not config.refine_principal_point:
            cure = "--poses.camera per-image --poses.refine-principal-point"
            high = f"reprojection error {found.reprojection_error:.2f} px is high"
            job.emit(Warned(f"{high}; if the photos were cropped or zoomed one by one, try {cure}"))
        return [
            f"poses of {found.num_registered} of {found.num_photos} photos, {found.num_points:,} points, "
            f"reprojection error {found.reprojection_error:.2f} px"
        ]

    run_stage(job, "poses", settings, [], [capture / "poses.json"], make)


def train_levels(job: Job, config: TrainConfig, seed: int) -> None:
    """Train 3DGS from the labelled points and record the levels."""
    run = job.run
    # what a step looks at decides the result, not who does the work
    settings = {**asdict(config), "batch": max(config.batch, job.processes), "seed": seed}

    def make() -> list[str]:
        belongs = json.dumps({**settings, "scene": file_hash(run.scene), "labels": file_hash(run.labels)})
        goes_on = run.checkpoint.exists() and (not job.force or _continues(run, belongs))
        fitted, cap = _fit_memory(job, config, goes_on)  # before anything is given up
        if not goes_on:
            remove_checkpoints(run.checkpoint)
            shutil.rmtree(run.levels, ignore_errors=True)
        write_json(run.cap, {"cap": cap})
        counts: dict[str, int] = {}
        names = job.names()
        start = partial(train_together, job.processes, job.threads) if job.processes > 1 else train
        events = start(
            job.scene, job.photos, job.point_labels, fitted,
            masks=job.masks if config.freeze_at is not None else None,
            seed=seed, backend=job.backend, folder=run.path, settings=belongs,
        )  # fmt: skip
        for event in events:
            match event:
                case Resumed(step, damage):
                    before = f", the checkpoint before the newest: {damage}" if damage else ""
                    job.emit(Warned(f"going on from step {step}{before}"))
                case Step(step, loss, num, _):
                    job.emit(Training(step, config.max_steps, loss, counts, num))
                case LevelSaved():
                    counts = {names[i]: n for i, n in event.counts.items()}
                case LabelFrozen(step, label, ssim, count):
                    name = names[label]
                    job.emit(
                        Warned(f"{name} stops at step {step} with SSIM {ssim:.3f} and {count:,} Gaussians")
                    )
                case Trained(gaussians, step, frozen):
                    write_json(run.frozen, {str(label): at for label, at in frozen.items()})
                    return [f"{len(gaussians):,} Gaussians after {step} steps"]
        return []

    run_stage(job, "train", settings, [run.scene, run.labels], [run.levels, run.checkpoint], make)


def _fit_memory(job: Job, config: TrainConfig, goes_on: bool) -> tuple[TrainConfig, int]:
    """The settings with a cap that fits into memory, and that cap (0: none needed).

    A training that goes on keeps the cap it began with.
    """
    if job.backend == "cuda":  # Gaussians are not in the machine's memory
        return config, 0
    began = int(read_json(job.run.cap)["cap"]) if goes_on and job.run.cap.exists() else 0
    fitted = memory.fit(job.scene, config, job.memory_limit, processes=job.processes, began=began)
    job.emit(Warned(str(fitted)))
    return fitted.config, fitted.lowered


def _continues(run: RunDir, belongs: str) -> bool:
    try:
        latest_checkpoint(run.checkpoint, belongs)
    except RunError:
        return False
    return True


def observe_levels(job: Job, config: FitConfig) -> None:
    """Measure every category at every level in every view."""
    run = job.run

    def make() -> list[str]:
        far = distances(job, config.distance)
        parts = [(rows, config.masks, far) for rows in split(range(len(job.scene.views)), job.pieces)]
        table = merge(work_all(job, "observe", _observe_views, parts))
        table.write_csv(run.observations)
        seen = table.select(np.isin(table.view, job.scene.train_ids))
        _show(job, tables.ladder_table(seen, job.ladder.counts, job.ladder.recovering, job.names()))
        return [
            f"{len(table):,} observations of {len(job.ladder.levels)} levels in {len(job.scene.views)} views"
        ]

    inputs = [run.scene, run.labels, ladder_files(run)[0], *fusion(run)]
    settings = {"distance": config.distance, "masks": config.masks}
    run_stage(job, "observe", settings, inputs, [run.observations], make)


def _observe_views(job: Job, part: tuple[Sequence[int], str, dict[int, np.ndarray]]) -> Observations:
    """The observations of some views (rows, source of label images, distances in all views)."""
    rows, masks, far = part
    return observe(
        job.scene, job.photos, label_images(job, masks), job.ladder, far,
        views=rows, backend=job.backend, antialiased=job.antialiased,
        progress=lambda done, total: job.emit(Progress("observe", done, total)),
    )  # fmt: skip


def ladder_files(run: RunDir) -> list[Path]:
    """What the run's levels, and the models of their quality, are read from."""
    if run.ladder == "nested":
        return [run.prefixes, run.chunks / INDEX, run.promises]
    return [run.levels, run.models]


def _show(job: Job, table: Table) -> None:
    job.emit(TableMade(table.title, table.header, tuple(map(tuple, table.cells()))))


def fit_ladder(job: Job, config: FitConfig) -> None:
    """Fit Eq. 3 to the observations of the training views."""
    run = job.run

    def make() -> list[str]:
        table = large_enough(read_observations(run.observations), job.scene, config.min_share)
        table = nesting.eroded(table, config.region)
        models = nesting.fit_curves(job, table)
        write_models(run.models, models)
        statuses = [m.status for m in models.values()]
        lines = [", ".join(f"{statuses.count(s)} {s}" for s in sorted(set(statuses)))]
        if run.ladder == "nested":
            promises = nesting.fit_viewpoints(job, table, config, models)
            write_promises(run.promises, promises)
            statuses = [m.status for m in promises.values()]
            lines.append("promises: " + ", ".join(f"{statuses.count(s)} {s}" for s in sorted(set(statuses))))
        return lines

    settings: dict[str, Any] = {"min_share": config.min_share, "region": config.region}
    inputs, outputs = [run.scene, run.observations], [run.models]
    if run.ladder == "nested":
        settings["confidence"] = config.confidence
        inputs, outputs = [*inputs, run.prefixes, run.chunks / INDEX], [*outputs, run.promises]
    run_stage(job, "fit", settings, inputs, outputs, make)


def make_plan(job: Job, config: PlanConfig) -> None:
    """Choose the levels: for the scene at each target, for every view at the main one."""
    run = job.run

    def from_promises() -> list[str]:
        costs, quality = nesting.promised_quality(job)
        shown = nesting.pixels_of(read_observations(run.observations), job, costs.labels, job.scene.train_ids)
        scene_plans = [
            plan_for_scene(quality, costs, target, config.share, shown) for target in config.targets
        ]
        view_plans = [
            plan_for_view(quality, costs, config.target_ssim, row) for row in range(len(job.scene.views))
        ]
        within = None
        if config.budget:
            weights = {label_named(job, name): weight for name, weight in config.weights.items()}
            within = plan_within(quality, costs, config.budget, config.budget_unit, shown, weights)
        write_plans(run.plan, scene_plans, view_plans, within)
        full = int(costs.sent[:, -1].sum())
        lines = [
            f"SSIM {p.target:g}: {p.sent / 1e6:.2f} of {full / 1e6:.2f} MB, {p.count:,} Gaussians, {p.status}"
            for p in scene_plans
            if p.sent is not None
        ]
        if within and within.sent is not None:
            lines.append(
                f"budget {config.budget:,g} {config.budget_unit}: {within.sent / 1e6:.2f} MB, "
                f"{within.count:,} Gaussians, {within.status}"
            )
        return lines

    def from_models() -> list[str]:
        models, ladder = read_models(run.models), job.ladder
        table = large_enough(read_observations(run.observations), job.scene, job.fit_config.min_share)
        table = table.select(table.level == ladder.levels[-1])
        seen = table.select(np.isin(table.view, job.scene.train_ids))
        labels = {label for label, _ in ladder.counts}
        by_label = {label: seen.distance[seen.label_id == label] for label in labels}
        scene_plans = [
            plan_scene(models, ladder.counts, by_label, target, config.share, recovering=ladder.recovering)
            for target in config.targets
        ]
        view_plans = []
        for row in range(len(job.scene.views)):
            here = table.select(table.view == row)
            distances = dict(zip(here.label_id.tolist(), here.distance.tolist(), strict=True))
            view_plans.append(
                plan_view(
                    models, ladder.counts, distances, config.target_ssim, row, recovering=ladder.recovering
                )
            )
        write_plans(run.plan, scene_plans, view_plans)
        full = ladder.size(ladder.levels[-1])
        return [f"SSIM {p.target:g}: {p.count:,} of {full:,} Gaussians, {p.status}" for p in scene_plans]

    nested = run.ladder == "nested"
    if config.budget and not nested:
        raise RunError("--budget needs the nested ladder; leave out --ladder snapshots")
    inputs = [run.scene, *ladder_files(run), run.observations]
    settings = asdict(config) | {"targets": config.targets}
    run_stage(job, "plan", settings, inputs, [run.plan], from_promises if nested else from_models)


def label_named(job: Job, name: str) -> int:
    """The id of a category of the run; RunError for a name that it does not have."""
    ids = {name: label for label, name in job.names().items()}
    if name not in ids:
        raise RunError(f"{job.run.path}: no category {name!r}; there are {', '.join(ids)}")
    return ids[name]


def main_target(run: RunDir) -> float:
    """The target that the run's plan was made for."""
    return float(settings_of(run, "plan")["target_ssim"])


def scene_plan(run: RunDir, target: float) -> Plan:
    """The scene's plan for one of the run's targets."""
    plans = {plan.target: plan for plan in read_plans(run.plan)[0]}
    if target not in plans:
        known = ", ".join(f"{t:g}" for t in plans)
        raise RunError(f"{run.plan}: no plan for SSIM {target:g}, only for {known}; run `sagesplat plan`")
    return plans[target]


def tune_composition(job: Job, g: Gaussians, steps: int) -> Gaussians:
    """A composition trained as a whole, with the settings of the run's training; as it is for 0 steps."""
    if steps <= 0:
        return g
    seed = settings_of(job.run, "train")["seed"]
    return tune(g, job.scene, job.photos, nesting.train_config(job), steps, seed=seed, backend=job.backend)


def compose(job: Job, plan: Plan) -> Gaussians:
    """The composition of a plan, tuned if the run's plans are (`PlanConfig.tune_steps`)."""
    steps = settings_of(job.run, "plan").get("tune_steps", 0)
    return tune_composition(job, job.ladder.compose(plan.levels), steps)


def main_plan(run: RunDir) -> Plan:
    """What the run composes: the plan for its budget, if it has one, else for its main target."""
    return read_budget_plan(run.plan) or scene_plan(run, main_target(run))


def compose_plan(job: Job) -> None:
    """Write the scene that the plan chose."""
    run = job.run

    def make() -> list[str]:
        plan = main_plan(run)
        g = compose(job, plan)
        write_ply(run.composed, g, job.names())
        sent = "" if plan.sent is None else f", {plan.sent / 1e6:.2f} MB to send"
        return [f"{len(g):,} Gaussians, {plan.nbytes / 1e6:.1f} MB at 248 bytes each{sent}"]

    settings = {"tune_steps": settings_of(run, "plan").get("tune_steps", 0)}
    run_stage(job, "compose", settings, [run.plan, ladder_files(run)[0]], [run.composed], make)


def view_planner(job: Job) -> Callable[[int, float], Plan]:
    """Plans single views (row of Scene.views, target SSIM), seen or not."""
    if job.run.ladder == "nested":
        costs, quality = nesting.promised_quality(job)
        return lambda row, target: plan_for_view(quality, costs, target, row)
    far, ladder = distances(job, job.fit_config.distance), job.ladder
    models = read_models(job.run.models)

    def plan(row: int, target: float) -> Plan:
        here = {label: float(d[row]) for label, d in far.items()}
        return plan_view(models, ladder.counts, here, target, row, recovering=ladder.recovering)

    return plan


def promised(job: Job) -> Callable[[int, int, int], float]:
    """SSIM promised of a (label id, level) in a view (row of Scene.views); NaN where nothing is."""
    if job.run.ladder == "nested":
        costs, quality = nesting.promised_quality(job)
        row_of = {label: i for i, label in enumerate(costs.labels)}
        return lambda label, level, row: float(quality.bound[row, row_of[label], level - 1])
    far, models = distances(job, job.fit_config.distance), read_models(job.run.models)

    def by_distance(label: int, level: int, row: int) -> float:
        known = (label, level) in models and label in far
        return float(models[label, level](float(far[label][row]))) if known else np.nan

    return by_distance


def evaluate_plans(job: Job) -> None:
    """Measure the compositions on the test views, beside the promise and the whole model."""
    run = job.run

    def make() -> list[str]:
        fitted, within = job.fit_config, read_budget_plan(run.plan)
        plans = [*read_plans(run.plan)[0], *([within] if within else [])]
        table = evaluate(
            job.scene, job.photos, label_images(job, fitted.masks), job.ladder, plans, promised(job),
            region=fitted.region, compose=lambda plan: compose(job, plan),
            backend=job.backend, antialiased=job.antialiased,
            progress=lambda done, total: job.emit(Progress("evaluate", done, total)),
        )  # fmt: skip
        table.write_csv(run.evaluation)
        if len(table):
            plan = scene_plan(run, main_target(run))
            _show(job, tables.outcome_table(plan, job.ladder.counts, table, job.names()))
        whole = table.select(table.label_id == TOTAL)
        lines = []
        for target in np.unique(whole.target):
            within_budget = np.isnan(target)
            at = whole.select(np.isnan(whole.target) if within_budget else whole.target == target)
            asked = "within the budget" if within_budget else f"SSIM {target:g} asked"
            lines.append(
                f"{asked}: test views {at.ssim.mean():.3f} / {at.psnr.mean():.2f} dB "
                f"(everything {at.full_ssim.mean():.3f} / {at.full_psnr.mean():.2f} dB)"
            )
        return lines

    inputs = [run.scene, run.labels, *ladder_files(run), run.plan]
    settings = {"tune_steps": settings_of(run, "plan").get("tune_steps", 0)}
    run_stage(job, "evaluate", settings, inputs, [run.evaluation], make)


def make_report(job: Job) -> None:
    """Write the report."""
    run = job.run

    def make() -> list[str]:
        target = main_target(run)
        # the page leads with a target: what was composed for a budget is not what it is about
        within_budget = read_budget_plan(run.plan) is not None
        composed = compose(job, scene_plan(run, target)) if within_budget else read_ply(run.composed)
        masks = job.best_masks
        data = report_data(run, job.scene, job.photos, masks, job.ladder, composed, target, job.backend)
        write_report(run.report, data)
        return []

    run_stage(
        job,
        "report",
        {},
        [run.observations, run.models, run.plan, run.evaluation],
        [run.report / "index.html"],
        make,
    )
    job.emit(RunDone(run.report / "index.html", run.path if run.ladder == "nested" else None))
