"""Camera poses of photos or a video, by structure from motion with COLMAP (Schönberger and Frahm 2016)."""

import importlib.util
import json
import math
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from sagesplat.core.config import PosesConfig
from sagesplat.core.errors import BackendUnavailable, SceneError
from sagesplat.core.extras import install
from sagesplat.core.limits import Count, Number
from sagesplat.io.files import write_json
from sagesplat.io.typed import check_limits, convert_as, known_json
from sagesplat.scene._prepare import PreparedPhoto, prepare_photos
from sagesplat.scene.feature_masks import OfPhoto, write_feature_masks
from sagesplat.scene.find_photos import PHOTOS
from sagesplat.scene.raw_photos import REPORT, describe_raw
from sagesplat.scene.video import extract_frames


@dataclass(frozen=True)
class Reconstruction:
    """The result of structure from motion; also in poses.json."""

    workspace: Path
    num_photos: Count  # readable ones
    num_registered: Count
    unregistered: dict[str, str]  # photo -> reason
    num_points: Count
    reprojection_error: Number  # mean, pixels
    seconds: dict[str, Number]  # by stage, of the last run


OnProgress = Callable[[str, int, int], None]  # stage, done, total

MIN_PHOTOS = 3  # registered photos that a scene needs
MANY_PHOTOS = 100  # with more, exhaustive matching takes too long on a CPU (four pairs a second)
_SCRIPT = Path(__file__).with_name("_sfm.py")
_OWN = ("images", "sparse", "sfm")  # folders that `reconstruct` writes


def reconstruct(
    source: Path,
    workspace: Path,
    config: PosesConfig = PosesConfig(),
    on_progress: OnProgress = lambda stage, done, total: None,
    *,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    threads: int = -1,
    alpha: str = "auto",
    ignored: OfPhoto = lambda name: None,
) -> Reconstruction:
    """Estimate the poses of a folder of photos or of a video; make `workspace` a capture for `load_scene`.

    Writes undistorted photos to images/, their COLMAP model to sparse/0, with gravity along +y, and
    poses.json. Intermediate results are kept in sfm/: a killed run resumes, unless photos or settings
    changed. `device`: of features and matching; `threads`: -1 for all cores.
    The stages of `on_progress` are prepare, features, matches, mapping and undistortion. Raises
    SceneError, RunError for settings out of range, and BackendUnavailable without pycolmap.

    There are no features in pixels that do not count: black in `masks_valid/` below the source, transparent
    (`alpha`, see `SceneConfig`), or `ignored` (the pixels of a photo that label images do not ignore, by the
    photo's name in images/).
    """
    _check(source, workspace, config)
    work, started = workspace / "sfm", time.perf_counter()
    folder = source

    def on_prepared(done: int, total: int) -> None:
        on_progress("prepare", done, total)

    if source.is_file():
        folder = work / "frames"
        extract_frames(source, folder, max_frames=config.max_frames, on_frame=on_prepared)
    photos, unreadable = prepare_photos(folder, work / "photos", workspace, on_prepared)
    if len(photos) < MIN_PHOTOS:
        raise SceneError(_too_few(source, photos, unreadable))
    masks = write_feature_masks(photos, folder, work / "masks", workspace, alpha, ignored)
    request = _request(source, photos, config) | {"device": device} | ({"masks": masks} if masks else {})
    finished = _resume(workspace, request)
    if finished and not (unreadable.keys() - finished.unregistered.keys()):
        return finished
    least = max(MIN_PHOTOS, math.ceil(config.min_registered * len(photos)))
    write_json(work / "request.json", request | {"min_photos": least, "threads": threads})
    seconds = {"prepare": round(time.perf_counter() - started, 2)}
    result = _run(work, on_progress)
    names = {photo.prepared: photo.name for photo in photos}
    reasons = {names[prepared]: reason for prepared, reason in result["reasons"].items()}
    reconstruction = Reconstruction(
        workspace=workspace,
        num_photos=len(photos),
        num_registered=len(result["registered"]),
        unregistered=reasons | unreadable,
        num_points=result["num_points"],
        reprojection_error=result["reprojection_error"],
        seconds=seconds | result["seconds"],
    )
    complete = reconstruction.num_registered >= least
    if complete:
        _publish(workspace)
    renamed = {photo.name: photo.final for photo in photos if photo.name != photo.final}
    resolved = {"matching": request["matching"], "cameras": len(request["cameras"])}
    report: dict[str, Any] = {"complete": complete, "settings": asdict(config), "resolved": resolved}
    report |= asdict(reconstruction) | {"workspace": str(workspace), "renamed": renamed}
    if complete:
        taken = {photo.prepared: (photo.final, photo.orientation) for photo in photos}
        report |= {"raw": describe_raw(work / "model", taken)}
    write_json(workspace / REPORT, report)
    if not complete:
        registered, total = reconstruction.num_registered, reconstruction.num_photos
        raise SceneError(
            f"{source}: poses found for {registered} of {total} photos ({registered / total:.0%}; "
            f"{least} are needed); take photos with more overlap and texture, or try another matching, "
            f"another camera, a larger max_size; reasons in {workspace / 'poses.json'}"
        )
    return reconstruction


