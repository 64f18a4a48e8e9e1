"""Begins a run with a splat that somebody else trained: its Gaussians, viewpoints, labels."""

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from scipy.spatial import KDTree

from sagesplat.adapt.free_viewpoints import check_size, free_cameras
from sagesplat.adapt.observe import RenderedLabels
from sagesplat.core.config import AdoptConfig, LabelsConfig, MasksConfig, SceneConfig, TrainConfig
from sagesplat.core.errors import DataError, RunError
from sagesplat.core.events import Progress, Warned
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.names import repaired
from sagesplat.core.sh import sh0_to_rgb
from sagesplat.formats.labels import sidecar
from sagesplat.formats.levels import read_header, read_level, read_more, write_level, write_set
from sagesplat.formats.offsets import beside as offset_beside
from sagesplat.formats.sog_write import sog_order
from sagesplat.formats.splat import relative_to
from sagesplat.formats.splats import Splat, num_lods, read_splat
from sagesplat.io.typed import check_limits
from sagesplat.raster import device_of, each_view
from sagesplat.run.job import Job
from sagesplat.run.records import file_hash, is_done
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import run_stage
from sagesplat.scene import load_scene
from sagesplat.scene.cameras import NamedCamera, read_camera_file
from sagesplat.scene.colmap_write import ModelCamera, ModelImage, write_model
from sagesplat.scene.scene import Camera, View
from sagesplat.segment.display_names import categories
from sagesplat.segment.edit import parse_merge
from sagesplat.segment.lift import LiftedLabels
from sagesplat.segment.masks import (
    UNLABELLED,
    UNLABELLED_NAME,
    Taxonomy,
    prepare_folder,
    write_labels,
    write_mask,
)
from sagesplat.segment.parents import read_parents, write_parents
from sagesplat.stages.edited import check_not_edited
from sagesplat.stages.label import edit_of, make_masks
from sagesplat.stages.memory import foretell_adopt
from sagesplat.stages.scene import check_folder, open_scene, reading
from sagesplat.train.votes import label_weights, winners
from sagesplat.viewer.frames import FLIP, upward

_WHOLE = {0: "scene"}  # the one category of a splat without labels
_POINTS = 50_000  # means that stand for the points of a capture
_OPAQUE = 0.1  # their least opacity, as far as there are such
# Of a training, whose time sampling may take a part of. With lenses to sample too, 1500 drew 91 viewpoints of
# a million, too few for the hardest twentieth; these draw 144, and a million takes 3.5 minutes.
_STEPS = 2400
_PARENTS = "parents.json"  # in the capture's folder: of the file's instances
_LEVEL = 1  # number of the one level that a splat from elsewhere has


def open_splat(
    job: Job, source: Path, config: AdoptConfig, scene: SceneConfig, masks: MasksConfig, labels: LabelsConfig
) -> None:
    """Read a splat file, choose viewpoints and label its Gaussians: a run up to its training.

    Labels are those of the file, unless `masks` names label images or a network: then the label images vote.
    A splat without any is one category, "scene".
    """
    segmented = masks.segmenter != "auto" or masks.masks is not None or masks.model is not None
    segmented = segmented or bool(masks.prompts)
    scene = replace(scene, downscale=scene.downscale or 1)  # nothing is trained on the photos
    check_folder(job.run)
    _check_run(job.run, config)
    if RunDir(source).scene.exists():
        raise RunError(f"{source}: a run folder; `sagesplat export {source} scene.ply` writes its splat")
    check_limits(config)
    own = job.run.capture / repaired(source.resolve().stem)
    photos = _make_capture(job, source, own, config, scene, labelled=not segmented)
    offset = tuple(read_more(job.run.adopted, "offset").astype(float).tolist())
    if photos and config.cameras:
        open_scene(job, config.cameras, scene, offset=offset)
    else:  # its photos are the renders
        open_scene(job, own, replace(scene, images=None, fisheye="crop"), offset=offset)
    if not segmented:
        masks = replace(masks, masks=own / "masks")
    make_masks(job, masks, labels)
    _label(job, None if segmented else own / _PARENTS, parse_merge(labels.merge))


