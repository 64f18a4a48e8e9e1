"""Nested levels beside their baselines: same data, same training views, same evaluation."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sagesplat.adapt.allocate import along
from sagesplat.adapt.observe import MIN_SHARE, TOTAL, as_unit, measure, measure_total, render_rgb
from sagesplat.adapt.plan import Plan
from sagesplat.core.config import CompareConfig, PlanConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Progress, RunDone
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.increments import INDEX, read_increments, read_index, shown, write_increments
from sagesplat.formats.levels import read_level, write_set
from sagesplat.formats.stream_increments import write_streams
from sagesplat.io.files import write_text
from sagesplat.io.typed import check_limits
from sagesplat.metrics.color_correct import color_correct_affine
from sagesplat.metrics.image import pasted
from sagesplat.metrics.lpips import Lpips
from sagesplat.output.tables import mean
from sagesplat.raster import Workspace
from sagesplat.run.executor import Local
from sagesplat.run.job import Job
from sagesplat.run.records import is_done, settings_of
from sagesplat.run.remote import work
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import Stage, run_stage, run_stages
from sagesplat.segment.display_names import titles
from sagesplat.stages.compose import compose_inputs, tune_composition
from sagesplat.stages.fit import fit_ladder
from sagesplat.stages.methods import NestedLevels, method_of
from sagesplat.stages.nest import train_capped
from sagesplat.stages.observe import observe_levels
from sagesplat.stages.plan import PAPER_TARGETS, ssim_target, ssim_targets
from sagesplat.stages.results import increments_of
from sagesplat.stages.shared import inlier_inputs, train_config
from sagesplat.stages.snapshots import Snapshots
from sagesplat.studies.compare import report
from sagesplat.studies.lpips import features_of, load_metrics, lpips_hashes
from sagesplat.studies.paper.same_size import nearest_snapshot, prune_to
from sagesplat.train.importance import importance
from sagesplat.train.nested import capped_config

_FEWEST = 10  # Gaussians that a training can begin with
_TOGETHER = 8  # sets in memory at a time


@dataclass(frozen=True)
class Contender:
    """A set of Gaussians to be measured, made when it is its turn."""

    method: str
    name: str
    steps: int  # training steps that it took, from the start
    load: Callable[[], Gaussians]
    encoded: dict[int, int] | None = None  # bytes by label id; None: a file per category
    target: float = np.nan  # SSIM that it was planned for
    budget: float = np.nan  # bytes that it was planned for


def compare(job: Job, config: CompareConfig, copy: Path | None = None) -> list[report.Point]:
    """Train what is missing of the baselines, measure all sets on the test views, write RUN/compare.

    `job` is one on the nested ladder. compare.json has every point; `copy` becomes the same. RunError for a
    run without a finished nested ladder or without test views, and for impossible settings.
    """
    _check(job, config)
    folder, file = _folder(job), _folder(job) / report.FILE
    lpips = lpips_hashes(config.lpips)
    targets = list(config.targets) or sorted({*PAPER_TARGETS, *ssim_targets(job.run)})
    settings = json.loads(json.dumps(asdict(config) | {"targets": targets, "lpips": lpips}))
    is_done(job.run, "compare", settings, None, [file], job.force)  # refused before hours of training
    snapshots = _snapshots(job)
    trained = trained_sets(job, [*pruned_sets(job, config, folder), *mcmc_sets(job, config, folder)])

    def make() -> list[str]:
        nested, sage = NestedLevels(job), Snapshots(snapshots)
        contenders = [
            *snapshot_points(snapshots, config),
            *_sage(sage, targets, settings_of(job.run, "plan")["share"]),
            *trained.values(),
            *prefixes(nested),
            *_planned(nested, config),
        ]
        points = measure_sets(job, contenders, load_metrics(job.emit, config.lpips))
        walks = _walks(nested, sage)
        (folder / report.PAGE).unlink(missing_ok=True)  # it shows what was measured before
        report.write_comparison(file, points, walks, scene=job.scene.name, views=len(job.scene.test_ids))
        return [f"{len(points)} sets in {len(job.scene.test_ids)} test views"]

    run = job.run
    inputs = [run.labels, *method_of(job).files, run.observations, *compose_inputs(job)]
    inputs += [snapshots.run.models, *trained]
    run_stage(job, "compare", settings, inputs, [file], make)
    points, walks = report.read_comparison(file)
    tables = report.make_tables(points, walks, ssim_target(run))

    def show() -> list[str]:
        report.write_report(folder, tables, points, titles(job.names()))
        return list(tables["table_2_baselines"].notes[:-2])

    run_stage(job, "compared", {}, [file], [folder / report.PAGE], show)
    for stem, columns in report.CONSOLE.items():
        table = tables[stem].only(*columns)
        job.emit(table.event)
    if copy:
        write_text(copy, file.read_text(encoding="utf-8"))
    job.emit(RunDone(folder / report.PAGE))
    return points


def _folder(job: Job) -> Path:
    return job.run.path / "compare"


def _check(job: Job, config: CompareConfig) -> None:
    run = job.run
    if not len(job.scene.test_ids):
        raise RunError(f"{run.path}: no test views to compare on; begin a run with --test-every 8")
    for path in (run.prefixes, run.increments / INDEX, run.observations, run.promises, run.plan):
        if not path.exists():
            raise RunError(f"{path}: missing, but all is compared with it; finish `sagesplat run` (nested)")
    check_limits(config)
    smallest = min(config.caps, default=1.0)
    if round(smallest * job.recorded.size(job.last_level.step)) < _FEWEST:
        raise RunError(f"{run.path}: --caps {smallest:g} leaves too few Gaussians to train; choose more")


def _snapshots(job: Job) -> Job:
    """The paper's job on the same run, its ladder measured and fitted as the nested one."""
    other = replace(job, run=RunDir(job.run.path, "snapshots"), source=job)
    observe_levels(other, job.fit_config)
    fit_ladder(other, job.fit_config)
    return other


