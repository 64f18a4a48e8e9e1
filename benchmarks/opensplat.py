"""A build of OpenSplat and sagesplat in turns on one capture: step time, time to a PSNR, and the ratio.

Both train on the same undistorted photos of the training views, written as a COLMAP workspace, for as many
steps, each with its own defaults. What both save on the way is rendered here, from the views that were held
out, and compared with their photos. Nothing of OpenSplat is part of this repository; docs/performance.md says
how to build it.
"""

import os
import re
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image

from benchmarks.common import finish
from sagesplat.adapt.observe import as_unit, render_rgb
from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import BackendUnavailable
from sagesplat.core.gaussians import Gaussians
from sagesplat.demo.capture import cached_capture
from sagesplat.formats.levels import read_level
from sagesplat.formats.splats import read_splat
from sagesplat.raster import resolve_backend, set_threads
from sagesplat.scene import load_scene
from sagesplat.scene.colmap_write import ModelCamera, ModelImage, write_model
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.train.events import LevelSaved, Step, Trained
from sagesplat.train.trainer import train

NAMES = ("opensplat", "sagesplat")
_STEP = re.compile(r"Step (\d+): ")
_WARM = 3  # steps before the clock runs, that compile kernels


@dataclass(frozen=True)
class Course:
    """What a training did: when each step was done, and what it held then."""

    seconds: Mapping[int, float]  # since the first step, by step; without the time that saving took
    step_seconds: float  # median
    psnr: Mapping[int, float]  # dB at the held-out views, by step
    count: int  # Gaussians at the end

    def seconds_to(self, psnr: float) -> float | None:
        """When it first measured a PSNR, between two measurements in a straight line; None: never."""
        before: tuple[float, float] | None = None
        for step, found in sorted(self.psnr.items()):
            now = self.seconds[step]
            if found >= psnr:
                share = (psnr - before[1]) / (found - before[1]) if before else 1.0
                return now if before is None else before[0] + share * (now - before[0])
            before = now, found
        return None


def main(
    binary: Path,
    capture: Path | None = None,
    steps: int = 2000,
    saves: int = 8,
    psnr: float | None = None,
    rounds: int = 1,
    downscale: int = 1,
    threads: int = 0,
    gpu: bool = False,
    options: tuple[str, ...] = (),
    write: bool = False,
) -> None:
    """OpenSplat and sagesplat in turns on one capture: step time, time to a PSNR, and the ratio of this run.

    Args:
        binary: the program `opensplat` of a build.
        capture: any capture with poses (default: the built-in scene).
        steps: of each training.
        saves: how often each is measured on its way, evenly spaced.
        psnr: dB to reach at held-out views (default: what both reach, rounded down to half a dB).
        rounds: how often both train; figures are medians.
        downscale: factor of the photos.
        threads: of the CPU for each (0: all cores).
        gpu: compute on the GPU, both.
        options: further options of OpenSplat, each as one word with its value behind a =, such as
            --sh-degree=2.
        write: keep the figures in benchmarks/results/cpu/opensplat.json.
    """
    threads = set_threads(threads)
    given = load_scene(capture or cached_capture(lambda done, total: None), downscale=downscale)
    every = max(1, steps // saves)
    program = Program(binary, threads, gpu, options)
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        scene = training_workspace(given, work / "capture")
        ours(scene, _WARM, _WARM, given, gpu, work / "warm")
        found: dict[str, list[Course]] = {name: [] for name in NAMES}
        for number in range(rounds):
            for name in NAMES if number % 2 == 0 else reversed(NAMES):
                folder = work / f"{name}-{number}"
                if name == "opensplat":
                    course = program.course(scene.path, steps, every, given, gpu, folder)
                else:
                    course = ours(scene, steps, every, given, gpu, folder)
                best = max(course.psnr.values())
                print(f"{name}: {1e3 * course.step_seconds:.1f} ms a step, at most {best:.2f} dB", flush=True)
                found[name].append(course)
    result = compared(found, psnr)
    about = {"version": program.version(), "capture": given.name, "views": len(scene.views), "steps": steps}
    size = [given.views[0].camera.width, given.views[0].camera.height]
    finish("opensplat", about | {"size": size, "threads": threads, "gpu": gpu} | result, write)


def training_workspace(scene: Scene, folder: Path) -> Scene:
    """A COLMAP workspace of the training views alone: undistorted photos as PNG, pinhole cameras, points."""
    rows, photos = scene.train_ids.tolist(), Photos(scene.views)
    cameras, images = [], []
    (folder / "images").mkdir(parents=True)
    (folder / "sparse" / "0").mkdir(parents=True)
    nothing = np.zeros((0, 2)), np.zeros(0, np.int64)
    for number, row in enumerate(rows, 1):
        camera, name = scene.views[row].camera, f"{number:05d}.png"
        Image.fromarray(photos[row]).save(folder / "images" / name)
        lens = tuple(map(float, (camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2])))
        cameras.append(ModelCamera(number, "PINHOLE", camera.width, camera.height, lens))
        images.append(ModelImage(number, name, number, camera.w2c, *nothing))
    points = scene.points
    write_model(folder / "sparse" / "0", cameras, images, points.xyz, points.rgb, np.zeros(len(points.xyz)))
    return load_scene(folder, test_every=0)