def _check_run(run: RunDir, config: AdoptConfig) -> None:
    """RunError where adopting would overwrite what it reads, or a run that was trained here."""
    check_not_edited(run)
    if run.scene.exists() and not run.adopted.exists():
        raise RunError(f"{run.path}: holds a run of its own; choose a new folder for the splat")
    if config.cameras is None:
        return
    cameras, given = config.cameras.resolve(), run.from_python.resolve()
    if cameras.is_relative_to(run.path.resolve()) and not cameras.is_relative_to(given):
        raise RunError(
            f"{config.cameras}: in the run folder, where adopt writes; copy it elsewhere, and give that path"
        )


def _make_capture(
    job: Job, source: Path, own: Path, config: AdoptConfig, scene: SceneConfig, *, labelled: bool
) -> bool:
    """Make RUN/adopted.npz, viewpoints.png, and a capture of renders, as far as there is none with photos.

    Returns whether there are photos.
    """
    run = job.run
    given = [] if config.cameras is None else read_camera_file(config.cameras, scene.images)
    photos = bool(given) and all(one.photo is not None for one in given)
    names = ("cameras", "views", "kind", "up", "fov", "size", "lod", "spz_axes", "seed")
    settings: dict[str, Any] = {"labels_of_file": labelled, "photos": photos}
    settings |= {name: getattr(config, name) for name in names}
    settings |= {name: reading(scene)[name] for name in ("downscale", "images", "fisheye")}
    settings["cameras"] = config.cameras and str(config.cameras.resolve())
    settings |= {"source": str(source.resolve()), "content": _content(source)}

    def make() -> list[str]:
        splat = read_splat(source, config.lod, spz_axes=config.spz_axes)
        for note in splat.notes:
            job.emit(Warned(f"{source}: {note}"))
        for reason, count in splat.dropped.items():
            job.emit(Warned(f"{source}: {count:,} Gaussians left out: {reason}"))
        splat = relative_to(splat, given[0].offset) if given else splat
        check_size(splat.gaussians, str(source))
        foretell_adopt(job, len(splat.gaussians), config.steps if config.fit == "renders" else 0)
        if labelled:
            splat = _labelled(splat)
        # files of levels hold one category after the other; neighbours in space are rendered together
        order = torch.from_numpy(sog_order(splat.gaussians))
        splat = replace(splat, gaussians=splat.gaussians.select(order))
        left_out = "".join(f", {count:,} left out ({reason})" for reason, count in splat.dropped.items())
        g = splat.gaussians
        if photos and config.cameras:
            views = list(load_scene(config.cameras, **reading(scene)).views)
            cameras = [view.camera for view in views]
            up, how = upward(cameras) * FLIP, f"those of {config.cameras.name}"
        else:
            cameras, up, how = _cameras(job, splat, given, config)
            views = _views(own, cameras)
            _write_model(own / "sparse" / "0", g, views, _points(g, config.seed))
        _write_pictures(job, own, splat, views, labelled=labelled, photos=photos)
        parents = {
            splat.names[label]: parent for label, parent in splat.parents.items() if label in splat.names
        }
        write_parents(own / _PARENTS, parents if labelled else {})
        # loads matplotlib, for which no training has to wait
        from sagesplat.output.contact_sheet import contact_sheet

        contact_sheet(
            run.contact_sheet, g, cameras, up, [f"{source.name}: {len(g):,} Gaussians{left_out}", how],
            antialiased=splat.antialiased, backend=job.backend,
            rendered=[] if photos else [view.image_path for view in views],
        )  # fmt: skip
        write_set(
            run.adopted, g, _LEVEL, exact=True, antialiased=splat.antialiased, offset=np.array(splat.offset)
        )  # fmt: skip
        return [
            f"{len(g):,} Gaussians ({splat.kind})",
            f"{len(cameras)} viewpoints, {run.contact_sheet}: {how}",
        ]

    # the capture's folder is named after the splat: for another splat it is missing, and not out of date
    is_done(run, "adopt", json.loads(json.dumps(settings)), None, [run.adopted], job.force)
    outputs = [run.adopted, run.contact_sheet]
    outputs += [] if photos else [own / "sparse"]
    outputs += [own / "masks" / "labels.json"] if labelled else []
    beside = [path for path in (sidecar(source), offset_beside(source)) if path.is_file()]
    run_stage(job, "adopt", settings, [source, *beside], outputs, make)
    return photos


