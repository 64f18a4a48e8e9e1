"""Makes scene.json from a capture, and a capture from photos or a video without poses."""

import hashlib
from dataclasses import asdict, replace
from pathlib import Path

from sagesplat.core.config import PosesConfig, SceneConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Progress, Warned
from sagesplat.core.names import repaired
from sagesplat.io.files import write_json
from sagesplat.run.capture import (
    Capture,
    Hashes,
    check_photos,
    fingerprint,
    photo_hashes,
    read_capture,
)
from sagesplat.run.job import Job
from sagesplat.run.records import settings_of
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import run_stage
from sagesplat.scene import load_scene
from sagesplat.scene.detect import detect
from sagesplat.scene.scene import Scene
from sagesplat.scene.stored import write_scene


def check_folder(run: RunDir) -> None:
    """RunError for a folder that holds something else than a run."""
    ours = (run.scene, run.capture, run.adopted, run.provenance("scene"))
    if not run.path.exists() or any(path.exists() for path in ours):
        return
    if any(not p.name.startswith(".") for p in run.path.iterdir()):
        raise RunError(f"{run.path}: not empty and not a run folder; choose a new folder")


def check_not_adopted(run: RunDir) -> None:
    """RunError for a run of a splat that somebody else trained: labels and training came with the splat."""
    if run.adopted.exists():
        raise RunError(
            f"{run.path}: a splat that was trained elsewhere; to change this run, repeat `sagesplat adopt` "
            "with --force; to train, choose another run folder: `sagesplat run CAPTURE NEW_RUN`"
        )


def open_scene(job: Job, path: Path, config: SceneConfig, poses: PosesConfig | None = None) -> None:
    """Read a capture and write scene.json. For photos without poses, or a video, estimate the poses first."""
    run = job.run
    check_folder(run)
    if detect(path) in ("photos", "video"):
        capture = run.capture / repaired(path.resolve().stem)  # the scene will have that name
        _find_poses(job, path, capture, poses or PosesConfig())
        path = capture
    scene = load_scene(path, **asdict(config))
    photos = photo_hashes(run.photo_hashes, scene)
    settings = {"path": str(path.resolve()), **asdict(config), "fingerprint": fingerprint(scene)}
    begun = _begun(job)
    if begun is None or begun.photos is not None or begun.fingerprint != settings["fingerprint"]:
        settings["photos"] = photos.digest
    if begun and begun.photos is not None and not job.force and begun.settings == asdict(config):
        check_photos(scene, begun.photos, photos.sha256)

    def make() -> list[str]:
        _write_geometry(run.geometry, scene)
        write_json(
            run.scene,
            {
                "path": str(path.resolve()),
                "settings": asdict(config),
                "fingerprint": settings["fingerprint"],
                "photos": photos.sha256,
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
    photos.keep()
    if not run.geometry.exists():  # the run began before it was kept
        _write_geometry(run.geometry, scene)


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


def _poses_progress(stage: str, done: float) -> Progress:
    """One progress bar for all stages of structure from motion; mapping may restart with another model."""
    return Progress("poses", round(100 * (_POSES.index(stage) + done)), 100 * len(_POSES), stage)


def _find_poses(job: Job, source: Path, capture: Path, config: PosesConfig) -> None:
    """Make a capture from photos or a video by structure from motion."""
    from sagesplat.scene.photos import reconstruct

    if job.run.path.resolve().is_relative_to(source.resolve()):
        raise RunError(f"{job.run.path}: lies among the photos; name a run folder outside of {source}")
    digest, hashes = _hashes(job, source)
    settings = {"source": str(source.resolve()), **asdict(config), "files": digest}

    def make() -> list[str]:
        result = reconstruct(
            source, capture, config,
            lambda stage, done, total: job.emit(_poses_progress(stage, done / max(total, 1))),
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
    if hashes:
        hashes.keep()


def _hashes(job: Job, source: Path) -> tuple[str, Hashes | None]:
    """What changes when the content of the photos, or of the video, does; and what is to be kept of it."""
    files = sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]
    state = [(str(p.relative_to(source)), p.stat().st_size, p.stat().st_mtime_ns) for p in files]
    of_times = hashlib.sha256(repr(state).encode()).hexdigest()  # what older run folders recorded
    try:
        if settings_of(job.run, "poses").get("files") == of_times:
            return of_times, None
    except RunError:
        pass
    hashes = Hashes(job.run.source_hashes, {str(path.relative_to(source)): path for path in files})
    return hashes.digest, hashes
