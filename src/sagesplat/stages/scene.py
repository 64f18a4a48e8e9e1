"""Makes scene.json from a capture, and a capture from photos or a video without poses."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sagesplat.core.config import LabelsConfig, MasksConfig, PosesConfig, SceneConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Progress, Warned
from sagesplat.core.geometry import NO_OFFSET, Position, offset_text
from sagesplat.core.names import repaired
from sagesplat.io.colour_profile import describe_profiles
from sagesplat.io.files import write_json
from sagesplat.run.capture import Capture, Hashes, check_photos, fingerprint, photo_hashes, read_capture
from sagesplat.run.job import Job
from sagesplat.run.records import file_hash
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import run_stage
from sagesplat.scene import load_scene
from sagesplat.scene.detect import detect
from sagesplat.scene.feature_masks import OfPhoto
from sagesplat.scene.find_model import model_folders
from sagesplat.scene.find_photos import PHOTO_FOLDERS
from sagesplat.scene.given_masks import holds_masks
from sagesplat.scene.scans import is_metashape_xml
from sagesplat.scene.scene import Scene, Vignetting
from sagesplat.scene.stored import write_scene
from sagesplat.segment.edit import ignored_ids, parse_merge, parse_names
from sagesplat.segment.mask_files import label_images_of
from sagesplat.stages.edited import check_not_edited

_CPU_PIXELS = 1.25e6  # of a photo: a training step's time and the cap of Gaussians grow with them
# VisualSFM, Bundler, OpenSfM, OpenMVG, Meshroom.
_POSES_OF_OTHERS = (".nvm", "bundle.out", "reconstruction.json", "sfm_data.json", ".sfm")
_SHARES = {1: "all", 2: "half", 4: "a quarter", 8: "an eighth"}  # of a photo's width


def check_folder(run: RunDir) -> None:
    """RunError for a folder that holds something else than a run."""
    ours = (run.scene, run.capture, run.adopted, run.from_python, run.provenance("scene"))
    if not run.path.exists() or any(path.exists() for path in ours):
        return
    if any(not p.name.startswith(".") for p in run.path.iterdir()):
        raise RunError(f"{run.path}: not empty and not a run folder; choose a new folder")


def check_not_adopted(run: RunDir) -> None:
    """RunError for a run of a splat that somebody else trained: labels and training came with the splat.

    And for a run made by editing the labels of another one (`check_not_edited`).
    """
    check_not_edited(run)
    if run.adopted.exists():
        raise RunError(
            f"{run.path}: a splat that was trained elsewhere; to change this run, repeat `sagesplat adopt` "
            "with --force; to train, choose another run folder: `sagesplat run CAPTURE NEW_RUN`"
        )


def open_scene(
    job: Job,
    path: Path,
    config: SceneConfig,
    poses: PosesConfig | None = None,
    masks: MasksConfig | None = None,
    labels: LabelsConfig | None = None,
    *,
    offset: Position = NO_OFFSET,
) -> None:
    """Read a capture and write scene.json. For photos without poses, or a video, estimate the poses first.

    Then no features come from what the photos' alpha, masks and given label images leave out. `offset` was
    subtracted from the positions of a capture that was made of an adopted splat.
    """
    run = job.run
    check_folder(run)
    if detect(path) in ("photos", "video"):
        if config.images is not None:
            raise RunError(
                f"{path}: no poses for the photos of --images; give the folder that has them, or leave out "
                "--images"
            )
        if unread := _unread_poses(path):
            job.emit(Warned(f"{unread}; poses are estimated anew"))
        capture = run.capture / repaired(path.resolve().stem)  # the scene will have that name
        leaving_out = _LeavingOut(config, masks or MasksConfig(), labels or LabelsConfig())
        _find_poses(job, path, capture, poses or PosesConfig(), leaving_out)
        path = capture
    begun = _begun(job)
    if not config.downscale:
        config = replace(config, downscale=_downscale(job, path, config, begun))
    reads = reading(config)
    same = begun and not job.force and begun.settings == reads
    again = begun and same and begun.path == path.resolve()  # what was found in the photos is known
    scene = begun.load() if begun and again else load_scene(path, **reads)
    scene = scene if any(scene.offset) else replace(scene, offset=offset)
    photos, found = photo_hashes(run.photo_hashes, scene), scene.views[0].vignetting
    settings = {"path": str(path.resolve()), **reads, "fingerprint": fingerprint(scene)}
    settings["photos"] = photos.digest
    if begun and same:
        check_photos(scene, begun.photos, photos.sha256)

    def make() -> list[str]:
        write_json(  # first: without it the folder would be none of a run
            run.scene,
            {
                "path": str(path.resolve()),
                "settings": reads,
                "fingerprint": settings["fingerprint"],
                "photos": photos.sha256,
                "vignetting": found and asdict(found),
                "extent": scene.extent,
                "offset": scene.offset,
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
        _write_geometry(run.geometry, scene)
        size = scene.views[0].camera
        lines = [
            f"{len(scene.train_ids)} training, {len(scene.test_ids)} test views, {size.width}x{size.height}",
            f"{len(scene.points.xyz):,} points",
            *scene.notes,
        ]
        if any(scene.offset):
            lines.append(f"far from the origin: {offset_text(scene.offset)} is subtracted from all positions")
        lines += describe_profiles(view.image_path for view in scene.views)
        if config.vignetting:
            lines.append(_of_lens(found))
        return lines

    run_stage(job, "scene", settings, [], [run.scene, run.geometry], make)
    photos.keep()


def _unread_poses(path: Path) -> str:
    """Why poses that lie beside photos or a video are not read, with the cure; empty where there are none."""
    beside = path.name in PHOTO_FOLDERS
    if beside and (folders := model_folders(path.parent)):
        return f"{folders[0]}: poses of a folder that was not given (to use them, give {path.parent})"
    folders = [folder for folder in (path, path.parent)[: 1 + beside] if folder.is_dir()]
    for file in (file for folder in folders for file in sorted(folder.iterdir())):
        name = file.name.lower()
        transforms = name.startswith("transforms") and name.endswith(".json")
        if transforms or (name.endswith(".xml") and is_metashape_xml(file)):
            return f"{file}: poses of a file that was not given (to use them, give it)"
        if name.endswith(_POSES_OF_OTHERS):
            cure = "to keep them, export a COLMAP model or a transforms.json"
            return f"{file}: poses of a format that is not read ({cure})"
    return ""


def reading(config: SceneConfig) -> dict[str, Any]:
    """How a capture is read, as records hold it: `load_scene` takes it."""
    images = config.images and str(config.images.resolve())
    return {**asdict(config), "images": images}


def _downscale(job: Job, path: Path, config: SceneConfig, begun: Capture | None) -> int:
    """The factor for a capture where none was asked for: that of the run, or what the machine can do."""
    if begun and "downscale" in begun.settings:
        return int(begun.settings["downscale"])
    if "cuda" in (job.backend, job.executor.backend) or detect(path) == "stored":
        return 1
    as_it_is = replace(config, downscale=1, vignetting=False)
    cameras = [view.camera for view in load_scene(path, **reading(as_it_is)).views]
    factor = cpu_downscale(float(np.median([camera.width * camera.height for camera in cameras])))
    if factor > 1:
        size = f"{cameras[0].width} x {cameras[0].height}"
        job.emit(
            Warned(
                f"photos of {size} px: trained at {_SHARES[factor]} of that on a CPU"
                " (--downscale 1 keeps their size)"
            )
        )
    return factor


def cpu_downscale(pixels: float) -> int:
    """The least power of two, up to 8, that brings photos of so many pixels to what a CPU trains on."""
    return next((n for n in _SHARES if pixels <= _CPU_PIXELS * n**2), max(_SHARES))


def _of_lens(found: Vignetting | None) -> str:
    if found is None:
        return "no vignetting that points of structure from motion tell: the photos stay as they are"
    return f"the lens loses {found.lost:.0%} of the light in the corners: the photos are corrected"


def _begun(job: Job) -> Capture | None:
    """What the run folder says of its capture; None where it says nothing, or nothing of use."""
    if not job.run.provenance("scene").exists():
        return None
    return read_capture(job.run.scene) if job.run.scene.exists() else None


def _write_geometry(path: Path, scene: Scene) -> None:
    """Write cameras and points without their tracks, which are long and which only training needs."""
    nothing = {name: getattr(scene.points, name)[:0] for name in ("track_points", "track_views", "track_uv")}
    write_scene(path, replace(scene, points=replace(scene.points, **nothing)))


HIGH_ERROR = 0.8  # px; `dinosaur` has 0.97 with one shared camera, 0.42 with a camera per photo
_POSES = ("prepare", "features", "matches", "mapping", "undistortion")


@dataclass(frozen=True)
class _LeavingOut:
    """What structure from motion takes no features from."""

    scene: SceneConfig
    masks: MasksConfig
    labels: LabelsConfig

    @property
    def folder(self) -> Path | None:
        """Label images whose ignored categories are known before there are poses."""
        given = self.labels.ignore and self.masks.segmenter in ("auto", "masks")
        folder = self.masks.masks if given else None
        return None if folder is not None and holds_masks(folder) else folder

    @property
    def settings(self) -> dict[str, Any]:
        """What the result depends on, where there is something."""
        made: dict[str, Any] = {} if self.scene.alpha == "auto" else {"alpha": self.scene.alpha}
        if self.folder is not None and self.folder.is_dir():
            made |= {"ignore": self.labels.ignore, "merge": self.labels.merge}
            made["label_images"] = file_hash(self.folder)
        return made

    def of_photos(self) -> OfPhoto:
        """The pixels of a photo, by its name, that label images do not ignore."""
        if self.folder is None:
            return lambda name: None
        taxonomy, read = label_images_of(self.folder)
        names, merge = parse_names(self.labels.ignore, "ignore"), parse_merge(self.labels.merge)
        ids = np.array(ignored_ids(taxonomy, names, merge)[0], np.int16)

        def of_photo(name: str) -> np.ndarray | None:
            label_ids = read(name)
            return None if label_ids is None else ~np.isin(label_ids, ids)

        return of_photo


def _find_poses(job: Job, source: Path, capture: Path, config: PosesConfig, leaving_out: _LeavingOut) -> None:
    """Make a capture from photos or a video by structure from motion."""
    from sagesplat.scene.photos import reconstruct

    if job.run.path.resolve().is_relative_to(source.resolve()):
        raise RunError(f"{job.run.path}: lies among the photos; name a run folder outside of {source}")
    hashes = _hashes(job, source)
    settings = {
        "source": str(source.resolve()),
        **asdict(config),
        "files": hashes.digest,
        **leaving_out.settings,
    }

    def progress(stage: str, done: int, total: int) -> None:  # one bar for all; mapping may begin again
        reached = _POSES.index(stage) + done / max(total, 1)
        job.emit(Progress("poses", round(100 * reached), 100 * len(_POSES), stage))

    def make() -> list[str]:
        result = reconstruct(
            source, capture, config, progress,
            device="cpu" if job.device == "cpu" else "auto", threads=job.threads or -1,
            alpha=leaving_out.scene.alpha, ignored=leaving_out.of_photos(),
        )  # fmt: skip
        for name, reason in list(result.unregistered.items())[:5]:
            job.emit(Warned(f"{name}: {reason}"))
        if len(result.unregistered) > 5:
            job.emit(Warned(f"{len(result.unregistered)} photos in all left out; see {capture}/poses.json"))
        if result.reprojection_error > HIGH_ERROR and not config.refine_principal_point:
            cure = "--poses.camera per-image --poses.refine-principal-point"
            high = f"reprojection error {result.reprojection_error:.2f} px is high"
            job.emit(Warned(f"{high}; if the photos were cropped or zoomed one by one, try {cure}"))
        return [
            f"poses of {result.num_registered} of {result.num_photos} photos, {result.num_points:,} points, "
            f"reprojection error {result.reprojection_error:.2f} px"
        ]

    run_stage(job, "poses", settings, [], [capture / "poses.json"], make)
    hashes.keep()


def _hashes(job: Job, source: Path) -> Hashes:
    """What changes when the content of the photos, or of the video, does."""
    files = sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]
    return Hashes(job.run.source_hashes, {str(path.relative_to(source)): path for path in files})
