"""Reads the data of the report from a finished run."""

import json
import math
import os
import platform
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import numpy as np

from sagesplat import __version__
from sagesplat.adapt.fidelity import pooled_cells
from sagesplat.adapt.free_poses import level_axes
from sagesplat.adapt.ladder import NestedLadder
from sagesplat.adapt.observe import as_unit, measure_total, render_rgb
from sagesplat.adapt.plan import Plan
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.adapt.viewpoints import SETS, in_words
from sagesplat.core.config import LadderKind
from sagesplat.core.gaussians import Gaussians
from sagesplat.io.pictures import open_picture
from sagesplat.output.figures import Panel
from sagesplat.output.next_steps import Commands
from sagesplat.output.place_figures import Place
from sagesplat.output.report_data import PromiseFacts, ReportData
from sagesplat.raster import Workspace
from sagesplat.run.capture import read_capture
from sagesplat.run.job import Job
from sagesplat.run.records import read_record, settings_of, uses
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage_table import STAGES, needed_for
from sagesplat.scene import describe
from sagesplat.scene.scene import Camera
from sagesplat.segment.display_names import titles
from sagesplat.segment.masks import UNLABELLED
from sagesplat.stages.looks import looks
from sagesplat.stages.methods import method_of
from sagesplat.stages.plan import scene_plan
from sagesplat.stages.results import (
    evaluation_of,
    fidelity_of,
    has_photos,
    models_of,
    observations_of,
    plans_of,
    sampled_of,
    viewpoints_of,
)
from sagesplat.stages.shared import label_colors
from sagesplat.viewer.frames import FLIP, upward

PANELS = 3  # views shown in pictures


def report_data(
    job: Job,
    composed: Gaussians,
    quality: QualityKind,
    target: float,
    noticed: Sequence[str] = (),
    url: str = "",
) -> ReportData:
    """Everything that the report shows; it leads with the plan for `target`, whose scene is `composed`.

    `url`: where the bundle was published.
    """
    run, scene, masks, ladder = job.run, job.scene, job.level_masks, job.ladder
    names = {**masks.taxonomy.names, UNLABELLED: masks.taxonomy.name(UNLABELLED)}
    promise, drawn, planned = _promise(job, scene_plan(job, quality, target))
    sets = viewpoints_of(job) if promise else None
    beside = settings_of(run, "plan")["target_ssim"] if quality == "fidelity" else None
    records = {path.stem: read_record(path) for path in stage_records(run)}
    return ReportData(
        title=scene.name,
        target=target,
        quality=quality,
        ssim_target=beside,
        sizes=method_of(job).bytes_to_send,
        names=titles(names),
        colours=label_colors(job),
        observations=observations_of(job),
        train_views=scene.train_ids,
        test_views=scene.test_ids,
        view_names=[view.name for view in scene.views],
        counts=ladder.counts,
        recovering=ladder.recovering,
        models=models_of(job),
        plans=list(plans_of(job)),
        evaluation=evaluation_of(job),
        panels=picture_panels(job, composed),
        scene_facts=[(title, _placeless(text)) for title, text in describe(scene)],
        settings=_settings(records),
        timings=[(stage, float(made.get("seconds", math.nan))) for stage, made in records.items()],
        provenance=_provenance(records),
        exposed=any(scene.views[row].camera.exposure is not None for row in scene.test_ids),
        photos=has_photos(run),
        adopted=_adopted(job, ladder) if run.adopted.exists() and isinstance(ladder, NestedLadder) else (),
        viewpoints=_viewpoints(run),
        noticed=noticed,
        commands=_commands(job),
        can_view=method_of(job).streams,
        links=links(run),
        url=url,
        place=_place(job, [view.camera for view in scene.views]),
        promise=promise,
        drawn=drawn,
        planned=planned,
        drawn_at=_place(job, [sets.cameras[row] for row in sets.rows("fit")]) if sets else None,
        looks=looks(job) if sets else (),
    )


