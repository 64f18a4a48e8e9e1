"""A run folder being worked on: what its stages share, and how a stage is done once."""

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sagesplat.adapt.ladder import Ladder, SnapshotLadder, read_ladder, read_prefixes
from sagesplat.adapt.observe import PERCENTILE, LabelImages, RenderedLabels, distances_in_views
from sagesplat.config import FitConfig
from sagesplat.errors import RunError, SageError
from sagesplat.events import Emit, StageDone, StageSkipped, StageStarted, Warned
from sagesplat.executor import LOCAL, Executor
from sagesplat.files import named_full_disk, read_json, remove_temporary, sync_changed
from sagesplat.lock import locked
from sagesplat.lpips import Lpips, Net, load_lpips, weights_path
from sagesplat.raster import Backend
from sagesplat.run_dir import RunDir, file_hash, is_done, record, settings_of
from sagesplat.scene import load_scene
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.segment.lift import LiftedLabels
from sagesplat.segment.masks import Masks, Taxonomy
from sagesplat.train import memory

_CLOCK_STEP = 2.0  # seconds: some disks keep no finer time
NETS: tuple[Net, ...] = ("alex", "vgg")
NO_RUN = "not a run folder (no scene.json); begin with `sagesplat run SCENE RUN`"


@dataclass(frozen=True)
class Job:
    """A run folder being worked on, and what its stages share."""

    run: RunDir
    emit: Emit
    backend: Backend = "auto"
    threads: int = 1
    force: bool = False
    processes: int = 1  # that train together
    device: str = "auto"  # where networks compute
    memory_limit: int = 0  # bytes that training may use (0: what the machine has, but for a margin)
    locks: ExitStack | None = None  # keeps the run folder locked between stages (else within each)
    executor: Executor = LOCAL  # of pieces that do not depend on each other

    @property
    def spec(self) -> "JobSpec":
        """What another process needs to open the same job."""
        return JobSpec(**{f.name: getattr(self, f.name) for f in fields(JobSpec)})

    @cached_property
    def scene(self) -> Scene:
        """The capture that scene.json names, unchanged since."""
        if not self.run.scene.exists():
            raise RunError(f"{self.run.path}: {NO_RUN}")
        made = read_json(self.run.scene)
        scene = load_scene(Path(made["path"]), **made["settings"])
        if fingerprint(scene) != made["fingerprint"]:
            raise RunError(
                f"{made['path']}: the capture changed since this run began; choose another run folder"
            )
        return scene

    @cached_property
    def photos(self) -> Photos:
        """The photos, loaded when asked for."""
        return Photos(self.scene.views, memory.photo_cache(self.memory_limit))

    @cached_property
    def taxonomy(self) -> Taxonomy:
        """The names of the run's categories."""
        return Taxonomy.read(self.run.masks / "labels.json")

    @cached_property
    def masks(self) -> Masks:
        """The label images before fusion, loaded when asked for."""
        return Masks(self.run.masks, self.taxonomy)

    @property
    def best_masks(self) -> Masks:
        """The label images that all views agreed on, if they were asked to."""
        fused = self.run.fused
        return Masks(fused, self.taxonomy) if (fused / "labels.json").exists() else self.masks

    @cached_property
    def point_labels(self) -> np.ndarray:
        """Category of each SfM point."""
        return LiftedLabels.read(self.run.labels, len(self.scene.points.xyz)).label_ids

    @cached_property
    def snapshots(self) -> SnapshotLadder:
        """The levels that training recorded."""
        return read_ladder(self.run.levels)

    @cached_property
    def ladder(self) -> Ladder:
        """The levels to choose from: prefixes of the nested model, or the snapshots."""
        return read_prefixes(self.run.prefixes) if self.run.ladder == "nested" else self.snapshots

    @cached_property
    def antialiased(self) -> bool:
        """Whether the run's Gaussians are drawn with the antialiasing filter."""
        return bool(settings_of(self.run, "train")["antialiased"])

    @property
    def fit_config(self) -> FitConfig:
        """How the run's levels were observed and its models fitted."""
        made = settings_of(self.run, "observe") | settings_of(self.run, "fit")
        return FitConfig(**{f.name: made[f.name] for f in fields(FitConfig) if f.name in made})

    def names(self) -> dict[int, str]:
        """Category names by id, the unlabelled one included."""
        return {**self.taxonomy.names, -1: self.taxonomy.name(-1)}


