"""Our rows: equal levels, and what the planner takes for each frame."""

import gzip
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.runtime.measure import Shown
from sagesplat.adapt.bound_plans import plan_for_view, quality_at
from sagesplat.adapt.fidelity import References, distances_at
from sagesplat.formats.increments import INDEX, shown
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.scene import Camera
from sagesplat.stages.methods import NestedLevels
from sagesplat.stages.results import fidelity_of, increments_of

TARGETS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.93, 0.95, 0.97, 0.98, 0.99, 0.995, 1.0)


def opened(run: Path) -> Job:
    """A finished run."""
    return Job(RunDir(run, "nested"), lambda event: None)


def ladder_ids(job: Job) -> list[int]:
    """What the ladder has levels of, ascending: the columns of all levels here."""
    return sorted({label for label, _ in job.ladder.counts})


def ours(job: Job, references: References, cameras: Sequence[Camera], targets: Sequence[float]) -> np.ndarray:
    """The planner's levels, int [V, J, L] from 1 to K: by camera, target and the ladder's ids, ascending."""
    costs = NestedLevels(job).costs
    labels = list(costs.labels)
    distance = distances_at(job.scene, job.point_labels, cameras, labels, job.fit_config.distance)
    far = dict(zip(labels, distance.T.astype(np.float64), strict=True))
    quality = quality_at(costs, fidelity_of(job), far, cameras, "fidelity")
    found = np.ones((len(cameras), len(targets), len(labels)), np.int64)
    for view, camera in enumerate(cameras):
        pixels = references.at(camera).pixels.astype(np.float64)
        for j, target in enumerate(targets):
            plan = plan_for_view(quality, costs, target, view, pixels)
            found[view, j] = [plan.levels[label] for label in labels]
    return found


class Levels:
    """Levels of a ladder, [F, J, L]; a method of `measure`."""

    def __init__(
        self, name: str, job: Job, references: References, settings: Sequence[float], levels: np.ndarray
    ):
        self.name, self.settings, self._job, self._levels = name, settings, job, levels
        self._references, self._ids = references, ladder_ids(job)
        listed = increments_of(job)
        self.piece_bytes = np.array([one.nbytes for one in listed])
        self.index_bytes = index_bytes(job.run)
        at = {id(one): i for i, one in enumerate(listed)}
        self._pieces = {
            (label, level): [at[id(one)] for one in shown(listed, label, level)]
            for label in self._ids
            for level in job.ladder.levels
        }

    def shown(self, frame: int, camera: Camera) -> Iterator[Shown]:
        """See `Method`."""
        seen = self._references.at(camera).levels
        assert seen is not None  # the ladder is nested
        for chosen in self._levels[frame].tolist():
            levels = dict(zip(self._ids, chosen, strict=True))
            needed = np.zeros(len(self.piece_bytes), bool)
            for of_level in levels.items():
                needed[self._pieces[of_level]] = True
            count = sum(self._job.ladder.counts[of_level] for of_level in levels.items())
            yield Shown(seen.render(levels), count, needed)


def equal_levels(job: Job, references: References, frames: int) -> Levels:
    """All categories at one level."""
    K = len(job.ladder.levels)
    levels = np.broadcast_to(np.arange(1, K + 1)[None, :, None], (frames, K, len(ladder_ids(job))))
    return Levels("equal levels", job, references, tuple(range(1, K + 1)), levels)


def planned(name: str, job: Job, references: References, cameras: Sequence[Camera]) -> Levels:
    """The planner's."""
    return Levels(name, job, references, TARGETS, ours(job, references, cameras, TARGETS))


def index_bytes(run: RunDir) -> int:
    """What a viewer of ours reads before it plans, compressed as servers do: manifest and models."""
    bundle = run.path / "bundle"
    files = [bundle / "manifest.json", *sorted(bundle.glob("promises-*.json"))]
    if not files[0].exists():
        files = [run.increments / INDEX, run.fidelity]
    return sum(len(gzip.compress(file.read_bytes())) for file in files)
