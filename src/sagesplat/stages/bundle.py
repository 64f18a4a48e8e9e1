"""Makes bundles for the web viewer from finished runs."""

import io
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from sagesplat.adapt.observe import large_enough
from sagesplat.core.errors import RunError
from sagesplat.core.events import Warned
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.names import composed
from sagesplat.formats.increments import INDEX, Increment, full_scene, read_increments
from sagesplat.formats.label_edits import ladder_hash
from sagesplat.raster import rasterize
from sagesplat.run.job import Job
from sagesplat.run.records import is_made_from
from sagesplat.run.run_dir import check_run
from sagesplat.scene import read_scene
from sagesplat.segment.display_names import meant
from sagesplat.stages.bundle_contents import bundle_contents
from sagesplat.stages.edited import label_settings
from sagesplat.stages.export import increment_files
from sagesplat.stages.looks import looks
from sagesplat.stages.plan import main_target
from sagesplat.stages.results import (
    cells_of,
    fidelity_of,
    has_photos,
    increments_of,
    observations_of,
    promises_of,
    viewpoints_of,
)
from sagesplat.viewer.built import check_viewer, package_viewer
from sagesplat.viewer.bundle import BundleSizes, check_target, write_bundle
from sagesplat.viewer.corrections import with_corrections
from sagesplat.viewer.frames import camera_at
from sagesplat.viewer.manifest import Category, Contents, start_of
from sagesplat.viewer.pack import ASPECT, FOV_Y
from sagesplat.viewer.promises import Seen
from sagesplat.viewer.single_file import check_page, write_single_file

_POSTER_HEIGHT = 360  # px
_LOOKS = 840  # px, longer side of a view, of which a third shows what fidelities look like
_MOST_LOOKS = 2.0  # times the photos' pixels: larger ones show nothing more


@dataclass(frozen=True)
class BundleMade:
    """The content of a bundle."""

    path: Path
    labels: int
    chunks: int  # increments
    count: int  # Gaussians
    sizes: BundleSizes  # bytes


def bundle(
    job: Job,
    out: Path,
    *,
    meters_per_unit: float | None = None,
    always: Collection[str] = (),
    weights: Mapping[str, float] | None = None,
    single_file: bool = False,
    chunks: Literal["stream", "spz"] | None = None,
    viewer: Path | None = None,
) -> BundleMade:
    """Write a finished run as a bundle into `out`: a new or empty folder, or an earlier bundle.

    With `single_file`, `out` is one HTML page.

    `meters_per_unit`: scale of the scene; by default guessed from the cameras' height. `always`: categories
    shipped in full. `weights`: by category, 1 for the others. An edited run has settings of its own
    (`stages.edited`), to which these are added. `chunks`: format of the increments; by default that of the
    run. `viewer`: the built viewer; by default the package's own.

    RunError for a run without nested levels or bounds, or without streams, another folder, unknown names or
    an impossible number; DataError for a damaged increment; SageError without a viewer.
    """
    edited = label_settings(job.run)
    job = replace(job, run=replace(job.run, ladder="nested"))
    _check_made(job)
    job = _without_capture(job)
    names = set(job.names().values())
    always = [*edited.always, *(meant(composed(name), names) for name in always)]
    given = {meant(composed(name), names): weight for name, weight in (weights or {}).items()}
    weights = edited.weights | given
    _check_asked(job, meters_per_unit, always, weights)
    viewer = viewer or package_viewer()
    if not single_file and out.suffix.lower() in (".html", ".htm"):
        raise RunError(f"{out}: a bundle is a folder; add --single-file for one page")
    (check_page if single_file else check_target)(out)
    check_viewer(viewer)
    listed = increments_of(job)
    if chunks == "stream" and not _in_streams(listed):
        raise RunError(
            f"{job.run.increments}: increments in SPZ files, not in coded streams; leave out --chunks"
        )
    full = full_scene(listed)
    g, drawn = read_increments(job.run.increments, full), viewpoints_of(job)
    contents = replace(
        bundle_contents(job, g, cells_of(job), job.antialiased),
        chunks=listed,
        meters_per_unit=meters_per_unit,
        drawn=[drawn.cameras[row] for row in drawn.rows("fit")],
        target=main_target(job.run) if job.run.plan.exists() else None,
        ladder=ladder_hash(listed, job.names()),
        hidden=edited.hidden,
        looks=_looks(job),
    )
    contents = replace(contents, categories=_with_quality(job, contents.categories, always, weights))
    contents = with_corrections(contents)
    write = write_single_file if single_file else write_bundle
    with TemporaryDirectory() as work:
        if chunks == "spz" and _in_streams(listed):
            contents = _in_spz(job, contents, Path(work) / "increments")
        written = write(out, contents, viewer, _poster(g, contents))
    count = sum(chunk.count for chunk in full)
    return BundleMade(out, len(contents.categories), len(listed), count, written)