@dataclass(frozen=True)
class Baseline:
    """A set that is trained once, and kept."""

    method: str
    name: str
    path: Path
    step: int
    settings: dict
    inputs: list[Path]
    make: Callable[..., Gaussians]  # (job, *of)
    of: Callable[[], tuple[Any, ...]]  # what `make` needs beside the job, computed when it is


def pruned_sets(job: Job, config: CompareConfig, folder: Path) -> list[Baseline]:
    """The last snapshot, pruned by LightGaussian's criterion (arXiv:2311.17245) and tuned."""
    last = job.last_level
    steps = settings_of(job.run, "nest")["steps"] if config.tune_steps < 0 else config.tune_steps

    @cache
    def weights() -> np.ndarray:
        views = job.scene.train_ids.tolist()
        antialiased = job.antialiased
        return importance(read_level(last.path), job.scene, views, "weight-volume", antialiased=antialiased)

    return [
        Baseline(
            report.PRUNED, f"{share:.0%}, {steps} steps", folder / f"pruned-{share:g}-{steps}.npz",
            last.step + steps, {"share": share, "tune_steps": steps}, [*job.run.scene_files, last.path],
            _prune, lambda share=share: (share, steps, weights()),
        )
        for share in sorted(set(config.shares))
    ]  # fmt: skip


def _prune(job: Job, share: float, steps: int, weights: np.ndarray) -> Gaussians:
    g = read_level(job.last_level.path)
    return tune_composition(job, prune_to(g, max(1, round(share * len(g))), weights), steps)


