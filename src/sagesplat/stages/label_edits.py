"""Applies edits of labels to a finished run: a new run folder with other categories, without training again.

Renaming and settings move nothing. Merged categories are measured by what was measured of their parts
(`adapt.regroup`); where one is split, its parts are measured. Then the models are fitted and calibrated, in
compositions of the new levels, for the categories that changed, and the plan and the bundle made. Merged
Gaussians stand for others of one category, so those of an adopted splat are made anew where it is edited.
"""

import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from scipy.spatial import KDTree

from sagesplat.adapt.regroup import NewCell
from sagesplat.core.config import AdoptConfig, FitConfig, PlanConfig, RunConfig, SceneConfig
from sagesplat.core.errors import LabelError, RunError
from sagesplat.core.events import StageDone, StageStarted
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.label_edits import FILE, LabelEdits, dump_edits, ladder_hash, read_edits
from sagesplat.io.files import atomic_folder, loads_json
from sagesplat.run.job import Job
from sagesplat.run.recorded import recorded_settings
from sagesplat.run.records import read_record, record
from sagesplat.run.run_dir import RunDir, check_run
from sagesplat.segment.display_names import categories
from sagesplat.segment.masks import UNLABELLED
from sagesplat.segment.parents import write_parents
from sagesplat.segment.relabel import Relabelled, relabelled
from sagesplat.stages import pipeline
from sagesplat.stages.bundle import BundleMade, bundle
from sagesplat.stages.edited import LabelSettings, label_settings, write_edited
from sagesplat.stages.given import write_given_cameras, write_given_splat
from sagesplat.stages.plan import make_plan
from sagesplat.stages.refit import refit
from sagesplat.stages.regroup import measure, move_labels, move_levels
from sagesplat.stages.results import increments_of
from sagesplat.stages.view import is_finished

# what a run begins with, as it is; label images, point labels and levels are written anew
_KEPT = (
    "scene.json", "photos.json", "source.json", "geometry.npz", "cameras.npz", "refined.json", "sky.npz",
    "valid", "inliers", "adopted.npz", "viewpoints.png", "floaters.json", "floaters.png", "frozen.json",
    "masks", "fused", "labels.npz", "provenance",
)  # fmt: skip
_OF_LADDER = (
    "ladder.npz", "cells.npz", "increments", "observations.csv", "viewpoints.json", "fidelity.npz",
    "fidelity.json", "models.json", "promises.json", "plan.json", "provenance",
)  # fmt: skip
_MEASURED = ("nest", "observe", "sample", "fit", "plan")  # stages in their order, each recorded again


@dataclass(frozen=True)
class LabelsApplied:
    """An edited run and its bundle."""

    path: Path
    bundle: BundleMade
    trained: bool  # whether anything had to be trained or measured by rendering levels again
    categories: tuple[str, ...]


def apply_labels(
    job: Job, edits: Path | None = None, out: Path | None = None, *, viewer: Path | None = None
) -> LabelsApplied:
    """Make a new run of a finished one, with edited categories, and its bundle: `sagesplat.apply_labels`.

    The run stays as it is. Where edits merge or split categories of an adopted splat whose levels replace
    those below, its levels are made and measured anew, which resumes where it was killed. `viewer`: the built
    one; None: the package's own.
    """
    path = edits or job.run.path / FILE
    out = (out or job.run.path.resolve().with_name(f"{job.run.path.resolve().name}-edited")).resolve()
    job = replace(job, run=replace(job.run, ladder="nested"), locks=None)
    check_run(job.run)
    if not is_finished(job.run):
        raise RunError(f"{job.run.path}: not finished; run `sagesplat run` again, then apply the edits")
    found = read_edits(path)
    made = _checked(job, found, path)
    _check_out(job.run, out)
    if made.changed and job.by_cell.replaces:
        return _adopt_again(job, out, found, made, viewer)
    begin = time.perf_counter()
    job.emit(StageStarted("labels"))
    with atomic_folder(out) as fresh:
        new = _begin(job, fresh, found, made)
        measured = _make(job, new, made)
        job.emit(StageDone("labels", time.perf_counter() - begin, _lines(made, measured)))
        written = bundle(new, fresh / "bundle", viewer=viewer)
    names = tuple(made.names.values())
    return LabelsApplied(out, replace(written, path=out / "bundle"), measured, names)


