"""What cells change in Chromium: milliseconds a frame, splats drawn, and what a turn of the head shows.

Frames are drawn by the CPU here, whose time grows with the splats and the pixels. Of the same scene with and
without cells the page shows the plan for the same fidelity, from the same views. For the turn the page has
come to rest at a view, then turns by a right angle over a slow network. Half a second and two frames later
the levels that it draws are rendered here, beside those that it draws in the end.
"""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from benchmarks.common import finish
from benchmarks.visitor import SAMPLE, camera_of, levels_of, picture, pose_of
from sagesplat.adapt.viewpoints import capture_cameras
from sagesplat.metrics.image import ssim_map
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.scene import Camera
from sagesplat.stages.view import show
from tests.browser import Opened, launch, open_page

LATENCY = 100.0  # ms
_ROUNDS = 3  # of which medians are taken, with and without cells in turns
_FRAMES, _STEP = 30, 1e-3  # of a camera that moves, and what it moves by in each, in scene extents
_SOON = 500  # ms after a turn
_RESTING = """(() => {
  const state = window.sagesplat?.state?.()
  return Boolean(state && state.count && !state.pending && state.status !== "loading")
})()"""
# milliseconds a frame while the camera moves, till all that was asked for is drawn
_MOVE = """async ([pose, step, frames]) => {
  const view = window.sagesplat, gl = document.querySelector("canvas").getContext("webgl2")
  const drawn = () => gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4))
  const [x, y, z] = pose.position
  drawn()
  const start = performance.now()
  for (let i = 1; i <= frames; i++) {
    view.setPose({ ...pose, position: [x + step * Math.min(i, frames - i), y, z] })
    await new Promise(requestAnimationFrame)
  }
  drawn()
  return (performance.now() - start) / frames
}"""


def frame_times(job: Job, opened: Opened, camera: Camera) -> tuple[float, int]:
    """Milliseconds a frame while the camera moves about a view, and the splats of the cells in sight."""
    opened.page.evaluate("(pose) => window.sagesplat.setPose(pose)", pose_of(camera))
    opened.page.wait_for_timeout(_SOON)
    opened.wait_for(_RESTING)
    ms = opened.page.evaluate(_MOVE, [pose_of(camera), _STEP * job.scene.extent, _FRAMES])
    cells = [cell for one in opened.page.evaluate(SAMPLE, pose_of(camera))["labels"] for cell in one["cells"]]
    counts = job.by_cell.counts
    return ms, sum(counts[cell, level] for cell, level, seen in cells if seen and level)


def turned(job: Job, opened: Opened, camera: Camera) -> dict[str, float]:
    """Fidelity half a second and two frames (`SAMPLE`) after a turn to the right from a view, and at rest."""
    right = np.eye(4, dtype=np.float32)
    right[:3, :3] = Rotation.from_euler("y", -90, degrees=True).as_matrix()
    after = replace(camera, w2c=right @ camera.w2c)
    opened.page.evaluate("(pose) => window.sagesplat.setPose(pose)", pose_of(camera))
    opened.page.wait_for_timeout(_SOON)
    opened.wait_for(_RESTING)
    opened.page.evaluate("(pose) => window.sagesplat.setPose(pose)", pose_of(after))
    opened.page.wait_for_timeout(_SOON)
    soon = opened.page.evaluate(SAMPLE, pose_of(after))
    opened.page.wait_for_timeout(4 * _SOON)
    opened.wait_for(_RESTING)
    rest = opened.page.evaluate(SAMPLE, pose_of(after))
    at = camera_of(rest, camera)
    whole = picture(job, at, dict.fromkeys(job.by_cell.sizes, job.ladder.levels[-1]), at)
    values = (float(ssim_map(picture(job, at, levels_of(one), at), whole).mean()) for one in (soon, rest))
    return dict(zip(("soon", "rest"), values, strict=True))


@contextmanager
def _served(run: Path) -> Iterator[str]:
    with show(run, print, port=0) as view:
        thread = threading.Thread(target=view.run, args=(False,))
        thread.start()
        try:
            yield view.urls[0]
        finally:
            view.stop()
            thread.join()


def main(
    run: tyro.conf.Positional[Path],
    without_cells: Path | None = None,
    targets: tuple[float, ...] = (0.9, 0.95),
    views: int = 6,
    size: tuple[int, int] = (640, 400),
    mbit: float = 10.0,
    write: bool = False,
) -> None:
    """Milliseconds a frame with and without cells, and the fidelity soon after a turn of the head.

    Args:
        run: folder of a run with a bundle.
        without_cells: the same scene run with --nest.cells 0; without it, no rows of it.
        targets: fidelity that the page is asked for.
        views: of the capture, as many, evenly.
        size: of the window, pixels.
        mbit: Mbit/s of the network, for the turn.
        write: keep the figures in benchmarks/results/cpu/frames.json.
    """
    job = Job(RunDir(run, "nested"), lambda event: None)
    cameras = capture_cameras(job.scene)
    chosen = [cameras[i] for i in np.linspace(0, len(cameras) - 1, views).round().astype(int)]
    folders = {"cells": run} | ({"no cells": without_cells} if without_cells else {})
    result: dict[str, Any] = {"run": run.name, "size": size, "views": views}
    with launch() as browser:
        for target in targets:
            found = [
                {name: _frames(browser, folder, target, chosen, size) for name, folder in folders.items()}
                for _ in range(_ROUNDS)
            ]
            result[f"{target:g}"] = {
                name: {key: float(np.median([one[name][key] for one in found])) for key in ("ms", "splats")}
                for name in folders
            }
        with (
            _served(run) as url,
            open_page(
                f"{url}?ui=0&target={targets[0]}", size, browser=browser, network=(mbit, LATENCY)
            ) as opened,
        ):
            opened.wait_for(_RESTING)
            turns = [turned(job, opened, camera) for camera in chosen]
    result["turn"] = {
        "mbit": mbit, "soon": [turn["soon"] for turn in turns], "rest": [turn["rest"] for turn in turns]
    }  # fmt: skip
    for target in targets:
        for name, found in result[f"{target:g}"].items():
            print(f"{target:g} {name}: {found['ms']:.1f} ms a frame, {found['splats']:,.0f} splats drawn")
    shares = [turn["soon"] / turn["rest"] for turn in turns]
    print(f"turn at {mbit:g} Mbit/s: {min(shares):.3f} to {max(shares):.3f} after 0.5 s and two frames")
    finish("frames", result, write)


def _frames(
    browser: Any, run: Path, target: float, cameras: Sequence[Camera], size: tuple[int, int]
) -> dict[str, float]:
    """Means over the views."""
    job = Job(RunDir(run, "nested"), lambda event: None)
    with (
        _served(run) as url,
        open_page(f"{url}?ui=0&target={target}", size, browser=browser) as opened,
    ):
        opened.wait_for(_RESTING)
        found = [frame_times(job, opened, camera) for camera in cameras]
    ms, splats = np.mean(found, 0).tolist()
    return {"ms": ms, "splats": splats}


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.frames")
