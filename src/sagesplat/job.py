"""A run folder being worked on: what its stages share, and how a stage is done once."""

import hashlib
import json
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sagesplat.adapt.ladder import Ladder, SnapshotLadder, read_ladder, read_prefixes
from sagesplat.adapt.observe import PERCENTILE, LabelImages, RenderedLabels, distances_in_views
from sagesplat.config import FitConfig
from sagesplat.errors import RunError, SageError
from sagesplat.events import Emit, StageDone, StageSkipped, StageStarted, Warned
from sagesplat.executor import LOCAL, Executor, Local, Task
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
_LOCK_WAIT = 60.0  # seconds that a task waits for one which a killed run left behind
_PIECES = 2  # of work for each task that can run: the slower ones then have less to wait for
Part = TypeVar("Part")
Result = TypeVar("Result")
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
    lock_wait: float = 0.0  # seconds to wait for who has the run folder

    @property
    def spec(self) -> "JobSpec":
        """What another process needs to open the same job."""
        spec = JobSpec(**{f.name: getattr(self, f.name) for f in fields(JobSpec)})
        return replace(
            spec,
            run=replace(self.run, path=self.run.path.absolute()),
            backend=self.executor.backend or self.backend,
            memory_limit=self.memory_limit or self.executor.memory,
        )

    @property
    def gpus(self) -> float:
        """GPUs that a task of this job computes on."""
        return float(self.spec.backend == "cuda")

    @property
    def pieces(self) -> int:
        """What to divide work by that one task would do as well."""
        return 1 if isinstance(self.executor, Local) else _PIECES * self.executor.parallel

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

    @property
    def has_blocks(self) -> bool:
        """Whether the scene is trained in blocks."""
        return (self.run.blocks / "blocks.json").exists()

    @property
    def has_parts(self) -> bool:
        """Whether each category in each block is one of its own by now."""
        return (self.run.parts / "labels.json").exists()

    @property
    def taxonomy(self) -> Taxonomy:
        """The names of the run's categories."""
        return Taxonomy.read((self.run.parts if self.has_parts else self.run.masks) / "labels.json")

    @cached_property
    def masks(self) -> Masks:
        """The label images before fusion, loaded when asked for."""
        return Masks(self.run.masks, Taxonomy.read(self.run.masks / "labels.json"))

    @property
    def whole_masks(self) -> Masks:
        """The label images that all views agreed on, if they were asked to."""
        fused = self.run.fused
        return Masks(fused, self.masks.taxonomy) if (fused / "labels.json").exists() else self.masks

    @property
    def best_masks(self) -> Masks:
        """The same, of the parts that a scene in blocks has."""
        return Masks(self.run.parts, self.taxonomy) if self.has_parts else self.whole_masks

    @property
    def point_labels(self) -> np.ndarray:
        """Category of each SfM point."""
        path = self.run.part_labels if self.has_parts else self.run.labels
        return LiftedLabels.read(path, len(self.scene.points.xyz)).label_ids

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
        made = {f.name: getattr(self, f.name) for f in fields(self)}
        return Job(emit=emit, lock_wait=_LOCK_WAIT, **made)


def work(
    job: Job, name: str, function: Callable[[Job, Part], Result], parts: Sequence[Part]
) -> Iterator[tuple[int, Result]]:
    """`function(job, part)` of each part, with the part's number, as they come (see `Executor.run`).

    `function` is one of a module. Where the executor is another process's, it gets a job opened there.
    """
    if isinstance(job.executor, Local):
        for number, part in enumerate(parts):
            yield number, function(job, part)
    else:
        spec, gpus = job.spec, job.gpus
        tasks = [Task(name, _piece, (spec, function, part), gpus) for part in parts]
        yield from job.executor.run(tasks, job.emit)


def work_all(
    job: Job, name: str, function: Callable[[Job, Part], Result], parts: Sequence[Part]
) -> list[Result]:
    """What `work` finds, in the order of the parts."""
    found = dict(work(job, name, function, parts))
    return [found[number] for number in range(len(parts))]