def _viewpoints(run: RunDir) -> np.ndarray | None:
    """The contact sheet of an adopted splat."""
    if not (run.adopted.exists() and run.contact_sheet.exists()):
        return None
    with open_picture(run.contact_sheet, ("PNG",)) as image:
        return np.asarray(image.convert("RGB"))


def _adopted(job: Job, ladder: NestedLadder) -> list[tuple[str, str]]:
    """How a splat that somebody else trained was looked at, and how its levels were made."""
    made, nest = settings_of(job.run, "adopt"), settings_of(job.run, "nest")
    trained = f"trained on renders of the splat, {nest['steps']:,} steps"
    names = titles(job.names())
    first = {names[ladder.label_of[cell]]: max(of) for cell, of in ladder.cells.replaces.items() if of}
    originals = ", ".join(f"{titled} {level}" for titled, level in first.items())
    drawn = f"{made['views']} drawn from the splat, kind {made['kind']}"
    return [
        ("file", Path(made["source"]).name),
        ("viewpoints", f"those of {Path(made['cameras']).name}" if made["cameras"] else drawn),
        ("compared with", "photos" if made["photos"] else "renders of the splat as it came in"),
        ("labels", "those of the file, if it has any" if made["labels_of_file"] else "votes of label images"),
        ("lower levels", trained if nest["fit"] == "renders" else "merged Gaussians, not trained"),
        ("originals from level", originals or "1"),
        ("last level", "identical to the file" if nest["lossless"] else "the file, rounded"),
    ]


def stage_records(run: RunDir) -> list[Path]:
    """The records of the stages that a run's results were made by: not of one whose result was deleted."""
    made = needed_for("report")
    if not (run.fused / "labels.json").exists():
        made.remove("fuse")
    if run.ladder != "nested":  # levels are as training recorded them, of categories
        made -= {"clean", "instances", "photo_instances"}
    elif not uses(run, "nest", run.base_model):
        made.remove("base")
    return [path for stage in STAGES if stage in made and (path := run.provenance(stage)).exists()]


def _commands(job: Job) -> Commands:
    """What is typed to go on with a run, in the folder that holds it: that stays right where it is moved."""
    run = job.run
    where = run.path.resolve()
    name = shlex.quote(where.name)
    if run.adopted.exists():
        return Commands(name)
    posed = run.provenance("poses").exists()
    capture = Path(settings_of(run, "poses")["source"] if posed else read_capture(run.scene).path)
    steps = settings_of(run, "train").get("max_steps", 0) if run.provenance("train").exists() else 0
    try:
        near = os.path.relpath(capture, where.parent)
    except ValueError:  # on another drive
        near = capture.name
    return Commands(name, shlex.quote(near), int(steps))


def links(run: RunDir) -> list[tuple[str, str]]:
    """What else was made of a run, by title: addresses relative to its report."""
    pages = [("Its bundle, for any static web server", run.path / "bundle")]
    pages += [
        (f"The paper's tables and figures, --ladder {kind}", RunDir(run.path, kind).paper)
        for kind in get_args(LadderKind)
    ]
    found = [(title, folder / "index.html") for title, folder in pages]
    return [(title, os.path.relpath(path, run.report)) for title, path in found if path.is_file()]


def _place(job: Job, cameras: Sequence[Camera]) -> Place:
    """The capture from above, and cameras."""
    scene = job.scene
    plane = np.stack(level_axes(upward([view.camera for view in scene.views]) * FLIP), axis=1)
    return Place(
        points=scene.points.xyz @ plane,
        colours=scene.points.rgb / 255,
        at=np.stack([camera.position for camera in cameras]) @ plane,
        towards=np.stack([camera.direction for camera in cameras]) @ plane,
    )


