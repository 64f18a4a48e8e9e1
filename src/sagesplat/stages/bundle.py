"""Makes bundles for the web viewer, from a finished run or from the newest level of a running training."""

import io
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import torch
from PIL import Image

from sagesplat.adapt.observe import large_enough
from sagesplat.adapt.viewpoint import QualityKind, ViewModel
from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Warned
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.names import composed
from sagesplat.formats.increments import INDEX, Increment, full_scene, read_increments, write_increments
from sagesplat.formats.label_edits import ladder_hash
from sagesplat.formats.levels import read_level
from sagesplat.io.files import write_json
from sagesplat.io.lock import alone
from sagesplat.io.npz import Npz
from sagesplat.io.typed import known_json, parse_json_as
from sagesplat.raster import rasterize
from sagesplat.run.job import Job
from sagesplat.run.records import is_made_from, settings_of
from sagesplat.scene import read_scene
from sagesplat.segment.display_names import meant, title_of
from sagesplat.segment.masks import UNLABELLED
from sagesplat.stages.edited import label_settings
from sagesplat.stages.export import increment_files
from sagesplat.stages.plan import main_target
from sagesplat.stages.results import (
    fidelity_of,
    has_photos,
    increments_of,
    observations_of,
    promises_of,
    sampled_of,
    viewpoints_of,
)
from sagesplat.stages.shared import category_and_block, category_colors, distances
from sagesplat.viewer import boxes
from sagesplat.viewer.built import check_viewer, package_viewer
from sagesplat.viewer.bundle import (
    MANIFEST,
    BundleSizes,
    check_target,
    has_viewer,
    write_bundle,
    write_documents,
)
from sagesplat.viewer.corrections import distance_error, with_corrections
from sagesplat.viewer.frames import FLIP, camera_at
from sagesplat.viewer.manifest import CameraEntry, Category, Contents, start_of
from sagesplat.viewer.pack import ASPECT, FOV_Y
from sagesplat.viewer.promises import Seen
from sagesplat.viewer.single_file import check_page, write_single_file

_GROUND = {"dirt", "floor", "grass", "gravel", "ground", "pavement", "platform", "playingfield", "railroad"}
_GROUND |= {"path", "road", "sand", "sidewalk", "snow", "soil", "street", "terrain"}
_FEW = boxes.FEW  # SfM points; with fewer a category's boxes also take its Gaussians
_OPAQUE = 0.1  # least opacity of such Gaussians
_POSTER_HEIGHT = 360  # px
_OTHERS = 10.0  # seconds to wait for another process that writes the same live bundle
_LIVE = ".live.json"  # the level that a live bundle was made from, and its files


