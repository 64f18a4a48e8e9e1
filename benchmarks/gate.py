"""Fails where the kernels use much less of the machine than when results/cpu/gate.json was written.

It compares ratios to the machine's own multiply-add peak, measured in the same run, so any machine will do.
"""

import json

import torch
import tyro

from benchmarks.common import RESULTS, finish
from benchmarks.kernels import blending, camera, cloud, parts
from sagesplat.raster import set_threads

# the least share of the figures that were written
LEAST = {"share_of_peak_forward": 0.6, "share_of_peak_backward": 0.6, "steps_per_gflop": 0.6}


def main(write: bool = False) -> None:
    """Compare with benchmarks/results/cpu/gate.json, or `--write` it."""
    set_threads(0)
    view = camera(512, 512)
    rates = blending(cloud(20_000, "dense", view), view, 10)
    photo = torch.rand(view.height, view.width, 3)
    step = parts(cloud(50_000, "sparse", view), view, photo, 3, 10)["step_ms"]
    result = {name: rates[name] for name in list(LEAST)[:2]}
    result["steps_per_gflop"] = 1e3 / step / rates["peak_gflops"]
    if not write:
        known = json.loads((RESULTS / "cpu" / "gate.json").read_text())
        for name, least in LEAST.items():
            ratio = result[name] / known[name]
            print(f"{name:28} {result[name]:.4g}, {ratio:.2f} of {known[name]:.4g} (at least {least})")
            if ratio < least:
                raise SystemExit(f"{name} fell to {ratio:.2f} of what it was; see docs/performance.md")
    finish("gate", result, write)


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.gate")