@dataclass(frozen=True)
class JobSpec:
    """A job without what only one process has: what a task takes along (see `Job`)."""

    run: RunDir
    backend: Backend
    threads: int
    force: bool
    processes: int
    device: str
    memory_limit: int

    def open(self, emit: Emit) -> Job:
        """The job, in this process."""
        return Job(emit=emit, **{f.name: getattr(self, f.name) for f in fields(self)})


def fusion(run: RunDir) -> list[Path]:
    """What results change with that look at label images after training."""
    return [run.provenance("fuse")] if (run.fused / "labels.json").exists() else []


def label_images(job: Job, source: str) -> LabelImages:
    """The label images that came with the photos ("given"), or those of the 3D labels ("rendered")."""
    if source == "given":
        return job.best_masks
    return RenderedLabels(job.ladder.load(job.ladder.levels[-1]), job.backend, job.antialiased)


def distances(job: Job, distance: str) -> dict[int, np.ndarray]:
    """d_min of each category in each view, as `FitConfig.distance` says."""
    percentile = PERCENTILE if distance == "percentile" else 0.0
    return distances_in_views(job.scene, job.point_labels, percentile)


def lpips_hashes(folder: Path | None) -> dict[str, str | None]:
    """What tells one set of LPIPS weights from another, by network."""
    paths = {net: weights_path(net, folder) for net in NETS}
    return {net: file_hash(path) if path.is_file() else None for net, path in paths.items()}


def load_metrics(job: Job, folder: Path | None, nets: Sequence[Net] = NETS) -> dict[str, Lpips]:
    """LPIPS as the field feeds it, by column; what cannot be loaded is left out with a warning."""
    found = {}
    for net in nets:
        try:
            found[f"lpips_{net}"] = load_lpips(net, folder, as_3dgs=net == "vgg")
        except SageError as error:
            job.emit(Warned(f"no LPIPS ({net}): {error}"))
    return found


def run_stage(
    job: Job, name: str, settings: dict[str, Any], inputs: Sequence[Path], outputs: Sequence[Path],
    make: Callable[[], Sequence[str]],
) -> None:  # fmt: skip
    """Do a stage unless its result is there already.

    Nobody else writes into the run folder meanwhile. A stage counts as done only once its files are on the
    disk, and not while it is done anew. RunError where another process works on the folder, or the disk is
    full: then what was finished stays, and the same command goes on.
    """
    if name not in ("poses", "scene") and not job.run.scene.exists():
        raise RunError(f"{job.run.path}: {NO_RUN}")
    for path in inputs:
        if not path.exists():
            raise RunError(f"{path}: missing; run the stage before `sagesplat {name}`, or `sagesplat run`")
    settings = json.loads(json.dumps(settings, default=str))  # as it will read back
    if is_done(job.run, name, settings, inputs, outputs, job.force):
        job.emit(StageSkipped(name))
        return
    with ExitStack() as own, named_full_disk(job.run.path):
        (job.locks or own).enter_context(locked(job.run.path))
        remove_temporary(job.run.path, but="bundle")  # a viewer writes those, without the lock
        job.run.provenance(name).unlink(missing_ok=True)
        job.emit(StageStarted(name))
        begin, since = time.perf_counter(), time.time() - _CLOCK_STEP
        lines = make()
        seconds = time.perf_counter() - begin
        sync_changed(job.run.path, since)
        record(job.run, name, settings, inputs, seconds)
    job.emit(StageDone(name, seconds, tuple(lines)))


def fingerprint(scene: Scene) -> str:
    """Changes when the poses, the points or the set of photos do."""
    digest = hashlib.sha256()
    for view in scene.views:
        size = view.image_path.stat().st_size
        digest.update(f"{view.name} {size} {view.camera.width} {view.camera.height}".encode())
        digest.update(view.camera.w2c.tobytes() + view.camera.K.tobytes())
        if any(view.camera.background):
            digest.update(bytes(view.camera.background))
    digest.update(scene.points.xyz.tobytes())
    if scene.test_names is not None:
        digest.update("\n".join(sorted(scene.test_names)).encode())
    return digest.hexdigest()