def mcmc_sets(job: Job, config: CompareConfig, folder: Path) -> list[Baseline]:
    """3DGS-MCMC from the start, its Gaussians capped at shares of the last snapshot's."""
    run, made, found = job.run, train_config(job), []
    full, seed = job.recorded.size(job.last_level.step), settings_of(job.run, "train")["seed"]
    for share in sorted(set(config.caps)):
        cap, path = round(share * full), folder / f"mcmc-{share:g}.npz"
        settings = {**asdict(capped_config(made, cap, made.max_steps)), "seed": seed}
        of = path.stem, cap, made.max_steps, seed
        baseline = Baseline(
            report.MCMC, f"cap {share:.0%}", path, made.max_steps, settings,
            [*run.scene_files, run.labels, *inlier_inputs(run)],
            train_capped, lambda of=of: of,
        )  # fmt: skip
        found.append(baseline)
    return found


def trained_sets(job: Job, baselines: Sequence[Baseline]) -> dict[Path, Contender]:
    """The baselines by file, trained where they are missing.

    Each is a stage of its own, so that a killed comparison resumes with the next one.
    """
    local = isinstance(job.executor, Local)
    for some in [[b] for b in baselines] if local else [baselines]:
        stages = [Stage(b.path.stem, b.settings, b.inputs, [b.path]) for b in some]
        run_stages(job, stages, partial(_train, job, some))
    return {b.path: Contender(b.method, b.name, b.step, partial(read_level, b.path)) for b in baselines}


def _train(
    job: Job, baselines: Sequence[Baseline], missing: Sequence[int]
) -> Iterator[tuple[int, Sequence[str]]]:
    """Train those of these numbers."""
    some = [baselines[number] for number in missing]
    for i, count in work(job, "baselines", _keep, [(b.make, b.of(), b.path.name, b.step) for b in some]):
        yield missing[i], [f"{count:,} Gaussians"]


def _keep(job: Job, part: tuple[Callable[..., Gaussians], tuple[Any, ...], str, int]) -> int:
    """Train one and write it; its number of Gaussians comes back."""
    make, of, name, step = part
    g = make(job, *of)
    write_set(_folder(job) / name, g, step)
    return len(g)


def snapshot_points(snapshots: Job, config: CompareConfig) -> list[Contender]:
    """Snapshots that no reset has just disturbed, spread in size; of equal ones the latest."""
    ladder = snapshots.recorded
    sizes = [ladder.size(level) for level in ladder.levels]
    wanted = np.geomspace(max(1, min(sizes)), max(sizes), config.snapshots)[::-1]
    picked = sorted({nearest_snapshot(ladder, round(size)) for size in wanted.tolist()})
    return [Contender(report.SNAPSHOTS, f"step {i}", i, partial(ladder.load, i)) for i in picked]


def _sage(sage: Snapshots, targets: Sequence[float], share: float) -> list[Contender]:
    """The paper's compositions for the scene (Eq. 1 with Eq. 3), from the snapshots."""
    ladder, found = sage.job.ladder, []
    for target in targets:
        plan = sage.plan_scene(target, share)
        name = f"SSIM {target:g}, {plan.status}"
        load = partial(plan.compose, ladder)
        found.append(Contender(report.SAGE, name, ladder.levels[-1], load, target=target))
    return found


def prefixes(nested: NestedLevels) -> list[Contender]:
    """The levels, all categories at the same one: as they are sent."""
    job, costs = nested.job, nested.costs
    steps = job.last_level.step + settings_of(job.run, "nest")["steps"]
    found = []
    for k in range(costs.transfer_bytes.shape[1]):
        bytes_of = dict(zip(costs.labels, costs.transfer_bytes[:, k].tolist(), strict=True))
        load = partial(job.ladder.load, k + 1)
        found.append(Contender(report.SAME_SHARE, f"level {k + 1}", steps, load, bytes_of))
    return found


def _planned(nested: NestedLevels, config: CompareConfig) -> list[Contender]:
    """Plans: within budgets, and for the run's targets."""
    job, sent = nested.job, nested.costs.transfer_bytes.sum(0)
    made = settings_of(job.run, "plan")
    budgets = np.ceil(np.geomspace(sent[0], sent[-1], config.budgets)).tolist()
    found = planned_within(nested, [(f"{b / 1e6:.3g} MB", b) for b in budgets], ssim_target(job.run))
    for target in ssim_targets(job.run):
        plan = nested.plan_scene(target, made["share"])
        found.append(_of_plan(nested, f"SSIM {target:g}, {plan.status}", plan))
    return found