def _in_spz(job: Job, contents: Contents, folder: Path) -> Contents:
    """The contents with increments in SPZ files, written to `folder`.

    SPZ has one opacity for each Gaussian. Where streams have two, the bounds of their levels would be wrong.
    """
    made = replace(contents, chunks=increment_files(job, folder, "spz"), folder=folder)
    if all(one.weight is None for one in contents.chunks):
        return made
    job.emit(
        Warned(
            "SPZ has one opacity for each Gaussian, here that of the full model: lower levels look worse "
            "than in coded streams, and the bundle has no bounds of them"
        )
    )
    return replace(
        made, categories=[replace(one, fidelity=None, ssim=None, seen=None) for one in contents.categories]
    )


def _in_streams(listed: Sequence[Increment]) -> bool:
    return any(one.format == "stream" for one in listed)


def _without_capture(job: Job) -> Job:
    """The job with the cameras and points that the run kept: its capture may be gone or changed since."""
    source = replace(job)
    source.given_scene = read_scene(job.run.geometry)
    return replace(job, source=source)


def _poster(g: Gaussians, contents: Contents) -> bytes:
    """A JPEG of the start view, shown while the viewer and the first increments are loading."""
    first = start_of(contents)
    width = round(ASPECT * _POSTER_HEIGHT)
    camera = camera_at(first["position"], first["quaternion"], FOV_Y, width, _POSTER_HEIGHT)
    with torch.no_grad():
        image = rasterize(g, camera, backend="cpu", antialiased=contents.antialiased).rgb
    return _jpeg((image.clamp(0, 1) * 255).round().to(torch.uint8).numpy(), 72)


def _looks(job: Job) -> tuple[Sequence[float], bytes] | None:
    """The fidelities of the run's plans and 1, and a JPEG of a part of a view at each, side by side."""
    side = max(max(view.camera.width, view.camera.height) for view in job.scene.views)
    shown = looks(job, min(_MOST_LOOKS, _LOOKS / side))
    if not shown:
        return None
    return [look.asked for look in shown], _jpeg(np.concatenate([look.image for look in shown], axis=1), 85)


def _jpeg(pixels: UInt8[np.ndarray, "H W 3"], quality: int) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=quality, optimize=True)
    return file.getvalue()


def _check_made(job: Job) -> None:
    run = job.run
    check_run(run)
    against_photos = (("observe", run.observations), ("fit", run.promises)) if has_photos(run) else ()
    for stage, path in (
        ("nest", run.increments / INDEX),
        *against_photos,
        ("sample", run.sampled),
        ("fit", run.fidelity),
    ):
        if not path.exists():
            raise RunError(
                f"{run.path}: no {path.relative_to(run.path)}; a bundle needs finished nested levels: run "
                f"`sagesplat {stage} {run.path}`, or `sagesplat run` again with --ladder nested"
            )
    if not is_made_from(run, "fit", run.increments / INDEX):
        raise RunError(f"{run.fidelity}: fitted to other increments; run `sagesplat fit` again with --force")


def _check_asked(
    job: Job, meters_per_unit: float | None, always: Collection[str], weights: Mapping[str, float]
) -> None:
    if meters_per_unit is not None and not 1e-6 <= meters_per_unit <= 1e6:
        raise RunError(f"{meters_per_unit} metres per unit are impossible; give a number such as 0.5")
    names = set(job.names().values())
    if unknown := sorted({*always, *weights} - names):
        raise RunError(f"{', '.join(unknown)}: no such category; there are {', '.join(sorted(names))}")
    for name, weight in weights.items():
        if not 0 <= weight <= 1e6:
            raise RunError(f"weight {weight} of {name} is impossible; give a number from 0 on, such as 2")


def _with_quality(
    job: Job, categories: Sequence[Category], always: Collection[str], weights: Mapping[str, float]
) -> list[Category]:
    fidelity, ssim = fidelity_of(job), promises_of(job)
    seen = _seen_in_photos(job) if has_photos(job.run) else {}
    found = []
    for category in categories:
        label = category.label_id
        found.append(
            replace(
                category,
                weight=float(weights.get(category.name, 1.0)),
                always=category.name in always,
                fidelity=fidelity.get(label),
                ssim=ssim.get(label),
                seen=seen.get(label),
            )
        )
    return found


def _seen_in_photos(job: Job) -> dict[int, Seen]:
    """By label id, its share of each photo (0 where it is too small) and its distance there."""
    shares, far = _shares(job), job.distances(job.fit_config.distance)
    nowhere, unknown = np.zeros(len(job.scene.views)), np.full(len(job.scene.views), np.nan)
    return {label: Seen(shares.get(label, nowhere), far.get(label, unknown)) for label in {*shares, *far}}


def _shares(job: Job) -> dict[int, np.ndarray]:
    """By label id, the pixel share in each view [V]; 0 where it is too small."""
    table = large_enough(observations_of(job), job.scene)
    table = table.select(table.level == table.level.max(initial=0))
    sizes = np.array([view.camera.width * view.camera.height for view in job.scene.views])
    shares = {label: np.zeros(len(sizes)) for label in set(table.label_id.tolist())}
    for label, view, pixels in zip(table.label_id, table.view, table.num_pixels, strict=True):
        shares[int(label)][view] = pixels / sizes[view]
    return shares
