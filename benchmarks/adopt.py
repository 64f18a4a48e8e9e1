"""Levels of adopted splats beside those of splat-transform, at equal counts.

playbot comes with levels that its author published; garden and the built-in scene are trained here, written
as PLY with labels, and decimated by splat-transform. Every image is compared with the splat that came in.
"""

import resource
import shutil
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.common import GARDEN, finish
from benchmarks.promises import CASES
from sagesplat.adapt.free_viewpoints import free_cameras
from sagesplat.adapt.observe import render_rgb
from sagesplat.core.config import AdoptConfig, LabelsConfig, MasksConfig, SceneConfig
from sagesplat.core.errors import BackendUnavailable
from sagesplat.core.events import Event, StageDone
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.ply import write_ply
from sagesplat.formats.splats import num_lods, read_splat
from sagesplat.metrics.image import ssim_map
from sagesplat.raster import Workspace
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.scene import Camera
from sagesplat.stages.adopt import open_splat
from sagesplat.stages.adopt_levels import make_levels
from sagesplat.stages.api import run_scene

PACKAGE = "@playcanvas/splat-transform@3.7"
SPLATS = GARDEN.parent.parent / "splats"
SHARES = (0.05, 0.1, 0.2, 0.35, 0.5, 0.7)
BELOW = (0.0125, 0.025)  # so that small levels share a set with those as in a usual ladder
FRESH = 1  # seed of viewpoints that nothing was made from
Say = Callable[[str], None]
Quality = dict[str, float]


@dataclass(frozen=True)
class Case:
    """A splat to adopt, the levels of others to compare with, and where from."""

    source: Path
    rivals: Mapping[float, Sequence[Gaussians]]  # by share of the Gaussians; the best by SSIM counts
    cameras: Path | None  # a capture; None: viewpoints are drawn
    scene: SceneConfig = SceneConfig()


def main(
    folder: Path = Path("runs/adopt"),
    scenes: tuple[str, ...] = ("playbot", "garden", "built-in-11"),
    splat_transform: Path | None = None,
    views: int = 40,
    steps: int = 3000,
    write: bool = False,
) -> None:
    """Levels of adopted splats beside those of splat-transform, at equal counts.

    Args:
        folder: where runs are made; what is done already is skipped.
        scenes: a streamed SOG in the folder of splats, and scenes of `promises`.
        splat_transform: its command (default: by npx).
        views: viewpoints to draw for a splat without a capture.
        steps: of the training of the lower levels.
        write: keep the figures in benchmarks/results/cpu/adopt.json.
    """
    results = {}
    for name in scenes:
        streamed = SPLATS / name / "lod-meta.json"
        if streamed.exists():
            case = published(streamed)
        else:
            case = trained(name, folder, find_transform(splat_transform))
        results[name] = measure(case, folder / "adopted" / name, views, steps, print)
    finish("adopt", results, write)


@dataclass(frozen=True)
class Transform:
    """splat-transform as a command."""

    command: tuple[str, ...]

    def __call__(self, *arguments: str | Path) -> None:
        """Run it; BackendUnavailable with what it said if it fails."""
        call = [*self.command, "-q", "-w", "-g", "cpu", *map(str, arguments)]
        done = subprocess.run(call, capture_output=True, text=True, check=False)
        if done.returncode:
            said = (done.stderr or done.stdout).strip().splitlines()[-1:]
            raise BackendUnavailable(f"{' '.join(call)} failed: {' '.join(said)}")


def find_transform(path: Path | None) -> Transform:
    """splat-transform 3, at a path or by npx; BackendUnavailable where there is none."""
    if path is None and shutil.which("npx") is None:
        raise BackendUnavailable(
            "no splat-transform: install Node 22 or newer, or name one (--splat-transform)"
        )
    command = (str(path),) if path else ("npx", "--yes", PACKAGE)
    try:
        said = subprocess.run([*command, "--version"], capture_output=True, text=True, check=False)
    except OSError as error:
        raise BackendUnavailable(f"{path}: cannot be run ({error.strerror}); name splat-transform") from None
    text = said.stdout + said.stderr
    if "v3." not in text:
        raise BackendUnavailable(
            f"{command[0]}: {text.strip()[:100]!r} is not splat-transform 3; it needs Node 22"
        )
    return Transform(command)


def published(source: Path) -> Case:
    """A streamed SOG with the levels that came with it."""
    full = len(read_splat(source).gaussians)
    levels = [read_splat(source, lod).gaussians for lod in range(1, num_lods(source))]
    return Case(source, {len(g) / full: [g] for g in levels}, None)


def trained(name: str, folder: Path, transform: Transform) -> Case:
    """A scene trained here as a PLY, decimated by splat-transform; `name` is one of `promises.CASES`."""
    case = CASES[name]
    capture = case.capture(folder / "captures" / name)
    job = run_scene(capture, folder / name, case.config, force=True).job
    g = job.load_last_level()
    source = folder / f"{name}.ply"
    write_ply(source, g, job.names(), antialiased=job.antialiased)
    rivals = {}
    for share in SHARES:
        rivals[share] = []
        for way in ("--decimate", "--decimate-adaptive"):
            out = folder / f"{name}-{share}{way}.ply"
            if not out.exists():
                transform(source, way, str(round(share * len(g))), out)
            rivals[share].append(read_splat(out).gaussians)
    return Case(source, rivals, capture, case.config.scene)