def planned_within(
    nested: NestedLevels, budgets: Sequence[tuple[str, float]], target_ssim: float | None = None
) -> list[Contender]:
    """Plans within budgets (name, bytes), without those of a smaller budget: most expected quality.

    Of SSIM against photos where there is a target of it, else of fidelity.
    """
    found, seen = [], []
    for name, nbytes in budgets:
        plan = nested.plan_budget(PlanConfig(target_ssim=target_ssim, budget=nbytes))
        if plan.levels not in seen:
            seen.append(plan.levels)
            found.append(_of_plan(nested, name, plan))
    return found


def _of_plan(nested: NestedLevels, name: str, plan: Plan) -> Contender:
    job = nested.job
    steps = job.last_level.step + settings_of(job.run, "nest")["steps"]
    return Contender(
        report.PLANNED, name, steps, partial(plan.compose, job.ladder),
        {choice.label_id: choice.transfer_bytes or 0 for choice in plan.choices}, plan.target,
        np.nan if plan.budget is None else plan.budget,
    )  # fmt: skip


def measure_sets(job: Job, contenders: Sequence[Contender], metrics: dict[str, Lpips]) -> list[report.Point]:
    """All contenders on all test views, some at a time."""
    labels = job.level_masks
    tests, workspace, points = job.valid.rows(job.scene, job.scene.test_ids), Workspace(), []
    done, total = 0, len(contenders) * len(tests)

    def exposed(row: int) -> bool:
        return job.scene.views[row].camera.exposure is not None

    def image_of(g: Gaussians, row: int, neutral: bool = False) -> np.ndarray:
        camera = job.scene.views[row].camera
        return render_rgb(
            g, camera.neutral if neutral else camera,
            backend=job.backend, antialiased=job.antialiased, workspace=workspace,
        )  # fmt: skip

    for begin in range(0, len(contenders), _TOGETHER):
        some = contenders[begin : begin + _TOGETHER]
        sets = [contender.load() for contender in some]
        found: list[list[dict[str | int, float]]] = [[] for _ in some]
        # nested levels are measured as decoded from their increments
        sent = [
            encode_set(job, g) if c.encoded is None else (c.encoded, None)
            for c, g in zip(some, sets, strict=True)
        ]
        for row in tests:
            photo, here = as_unit(job.photos[row]), labels[job.scene.views[row]]
            valid, of_photo = job.valid[job.scene.views[row]], features_of(metrics, photo)
            for g, (_, arrived), values in zip(sets, sent, found, strict=True):
                image = image_of(g, row)
                values.append(_values(image, photo, here, valid))
                if valid is not None:
                    of_photo = features_of(metrics, pasted(photo, image, valid))
                for column, metric in metrics.items():
                    values[-1][column] = metric.distance(metric.features(image), of_photo[column])
                if exposed(row):
                    values[-1] |= _corrected(image_of(g, row, neutral=True), photo, valid, metrics)
                if arrived is not None:
                    values[-1]["ssim_sent"] = measure_total(image_of(arrived, row), photo, valid)["ssim"]
                done += 1
                job.emit(Progress("compare", done, total))
        parts = zip(some, sets, sent, found, strict=True)
        points += [_point(c, g, encoded, values) for c, g, (encoded, _), values in parts]
    return points


def _corrected(
    image: np.ndarray, photo: np.ndarray, valid: np.ndarray | None, metrics: Mapping[str, Lpips]
) -> dict[str | int, float]:
    """The metrics of a colour-corrected image, by the names that gsplat has for them."""
    corrected = color_correct_affine(image, photo, valid)
    total = measure_total(corrected, photo, valid)
    found: dict[str | int, float] = {"cc_psnr": total["psnr"], "cc_ssim": total["ssim"]}
    of_photo = features_of(metrics, pasted(photo, corrected, valid))
    for column, metric in metrics.items():
        found[f"cc_{column}"] = metric.distance(metric.features(corrected), of_photo[column])
    return found


