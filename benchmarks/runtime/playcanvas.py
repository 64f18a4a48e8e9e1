"""PlayCanvas: streamed SOG made by splat-transform, and the level that its engine takes of each node.

The rule is that of playcanvas 2.23.3, src/scene/gsplat-unified: `gsplat-octree-instance.js`
(evaluateNodeDistances), `gsplat-lod-table.js` and `gsplat-budget-balancer.js` (balance), with the defaults of
`gsplat-params.js` and `gsplat-placement.js` (MIT licence; described, not copied):

1. A node's distance is that of the camera to its bounding box, of which each side is first drawn in by 0.75
   of what half its length exceeds the median node's. It is multiplied by 1 + 0.5 cos of the angle to straight
   backwards for what lies behind the camera, and by the tangent of the smaller half field of view over that
   of 22.5 degrees.
2. Level k begins at c lodBaseDistance lodMultiplier^(k - 1). In the engine's default mode
   (GSPLAT_BUDGET_TARGET) c is the largest with which all nodes together fit into the splat budget, so the
   base distance is of no account with one scene; lodMultiplier is 3.
3. All is at its coarsest level where even that exceeds the budget. A level without splats is its next finer
   one; beyond the coarsest that has some a node is empty.

A file of the streamed SOG, all rows of all its nodes, is what is fetched as one.
"""

import gzip
import json
import math
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.runtime.measure import Shown
from sagesplat.adapt.observe import render_rgb
from sagesplat.core.gaussians import concat
from sagesplat.formats.sog import read_sog
from sagesplat.raster import Backend, Workspace
from sagesplat.scene.scene import Camera

BEHIND, SHRINK, MULTIPLIER = 1.5, 0.75, 3.0  # lodBehindPenalty, lodDistanceShrink, lodMultiplier
_BINS = 96 / 1024 / 1024  # of the logarithm of distances, that are taken together
_HALVINGS = 6  # "halving the Gaussian count at each level", as SuperSplat publishes scenes
_ITERATIONS = "1"  # of k-means for harmonics: ten, the default, take hours without a GPU


def made(model: Path, tool: Path, chunk: int, extent: float, harmonics: int) -> Path:
    """The lod-meta.json of a PLY, made by splat-transform where it is not there yet.

    `chunk`: thousands of splats in a file, an eighth of `extent` wide at most; 0: as the tool has it.
    `harmonics`: the degree that is kept.
    """
    meta = model.with_name(f"playcanvas-{chunk}-{harmonics}") / "lod-meta.json"
    if meta.exists():
        return meta
    node = [shutil.which("node") or "node"] if tool.suffix in (".mjs", ".js") else []
    command = [*node, str(tool), "-q", "-w", "-g", "cpu", "-i", _ITERATIONS]
    levels = [model]
    for k in range(1, _HALVINGS + 1):
        levels.append(model.with_name(f"decimated-{k}.ply"))
        if not levels[-1].exists():
            subprocess.run(
                [*command, str(model), "--decimate", f"{100 / 2**k:g}%", str(levels[-1])], check=True
            )
    if chunk:
        command += ["--lod-chunk-count", f"{chunk}", "--lod-chunk-extent", f"{max(round(extent / 8), 1)}"]
        command += ["--lod-chunk-min", "1"]
    inputs = [part for k, path in enumerate(levels) for part in (str(path), "-l", str(k))]
    meta.parent.mkdir(exist_ok=True)
    subprocess.run([*command, *inputs, str(meta), "--filter-harmonics", str(harmonics)], check=True)
    return meta