def measure(case: Case, folder: Path, views: int, steps: int, say: Say) -> dict[str, Any]:
    """SSIM and PSNR of the rivals' levels and of ours, trained and not, at the same counts."""
    reference = read_splat(case.source)
    g, antialiased = reference.gaussians, reference.antialiased
    shares = tuple(sorted(case.rivals))
    result: dict[str, Any] = {"count": len(g)}
    scored: dict[str, dict[float, Quality]] = {}
    cameras: Sequence[Camera] = ()
    for fit in ("none", "renders"):
        config = AdoptConfig(
            fit=fit, steps=steps, shares=(*_below(shares), *shares, 0.7, 1.0), cameras=case.cameras
        )
        job, seconds = _adopted(case, folder / f"{case.source.stem}-{fit}", config, say)
        if not cameras:
            cameras = _test_cameras(job, g, case, views)
            scored["rival"] = {s: _best(case.rivals[s], g, cameras, antialiased) for s in shares}
        ladder = job.ladder
        by_count = {ladder.size(level): level for level in ladder.levels}
        ours = {s: min(by_count, key=lambda n, s=s: abs(n - s * len(g))) for s in shares}
        scored[fit] = {
            s: score(ladder.load(by_count[n]), g, cameras, antialiased) | {"count": n}
            for s, n in ours.items()
        }
        full = score(ladder.load(ladder.levels[-1]), g, cameras, antialiased)
        result[fit] = {"seconds": seconds, "full_psnr": full["psnr"]}
        for share in shares:
            say(f"{case.source.stem} {fit:8}" + _line(share, scored, fit))
    result["levels"] = {
        str(int(scored["rival"][s]["count"])): {who: scored[who][s] for who in scored} for s in shares
    }
    for fit in ("none", "renders"):
        for metric in ("psnr", "ssim"):
            ahead = [scored[fit][s][metric] - scored["rival"][s][metric] for s in shares]
            result[fit][f"{metric}_ahead"] = {"mean": float(np.mean(ahead)), "least": float(min(ahead))}
    result["peak_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    return result


def _below(shares: Sequence[float]) -> tuple[float, ...]:
    return BELOW if min(shares) > max(BELOW) else ()


def _adopted(case: Case, folder: Path, config: AdoptConfig, say: Say) -> tuple[Job, dict[str, float]]:
    seconds: dict[str, float] = {}

    def emit(event: Event) -> None:
        if isinstance(event, StageDone):
            seconds[event.name] = round(event.seconds, 1)
            say(f"  {event.name}: {event.seconds:.1f} s, {'; '.join(event.lines)}")

    job = Job(RunDir(folder), emit, "cpu", 2, force=True)
    begin = time.perf_counter()
    open_splat(job, case.source, config, case.scene, MasksConfig(), LabelsConfig())
    make_levels(job, config)
    return job, seconds | {"all": round(time.perf_counter() - begin, 1)}


def _test_cameras(job: Job, g: Gaussians, case: Case, views: int) -> Sequence[Camera]:
    if case.cameras is None:
        return free_cameras(g, views, seed=FRESH).cameras
    return [job.scene.views[row].camera for row in job.scene.test_ids]


def score(g: Gaussians, full: Gaussians, cameras: Sequence[Camera], antialiased: bool) -> Quality:
    """Mean SSIM and PSNR (dB) of a level against the full model."""
    psnr, ssim, work = [], [], (Workspace(), Workspace())
    for camera in cameras:
        one, other = (
            render_rgb(some, camera, backend="cpu", antialiased=antialiased, workspace=space)
            for some, space in zip((g, full), work, strict=True)
        )
        error = max(float(np.square(one - other).mean()), 1e-10)
        psnr.append(-10 * np.log10(error))
        ssim.append(float(ssim_map(one, other).mean()))
    return {"psnr": float(np.mean(psnr)), "ssim": float(np.mean(ssim))}


def _best(
    rivals: Sequence[Gaussians], full: Gaussians, cameras: Sequence[Camera], antialiased: bool
) -> Quality:
    """The score of the best of some levels by SSIM, and its count."""
    return max(
        (score(rival, full, cameras, antialiased) | {"count": len(rival)} for rival in rivals),
        key=lambda quality: quality["ssim"],
    )


def _line(share: float, scored: Mapping[str, Mapping[float, Quality]], fit: str) -> str:
    rival, ours = scored["rival"][share], scored[fit][share]
    return (
        f" {int(rival['count']):8,} Gaussians: {rival['psnr']:.2f} dB {rival['ssim']:.4f}, ours "
        f"{int(ours['count']):,} {ours['psnr']:.2f} dB {ours['ssim']:.4f}: "
        f"{ours['psnr'] - rival['psnr']:+.2f} dB {ours['ssim'] - rival['ssim']:+.4f}"
    )


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.adopt")