def _checked(job: Job, edits: LabelEdits, path: Path) -> Relabelled:
    """The categories after the edits; LabelError or RunError where they cannot be applied."""
    increments, names = increments_of(job), job.names()
    if ladder_hash(increments, names) != edits.ladder:
        raise LabelError(
            f"{path}: edits of another run than {job.run.path}, or of its earlier levels; open that run with "
            "`sagesplat view RUN --edit` and edit it"
        )
    if not edits.operations:
        raise LabelError(f"{path}: no operations; there is nothing to apply")
    last = job.ladder.levels[-1]  # of which edits name Gaussians
    counts = {label: count for (label, level), count in job.ladder.counts.items() if level == last}
    try:
        made = relabelled(
            {label: names[label] for label in counts}, counts, edits.operations,
            **vars(label_settings(job.run)),
        )  # fmt: skip
    except LabelError as error:
        raise LabelError(f"{path}: {error}") from None
    shown = {name for label, name in job.taxonomy.names.items() if label not in counts}
    if taken := sorted(shown & set(made.names.values())):
        raise LabelError(
            f"{path}: the name {taken[0]!r} is that of a category that label images show, without Gaussians; "
            "choose another"
        )
    if made.changed and not job.by_cell.replaces and any(one.format != "stream" for one in increments):
        raise RunError(
            f"{job.run.path}: levels in PLY or SPZ files; its categories can be renamed, hidden, weighed and "
            "kept in full, but not merged or split"
        )
    return made


def _check_out(run: RunDir, out: Path) -> None:
    if out == run.path.resolve():
        raise RunError(f"{out}: the run itself; name another folder for the edited run")
    ours = (RunDir(out).edited, RunDir(out).from_python / FILE)
    if out.is_dir() and any(out.iterdir()) and not any(path.exists() for path in ours):
        raise RunError(f"{out}: neither empty nor an edited run; name a new folder")


def _adopt_again(
    job: Job, out: Path, edits: LabelEdits, made: Relabelled, viewer: Path | None
) -> LabelsApplied:
    """Adopt the splat that came in once more, with its new labels and from the same viewpoints."""
    new = replace(_job_on(job, out), force=True)
    known, run = recorded_settings(job.run), new.run
    config: AdoptConfig = replace(known["adopt"], lod=0)  # a PLY has only one
    run.edited.unlink(missing_ok=True)  # it is no finished edited run any more
    run.from_python.mkdir(parents=True, exist_ok=True)
    (run.from_python / FILE).write_bytes(dump_edits(edits))  # says whose folder it is
    parents = made.parents(job.parents, job.names())
    source = write_given_splat(
        run, _with_new_labels(job, made), made.names, job.antialiased, offset=job.scene.offset,
        parents={label: parents[name] for label, name in made.names.items() if name in parents},
    )  # fmt: skip
    if not config.cameras:
        cameras = [view.camera for view in job.scene.views]
        config = replace(config, cameras=write_given_cameras(run, cameras, job.scene.offset))
    plan: PlanConfig = known.get("plan", PlanConfig())
    plan = replace(plan, weights=made.weights if plan.budget else {})
    later = {name: known[name] for name in ("sample", "fit") if name in known}
    scene = known.get("scene_config", SceneConfig())
    pipeline.adopt(new, source, config, RunConfig(scene, plan=plan, **later))
    _write_settings(job, new, edits, made)
    return LabelsApplied(out, bundle(new, out / "bundle", viewer=viewer), True, tuple(made.names.values()))


