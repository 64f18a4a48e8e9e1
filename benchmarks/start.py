"""How long people wait before something happens: help, torch's import, the first training step of a run."""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

_FIRST_STEP = Path(__file__).with_name("start_process.py")


def measure(scene: Path, words: list[str], repeats: int) -> dict[str, float | dict[str, float]]:
    """Seconds from the start of a process, the best of several: kernels and files are cached then.

    Args:
        scene: Capture that runs begin with.
        words: Further options of `sagesplat run`, such as --downscale 2.
        repeats: Times that each is measured.
    """
    python = [sys.executable, "-m", "sagesplat"]
    firsts = [_first_step(scene, words) for _ in range(repeats + 1)][1:]  # not the one that fills caches
    best = min(firsts, key=lambda parts: parts["first step"])
    return {
        "help_s": _best(repeats, [*python, "--help"]),
        "run_help_s": _best(repeats, [*python, "run", "--help"]),
        "import_torch_s": _best(repeats, [sys.executable, "-c", "import torch"]),
        "first_step_s": best["first step"],
        "until_s": best,
    }


def _best(repeats: int, command: list[str]) -> float:
    run = partial(subprocess.run, command, check=True, capture_output=True)
    return min(_seconds(run) for _ in range(repeats))


def _seconds(call: Callable[[], object]) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def _first_step(scene: Path, words: list[str]) -> dict[str, float]:
    """Seconds from the start of `sagesplat run` until each of its stages begins, and to its first step."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(_FIRST_STEP), str(time.time())]
        command += ["run", str(scene), f"{folder}/run", *words]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))