def _piece(spec: JobSpec, function: Callable[[Job, Any], Any], part: Any, emit: Emit) -> Any:
    """A task: one part, in a process that may have had others of the same scene."""
    job = spec.open(emit)
    kept = _kept(replace(spec, force=False), job.run.scene.read_bytes())
    vars(job).update(scene=kept.scene, photos=kept.photos)
    return function(job, part)


@lru_cache(maxsize=1)
def _kept(spec: JobSpec, scene: bytes) -> Job:
    """A job whose scene and photos serve one task after the other; `scene`: content of scene.json."""
    capture = Path(json.loads(scene)["path"])
    if not capture.exists():
        raise RunError(
            f"{capture}: {socket.gethostname()} does not see the capture; all nodes need it under this path, "
            "on a disk that they share"
        )
    return spec.open(lambda event: None)


def fusion(run: RunDir) -> list[Path]:
    """What results change with that look at label images after training."""
    made = [("fuse", run.fused), ("parts", run.parts)]
    return [run.provenance(stage) for stage, folder in made if (folder / "labels.json").exists()]


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


@dataclass(frozen=True)
class Stage:
    """What is done once: its settings and inputs decide its outputs."""

    name: str
    settings: dict[str, Any]
    inputs: Sequence[Path]
    outputs: Sequence[Path]


def run_stage(
    job: Job, name: str, settings: dict[str, Any], inputs: Sequence[Path], outputs: Sequence[Path],
    make: Callable[[], Sequence[str]],
) -> None:  # fmt: skip
    """Do a stage unless its result is there already.

    Nobody else writes into the run folder meanwhile. A stage counts as done only once its files are on the
    disk, and not while it is done anew. RunError where another process works on the folder, or the disk is
    full: then what was finished stays, and the same command goes on.
    """
    run_stages(job, [Stage(name, settings, inputs, outputs)], lambda _: iter([(0, make())]))


def run_stages(
    job: Job,
    stages: Sequence[Stage],
    make: Callable[[Sequence[int]], Iterator[tuple[int, Sequence[str]]]],
) -> None:
    """Like `run_stage` for several that do not depend on each other, side by side.

    `make` gets the numbers of those that are to be done, and gives each with its lines as soon as it is.
    """
    stages = [replace(s, settings=json.loads(json.dumps(s.settings, default=str))) for s in stages]
    missing = [number for number, stage in enumerate(stages) if not _is_done(job, stage)]
    if not missing:
        return
    with ExitStack() as own, named_full_disk(job.run.path):
        (job.locks or own).enter_context(locked(job.run.path, job.lock_wait))
        remove_temporary(job.run.path, but="bundle")  # a viewer writes those, without the lock
        for number in missing:
            job.run.provenance(stages[number].name).unlink(missing_ok=True)
            job.emit(StageStarted(stages[number].name))
        begin, since = time.perf_counter(), time.time() - _CLOCK_STEP
        for number, lines in make(missing):
            stage = stages[number]
            seconds = time.perf_counter() - begin
            sync_changed(job.run.path, since)
            record(job.run, stage.name, stage.settings, stage.inputs, seconds)
            job.emit(StageDone(stage.name, seconds, tuple(lines)))


def _is_done(job: Job, stage: Stage) -> bool:
    """Whether a stage is to be skipped, which is said; RunError where it cannot be done."""
    if stage.name not in ("poses", "scene") and not job.run.scene.exists():
        raise RunError(f"{job.run.path}: {NO_RUN}")
    for path in stage.inputs:
        if not path.exists():
            raise RunError(
                f"{path}: missing; run the stage before `sagesplat {stage.name}`, or `sagesplat run`"
            )
    done = is_done(job.run, stage.name, stage.settings, stage.inputs, stage.outputs, job.force)
    if done:
        job.emit(StageSkipped(stage.name))
    return done


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
    if scene.calibration_names is not None:
        digest.update("\n".join(["", *sorted(scene.calibration_names)]).encode())
    return digest.hexdigest()
