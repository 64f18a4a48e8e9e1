"""Seconds of training and the quality reached on test views, of one or more checkouts that take turns."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.whole import commit

_PROCESS = Path(__file__).with_name("quality_process.py")


def measure(
    scene: Path, downscale: int, sources: Sequence[Path], steps: Sequence[int], repeats: int
) -> dict[str, dict[str, float]]:
    """Medians over repeats, by checkout: seconds of training, Gaussians, PSNR [dB] and SSIM of test views.

    Args:
        scene: Capture.
        downscale: Of its photos.
        sources: Checkouts, each with the number of training steps at the same place in `steps`.
        steps: See `sources`.
        repeats: Times that each is trained, after a short training that fills its cache of kernels.
    """
    found: dict[str, list[dict[str, float]]] = {}
    for source in sources:
        _train(scene, downscale, source, 20)
    for _ in range(repeats):
        for source, count in zip(sources, steps, strict=True):
            name = f"{source.resolve()} {commit(source)}, {count} steps"
            found.setdefault(name, []).append(_train(scene, downscale, source, count))
            print(f"{name}: {found[name][-1]}", flush=True)
    return {
        name: {key: float(np.median([run[key] for run in runs])) for key in runs[0]}
        for name, runs in found.items()
    }


def _train(scene: Path, downscale: int, source: Path, steps: int) -> dict[str, float]:
    command = [sys.executable, str(_PROCESS), str(scene), str(downscale), str(steps)]
    env = os.environ | {"PYTHONPATH": str(source.resolve() / "src"), "OMP_WAIT_POLICY": "PASSIVE"}
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=env)
    return dict(json.loads(done.stdout.splitlines()[-1]))
