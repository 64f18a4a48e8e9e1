"""Seconds of a whole run by stage, of one or more checkouts of the package that take turns."""

import csv
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.common import ROOT, commit, finish
from sagesplat.adapt.observe import TOTAL


def main(
    scene: Path,
    out: Path | None = None,
    downscale: int = 1,
    steps: int = 3000,
    threads: int = 0,
    sources: tuple[Path, ...] = (ROOT,),
    repeats: int = 1,
    write: bool = False,
) -> None:
    """Seconds of `sagesplat run` by stage.

    Args:
        scene: capture.
        out: folder for the runs; what is done is not done again (default: one that is removed afterwards).
        downscale: of the photos.
        steps: of training.
        threads: 0: one per core.
        sources: checkouts of the package, which take turns (`git worktree add`).
        repeats: of each.
        write: keep the results.
    """
    options = ["--downscale", str(downscale), "--train.max-steps", str(steps), "--threads", str(threads)]
    with tempfile.TemporaryDirectory() as folder:
        found = measure(scene.resolve(), out or Path(folder), sources, repeats, options)
    print(*table(found), sep="\n")
    result = {"scene": scene.name, "downscale": downscale, "steps": steps, "threads": threads, "runs": found}
    finish(f"whole_{scene.name}", result, write)


def measure(
    scene: Path, out: Path, sources: Sequence[Path], repeats: int, options: Sequence[str]
) -> dict[str, Any]:
    """Medians over repeats, by checkout: seconds by stage, of the whole command, and what it made."""
    found: dict[str, list[dict[str, Any]]] = {}
    for repeat in range(repeats):
        for number, source in enumerate(sources):
            folder = out / f"{number}-{source.name}-{repeat}"
            name = f"{source.resolve()} {commit(source)}"
            if not (folder / "whole.json").exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir(parents=True)
                (folder / "whole.json").write_text(json.dumps(_run(scene, folder / "run", source, options)))
            found.setdefault(name, []).append(json.loads((folder / "whole.json").read_text()))
            print(f"{name}: {found[name][-1]}", flush=True)
    return {name: _medians(runs) for name, runs in found.items()}


def _run(scene: Path, run: Path, source: Path, options: Sequence[str]) -> dict[str, Any]:
    command = [sys.executable, "-m", "sagesplat", "run", str(scene), str(run), *options]
    begin = time.perf_counter()
    subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": str(source / "src")}, cwd=run.parent)
    whole = time.perf_counter() - begin
    records = (json.loads(path.read_text()) for path in sorted(run.glob("**/provenance/*.json")))
    stages = {made["stage"]: made["seconds"] for made in records}
    return {"whole": whole, "stages": stages, "between": whole - sum(stages.values()), **_made(run)}


def _made(run: Path) -> dict[str, float]:
    """How good the full model is on test views, and what the first plan sends of it."""
    (table,) = run.glob("*/evaluation.csv")
    with table.open() as lines:
        rows = [row for row in csv.DictReader(lines) if int(row["label_id"]) == TOTAL]
    means = {name: float(np.mean([float(row[name]) for row in rows])) for name in ("full_psnr", "full_ssim")}
    (increments,) = run.glob("*/increments")
    return means | {"bytes": sum(path.stat().st_size for path in increments.rglob("*") if path.is_file())}


def _medians(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    plain = {key: float(np.median([run[key] for run in runs])) for key in runs[0] if key != "stages"}
    stages = {name: float(np.median([run["stages"][name] for run in runs])) for name in runs[0]["stages"]}
    return plain | {"stages": stages}


def table(found: dict[str, dict[str, Any]]) -> list[str]:
    """Lines: a stage each, seconds of every checkout, and the ratio of the last to the first."""
    runs = list(found.values())
    lines = []
    for name in [*runs[0]["stages"], "between", "whole"]:
        seconds = [run["stages"].get(name, run.get(name, np.nan)) for run in runs]
        ratio = f"  {seconds[-1] / seconds[0]:5.2f}" if len(runs) > 1 and seconds[0] else ""
        lines.append(f"{name:10}" + "".join(f"{s:9.1f}" for s in seconds) + ratio)
    return lines


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.whole")