def compared(found: Mapping[str, Sequence[Course]], psnr: float | None) -> dict[str, Any]:
    """The figures of both, and what OpenSplat's are over ours; null where a PSNR was not reached."""
    best = [max(course.psnr.values()) for courses in found.values() for course in courses]
    psnr = float(np.floor(2 * min(best)) / 2) if psnr is None else psnr
    rows: dict[str, Any] = {}
    for name, courses in found.items():
        times = [course.seconds_to(psnr) for course in courses]
        reached = [seconds for seconds in times if seconds is not None]
        rows[name] = {
            "step_ms": 1e3 * float(np.median([course.step_seconds for course in courses])),
            "seconds_to_psnr": float(np.median(reached)) if len(reached) == len(times) else None,
            "psnr": [list(course.psnr.values()) for course in courses],
            "seconds": [[course.seconds[step] for step in course.psnr] for course in courses],
            "gaussians": [course.count for course in courses],
        }
    theirs, own = (rows[name] for name in NAMES)
    times = theirs["seconds_to_psnr"], own["seconds_to_psnr"]
    ratio = {
        "step": theirs["step_ms"] / own["step_ms"],
        "seconds_to_psnr": None if None in times else times[0] / times[1],
    }
    return {"psnr": psnr, **rows, "ratio": ratio}


@dataclass(frozen=True)
class Program:
    """A build of OpenSplat, as a command."""

    path: Path
    threads: int
    gpu: bool
    options: tuple[str, ...]

    def version(self) -> str:
        """What it says of itself; empty for builds that have no --version."""
        done = subprocess.run([self.path, "--version"], capture_output=True, text=True, check=False)
        return done.stdout.strip() if done.returncode == 0 and len(done.stdout) < 200 else ""

    def course(
        self, workspace: Path, steps: int, every: int, held_out: Scene, gpu: bool, folder: Path
    ) -> Course:
        """Train; a step is done when the program prints it. BackendUnavailable where it fails."""
        folder.mkdir()
        out = folder / "splat.ply"
        command = [str(self.path), str(workspace), "-n", str(steps), "-o", str(out), "-s", str(every)]
        command += ["--keep-crs", *(() if gpu else ("--cpu",)), *self.options]
        threads = {name: str(self.threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
        stamps: dict[int, float] = {}
        said: list[str] = []
        try:
            process = subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=folder,
                env={**os.environ, **threads},
            )  # fmt: skip
        except OSError as error:
            raise BackendUnavailable(f"{self.path}: {error.strerror}; give a build of OpenSplat") from None
        with process:
            assert process.stdout
            for line in process.stdout:
                if step := _STEP.match(line):
                    stamps[int(step[1])] = time.perf_counter()
                elif line.strip():
                    said.append(line.strip())
        if process.returncode or not out.exists() or len(stamps) < 2:
            last = said[-1][:200] if said else "nothing"
            raise BackendUnavailable(
                f"{self.path}: ended with {process.returncode} after {len(stamps)} steps, and said {last!r}; "
                "try the printed command: " + " ".join(command)
            )
        saved = {step: path for step in stamps if (path := out.with_name(f"splat_{step}.ply")).exists()}
        sets = {step: read_splat(path).gaussians for step, path in (saved | {max(stamps): out}).items()}
        return course_of(stamps, sets, held_out, gpu, antialiased=False)


def ours(scene: Scene, steps: int, every: int, held_out: Scene, gpu: bool, folder: Path) -> Course:
    """Train here, with sagesplat's own defaults."""
    config = TrainConfig(max_steps=steps, level_every=every, exposure="off")
    photos, labels = Photos(scene.views), np.full(len(scene.points.xyz), -1, np.int16)
    stamps: dict[int, float] = {}
    sets: dict[int, Gaussians] = {}
    levels: dict[int, Path] = {}
    backend = resolve_backend("auto", "cuda" if gpu else "cpu")
    for event in train(scene, photos, labels, config, backend=backend, folder=folder):
        match event:
            case Step(step):
                stamps[step] = time.perf_counter()
            case LevelSaved(step, path) if path is not None:
                levels[step] = path
            case Trained(gaussians):
                sets[max(stamps)] = gaussians
    sets |= {step: read_level(path) for step, path in levels.items() if step not in sets}
    return course_of(stamps, sets, held_out, gpu, antialiased=config.antialiased)


def course_of(
    stamps: Mapping[int, float],
    sets: Mapping[int, Gaussians],
    held_out: Scene,
    gpu: bool,
    *,
    antialiased: bool,
) -> Course:
    """The course of a training from when its steps were done, and what it saved.

    The time from a saved step to the next is taken to be the median: saving is not training.
    """
    steps = sorted(stamps)
    gaps = {step: (stamps[step] - stamps[before]) / (step - before) for before, step in pairwise(steps)}
    median = float(np.median(list(gaps.values())))
    seconds = {steps[0]: steps[0] * median}  # the first one loads and compiles
    for before, step in pairwise(steps):
        seconds[step] = seconds[before] + (step - before) * (median if before in sets else gaps[step])
    backend = resolve_backend("auto", "cuda" if gpu else "cpu")
    views = [held_out.views[row] for row in held_out.test_ids]
    photos = Photos(views)

    def psnr(g: Gaussians) -> float:
        found = []
        for row, view in enumerate(views):
            image = render_rgb(g, view.camera.neutral, backend=backend, antialiased=antialiased)
            found.append(-10 * np.log10(max(float(np.square(image - as_unit(photos[row])).mean()), 1e-10)))
        return float(np.mean(found))

    measured = {step: psnr(sets[step]) for step in sorted(sets) if step in seconds}
    return Course(seconds, median, measured, len(sets[max(sets)]))


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.opensplat")
