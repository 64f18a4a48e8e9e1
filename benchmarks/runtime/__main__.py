"""`python -m benchmarks runtime`: fidelity on a walk, ours beside PlayCanvas's and Spark's levels."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.common import finish
from benchmarks.runtime import playcanvas, spark, spark_tree
from benchmarks.runtime.levels import equal_levels, opened, planned
from benchmarks.runtime.measure import Method, lines, summary, walk
from benchmarks.runtime.walk import recorded
from sagesplat.formats.ply import put_ply
from sagesplat.run.job import Job

BUDGETS = (
    0.005,
    0.01,
    0.015,
    0.025,
    0.04,
    0.06,
    0.1,
    0.15,
    0.25,
    0.4,
    0.6,
    1.0,
)  # of the full model's splats
FOLDER = Path(tempfile.gettempdir()) / "sagesplat-runtime"
CELLS = 50  # that a level of PlayCanvas is cut into at least, in the row of small chunks


def measure(
    run: Path, folder: Path, tool: Path | None, package: Path | None, without: Path | None, decimate: str,
    seed: int, screen: float, every: int,
) -> dict[str, Any]:  # fmt: skip
    """One scene's tables."""
    job, folder = opened(run), folder / run.name
    folder.mkdir(parents=True, exist_ok=True)
    cameras = recorded(job, folder / "walk.json", seed, screen, every)
    references = job.references
    methods: list[Method] = [
        equal_levels(job, references, len(cameras)),
        planned("ours", job, references, cameras),
    ]
    if without:
        other = opened(without)
        methods.append(planned("ours without cells", other, other.references, cameras))
    methods += rivals(job, folder, tool, package, decimate)
    for method in methods:
        print(f"{method.name}: {len(method.piece_bytes)} files or ranges, {sum(method.piece_bytes):,} bytes")
    found = walk(methods, references, cameras)
    size = int(sum(methods[0].piece_bytes))
    print(f"{run.name}: {len(cameras)} frames at {cameras[0].width} x {cameras[0].height}")
    result = summary(found, job.ladder.size(job.ladder.levels[-1]), size)
    for line in lines(result):
        print(line)
    return result


def rivals(job: Job, folder: Path, tool: Path | None, package: Path | None, decimate: str) -> list[Method]:
    """Methods of others; what their tools made of the full model is kept in the folder."""
    full = job.came_in or job.ladder.load(job.ladder.levels[-1])
    model = folder / "full.ply"
    put_ply(model, full, antialiased=job.antialiased)
    budgets = [share * len(full) for share in BUDGETS]
    methods: list[Method] = []
    if tool is None or not tool.exists():
        print("no rows of PlayCanvas: --splat-transform names no file of splat-transform")
    else:
        extent = float(np.ptp(np.quantile(full.means.numpy(), [0.05, 0.95], axis=0), axis=0).max())
        small = ["--lod-chunk-count", f"{max(len(full) // CELLS // 1000, 1)}", "--lod-chunk-min", "1"]
        for name, options in (
            ("PlayCanvas", []),
            ("PlayCanvas, small chunks", [*small, "--lod-chunk-extent", f"{extent / 4:.4g}"]),
        ):
            place = folder / f"{name.replace(', ', '-').replace(' ', '-').lower()}-{decimate}"
            meta = playcanvas.made(place, model, tool, decimate, options)
            method = playcanvas.StreamedSog(name, meta, budgets, job.backend, job.antialiased)
            methods.append(method)
    if package is None or not package.exists():
        print("no rows of Spark: --spark names no folder of @sparkjsdev/spark")
    else:
        kept = folder / "spark.npz"
        if not kept.exists():
            np.savez(kept, **spark_tree.built(model, package))
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
    decimate: str = "decimate",
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
        decimate: splat-transform's way to make levels, decimate or decimate-adaptive.
        seed: of the walk.
        screen: pixels, times the side of the photos.
        every: of how many frames (two a second) one is measured.
        write: keep the figures in benchmarks/results/cpu/runtime.json.
    """
    others: Sequence[Path | None] = without_cells or [None] * len(runs)
    results = {
        run.name: measure(run, folder, splat_transform, spark, other, decimate, seed, screen, every)
        for run, other in zip(runs, others, strict=True)
    }
    finish("runtime", results, write)


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.runtime")
