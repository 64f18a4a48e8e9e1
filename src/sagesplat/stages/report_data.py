"""Reads the data of the report from a finished run."""

import json
import math
import platform
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sagesplat import __version__
from sagesplat.adapt.ladder import PrefixLadder
from sagesplat.adapt.observe import as_unit, measure_total, render_rgb
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.core.gaussians import Gaussians
from sagesplat.io.pictures import open_picture
from sagesplat.output.figures import Colours, Panel
from sagesplat.output.report import ReportData
from sagesplat.run.job import Job
from sagesplat.run.records import read_record, settings_of
from sagesplat.run.run_dir import RunDir
from sagesplat.scene import describe
from sagesplat.segment.block_categories import category_of
from sagesplat.segment.display_names import titles
from sagesplat.segment.masks import UNLABELLED, UNLABELLED_COLOR, Taxonomy
from sagesplat.stages.methods import method_of
from sagesplat.stages.results import evaluation_of, has_photos, models_of, observations_of, plans_of

PANELS = 3  # views shown in pictures
STAGES = (
    *("adopt", "poses", "scene", "segment", "masks", "lift", "train", "clean", "fuse"),
    *("nest", "observe", "sample", "fit", "plan", "compose", "evaluate"),
)


def report_data(
    job: Job, composed: Gaussians, quality: QualityKind, target: float, noticed: Sequence[str] = ()
) -> ReportData:
    """Everything that the report shows; it leads with the plan for `target`, whose scene is `composed`."""
    run, scene, masks, ladder = job.run, job.scene, job.best_masks, job.ladder
    names = {**masks.taxonomy.names, UNLABELLED: masks.taxonomy.name(UNLABELLED)}
    categories, colours = _parts(run, names)
    beside = settings_of(run, "plan").get("target_ssim") if quality == "fidelity" else None
    records = {path.stem: read_record(path) for path in stage_records(run)}
    return ReportData(
        title=scene.name,
        target=target,
        quality=quality,
        ssim_target=beside,
        sizes=method_of(job).bytes_to_send,
        names=titles(names),
        colours=colours or {label: masks.taxonomy.color(label) for label in names},
        observations=observations_of(job),
        train_views=scene.train_ids,
        test_views=scene.test_ids,
        view_names=[view.name for view in scene.views],
        counts=ladder.counts,
        recovering=ladder.recovering,
        models=models_of(job),
        plans=list(plans_of(job)),
        evaluation=evaluation_of(job),
        panels=_panels(job, composed),
        scene_facts=describe(scene),
        settings=_settings(records),
        timings=[(stage, float(made.get("seconds", math.nan))) for stage, made in records.items()],
        provenance=_provenance(records),
        categories=categories,
        exposed=any(scene.views[row].camera.exposure is not None for row in scene.test_ids),
        photos=has_photos(run),
        adopted=_adopted(job, ladder) if run.adopted.exists() and isinstance(ladder, PrefixLadder) else (),
        viewpoints=_viewpoints(run),
        noticed=noticed,
    )


def _viewpoints(run: RunDir) -> np.ndarray | None:
    """The contact sheet of an adopted splat."""
    if not (run.adopted.exists() and run.contact_sheet.exists()):
        return None
    with open_picture(run.contact_sheet, ("PNG",)) as image:
        return np.asarray(image.convert("RGB"))


def _adopted(job: Job, ladder: PrefixLadder) -> list[tuple[str, str]]:
    """How a splat that somebody else trained was looked at, and how its levels were made."""
    made, nest = settings_of(job.run, "adopt"), settings_of(job.run, "nest")
    trained = f"trained on renders of the splat, {nest['steps']:,} steps"
    first = {job.names()[label]: max(levels) for label, levels in ladder.replaces.items() if levels}
    originals = ", ".join(f"{titled} {level}" for titled, level in first.items())
    return [
        ("file", Path(made["source"]).name),
        (
            "viewpoints",
            made["cameras"] or f"{made['views']} drawn from the splat, kind {made['kind']}",
        ),
        ("compared with", "photos" if made["photos"] else "renders of the splat as it came in"),
        ("labels", "those of the file, if it has any" if made["labelled"] else "votes of label images"),
        ("lower levels", trained if nest["fit"] == "renders" else "merged Gaussians, not trained"),
        ("originals from level", originals or "1"),
        (
            "last level",
            "identical to the file" if nest["lossless"] else "the file, rounded as SPZ",
        ),
    ]


def stage_records(run: RunDir) -> list[Path]:
    """The records of the stages that a run's results were made by: not of one whose result was deleted."""
    without = set() if (run.fused / "labels.json").exists() else {"fuse"}
    without |= {"clean"} if run.ladder != "nested" else set()  # snapshots are as training recorded them
    return [path for s in STAGES if s not in without and (path := run.provenance(s)).exists()]


def _parts(run: RunDir, names: dict[int, str]) -> tuple[dict[int, int], Colours]:
    """Of a scene in blocks: the label of each per-block category's category, and its colour; else nothing."""
    if not (run.block_categories / "labels.json").exists():
        return {}, {}
    taxonomy = Taxonomy.read(run.masks / "labels.json")
    by_name = {taxonomy.name(i): taxonomy.color(i) for i in (UNLABELLED, *taxonomy.names)}
    of = {label: category_of(name) for label, name in sorted(names.items())}
    stands: dict[str, int] = {}
    for label, category in of.items():
        stands.setdefault(category, label)
    colours = {label: by_name.get(category, UNLABELLED_COLOR) for label, category in of.items()}
    return {label: stands[category] for label, category in of.items() if label != UNLABELLED}, colours


def _panels(job: Job, composed: Gaussians) -> list[Panel]:
    """A few test views, spread over the capture, in pictures."""
    scene, photos, masks, ladder = job.scene, job.photos, job.best_masks, job.ladder
    tests = np.array(job.valid.rows(scene, scene.test_ids), int)
    if not len(tests):
        return []
    rows = tests[np.unique(np.linspace(0, len(tests) - 1, PANELS + 2).round().astype(int))[1:-1]]
    if not len(rows):
        rows = tests[:1]
    full = ladder.load(ladder.levels[-1])
    panels = []
    for row in rows.tolist():
        view = scene.views[row]
        photo = photos[row]
        images = [
            render_rgb(g, view.camera, backend=job.backend, antialiased=job.antialiased)
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
            )
        )
    return panels


def _settings(records: dict[str, dict]) -> list[tuple[str, str]]:
    """Settings by stage, fingerprints left out."""
    rows = []
    for stage, made in records.items():
        for name, value in made["settings"].items():
            text = value if isinstance(value, str) else json.dumps(value)
            if len(text) != 64:  # a hash
                rows.append((f"{stage}.{name}", text))
    return rows


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
    hashes = {name: h for made in records.values() for name, h in made["inputs"].items()}
    return versions + [(f"sha256 of {name}", h) for name, h in sorted(hashes.items())]