def distances(bounds: np.ndarray, camera: Camera) -> np.ndarray:
    """Distances of nodes [M] by their bounds [M, 2, 3], as the engine has them."""
    low, high = bounds[:, 0], bounds[:, 1]
    half = (high - low) / 2
    excess = np.maximum(half - np.sort(half, 0)[len(half) // 2], 0)
    at = camera.position.astype(np.float64)
    to = np.clip(at, low + SHRINK * excess, high - SHRINK * excess) - at
    distance = np.linalg.norm(to, axis=1)
    behind = np.maximum(-(to @ camera.direction), 0) / np.maximum(distance, 1e-30)
    penalty = np.where(distance > 1e-2, 1 + (BEHIND - 1) * behind, 1)
    view = min(camera.width / camera.K[0, 0], camera.height / camera.K[1, 1]) / 2 / math.tan(math.pi / 8)
    return distance * penalty * view


def filled(counts: np.ndarray) -> np.ndarray:
    """The level that each node has in the place of each, [M, K] of `counts` [M, K]; -1: it is empty."""
    found = np.full(counts.shape, -1)
    for node, row in enumerate(counts):
        some = np.flatnonzero(row)
        for level in range(some[-1] + 1 if len(some) else 0):
            finer = some[some <= level]
            found[node, level] = finer[-1] if len(finer) else some[0]
    return found


def chosen(
    distance: np.ndarray, counts: np.ndarray, budget: float, multiplier: float = MULTIPLIER
) -> np.ndarray:
    """The place [M] of each node's level in `filled`, within a budget of splats."""
    at = filled(counts)
    held = np.where(at < 0, 0, np.take_along_axis(counts, np.maximum(at, 0), 1))
    K = counts.shape[1]
    coarsest, finest = held[:, -1].sum(), held[:, 0].sum()
    if coarsest >= budget or finest <= budget:
        return np.full(len(counts), K - 1 if coarsest >= budget else 0)
    # an upgrade of each node from level k to k - 1, in the order in which c passes them
    key = np.log(np.maximum(distance, 1e-6))[:, None] - math.log(multiplier) * np.arange(1, K)
    bins = np.floor(key / _BINS)
    gain = held[:, :-1] - held[:, 1:]
    values, where = np.unique(bins, return_inverse=True)
    total = coarsest + np.cumsum(np.bincount(where.ravel(), gain.ravel(), len(values)))
    over = np.flatnonzero(total > budget)
    cut = values[over[0]] if len(over) else np.inf
    return K - 1 - (bins < cut).sum(1)


class StreamedSog:
    """A method of `measure`: the knob is the splat budget."""

    targets: Sequence[float] = ()

    def __init__(self, name: str, meta: Path, budgets: Sequence[float], backend: Backend, antialiased: bool):
        self.name, self.settings = name, budgets
        self._backend: Backend = backend
        self._antialiased, self._space = antialiased, Workspace()
        document = json.loads(meta.read_bytes())
        files = [meta.parent / file for file in document["filenames"]]
        parts = [read_sog(file).gaussians for file in files]
        self._all = concat(parts)
        first = np.cumsum([0, *map(len, parts)])
        leaves = list(_leaves(document["tree"]))
        K = document["lodLevels"]
        self._bounds = np.array([[leaf["bound"]["min"], leaf["bound"]["max"]] for leaf in leaves])
        self._file, self._begin, self._counts = np.zeros((3, len(leaves), K), np.int64)
        for node, leaf in enumerate(leaves):
            for level, rows in leaf["lods"].items():
                place = node, int(level)
                self._file[place], self._counts[place] = rows["file"], rows["count"]
                self._begin[place] = first[rows["file"]] + rows["offset"]
        self._filled = filled(self._counts)
        self.piece_bytes = np.array([sog_bytes(file) for file in files])
        self.index_bytes = len(gzip.compress(meta.read_bytes()))
        self.nodes = len(leaves)

    def shown(self, frame: int, camera: Camera) -> Iterator[Shown]:
        """See `Method`."""
        distance = distances(self._bounds, camera)
        for budget in self.settings:
            level = self._filled[np.arange(self.nodes), chosen(distance, self._counts, budget)]
            at = np.flatnonzero(level >= 0), level[level >= 0]
            begin, count = self._begin[at], self._counts[at]
            g = self._all.slices(
                [slice(b, b + n) for b, n in zip(begin.tolist(), count.tolist(), strict=True)]
            )
            needed = np.zeros(len(self.piece_bytes), bool)
            needed[self._file[at]] = True
            image = render_rgb(
                g, camera, backend=self._backend, antialiased=self._antialiased, workspace=self._space
            )
            yield Shown(image, int(count.sum()), needed)


def sog_bytes(file: Path) -> int:
    """What one scene of a streamed SOG takes on the way: pictures, and its description compressed."""
    if file.name != "meta.json":
        return file.stat().st_size
    pictures = sum(path.stat().st_size for path in file.parent.glob("*.webp"))
    return pictures + len(gzip.compress(file.read_bytes()))


def _leaves(node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    if "lods" in node:
        yield node
    for child in node.get("children", ()):
        yield from _leaves(child)