def _content(source: Path) -> str:
    """The hash of a splat; of one in several files, of all in its folder. DataError where it is none."""
    num_lods(source)
    return file_hash(source.parent if source.suffix == ".json" else source)


def _labelled(splat: Splat) -> Splat:
    """The splat by category; where it has no labels, of one category."""
    g = splat.gaussians
    found = sorted(set(torch.unique(g.label_ids).tolist()) - {UNLABELLED})
    if not found:
        return replace(splat, gaussians=replace(g, label_ids=torch.zeros_like(g.label_ids)), names=_WHOLE)
    names = {label: splat.names.get(label, f"category {label}") for label in found}
    return replace(splat, names=names)


def _cameras(
    job: Job, splat: Splat, given: Sequence[NamedCamera], config: AdoptConfig
) -> tuple[Sequence[Camera], np.ndarray, str]:
    """Where to look from, which direction is up there, and what that was decided by."""
    if given:
        assert config.cameras is not None  # they were read from it
        cameras = [one.camera for one in given]
        return cameras, upward(cameras) * FLIP, f"those of {config.cameras.name}"
    drawn = free_cameras(
        splat.gaussians, config.views, up=splat.up if config.up == "auto" else config.up, fov=config.fov,
        size=config.size, seed=config.seed, kind=config.kind, backend=job.backend,
    )  # fmt: skip
    reason = drawn.reason
    if config.up == "auto" != splat.up:
        reason = reason.replace("as given", "as nerfstudio wrote into the file")
    return drawn.cameras, drawn.up, reason


def _points(g: Gaussians, seed: int, most: int = _POINTS) -> np.ndarray:
    """Rows of the Gaussians that stand for the points of a capture, ascending."""
    opaque = torch.nonzero(torch.sigmoid(g.logit_opacities) >= _OPAQUE)[:, 0].numpy()
    rows = opaque if len(opaque) else np.arange(len(g))
    if len(rows) > most:
        rows = np.random.default_rng(seed).choice(rows, most, replace=False)
    return np.sort(rows)


def _views(folder: Path, cameras: Sequence[Camera]) -> list[View]:
    """Views of a capture of renders."""
    digits = max(3, len(str(len(cameras))))
    names = [f"view_{number:0{digits}d}.png" for number in range(len(cameras))]
    return [View(name, camera, folder / "images" / name) for name, camera in zip(names, cameras, strict=True)]


def _write_pictures(
    job: Job, folder: Path, splat: Splat, views: Sequence[View], *, labelled: bool, photos: bool
) -> None:
    """Write renders in place of photos, where there are none, and with `labelled` their label images."""
    masks, taxonomy = folder / "masks", Taxonomy(splat.names)
    for below in ("images", "masks"):
        shutil.rmtree(folder / below, ignore_errors=True)
        (folder / below).mkdir(parents=True)
    paint = RenderedLabels(splat.gaussians, job.backend, splat.antialiased)
    paths = prepare_folder(masks, views) if labelled else []
    occurring: set[int] = set()

    def write(number: int) -> set[int]:
        view = views[number]
        rgb, ids = paint.picture(view.camera)
        if not photos:
            picture = Image.fromarray((rgb * 255).round().astype(np.uint8))
            picture.save(view.image_path, compress_level=1)  # half the time, 7 % more bytes
        if labelled:
            write_mask(paths[number], ids, taxonomy)
        return set(np.unique(ids).tolist())

    wanted = range(0 if photos and not labelled else len(views))
    for done, of_view in enumerate(each_view(write, wanted, device_of(job.backend)), 1):
        occurring |= of_view
        job.emit(Progress("adopt", done, len(views)))
    if labelled and not occurring - {UNLABELLED}:
        raise DataError(
            f"{folder.name}: no viewpoint shows any of its labelled Gaussians; give --cameras of this "
            "scene, in its frame, or none"
        )
    if labelled:
        write_labels(masks, taxonomy, occurring)
    else:
        masks.rmdir()  # a folder of that name would be taken for label images