def _promise(
    job: Job, plan: Plan
) -> tuple[PromiseFacts | None, dict[int, np.ndarray], dict[int, np.ndarray]]:
    """Facts of the bounds of fidelity; the fidelity at drawn viewpoints by label id, and that of the plan."""
    run = job.run
    if not (run.ladder == "nested" and run.sampled.exists() and run.fidelity.exists()):
        return None, {}, {}
    models, sets = fidelity_of(job), viewpoints_of(job)
    by_cell, cells = sampled_of(job), job.cells
    sampled = by_cell.by_label(cells.label_of)
    confidence = min((model.confidence for model in models.values()), default=0.0)
    fitted, composed, calibration = (len(sets.rows(name)) for name in SETS)
    facts = PromiseFacts(confidence, fitted, composed, calibration, in_words(sets))
    shown = sampled.shown()
    drawn = {
        label: np.where(shown[:, column, None], sampled.fidelity[:, column], np.float32(np.nan))
        for column, label in enumerate(sampled.labels)
        if shown[:, column].any()
    }
    of_cells = plan.levels_of_cells(cells.label_of)
    columns = np.array([of_cells[cell] for cell in by_cell.labels]) - 1
    taken = by_cell.fidelity[:, np.arange(len(columns)), columns]
    member = cells.labels[:, None] == np.array(sampled.labels)
    at_plan = pooled_cells(taken[:, None], by_cell.pixels, member)[:, 0]
    planned = {
        label: np.where(shown[:, column], at_plan[:, column], np.float32(np.nan))
        for column, label in enumerate(sampled.labels)
        if label in drawn
    }
    return facts, drawn, planned


def picture_panels(job: Job, composed: Gaussians) -> list[Panel]:
    """A few test views, spread over the capture, in pictures."""
    scene, photos, masks, ladder = job.scene, job.photos, job.level_masks, job.ladder
    tests = np.array(job.valid.rows(scene, scene.test_ids), int)
    if not len(tests):
        return []
    rows = tests[np.unique(np.linspace(0, len(tests) - 1, PANELS + 2).round().astype(int))[1:-1]]
    if not len(rows):
        rows = tests[:1]
    full = ladder.load(ladder.levels[-1])
    panels, space = [], Workspace()
    for row in rows.tolist():
        view, photo = scene.views[row], photos[row]
        images = [
            render_rgb(g, view.camera, backend=job.backend, antialiased=job.antialiased, workspace=space)
            for g in (full, composed)
        ]
        of_full, of_composed = (measure_total(image, as_unit(photo), job.valid[view]) for image in images)
        eight_bit = [np.round(image * 255).astype(np.uint8) for image in images]
        panels.append(
            Panel(
                name=view.name,
                photo=photo,
                full=eight_bit[0],
                composed=eight_bit[1],
                label_ids=masks[view],
                ssim=of_composed["ssim"],
                psnr=of_composed["psnr"],
                full_ssim=of_full["ssim"],
                full_psnr=of_full["psnr"],
                valid=job.valid[view],
            )
        )
    return panels


def _settings(records: dict[str, dict]) -> list[tuple[str, str]]:
    """Settings by stage, fingerprints left out."""
    rows = []
    for stage, made in records.items():
        for name, value in made["settings"].items():
            text = _placeless(value) if isinstance(value, str) else json.dumps(value)
            if len(text) != 64:  # a hash
                rows.append((f"{stage}.{name}", text))
    return rows


def _placeless(text: str) -> str:
    """The name of a path outside of the run, which moving the run does not make wrong; of others the text."""
    return Path(text).name if os.path.isabs(text) or text.startswith("../") else text


def _provenance(records: dict[str, dict]) -> list[tuple[str, str]]:
    """Versions, and the hashes that tie the results to their inputs."""
    import numba
    import torch

    versions = [
        ("sagesplat", __version__),
        ("Python", platform.python_version()),
        ("machine", f"{platform.system()} {platform.machine()}"),
        ("torch", torch.__version__),
        ("numba", numba.__version__),
    ]
    hashes = {_placeless(name): h for made in records.values() for name, h in made["inputs"].items()}
    return versions + [(f"sha256 of {name}", h) for name, h in sorted(hashes.items())]