@dataclass(frozen=True)
class BundleMade:
    """The content of a bundle, and the accuracy of the distances by its boxes."""

    path: Path
    labels: int
    chunks: int  # increments
    count: int  # Gaussians
    sizes: BundleSizes  # bytes
    agreement: dict[int, tuple[float, float]]  # by label id: median, 95th percentile of the relative error
    error: tuple[float, float]  # the same over all labels


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
    (`stages.edited`), to which these are added. In a scene in blocks, a category's name stands
    for all its per-block categories, and `name@block` for one of them. `chunks`: format of the increments; by
    default that of the run. `viewer`: the built viewer; by default the package's own.

    RunError for a run without nested levels or bounds, or without streams, another folder, unknown names or
    an impossible number; DataError for a damaged increment; SageError without a viewer.
    """
    edited = label_settings(job.run)
    job = _without_capture(replace(job, run=replace(job.run, ladder="nested")))
    _check_made(job)
    names = set(job.names().values())
    names |= {category_and_block(job, name)[0] for name in names}
    always = [*edited.always, *(meant(composed(name), names) for name in always)]
    given = {meant(composed(name), names): weight for name, weight in (weights or {}).items()}
    weights = edited.weights | given
    _check_asked(job, meters_per_unit, always, weights)
    viewer = viewer or package_viewer()
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
        _contents(job, g, job.antialiased),
        chunks=listed,
        meters_per_unit=meters_per_unit,
        drawn=[drawn.cameras[row] for row in drawn.rows("fit")],
        target=_target(job),
        ladder=ladder_hash(listed, job.names()),
        hidden=edited.hidden,
    )
    contents = replace(contents, categories=_with_quality(job, contents.categories, always, weights))
    contents = with_corrections(contents)
    write = write_single_file if single_file else write_bundle
    with TemporaryDirectory() as work:
        if chunks == "spz" and _in_streams(listed):
            contents = _in_spz(job, contents, Path(work) / "increments")
        written = write(out, contents, viewer, _poster(g, contents))
    agreement, error = distance_error(contents)
    count = sum(chunk.count for chunk in full)
    return BundleMade(out, len(contents.categories), len(listed), count, written, agreement, error)


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
    return replace(made, categories=[replace(one, models={}, seen={}) for one in contents.categories])


def _in_streams(listed: Sequence[Increment]) -> bool:
    return any(one.format == "stream" for one in listed)


def _without_capture(job: Job) -> Job:
    """The job with the cameras and points that the run kept: its capture may be gone or changed since."""
    source = replace(job)
    vars(source)["given_scene"] = read_scene(job.run.geometry)
    return replace(job, source=source)


def _poster(g: Gaussians, contents: Contents) -> bytes:
    """A JPEG of the start view, shown while the viewer and the first increments are loading."""
    first = start_of(contents)
    width = round(ASPECT * _POSTER_HEIGHT)
    camera = camera_at(first["position"], first["quaternion"], FOV_Y, width, _POSTER_HEIGHT)
    with torch.no_grad():
        image = rasterize(g, camera, backend="cpu", antialiased=contents.antialiased).rgb
    pixels = (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=72, optimize=True)
    return file.getvalue()


def live_bundle(job: Job, folder: Path, viewer: Path | None = None) -> bool:
    """Write the newest level of a training, which may still run, to `folder`; False if it is there already.

    The bundle has one level per category and no bounds. Files are written atomically. Those that a page may
    still be loading are kept until two newer levels are written. RunError if there is no level yet, or where
    another process writes there for seconds.
    """
    job = replace(job, run=replace(job.run, ladder="snapshots"))  # what training writes knows no instances
    with alone(folder, _OTHERS):
        return _live_bundle(job, folder, viewer or package_viewer())


def _live_bundle(job: Job, folder: Path, viewer: Path) -> bool:
    steps = sorted(p for p in job.run.levels.glob("*.npz") if not p.name.startswith("."))
    if not steps:
        raise RunError(f"{job.run.levels}: no level yet; wait, or run `sagesplat train`")
    newest = {"level": steps[-1].name, "written": steps[-1].stat().st_mtime_ns}
    previous = _read_live(folder / _LIVE)
    if previous and previous.of == newest and (folder / MANIFEST).exists():
        return False
    if not previous:
        check_target(folder)
    if not has_viewer(folder, viewer):  # none yet, or not the one of this package
        check_viewer(viewer)
        shutil.copytree(viewer, folder, dirs_exist_ok=True)
    g = read_level(steps[-1])
    g = g.select(torch.argsort(g.label_ids, stable=True))
    antialiased = _antialiased(job)
    work, target = folder / ".chunks", folder / "chunks"
    sizes = {label: (n,) for label, n in g.counts().items()}
    chunks = write_increments(work, g, sizes, job.names(), antialiased=antialiased)
    target.mkdir(exist_ok=True)
    for chunk in chunks:
        (work / chunk.uri).replace(target / chunk.uri)
    shutil.rmtree(work)
    write_documents(folder, replace(_contents(job, g, antialiased), chunks=chunks, live=True))
    uris = [chunk.uri for chunk in chunks]
    kept = [uris, *(version for version in (previous.kept if previous else ()) if version != uris)][:3]
    write_json(folder / _LIVE, {"of": newest, "kept": kept})
    for path in target.iterdir():
        if path.name not in {uri for version in kept for uri in version}:
            path.unlink()
    return True


@dataclass(frozen=True)
class _Live:
    """What the last call of `live_bundle` wrote down."""

    of: Any = None  # the newest snapshot then
    kept: list[list[str]] = field(default_factory=list)  # files of the last versions


def _read_live(path: Path) -> _Live | None:
    """What the last call of `live_bundle` wrote down; None where there is nothing of use."""
    return known_json(path, _Live)


def _check_made(job: Job) -> None:
    run = job.run
    against_photos = (("observe", run.observations), ("fit", run.promises)) if has_photos(run) else ()
    for stage, path in (
        ("nest", run.increments / INDEX),
        *against_photos,
        ("sample", run.sampled),
        ("fit", run.fidelity),
    ):
        if not path.exists():
            raise RunError(
                f"{run.path}: no {path.relative_to(run.path)}; a bundle needs a finished nested ladder: "
                f"run `sagesplat {stage}`, or `sagesplat run`"
            )
    if not is_made_from(run, "fit", run.increments / INDEX):
        raise RunError(f"{run.fidelity}: fitted to other increments; run `sagesplat fit` again with --force")


def _check_asked(
    job: Job, meters_per_unit: float | None, always: Collection[str], weights: Mapping[str, float]
) -> None:
    if meters_per_unit is not None and not 1e-6 <= meters_per_unit <= 1e6:
        raise RunError(f"{meters_per_unit} metres per unit are impossible; give a number such as 0.5")
    names = set(job.names().values())
    categories = {category_and_block(job, name)[0] for name in names}
    if unknown := sorted({*always, *weights} - names - categories):
        one = ", each also NAME@BLOCK" if job.has_block_categories else ""
        raise RunError(
            f"{', '.join(unknown)}: no such category; there are {', '.join(sorted(categories))}{one}"
        )
    for name, weight in weights.items():
        if not 0 <= weight <= 1e6:
            raise RunError(f"weight {weight} of {name} is impossible; give a number from 0 on, such as 2")


def _contents(job: Job, g: Gaussians, antialiased: bool) -> Contents:
    """The contents of a bundle without increments and bounds."""
    scene, names = job.scene, job.names()
    labels = sorted(g.counts())
    job.check_named(job.run.levels, labels)
    split_names = {i: category_and_block(job, names[i]) for i in labels}
    colors = category_colors(job, {category for category, _ in split_names.values()})
    ground = [i for i in labels if _GROUND & set(_title(job, split_names[i][0]).split())]
    places = _places(job, g)
    return Contents(
        name=scene.name,
        extent=scene.extent,
        cameras=[
            CameraEntry(view.name, scene.split(row), view.camera) for row, view in enumerate(scene.views)
        ],
        categories=[
            Category(
                i,
                names[i],
                _title(job, category),
                colors[category],
                boxes.split_boxes(places[i] * FLIP),
                block=block,
                parent=job.parents.get(category),
            )
            for i, (category, block) in split_names.items()
        ],
        chunks=[],
        folder=job.run.increments,
        sh_degree=g.sh_degree,
        antialiased=antialiased,
        points=scene.points.xyz,
        ground=np.isin(job.point_labels, ground),
    )


def _title(job: Job, category: str) -> str:
    return title_of(category) if category != job.whole_masks.taxonomy.name(UNLABELLED) else "everything else"


def _places(job: Job, g: Gaussians) -> dict[int, np.ndarray]:
    """By label id its SfM points [N, 3]; where they are few, also the means of its opaque Gaussians."""
    points, rows = job.scene.points.xyz, _rows_by_label(job.point_labels)
    means, mine = g.means.numpy(), _rows_by_label(g.label_ids.numpy())
    opaque = g.logit_opacities.numpy() >= np.log(_OPAQUE / (1 - _OPAQUE))
    places = {}
    for label, own in mine.items():
        known = points[rows.get(label, [])]
        if len(known) < _FEW:
            seen = own[opaque[own]]
            known = np.concatenate([known, means[seen if len(seen) else own]])
        places[label] = known
    return places


def _rows_by_label(label_ids: np.ndarray) -> dict[int, np.ndarray]:
    order = np.argsort(label_ids, kind="stable")
    labels, starts = np.unique(label_ids[order], return_index=True)
    return dict(zip(labels.tolist(), np.split(order, starts[1:]), strict=True))


def _with_quality(
    job: Job, categories: Sequence[Category], always: Collection[str], weights: Mapping[str, float]
) -> list[Category]:
    models: dict[QualityKind, dict[int, ViewModel]] = {
        "fidelity": fidelity_of(job),
        "ssim": promises_of(job),
    }
    seen: dict[QualityKind, dict[int, Seen]] = {
        "fidelity": _seen_from_drawn(job),
        "ssim": _seen_in_photos(job) if has_photos(job.run) else {},
    }
    return [
        replace(
            category,
            weight=float(weights.get(category.name, weights.get(category.category, 1.0))),
            always=category.name in always or category.category in always,
            models={q: some[category.label_id] for q, some in models.items() if category.label_id in some},
            seen={q: some[category.label_id] for q, some in seen.items() if category.label_id in some},
        )
        for category in categories
    ]


def _target(job: Job) -> tuple[QualityKind, float] | None:
    """What the run's plan leads with; None without a plan."""
    return main_target(job.run) if job.run.plan.exists() else None


