"""A run folder being worked on, and what its stages share."""

from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from sagesplat.adapt.cells import Cells, read_cells
from sagesplat.adapt.fidelity import References
from sagesplat.adapt.ladder import (
    Ladder,
    NestedLadder,
    PrefixLadder,
    RecordedLadder,
    read_ladder,
    read_prefixes,
)
from sagesplat.adapt.observe import PERCENTILE, distances_in_views
from sagesplat.core.config import FitConfig
from sagesplat.core.errors import DataError, RunError
from sagesplat.core.events import Emit
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.levels import LevelFile
from sagesplat.raster import Backend
from sagesplat.run.capture import check_photos, fingerprint, photo_hashes, read_capture
from sagesplat.run.executor import LOCAL, Executor, Local
from sagesplat.run.records import settings_of
from sagesplat.run.run_dir import RunDir, check_run
from sagesplat.scene.images import Photos
from sagesplat.scene.refined import read_refined, with_cameras
from sagesplat.scene.scene import Scene
from sagesplat.segment.lift import LiftedLabels
from sagesplat.segment.masks import Masks, Taxonomy
from sagesplat.segment.parents import read_parents
from sagesplat.segment.valid import ValidPixels
from sagesplat.train import memory
from sagesplat.train.sky import Sky, read_sky

_PIECES = 2  # of work for each task that can run: the slower ones then have less to wait for
_LOCK_WAIT = 60.0  # seconds that a task waits for one which a killed run left behind


