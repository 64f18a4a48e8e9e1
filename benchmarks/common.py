"""What the benchmarks share: where captures and results are, timing, what the machine can do."""

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from datetime import date
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba import njit, prange

from sagesplat.kernels.simd import fma, splat16, total

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
GARDEN = ROOT.parent / "shared" / "scenes" / "garden"


def finish(name: str, result: Mapping[str, Any], write: bool, folder: str = "cpu") -> None:
    """Print a result as one line of JSON; with `write` keep it and its origin in results/FOLDER/NAME.json."""
    line = json.dumps(rounded(result))
    if write:
        path = RESULTS / folder / f"{name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(origin() | rounded(result)) + "\n")
    print(line)


def rounded(value: Any) -> Any:
    """Floats of four digits, for files; keys as text."""
    if isinstance(value, Mapping):
        return {str(key): rounded(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(each) for each in value]
    return float(f"{value:.4g}") if isinstance(value, float | np.floating) else value


def origin() -> dict[str, str]:
    """What figures are of: command, commit and date."""
    program = Path(sys.argv[0])
    name = program.parent.name if program.stem == "__main__" else program.stem
    command = " ".join([f"python -m benchmarks.{name}", *sys.argv[1:]])
    return {"command": command, "commit": commit(ROOT), "date": date.today().isoformat()}


def commit(source: Path) -> str:
    """The commit of a checkout; empty where there is none."""
    git = ["git", "-C", str(source), "rev-parse", "--short", "HEAD"]
    return subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()


def milliseconds(call: Callable[[], Any], repeats: int, *, best: bool = False) -> float:
    """Median (or best) time of a call, after up to three to warm up."""
    times, warm = [], min(3, repeats)
    for _ in range(warm + repeats):
        begin = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - begin))
    return float(np.min(times[warm:]) if best else np.median(times[warm:]))


@njit(parallel=True, cache=True)
def _multiply_add(count, out):
    for job in prange(len(out)):
        x, y = splat16(np.float32(0.999999)), splat16(np.float32(1e-7))
        a = b = c = d = e = f = g = h = i = j = splat16(np.float32(1))
        for _ in range(count):
            a, b, c, d, e = fma(a, x, y), fma(b, x, y), fma(c, x, y), fma(d, x, y), fma(e, x, y)
            f, g, h, i, j = fma(f, x, y), fma(g, x, y), fma(h, x, y), fma(i, x, y), fma(j, x, y)
        out[job] = total(a + b + c + d + e + f + g + h + i + j)


def peak_gflops() -> float:
    """What the machine's threads can multiply and add, right now: the calibration of everything else."""
    out, count = np.zeros(numba.get_num_threads(), np.float32), 2_000_000
    best = milliseconds(lambda: _multiply_add(count, out), 3, best=True)
    return count * len(out) * 10 * 16 * 2 / best / 1e6


def peak_mib() -> float:
    """Most memory that this process ever had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