def _values(
    image: np.ndarray, photo: np.ndarray, labels: np.ndarray, valid: np.ndarray | None
) -> dict[str | int, float]:
    """What is measured of one image: of the whole by name, SSIM of its categories by label id."""
    rows, few = measure(image, photo, labels, valid=valid), MIN_SHARE * labels.size
    whole = {"ssim": rows[TOTAL]["ssim"], "ssim_sent": rows[TOTAL]["ssim"], "psnr": rows[TOTAL]["psnr"]}
    return whole | {i: of["ssim"] for i, of in rows.items() if i != TOTAL and of["num_pixels"] >= few}


def _point(
    contender: Contender, g: Gaussians, encoded: dict[int, int], views: list[dict[str | int, float]]
) -> report.Point:
    def over_views(key: str | int) -> float:
        return mean(np.array([values.get(key, np.nan) for values in views]))

    counts = g.counts()
    ids = sorted({*counts, *(key for values in views for key in values if isinstance(key, int))})
    return report.Point(
        method=contender.method,
        name=contender.name,
        target=contender.target,
        budget=contender.budget,
        count=len(g),
        encoded=sum(encoded.values()),
        steps=contender.steps,
        **{name: over_views(name) for name in ("ssim_sent", *report.MEASURES)},
        labels={i: report.OfLabel(counts.get(i, 0), encoded.get(i, 0), over_views(i)) for i in ids},
    )


def encode_set(job: Job, g: Gaussians) -> tuple[dict[int, int], Gaussians]:
    """Bytes by label id, one file each encoded as the run's increments are, and what a viewer decodes."""
    streams = any(one.format == "stream" for one in read_index(job.run.increments))
    whole = {label: (count,) for label, count in g.counts().items()}
    names, label_of = job.names(), {label: label for label in whole}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "increments"
        if streams:
            made = write_streams(path, g, whole, names, label_of=label_of, antialiased=job.antialiased)
            increments = made.increments
        else:
            increments = write_increments(
                path, g, whole, names, label_of=label_of, antialiased=job.antialiased
            )
        arrived = read_increments(path, increments) if increments else g
    return {c.label_id: c.nbytes for c in increments}, arrived


def _walks(nested: NestedLevels, sage: Snapshots) -> list[report.Walk]:
    """From view to view by name at the main target: ours with hysteresis, and the paper's plans."""
    job, costs = nested.job, nested.costs
    target, views = ssim_target(job.run), range(len(job.scene.views))
    chosen = along(nested.qualities["ssim"].bound, costs.transfer_bytes, target) + 1
    ours = [dict(zip(costs.labels, levels.tolist(), strict=True)) for levels in chosen]
    increments = increments_of(job)
    label_of = job.cells.label_of
    increment_files = {
        (label, k + 1): {
            f"{c.uri} {c.cell} {c.level}": c.nbytes
            for cell, of in label_of.items()
            if of == label
            for c in shown(increments, cell, k + 1)
        }
        for label in costs.labels
        for k in range(costs.transfer_bytes.shape[1])
    }
    theirs = [sage.plan_view(row, target).levels for row in views]
    needed = sorted({choice for levels in theirs for choice in levels.items()})
    level_files = {
        (label, level): {
            f"{label} at {level}": sum(encode_set(job, sage.job.ladder.load(level, [label]))[0].values())
        }
        for label, level in needed
    }
    walks = []
    for keeps in (True, False):
        mine = report.walk("nested", ours, increment_files, keeps)
        replacing = any(c.refine == "REPLACE" for c in increments)
        assert replacing or mine.replaced == 0, "a level must contain the ones below it"
        walks += [mine, report.walk(report.SAGE, theirs, level_files, keeps)]
    return walks
