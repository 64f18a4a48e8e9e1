"""`python -m benchmarks runtime`: fidelity on a walk, ours beside PlayCanvas's and Spark's levels."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import tyro

from benchmarks.common import finish
from benchmarks.runtime import playcanvas, spark, spark_tree
from benchmarks.runtime.levels import equal_levels, opened, planned
from benchmarks.runtime.measure import Method, lines, summary, walk
from benchmarks.runtime.walk import recorded
from sagesplat.formats.ply import put_ply
from sagesplat.run.job import Job

# of the full model's splats
BUDGETS = (0.005, 0.01, 0.015, 0.025, 0.04, 0.06, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
TARGETS = (0.8, 0.85, 0.9, 0.93, 0.95, 0.97)
FOLDER = Path(tempfile.gettempdir()) / "sagesplat-runtime"


class Tools(NamedTuple):
    """What makes the others' levels; None: their rows are left out."""

    splat_transform: Path | None
    spark: Path | None
    chunks: tuple[int, ...]  # of PlayCanvas: see `playcanvas.made`
    harmonics: int


def measure(
    run: Path, without: Path | None, folder: Path, tools: Tools, seed: int, screen: float, every: int
) -> dict[str, Any]:
    """One scene's tables."""
    job, folder = opened(run), folder / run.name
    folder.mkdir(parents=True, exist_ok=True)
    cameras, references = recorded(job, folder / "walk.json", seed, screen, every), job.references
    methods: list[Method] = [
        equal_levels(job, references, len(cameras)),
        planned("ours", job, references, cameras, BUDGETS, TARGETS),
    ]
    methods += rivals(job, folder, tools)
    print(f"{run.name}: {len(cameras)} frames at {cameras[0].width} x {cameras[0].height}")
    for method in methods:
        print(f"  {method.name}: {len(method.piece_bytes)} pieces, {sum(method.piece_bytes) / 1e6:.2f} MB")
    found = walk(methods, job, cameras)
    if without:
        other = opened(without)
        one_each = planned("ours without cells", other, other.references, cameras, BUDGETS, TARGETS)
        found.insert(2, *walk([one_each], other, cameras))
    result = summary(found, job.ladder.size(job.ladder.levels[-1]), int(found[0].nbytes[0, -1]))
    print("\n".join(lines(result)))
    return result


def rivals(job: Job, folder: Path, tools: Tools) -> list[Method]:
    """Methods of others; what their tools made of the full model is kept in the folder."""
    full = job.came_in or job.ladder.load(job.ladder.levels[-1])
    model, methods = folder / "full.ply", list[Method]()
    put_ply(model, full, antialiased=job.antialiased)
    budgets = [share * len(full) for share in BUDGETS]
    if tools.splat_transform is None or not tools.splat_transform.exists():
        print("no rows of PlayCanvas: --splat-transform names no file of splat-transform")
    else:
        extent = float(np.ptp(np.quantile(full.means.numpy(), [0.05, 0.95], axis=0), axis=0).max())
        for chunk in tools.chunks:
            meta = playcanvas.made(model, tools.splat_transform, chunk, extent, tools.harmonics)
            name = f"PlayCanvas, chunks of {chunk}K" if chunk else "PlayCanvas"
            methods.append(playcanvas.StreamedSog(name, meta, budgets, job.backend, job.antialiased))
    if tools.spark is None or not tools.spark.exists():
        print("no rows of Spark: --spark names no folder of @sparkjsdev/spark")
    else:
        kept = folder / "spark.npz"
        if not kept.exists():
            np.savez(kept, allow_pickle=False, **spark_tree.built(model, tools.spark))
        with np.load(kept) as arrays:
            tree = spark.decoded(dict(arrays), full)
        for name, foveation in (("Spark", spark.NO_FOVEATION), ("Spark, foveation", spark.FOVEATION)):
            methods.append(spark.SparkTree(name, tree, budgets, foveation, job.backend, job.antialiased))
    return methods


def main(
    runs: tyro.conf.Positional[tuple[Path, ...]],
    folder: Path = FOLDER,
    splat_transform: Path | None = None,
    spark: Path | None = None,
    without_cells: tuple[Path, ...] = (),
    chunks: tuple[int, ...] = (0, 3),
    harmonics: Literal[0, 1, 2, 3] = 3,
    seed: int = 5,
    screen: float = 1.0,
    every: int = 2,
    write: bool = False,
) -> None:
    """A walk of 60 s through finished runs: fidelity at equal splats and equal bytes, beside what others do.

    Args:
        runs: run folders, finished with nested levels.
        folder: for the walk, the full model and what the others' tools make of it; kept.
        splat_transform: PlayCanvas's command line, 3.7 (bin/cli.mjs); without it, no rows of PlayCanvas.
        spark: folder of @sparkjsdev/spark 2.2, with three beside it; without it, no rows of Spark.
        without_cells: the same scenes run with --nest.cells 0, in the order of `runs`.
        chunks: thousands of splats in a file of PlayCanvas, a row each; 0: as its tool has it, 512.
        harmonics: degree that PlayCanvas's files keep; with any, large chunks take hours without a GPU.
        seed: of the walk.
        screen: pixels, times the side of the photos.
        every: of how many frames (two a second) one is measured.
        write: keep the figures in benchmarks/results/cpu/runtime.json.
    """
    tools = Tools(splat_transform, spark, chunks, harmonics)
    others: Sequence[Path | None] = without_cells or [None] * len(runs)
    results = {
        run.name: measure(run, other, folder, tools, seed, screen, every)
        for run, other in zip(runs, others, strict=True)
    }
    finish("runtime", results, write)


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.runtime")