def _check(source: Path, workspace: Path, config: PosesConfig) -> None:
    """An error of `reconstruct` for what can be rejected before any work."""
    if importlib.util.find_spec("pycolmap") is None:
        raise BackendUnavailable(f"poses from photos need pycolmap; {install('sagesplat[poses]')}")
    if not source.exists():
        raise SceneError(f"{source}: no such file or folder; name a folder of photos or a video")
    if config.model not in _MODELS:
        raise SceneError(f"{config.model}: COLMAP cannot undistort it; take one of {', '.join(_MODELS)}")
    check_limits(config, "poses.")
    inside, outside = source.resolve(), workspace.resolve()
    if inside == outside or any(inside.is_relative_to(outside / name) for name in _OWN):
        raise SceneError(f"{source}: lies where the poses would be written; name another for the poses")
    if workspace.exists() and not workspace.is_dir():
        raise SceneError(f"{workspace}: is not a folder; name a folder")
    if not (workspace / "sfm").is_dir() and any((workspace / name).exists() for name in _OWN):
        raise SceneError(f"{workspace}: already holds a capture; name an empty folder")


# Camera models that COLMAP can undistort to a pinhole.
_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"),
)


def _too_few(source: Path, photos: list[PreparedPhoto], unreadable: dict[str, str]) -> str:
    problem = f"{source}: {len(photos)} readable photos, but it takes {MIN_PHOTOS}"
    if unreadable:
        name, reason = next(iter(unreadable.items()))
        count = f" (the first of {len(unreadable)})" if len(unreadable) > 1 else ""
        return f"{problem}; {name}{count} is {reason}"
    if photos and source.is_file():
        return f"{problem} frames that differ; move the camera, or take a longer video"
    kinds = ", ".join(sorted(suffix[1:] for suffix in PHOTOS))
    return f"{problem}; add overlapping photos ({kinds}) or name a video"


def _request(source: Path, photos: list[PreparedPhoto], config: PosesConfig) -> dict[str, Any]:
    """The request to _sfm.py; intermediate results are kept as long as it does not change."""
    matching = config.matching
    if matching == "auto":
        matching = "sequential" if source.is_file() or len(photos) > MANY_PHOTOS else "exhaustive"
    key: Callable[[PreparedPhoto], Any] = {
        "auto": lambda photo: photo.camera,
        "single": lambda photo: None,
        "per-folder": lambda photo: photo.name.rpartition("/")[0],
        "per-image": lambda photo: photo.prepared,
    }[config.camera]
    cameras: dict[Any, list[PreparedPhoto]] = {}
    for photo in photos:
        cameras.setdefault(key(photo), []).append(photo)
    for group in cameras.values():
        if len(sizes := sorted({photo.camera[:2] for photo in group})) > 1:
            (w, h), (w2, h2) = sizes[:2]
            raise SceneError(
                f"{source}: photos of {w} x {h} and {w2} x {h2} pixels cannot share a camera; "
                "take camera auto or per-image"
            )
    return {
        "order": [photo.prepared for photo in photos],
        "names": {photo.prepared: photo.final for photo in photos},
        "states": [photo.state for photo in photos],
        "cameras": [[photo.prepared for photo in group] for group in cameras.values()],
        "matching": matching,
        "model": config.model,
        "refine_principal_point": config.refine_principal_point,
        "max_size": config.max_size,
    }


def _resume(workspace: Path, request: dict[str, Any]) -> Reconstruction | None:
    """The finished result of the same request, if any; results of another request are removed."""
    work, report = workspace / "sfm", workspace / REPORT
    request, old = json.loads(json.dumps(request)), known_json(work / "request.json", dict) or {}
    if {k: v for k, v in old.items() if k not in ("min_photos", "threads")} != request:
        for name in ("database.db", "database.db-wal", "database.db-shm", "models.json", "seconds.json"):
            (work / name).unlink(missing_ok=True)
        report.unlink(missing_ok=True)
        return None
    content = known_json(report, dict) or {}
    if content.get("complete") is not True or not (workspace / "sparse" / "0").is_dir():
        return None
    try:
        return convert_as(content | {"workspace": workspace}, Reconstruction)
    except ValueError:
        return None


def _run(work: Path, on_progress: OnProgress) -> dict[str, Any]:
    """Run _sfm.py on sfm/request.json in a child process that exits with this one; its result."""
    log = work / "log.txt"
    # By its path, not as a module: importing the package would import Pillow.
    command = [sys.executable, "-P", str(_SCRIPT), str(work)]
    answer: dict[str, Any] = {}
    with (
        log.open("w", encoding="utf-8") as stderr,
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, encoding="utf-8"
        ) as child,
    ):
        try:
            assert child.stdout is not None
            for line in child.stdout:
                answer = json.loads(line)
                if "stage" in answer:
                    on_progress(answer["stage"], answer["done"], answer["total"])
            code = child.wait()
        finally:
            child.kill()
            child.wait()  # after Ctrl-C the context waits a quarter of a second only
    if "unavailable" in answer:
        raise BackendUnavailable(answer["unavailable"])
    if code == 0 and "result" in answer:
        return answer["result"]
    raise SceneError(f"{work.parent}: COLMAP {_ending(code, log)}; see {log}; run it again to resume")


def _ending(code: int, log: Path) -> str:
    if code == -getattr(signal, "SIGKILL", 9):  # Windows has none, and no negative codes
        return "was killed (often for lack of memory: take a smaller max_size)"
    if code < 0:
        return f"crashed ({signal.Signals(-code).name})"
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
    return f"failed ({next((line for line in reversed(lines) if line.strip()), 'no message')})"


def _publish(workspace: Path) -> None:
    """Move the undistorted photos and their model to images/ and sparse/."""
    for name in ("images", "sparse"):
        shutil.rmtree(workspace / name, ignore_errors=True)
        (workspace / "sfm" / "undistorted" / name).rename(workspace / name)
    shutil.rmtree(workspace / "sfm" / "undistorted")