def _with_new_labels(job: Job, made: Relabelled) -> Gaussians:
    """The splat that came in, each Gaussian with the new category of the nearest one of its last level.

    That level has the same Gaussians, rounded, in another order, without those that are hardly to be seen.
    """
    before, top = job.came_in, job.ladder.load(job.ladder.levels[-1])
    assert before is not None  # adopted levels alone replace those below
    ids = torch.full_like(before.label_ids, UNLABELLED)
    for old, new_ids in made.new_ids.items():
        rows = before.label_ids == old
        nearest = KDTree(top.means[top.label_ids == old].numpy()).query(before.means[rows].numpy())[1]
        ids[rows] = torch.from_numpy(new_ids[nearest])
    return replace(before, label_ids=ids)


def _job_on(job: Job, path: Path) -> Job:
    return Job(
        replace(job.run, path=path), job.emit, job.backend, job.threads, device=job.device,
        memory_limit=job.memory_limit, executor=job.executor,
    )  # fmt: skip


def _write_settings(job: Job, new: Job, edits: LabelEdits, made: Relabelled) -> None:
    settings = LabelSettings(made.weights, made.hidden, made.always)
    write_edited(new.run, job.run.path.name, loads_json(dump_edits(edits)), settings)


def _begin(job: Job, fresh: Path, edits: LabelEdits, made: Relabelled) -> Job:
    """Copy what stays to the new folder; the job on it."""
    started = _job_on(job, fresh)
    new = started.run
    # fidelity is against the splat that came in; what was trained here is the last nested level
    came_in = (job.run.levels.name,) if job.run.adopted.exists() else ()
    folders = (((*_KEPT, *came_in), job.run.path, fresh), (_OF_LADDER, job.run.adapted, new.adapted))
    for names, source, target in folders:
        target.mkdir(exist_ok=True)
        for name in names:
            if (source / name).is_dir():
                shutil.copytree(source / name, target / name, dirs_exist_ok=True)
            elif (source / name).exists():
                shutil.copy2(source / name, target / name)
    for earlier in (new.adapted / "provenance").glob("*.json"):
        if earlier.stem not in _MEASURED:
            earlier.unlink()
    if job.run.has_instances:
        _keep_instances_alone(job.run, new)
    write_parents(new.parents, made.parents(job.parents, job.names()))
    _write_settings(job, started, edits, made)
    return replace(started, source=job)


def _keep_instances_alone(run: RunDir, new: RunDir) -> None:
    """Label images of instances become those of the edited run; what they were made of stays behind."""
    for folder in (new.masks, new.fused):
        shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(run.instances, new.masks)
    shutil.move(new.masks / run.instance_labels.name, new.labels)
    for stage in ("fuse", "instances", "photo_instances"):
        new.provenance(stage).unlink(missing_ok=True)


def _make(job: Job, new: Job, made: Relabelled) -> bool:
    """Levels, measurements, models and plan of the new categories; whether levels were rendered again."""
    cells: dict[int, NewCell] = move_levels(job, new, made) if made.changed else {}
    move_labels(job, new, made)
    _sign(new.run, "masks", [new.run.edited])
    known = recorded_settings(new.run)
    fit: FitConfig = known["fit"]
    if not made.changed:
        for stage in _MEASURED:
            _sign(new.run, stage)
        return False
    _sign(new.run, "nest")
    rendered = measure(job, new, made, cells, fit)
    _sign(new.run, "observe")
    _sign(new.run, "sample")
    refit(job, new, fit, made.changed, cells)
    _sign(new.run, "fit")
    plan: PlanConfig = known.get("plan", PlanConfig())
    make_plan(new, replace(plan, weights=made.weights if plan.budget else {}))
    return rendered


def _sign(run: RunDir, stage: str, more: Sequence[Path] = ()) -> None:
    """Record a stage's result as made from its inputs as they are in this folder now."""
    path = run.provenance(stage)
    if not path.exists():
        return
    made = read_record(path)
    inputs = [run.path / name for name in made["inputs"]]
    record(run, stage, made["settings"], [one for one in [*inputs, *more] if one.exists()], made["seconds"])


def _lines(made: Relabelled, rendered: bool) -> tuple[str, ...]:
    how = "rendered again to measure what changed" if rendered else "nothing trained or rendered again"
    return (f"{categories(len(made.names))}, {len(made.changed)} of other Gaussians than before; {how}",)