def _seen_in_photos(job: Job) -> dict[int, Seen]:
    """By label id, its share of each photo (0 where it is too small) and its distance there."""
    shares, far = _shares(job), distances(job, job.fit_config.distance)
    nowhere, unknown = np.zeros(len(job.scene.views)), np.full(len(job.scene.views), np.nan)
    return {label: Seen(shares.get(label, nowhere), far.get(label, unknown)) for label in {*shares, *far}}


def _seen_from_drawn(job: Job) -> dict[int, Seen]:
    """The same of the viewpoints at which fidelity was sampled."""
    sampled = sampled_of(job)
    shares = np.where(sampled.shown(), sampled.pixels / sampled.image[:, None], 0.0)
    return {
        label: Seen(shares[:, column], sampled.distance[:, column].astype(np.float64))
        for column, label in enumerate(sampled.labels)
    }


def _shares(job: Job) -> dict[int, np.ndarray]:
    """By label id, the pixel share in each view [V]; 0 where it is too small."""
    table = large_enough(observations_of(job), job.scene)
    table = table.select(table.level == table.level.max(initial=0))
    sizes = np.array([view.camera.width * view.camera.height for view in job.scene.views])
    shares = {label: np.zeros(len(sizes)) for label in set(table.label_id.tolist())}
    for label, view, pixels in zip(table.label_id, table.view, table.num_pixels, strict=True):
        shares[int(label)][view] = pixels / sizes[view]
    return shares


@dataclass(frozen=True)
class _Meta:
    """Of a checkpoint what it belongs to, as JSON of its own."""

    settings: str


@dataclass(frozen=True)
class _Key:
    settings: TrainConfig


def _antialiased(job: Job) -> bool:
    """Whether the run trains with antialiasing; read from the checkpoint while training runs."""
    try:
        return bool(settings_of(job.run, "train")["antialiased"])
    except RunError:
        pass
    try:
        with Npz(job.run.checkpoint) as file:
            meta = parse_json_as(str(file["meta"]), _Meta)
            return parse_json_as(meta.settings, _Key).settings.antialiased
    except (OSError, ValueError, KeyError):
        return False  # no checkpoint yet, or one of another version
