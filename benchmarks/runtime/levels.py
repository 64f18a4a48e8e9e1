"""Our rows: equal levels, and what the planner takes for each frame within a budget."""

import gzip
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.runtime.measure import Shown
from sagesplat.adapt.cell_plans import within
from sagesplat.adapt.fidelity import References
from sagesplat.formats.increments import shown
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.scene import Camera
from sagesplat.stages.bundle import bundle
from sagesplat.stages.methods import NestedLevels
from sagesplat.stages.results import increments_of


def opened(run: Path) -> Job:
    """A finished run."""
    return Job(RunDir(run, "nested"), lambda event: None)


def ours(job: Job, cameras: Sequence[Camera], shares: Sequence[float]) -> np.ndarray:
    """The planner's levels of cells, int [F, 2 J, C] from 1 to K, within shares of all splats and bytes."""
    method = NestedLevels(job)
    expected, costs = method.expect(cameras), method.cell_costs
    budgets = [
        (cost, share * float(cost[:, -1].sum()))
        for cost in (costs.count, costs.transfer_bytes)
        for share in shares
    ]
    return np.array(
        [
            [within(cost, mean, share, budget) + 1 for cost, budget in budgets]
            for mean, share in zip(expected.mean, expected.share, strict=True)
        ]
    )


class Levels:
    """Levels of a ladder, [F, J, L]; a method of `measure`."""

    def __init__(
        self, name: str, job: Job, references: References, settings: Sequence[float], levels: np.ndarray
    ):
        self.name, self.settings, self._levels = name, settings, levels
        self._references, self._counts, self._ids = references, job.by_cell.counts, job.cells.ids.tolist()
        listed = increments_of(job)
        self.piece_bytes = np.array([one.nbytes for one in listed])
        self.index_bytes = index_bytes(job)
        at = {id(one): i for i, one in enumerate(listed)}
        self._pieces = {
            (cell, level): [at[id(one)] for one in shown(listed, cell, level)]
            for cell in self._ids
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
            count = sum(self._counts[of_level] for of_level in levels.items())
            yield Shown(seen.render(levels), count, needed)


def equal_levels(job: Job, references: References, frames: int) -> Levels:
    """All cells at one level."""
    K = len(job.ladder.levels)
    levels = np.broadcast_to(np.arange(1, K + 1)[None, :, None], (frames, K, len(job.cells.ids)))
    return Levels("equal levels", job, references, tuple(range(1, K + 1)), levels)


def planned(
    name: str, job: Job, references: References, cameras: Sequence[Camera], shares: Sequence[float]
) -> Levels:
    """The planner's within shares of all splats, and of all bytes."""
    return Levels(name, job, references, (*shares, *shares), ours(job, cameras, shares))


def index_bytes(job: Job) -> int:
    """What a viewer of ours reads before it plans, compressed as servers do: manifest and models."""
    with tempfile.TemporaryDirectory() as work:
        out = bundle(job, Path(work) / "bundle").path
        files = [out / "manifest.json", *out.glob("promises-*.json")]
        return sum(len(gzip.compress(file.read_bytes())) for file in files)
