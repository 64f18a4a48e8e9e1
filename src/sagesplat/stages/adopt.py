"""Begins a run with a splat that somebody else trained: its Gaussians, viewpoints, labels."""

import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from sagesplat.adapt.free_viewpoints import free_cameras
from sagesplat.adapt.observe import RenderedLabels
from sagesplat.core.config import AdoptConfig, LabelsConfig, MasksConfig, SceneConfig, TrainConfig
from sagesplat.core.events import Progress, Warned
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.names import repaired
from sagesplat.core.sh import sh0_to_rgb
from sagesplat.formats.levels import read_header, read_level, read_more, write_level, write_set
from sagesplat.formats.splats import Splat, read_splat
from sagesplat.output.contact_sheet import contact_sheet
from sagesplat.run.job import Job
from sagesplat.run.records import file_hash
from sagesplat.run.stage import run_stage
from sagesplat.scene.cameras import NamedCamera, read_camera_file
from sagesplat.scene.colmap_write import ModelCamera, ModelImage, write_model
from sagesplat.scene.scene import Camera, View
from sagesplat.segment.lift import LiftedLabels
from sagesplat.segment.masks import UNLABELLED, Taxonomy, prepare_folder, write_labels, write_mask
from sagesplat.stages.label import make_masks
from sagesplat.stages.scene import open_scene
from sagesplat.train.votes import vote
from sagesplat.viewer.frames import FLIP, upward

_WHOLE = {0: "scene"}  # the one category of a splat without labels
_POINTS = 50_000  # means that stand for the points of a capture
_OPAQUE = 0.1  # their least opacity, as far as there are such
_STEPS = 1500  # of a training, whose time the sampling of fidelity may take a part of
_LEVEL = 1  # number of the one level that a splat from elsewhere has


def open_splat(
    job: Job, source: Path, config: AdoptConfig, scene: SceneConfig, masks: MasksConfig, labels: LabelsConfig
) -> None:
    """Read a splat file, choose viewpoints and label its Gaussians: a run up to its training.

    Labels are those of the file, unless `masks` names label images or a network: then the label images vote.
    A splat without any is one category, "scene".
    """
    segmented = masks.segmenter != "auto" or masks.masks is not None or masks.model is not None
    capture = _make_capture(job, source, config, labelled=not segmented)
    open_scene(job, capture, scene)
    make_masks(job, masks, labels)
    _label(job, voted=segmented)


def _make_capture(job: Job, source: Path, config: AdoptConfig, *, labelled: bool) -> Path:
    """Make RUN/adopted.npz and viewpoints.png; the capture, which holds renders unless there are photos."""
    run = job.run
    given = [] if config.cameras is None else read_camera_file(config.cameras)
    photos = bool(given) and all(one.photo is not None for one in given)
    own = run.capture / repaired(source.resolve().stem)
    names = ("cameras", "views", "kind", "up", "fov", "size", "lod", "seed")
    settings = {name: getattr(config, name) for name in names} | {"labelled": labelled, "photos": photos}
    settings |= {"source": str(source.resolve()), "content": file_hash(source)}

    def make() -> list[str]:
        splat = read_splat(source, config.lod)
        for reason, count in splat.dropped.items():
            job.emit(Warned(f"{source}: {count:,} Gaussians left out: {reason}"))
        if labelled:
            splat = _labelled(splat)
        g = splat.gaussians
        cameras, up, how = _cameras(job, g, given, config)
        rows = _points(g, config.seed)
        if not photos:
            _write_photos(job, own, splat, cameras, labelled=labelled)
            _write_model(own / "sparse" / "0", g, cameras, rows)
        contact_sheet(
            run.contact_sheet, g, cameras, up, [f"{source.name}: {len(g):,} Gaussians", how],
            antialiased=splat.antialiased, backend=job.backend,
        )  # fmt: skip
        write_set(run.adopted, g, _LEVEL, exact=True, points=rows, antialiased=splat.antialiased)
        return [
            f"{len(g):,} Gaussians ({splat.kind})",
            f"{len(cameras)} viewpoints, {run.contact_sheet}: {how}",
        ]

    outputs = [run.adopted, run.contact_sheet, *([] if photos else [own / "sparse"])]
    run_stage(job, "adopt", settings, [source], outputs, make)
    return config.cameras if photos and config.cameras else own


def _labelled(splat: Splat) -> Splat:
    """The splat by category; where it has no labels, of one category."""
    g = splat.gaussians
    found = sorted(set(torch.unique(g.label_ids).tolist()) - {UNLABELLED})
    if not found:
        return replace(splat, gaussians=replace(g, label_ids=torch.zeros_like(g.label_ids)), names=_WHOLE)
    names = {label: splat.names.get(label, f"category {label}") for label in found}
    # files of levels hold one category after the other
    return replace(splat, gaussians=g.select(torch.argsort(g.label_ids, stable=True)), names=names)