@dataclass(eq=False)
class Job:
    """A run folder being worked on, and what its stages share. `replace` makes one that has read nothing."""

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
    source: "Job | None" = None  # job of the same scene: share its scene and photos, do not load them again
    before_redo: Callable[[str, str], None] | None = None  # told of a stage to be forced, and what differs
    # what was computed last, with what it depends on: a stage of this job may change that
    _refined: tuple[tuple[int, int, int], Scene] | None = field(default=None, init=False, repr=False)
    _distances: tuple[Scene, tuple[float, bytes], dict[int, np.ndarray]] | None = field(
        default=None, init=False, repr=False
    )

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

    def block_spec(self, number: int) -> "JobSpec":
        """The job on a block of a large scene."""
        return replace(self.spec, run=self.run.block(number))

    @property
    def gpus(self) -> float:
        """GPUs that a task of this job computes on."""
        return float(self.spec.backend == "cuda")

    @property
    def pieces(self) -> int:
        """What to divide work by that one task would do as well."""
        return 1 if isinstance(self.executor, Local) else _PIECES * self.executor.parallel

    @property
    def scene(self) -> Scene:
        """The capture with the cameras that training refined: what everything after training uses."""
        given, path = self.given_scene, self.run.cameras
        if not path.exists():
            return given
        stat = path.stat()
        state = stat.st_mtime_ns, stat.st_size, stat.st_ino  # a training of this job may replace the file
        if self._refined is None or self._refined[0] != state:
            self._refined = state, with_cameras(given, read_refined(path, len(given.views)))
        return self._refined[1]

    @cached_property
    def given_scene(self) -> Scene:
        """The capture that scene.json names, unchanged since, with its cameras as they were given."""
        return self.source.given_scene if self.source else self._opened[0]

    @cached_property
    def photos(self) -> Photos:
        """The photos, loaded when asked for."""
        return self._opened[1]

    @cached_property
    def _opened(self) -> tuple[Scene, Photos]:
        """The capture and its photos, opened together: photos that change from then on are noticed."""
        if self.source is not None:
            return self.source._opened
        check_run(self.run)
        made = read_capture(self.run.scene)
        scene = made.load()
        if fingerprint(scene) != made.fingerprint:
            raise RunError(
                f"{made.path}: the capture changed since this run began; choose another run folder"
            )
        now = photo_hashes(self.run.photo_hashes, scene)
        check_photos(scene, made.photos, now.sha256)
        now.keep()
        return scene, Photos(scene.views, memory.photo_cache(self.memory_limit))

    @property
    def has_blocks(self) -> bool:
        """Whether the scene is trained in blocks."""
        return self.run.division.exists()

    @property
    def taxonomy(self) -> Taxonomy:
        """The names of the run's categories."""
        return Taxonomy.read(self._labels)

    @property
    def _labels(self) -> Path:
        return (self.run.instances if self.run.has_instances else self.run.masks) / "labels.json"

    @property
    def parents(self) -> dict[str, str]:
        """The category of each instance, by name."""
        return read_parents(self.run.parents) if self.run.ladder == "nested" else {}

    @cached_property
    def masks(self) -> Masks:
        """The label images before fusion, loaded when asked for."""
        return Masks(self.run.masks, Taxonomy.read(self.run.masks / "labels.json"))

    @cached_property
    def valid(self) -> ValidPixels:
        """The pixels that count, loaded when asked for."""
        return ValidPixels(self.run.valid)

    @property
    def inliers(self) -> ValidPixels:
        """The pixels that Gaussians are fitted to after training: those that count, without outliers."""
        return ValidPixels(self.run.inliers) if self.run.inliers.exists() else self.valid

    @property
    def parents_by_id(self) -> dict[int, str]:
        """The category of each instance, by the instance's id."""
        parents = self.parents
        return {label: parents[name] for label, name in self.names().items() if name in parents}

    @property
    def level_masks(self) -> Masks:
        """The label images of what the levels are of: with instances, if they were asked for."""
        instances = self.run.instances
        if self.run.has_instances:
            return Masks(instances, Taxonomy.read(instances / "labels.json"))
        return self.category_masks

    @property
    def category_masks(self) -> Masks:
        """The label images that all views agreed on, if they were asked to."""
        fused = self.run.fused
        return Masks(fused, self.masks.taxonomy) if (fused / "labels.json").exists() else self.masks

    @property
    def sky(self) -> Sky | None:
        """The sky that the run was trained with."""
        return read_sky(self.run.sky) if self.run.sky.exists() else None

    @property
    def point_labels(self) -> np.ndarray:
        """Category of each SfM point."""
        return self._lifted(self.point_label_file).label_ids

    @property
    def point_label_file(self) -> Path:
        """Where the categories of SfM points are, those of instances if they were asked for."""
        return self.run.instance_labels if self.run.has_instances else self.run.labels

    @property
    def initial_labels(self) -> np.ndarray:
        """Category of the Gaussian that begins at each SfM point; `lift.IGNORED` where none does."""
        return self._lifted(self.run.labels).initial_ids

    def _lifted(self, path: Path) -> LiftedLabels:
        lifted = LiftedLabels.read(path, len(self.scene.points.xyz))
        ids = np.flatnonzero(np.bincount(lifted.label_ids.astype(np.int64) + 1)) - 1
        self.check_named(path, ids)
        return lifted

    def distances(self, distance: str) -> dict[int, np.ndarray]:
        """d_min of each category in each view, as `FitConfig.distance` says; kept, as several stages ask."""
        percentile = PERCENTILE if distance == "percentile" else 0.0
        scene, labels = self.scene, self.point_labels
        key, kept = (percentile, labels.tobytes()), self._distances
        if kept is None or kept[0] is not scene or kept[1] != key:
            kept = self._distances = scene, key, distances_in_views(scene, labels, percentile)
        return kept[2]

    @cached_property
    def recorded(self) -> RecordedLadder:
        """The levels that training recorded."""
        return read_ladder(self.run.levels)

    @property
    def last_level(self) -> LevelFile:
        """What training ended with, floaters included."""
        return self.recorded.files[-1]

    def load_last_level(self) -> Gaussians:
        """The Gaussians that training ended with, floaters included."""
        return self.recorded.load(self.last_level.step)

    @cached_property
    def came_in(self) -> Gaussians | None:
        """The splat that was adopted, which fidelity is against; None where the run trained its own."""
        return self.load_last_level() if self.run.adopted.exists() else None

    @property
    def trained(self) -> Path:
        """The trained model: the last level, without its floaters where some were removed."""
        return self.run.cleaned if self.run.cleaned.exists() else self.last_level.path

    @cached_property
    def ladder(self) -> Ladder:
        """The levels to choose from: prefixes of the nested model, or those that training recorded."""
        if self.run.ladder != "nested":
            path, ladder = self.run.levels, self.recorded
        else:
            path, prefixes = self.run.prefixes, read_prefixes(self.run.prefixes)
            if prefixes.sizes.keys() != self.cells.label_of.keys():
                raise DataError(
                    f"{path}: not of the cells beside it; delete it and run `sagesplat nest` again"
                )
            ladder = NestedLadder(prefixes, self.cells.label_of)
        self.check_named(path, sorted({label for label, _ in ladder.counts}))
        return ladder

    @cached_property
    def cells(self) -> Cells:
        """The cells of the nested levels."""
        return read_cells(self.run.cells)

    @property
    def by_cell(self) -> PrefixLadder:
        """The nested levels by cell."""
        ladder = self.ladder
        assert isinstance(ladder, NestedLadder)
        return ladder.cells

    @cached_property
    def references(self) -> References:
        """What compositions of the cells' levels are compared with."""
        return References(self.by_cell, self.backend, self.antialiased, full=self.came_in)

    def check_named(self, path: Path, label_ids: Iterable[int]) -> None:
        """RunError for an id that the run's labels.json does not name."""
        names = self.names()
        for label in label_ids:
            if label not in names:
                raise RunError(
                    f"{path}: of category {label}, which {self._labels} does not name; put back the "
                    "labels.json that belongs to it, or run again into a new folder"
                )

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

    def open(self, emit: Emit, source: Job | None = None) -> Job:
        """The job, in this process; it shares the scene and the photos of `source`."""
        made = {f.name: getattr(self, f.name) for f in fields(self)}
        return Job(emit=emit, lock_wait=_LOCK_WAIT, source=source, **made)