def _write_model(folder: Path, g: Gaussians, views: Sequence[View], rows: np.ndarray) -> None:
    """Write the cameras, and some Gaussians as points, as a COLMAP model."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras = [view.camera for view in views]
    lenses = [(c.width, c.height, c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2]) for c in cameras]
    ids = {lens: number for number, lens in enumerate(dict.fromkeys(lenses), 1)}
    models = [ModelCamera(i, "PINHOLE", *lens[:2], tuple(map(float, lens[2:]))) for lens, i in ids.items()]
    nothing = np.zeros((0, 2)), np.zeros(0, np.int64)
    images = [
        ModelImage(number, view.name, ids[lens], view.camera.w2c, *nothing)
        for number, (view, lens) in enumerate(zip(views, lenses, strict=True), 1)
    ]
    points = torch.from_numpy(rows)
    rgb = (sh0_to_rgb(g.sh0[points, 0]).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    write_model(folder, models, images, g.means[points].numpy(), rgb, np.zeros(len(rows)))


def _edited(job: Job, g: Gaussians) -> Gaussians:
    """Gaussians with the labels of the file, as its label images were edited: merged, kept or left out.

    Unlabelled are those of categories that no label image shows: no viewpoint would tell what their levels
    are worth.
    """
    ids = g.label_ids.numpy()
    before = Taxonomy.read(job.run.segmented / "labels.json")
    unseen = ~np.isin(ids, (UNLABELLED, *before.names))
    if unseen.any():
        job.emit(Warned(f"{unseen.sum():,} Gaussians of categories that no viewpoint shows are unlabelled"))
    return replace(g, label_ids=torch.from_numpy(edit_of(job.run)[ids]))


def _parents(job: Job, path: Path, merge: Mapping[str, str]) -> dict[str, str]:
    """The category of each instance of the file that is left, as `merge` names it."""
    names = job.names().values()
    found = {name: merge.get(of, of) for name, of in read_parents(path).items() if name in names}
    return {name: of for name, of in found.items() if of not in found and of != UNLABELLED_NAME}


def _label(job: Job, of_file: Path | None, merge: Mapping[str, str]) -> None:
    """Label all Gaussians, by the file or by votes of the label images: the one level that was trained.

    `of_file`: the categories of the file's instances; None where label images vote. `merge`: of categories.
    """
    run, voted = job.run, of_file is None
    antialiased = bool(read_more(run.adopted, "antialiased"))

    def make() -> list[str]:
        g = read_level(run.adopted)
        if voted:
            views = job.scene.train_ids.tolist()
            g = replace(g, label_ids=torch.full_like(g.label_ids, UNLABELLED))
            ids, weights = label_weights(g, job.scene, job.masks, views, antialiased=antialiased)
            g = replace(g, label_ids=winners(g, ids, weights))
        else:
            g = _edited(job, g)
        points = job.scene.points.xyz
        rows = _points(g, 0, most=len(g))
        ids = g.label_ids.numpy()[rows[KDTree(g.means.numpy()[rows]).query(points)[1]]]
        one = np.ones(len(points), np.int32)
        LiftedLabels(ids, one, one).write(run.labels)
        write_parents(run.parents, _parents(job, of_file, merge) if of_file else {})
        shutil.rmtree(run.levels, ignore_errors=True)
        run.levels.mkdir()
        write_level(run.levels, _LEVEL, g, recovering=False, sh_degree=g.sh_degree, exact=True)
        return [f"{len(g):,} Gaussians of {categories(len(g.counts()))}"]

    inputs = [run.scene, run.adopted, run.provenance("masks"), run.masks / "labels.json"]
    inputs += [of_file] if of_file and of_file.exists() else []
    run_stage(job, "lift", {"voted": voted}, inputs, [run.labels, run.levels], make)
    # what later stages ask of the training
    config = TrainConfig(
        max_steps=_STEPS, sh_degree=read_header(run.adopted).sh_degree, antialiased=antialiased
    )
    settings = {**asdict(config), "seed": 0, "adopted": True}
    run_stage(job, "train", settings, [run.scene, run.labels], [run.levels], lambda: ["trained elsewhere"])