def _cameras(
    job: Job, g: Gaussians, given: Sequence[NamedCamera], config: AdoptConfig
) -> tuple[Sequence[Camera], np.ndarray, str]:
    """Where to look from, which direction is up there, and what that was decided by."""
    if given:
        cameras = [one.camera for one in given]
        return cameras, upward(cameras) * FLIP, f"those of {config.cameras}"
    drawn = free_cameras(
        g, config.views, up=config.up, fov=config.fov, size=config.size, seed=config.seed, kind=config.kind,
        backend=job.backend,
    )  # fmt: skip
    return drawn.cameras, drawn.up, drawn.reason


def _points(g: Gaussians, seed: int) -> np.ndarray:
    """Rows of the Gaussians that stand for the points of a capture, ascending."""
    opaque = torch.nonzero(torch.sigmoid(g.logit_opacities) >= _OPAQUE)[:, 0].numpy()
    rows = opaque if len(opaque) else np.arange(len(g))
    if len(rows) > _POINTS:
        rows = np.random.default_rng(seed).choice(rows, _POINTS, replace=False)
    return np.sort(rows)


def _write_photos(job: Job, folder: Path, splat: Splat, cameras: Sequence[Camera], *, labelled: bool) -> None:
    """Write a capture's photos, which are renders; with `labelled` also their label images."""
    images, masks, taxonomy = folder / "images", folder / "masks", Taxonomy(splat.names)
    for below in (images, masks):
        shutil.rmtree(below, ignore_errors=True)
    images.mkdir(parents=True)
    paint = RenderedLabels(splat.gaussians, job.backend, splat.antialiased)
    views = [View(name, camera, images / name) for name, camera in zip(_names(cameras), cameras, strict=True)]
    paths = prepare_folder(masks, views) if labelled else []
    occurring: set[int] = set()
    for done, view in enumerate(views):
        rgb, ids = paint.paint(view.camera)
        Image.fromarray((rgb * 255).round().astype(np.uint8)).save(view.image_path)
        if labelled:
            write_mask(paths[done], ids, taxonomy)
            occurring.update(np.unique(ids).tolist())
        job.emit(Progress("adopt", done + 1, len(views)))
    if labelled:
        write_labels(masks, taxonomy, occurring)


def _names(cameras: Sequence[Camera]) -> list[str]:
    digits = max(3, len(str(len(cameras))))
    return [f"view_{number:0{digits}d}.png" for number in range(len(cameras))]


def _write_model(folder: Path, g: Gaussians, cameras: Sequence[Camera], rows: np.ndarray) -> None:
    """Write the cameras, and some Gaussians as points, as a COLMAP model."""
    folder.mkdir(parents=True, exist_ok=True)
    lenses = [(c.width, c.height, c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2]) for c in cameras]
    ids = {lens: number for number, lens in enumerate(dict.fromkeys(lenses), 1)}
    models = [ModelCamera(i, "PINHOLE", *lens[:2], tuple(map(float, lens[2:]))) for lens, i in ids.items()]
    nothing = np.zeros((0, 2)), np.zeros(0, np.int64)
    images = [
        ModelImage(number, name, ids[lens], camera.w2c, *nothing)
        for number, (name, lens, camera) in enumerate(zip(_names(cameras), lenses, cameras, strict=True), 1)
    ]
    points = torch.from_numpy(rows)
    rgb = (sh0_to_rgb(g.sh0[points, 0]).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    write_model(folder, models, images, g.means[points].numpy(), rgb, np.zeros(len(rows)))


def _label(job: Job, *, voted: bool) -> None:
    """Label all Gaussians, by the file or by votes of the label images: the one level that was trained."""
    run = job.run
    antialiased = bool(read_more(run.adopted, "antialiased"))

    def make() -> list[str]:
        g, rows = read_level(run.adopted), read_more(run.adopted, "points")
        if voted:
            g = replace(g, label_ids=torch.full_like(g.label_ids, UNLABELLED))
            g = replace(
                g,
                label_ids=vote(
                    g, job.scene, job.masks, job.scene.train_ids.tolist(), antialiased=antialiased
                ),
            )
        ids, one = g.label_ids.numpy()[rows], np.ones(len(rows), np.int32)
        LiftedLabels(ids, one, one).write(run.labels)
        shutil.rmtree(run.levels, ignore_errors=True)
        run.levels.mkdir()
        write_level(run.levels, _LEVEL, g, recovering=False, sh_degree=g.sh_degree, exact=True)
        return [f"{len(g):,} Gaussians of {len(g.counts())} categories"]

    inputs = [run.scene, run.adopted, run.masks / "labels.json"]
    run_stage(job, "lift", {"voted": voted}, inputs, [run.labels, run.levels], make)
    # what later stages ask of the training
    config = TrainConfig(
        max_steps=_STEPS, sh_degree=read_header(run.adopted).sh_degree, antialiased=antialiased
    )
    settings = {**asdict(config), "seed": 0, "adopted": True}
    run_stage(job, "train", settings, [run.scene, run.labels], [run.levels], lambda: ["trained elsewhere"])
