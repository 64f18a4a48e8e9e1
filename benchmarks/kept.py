"""Whether finished runs keep their promises of fidelity, by screen, place and lens, at many viewpoints.

Only the cheapest levels that keep a promise are measured, without the planner that knows of `promises`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.common import finish
from benchmarks.promises_fidelity import CONDITIONS, TARGETS, cameras_of, shares_kept
from sagesplat.adapt.calibrate_fidelity import plan_nominal
from sagesplat.adapt.cell_models import needed
from sagesplat.adapt.fidelity import shown_enough
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.stages.fidelity import compositions_at
from sagesplat.stages.methods import NestedLevels

PROMISED, WORST = 0.95, 0.9  # share of decisions that are to be kept, of all and of each category
COUNTED = 20  # viewpoints that show a category, from which on it counts


def by_condition(job: Job, views: int) -> dict[str, Any]:
    """Of each condition and target what `shares_kept` says, and the share that has a promise."""
    method, names, found = NestedLevels(job), job.names(), {}
    labels, models = list(method.costs.labels), method.fidelity
    calibrated = [label in models and models[label].calibration.status == "calibrated" for label in labels]
    for name, condition in CONDITIONS.items():
        cameras = cameras_of(job, condition, views)
        expected = method.expect(cameras)
        planned = plan_nominal(models, expected, method.cell_costs.transfer_bytes, np.array(TARGETS))
        got, pixels = compositions_at(job, cameras, planned, "promises")
        shown = shown_enough(pixels, cameras) & calibrated
        promised = np.isfinite(needed(models, expected, 0.9))
        for j, target in enumerate(TARGETS):
            counts = shown & promised
            kept = (got[:, j, :-1] >= target) & counts
            row = shares_kept(kept, counts, [names[label] for label in labels])
            found[f"{name}, {target:g}"] = row | {"promised": float(promised[shown].mean())}
    return found


def summary(rows: Mapping[str, Any]) -> dict[str, Any]:
    """How many rows, intervals and categories keep what they should."""
    of = [
        (kept / n, n, f"{category}, {name}: {kept} of {n}")
        for name, row in rows.items()
        for category, (kept, n) in row["by_category"].items()
        if n >= COUNTED
    ]
    return {
        "promised": min(row["promised"] for row in rows.values()),
        "kept": float(np.mean([row["kept"] for row in rows.values()])),
        "lowest": min((row["kept"], name) for name, row in rows.items()),
        "rows": [sum(row["kept"] >= PROMISED for row in rows.values()), len(rows)],
        "intervals": [sum(row["interval"][1] >= PROMISED for row in rows.values()), len(rows)],
        "categories below": [sum(share < WORST for share, _, _ in of), len(of)],
        "lowest categories": [text for share, _, text in sorted(of) if share < WORST],
    }


def main(runs: tyro.conf.Positional[tuple[Path, ...]], views: int = 200, write: bool = False) -> None:
    """Share of promises of fidelity that fresh viewpoints keep, by screen, place and lens.

    Args:
        runs: finished run folders.
        views: viewpoints for each of nine kinds.
        write: keep the figures in benchmarks/results/cpu/kept.json.
    """
    result = {}
    for run in runs:
        rows = by_condition(Job(RunDir(run, "nested"), lambda event: None), views)
        summed = summary(rows)
        result[run.name] = summed | {"by condition": rows}
        print(f"{run.name}:")
        for name, row in rows.items():
            low, high = row["interval"]
            print(f"  {name:36} kept {row['kept']:.3f} [{low:.3f}, {high:.3f}] of {row['decisions']}")
        for name, value in summed.items():
            print(f"  {name}: {value}")
    finish("kept", result, write)


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.kept")
