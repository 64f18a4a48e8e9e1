"""Our rows: equal levels, and what the planner takes for each frame within a budget or for a target."""

import gzip
import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.runtime.measure import Shown
from sagesplat.adapt.cell_models import needed
from sagesplat.adapt.cell_plans import reach, within
from sagesplat.adapt.fidelity import References
from sagesplat.adapt.fill import fill
from sagesplat.formats.increments import shown
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.scene import Camera
from sagesplat.stages.bundle import bundle
from sagesplat.stages.methods import NestedLevels
from sagesplat.stages.results import cells_of, increments_of

# what a byte that has come counts in the next plan for a target, as in web/src/core/residency.ts
THERE = 0.25


def opened(run: Path) -> Job:
    """A finished run."""
    return Job(RunDir(run, "nested"), lambda event: None)


class Pieces:
    """What is fetched as one of a run's levels."""

    def __init__(self, job: Job):
        listed = increments_of(job)
        at = {id(one): i for i, one in enumerate(listed)}
        self.nbytes = np.array([one.nbytes for one in listed])
        self.of = {  # (cell, level) takes
            (cell, level): [at[id(one)] for one in shown(listed, cell, level)]
            for cell in job.cells.ids.tolist()
            for level in job.ladder.levels
        }
        self.shape = len(job.cells.ids), len(job.ladder.levels)

    def of_composition(self, levels: Mapping[int, int]) -> np.ndarray:
        """Which ones levels by cell take, bool [P]."""
        found = np.zeros(len(self.nbytes), bool)
        for of_level in levels.items():
            found[self.of[of_level]] = True
        return found

    def among(self, came: np.ndarray) -> np.ndarray:
        """Bytes of some pieces in each level of each cell, int [C, K]."""
        nbytes = self.nbytes * came
        return np.array([nbytes[mine].sum() for mine in self.of.values()]).reshape(self.shape)


def within_budgets(job: Job, cameras: Sequence[Camera], shares: Sequence[float]) -> np.ndarray:
    """The planner's levels of cells, int [F, J, C] from 1 to K, within shares of all splats.

    As in the viewer (web/src/core/planner.ts), where not even the lowest levels fit, cells out of sight are
    left out (0), those of the least apparent size first.
    """
    method, cells = NestedLevels(job), cells_of(job)
    expected, cost = method.expect(cameras), method.cell_costs.count
    points, areas = cells.points(), cells.areas()
    found = np.zeros((len(cameras), len(shares), len(cost)), np.int64)
    for row, camera in enumerate(cameras):
        share = expected.share[row]
        apparent = (areas / np.maximum(((points - camera.position) ** 2).sum(2), 1e-12)).sum(1)
        unseen = [cell for cell in np.argsort(apparent) if not share[cell] > 0]
        for j, of_all in enumerate(shares):
            budget, drawn = of_all * float(cost[:, -1].sum()), np.ones(len(cost), bool)
            for cell in unseen:
                if cost[drawn, 0].sum() <= budget:
                    break
                drawn[cell] = False
            levels = within(cost[drawn], expected.mean[row][drawn], share[drawn], budget)
            found[row, j, drawn] = levels + 1
    return found


def for_targets(job: Job, pieces: Pieces, cameras: Sequence[Camera], targets: Sequence[float]) -> np.ndarray:
    """The planner's levels of cells, int [F, J, C] from 1 to K, that keep targets in each category.

    As in the viewer, what an earlier frame has fetched costs a part of its bytes (`THERE`).
    """
    method, ids = NestedLevels(job), job.cells.ids.tolist()
    expected, full = method.expect(cameras), method.cell_costs.transfer_bytes.astype(np.float64)
    found = np.zeros((len(cameras), len(targets), len(ids)), np.int64)
    for j, target in enumerate(targets):
        came = np.zeros(len(pieces.nbytes), bool)
        for frame in range(len(cameras)):
            here, cost = expected.at(frame), full - (1 - THERE) * pieces.among(came)
            mean, share = here.mean[0], here.share[0]
            least = needed(method.fidelity, here, target)[0]
            levels = fill(reach(cost, mean, share, here.column, least).levels, mean, cost, share) + 1
            found[frame, j] = levels
            came |= pieces.of_composition(dict(zip(ids, levels.tolist(), strict=True)))
    return found


class Levels:
    """Levels of a ladder, [F, J, L], 0: not drawn; a method of `measure`."""

    def __init__(
        self,
        name: str,
        job: Job,
        references: References,
        settings: Sequence[float],
        levels: np.ndarray,
        targets: Sequence[float] = (),
    ):
        """`targets`: those of the last settings."""
        self.name, self.settings, self.targets, self._levels = name, settings, targets, levels
        self._references, self._counts, self._ids = references, job.by_cell.counts, job.cells.ids.tolist()
        self._pieces = Pieces(job)
        self.piece_bytes, self.index_bytes = self._pieces.nbytes, index_bytes(job)

    def shown(self, frame: int, camera: Camera) -> Iterator[Shown]:
        """See `Method`."""
        seen = self._references.at(camera).levels
        assert seen is not None  # the ladder is nested
        for chosen in self._levels[frame].tolist():
            levels = {cell: level for cell, level in zip(self._ids, chosen, strict=True) if level}
            count = sum(self._counts[of_level] for of_level in levels.items())
            yield Shown(seen.render(levels), count, self._pieces.of_composition(levels))


def equal_levels(job: Job, references: References, frames: int) -> Levels:
    """All cells at one level."""
    K = len(job.ladder.levels)
    levels = np.broadcast_to(np.arange(1, K + 1)[None, :, None], (frames, K, len(job.cells.ids)))
    return Levels("equal levels", job, references, tuple(range(1, K + 1)), levels)


def planned(
    name: str,
    job: Job,
    references: References,
    cameras: Sequence[Camera],
    shares: Sequence[float],
    targets: Sequence[float],
) -> Levels:
    """The planner's within shares of all splats, and for targets of every category."""
    levels = [within_budgets(job, cameras, shares), for_targets(job, Pieces(job), cameras, targets)]
    return Levels(name, job, references, (*shares, *targets), np.concatenate(levels, 1), targets)


def index_bytes(job: Job) -> int:
    """What our viewer reads before it plans for fidelity, compressed as servers do: manifest and models."""
    with tempfile.TemporaryDirectory() as work:
        out = bundle(job, Path(work) / "bundle").path
        manifest = out / "manifest.json"
        models = json.loads(manifest.read_text())["promises"]["fidelity"]["uri"]
        files = [manifest, out / models]
        return sum(len(gzip.compress(file.read_bytes())) for file in files)
