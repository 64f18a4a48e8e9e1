"""`adopt` of a large splat: copies of given splats side by side, seconds by stage and the peak of memory."""

import resource
import subprocess
import sys
import time
from itertools import cycle
from pathlib import Path

import numpy as np
import torch
import tyro
from scipy.spatial.transform import Rotation

from benchmarks.adopt import SPLATS
from benchmarks.common import finish
from sagesplat.core.gaussians import Gaussians, concat
from sagesplat.core.transform import transformed
from sagesplat.formats.splats import read_splat, write_splat
from sagesplat.run.recorded import stage_seconds
from sagesplat.run.run_dir import RunDir

GIVEN = (SPLATS / "playbot", SPLATS / "guitar.compressed.ply", SPLATS / "biker.compressed.ply")
SIZES = (0.7, 1.4)  # of a copy; 1: 90 % of its Gaussians lie in a ball of radius 1


def main(
    folder: Path,
    count: int = 1_000_000,
    splats: tuple[Path, ...] = GIVEN,
    seed: int = 0,
    fit: str = "none",
    write: bool = False,
) -> None:
    """Make a cloud of `count` Gaussians in `folder`, `adopt` it, and say what that took."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"cloud-{count}-{seed}.ply"
    if not path.exists():
        write_splat(path, cloud([read_splat(splat).gaussians for splat in splats], count, seed))
    run = folder / f"run-{count}-{seed}-{fit}"
    command = [sys.executable, "-m", "sagesplat", "adopt", str(path), str(run), "--fit", fit, "--yes"]
    begin = time.perf_counter()
    subprocess.run(command, check=True)
    seconds = time.perf_counter() - begin
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = {"count": count, "fit": fit, "seconds": seconds, "cpu": used.ru_utime + used.ru_stime}
    finish(
        "cloud", found | {"peak_gb": used.ru_maxrss * 1024 / 1e9, "stages": stage_seconds(RunDir(run))}, write
    )


def cloud(splats: list[Gaussians], count: int, seed: int) -> Gaussians:
    """Copies on a square grid, each turned and scaled at random; the last is cut to reach the count."""
    rng, parts, left = np.random.default_rng(seed), [], count
    for g in cycle(_unit(g) for g in splats):
        taken = g if len(g) <= left else g.select(_some(rng, len(g), left))
        parts.append(transformed(taken, Rotation.random(None, rng).as_matrix(), float(rng.uniform(*SIZES))))
        left -= len(taken)
        if left == 0:
            break
    side = int(np.ceil(np.sqrt(len(parts))))
    for i, part in enumerate(parts):
        place = 2.5 * np.array([i % side, i // side, 0.0])
        parts[i] = transformed(part, np.eye(3), 1.0, place)
    return concat(parts)


def _unit(g: Gaussians) -> Gaussians:
    """Moved and scaled so that 90 % lie in a ball of radius 1."""
    xyz = g.means.numpy().astype(np.float64)
    centre = np.median(xyz, 0)
    radius = float(np.quantile(np.linalg.norm(xyz - centre, axis=1), 0.9))
    return transformed(g, np.eye(3), 1 / radius, -centre / radius)


def _some(rng: np.random.Generator, count: int, kept: int) -> torch.Tensor:
    return torch.from_numpy(np.sort(rng.permutation(count)[:kept]))


if __name__ == "__main__":
    tyro.cli(main)
