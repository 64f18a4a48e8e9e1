"""A visitor's promises in Chromium, frame by frame, against renderings of the full model.

One visit of 60 s: along the capture's cameras, walking among them, and stepping back. Of each frame that is
sampled the page tells the pose, the pixels of its canvas, the levels that are drawn and what is promised of
them. Both those levels and the full model are then rendered here. A screen sharper than promises are made for
is compared averaged down to the sharpest of them, as the promise says.
"""

import math
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import tyro
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.common import finish
from sagesplat.adapt.fidelity import PROMISED_SHARE, References
from sagesplat.adapt.observe import render_rgb
from sagesplat.adapt.viewpoints import capture_cameras, draw
from sagesplat.metrics.image import means_by_label, ssim_map
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.scene import Camera
from sagesplat.stages.results import viewpoints_of
from sagesplat.stages.view import show
from sagesplat.viewer import frames
from tests.browser import launch, open_page


class Screen(NamedTuple):
    """A window, and pixels of the screen per pixel of the window."""

    width: int
    height: int
    ratio: float


SCREENS = {
    "1280 x 720": Screen(1280, 720, 1.0),
    "1280 x 720, dense": Screen(1280, 720, 2.0),
    "portrait phone": Screen(390, 844, 3.0),
}
SECONDS = 60
_STEPS = 2  # poses a second: software draws no more
_WALKS = 8  # places that a walk goes through
_TOGETHER = 10  # seconds of the visit that are drawn as one in the bootstrap: they show nearly the same
_DRAWS = 1000
# the next pose; then what is drawn and promised once the page has drawn it
SAMPLE = """async (pose) => {
  const view = window.sagesplat
  view.setPose(pose)
  for (let i = 0; i < 2; i++) await new Promise(requestAnimationFrame)
  const { width, height } = document.querySelector("canvas")
  const { labels, screens } = view.state()
  return {
    pose: view.pose(), width, height, most: screens?.most ?? null,
    labels: labels.map(({ label, shown, promised, visible, cells }) => ({
      id: label.id, shown, visible, promised: Number.isFinite(promised) ? promised : null,
      cells: cells.map(({ cell, shown, visible }) => [cell.id, shown, visible]),
    })),
  }
}"""


def visit(job: Job, seed: int = 5) -> list[Camera]:
    """A camera for each step: a third along the capture's cameras, a third walking, a third stepping back."""
    base, rule = capture_cameras(job.scene), viewpoints_of(job).rule
    along = base[: max(len(base) // 2, 2)]
    walks = draw(job.scene, base, replace(rule, seed=seed, places=(0, 1, 0)), {"fit": _WALKS}).cameras
    start = base[len(base) // 2]
    depth = (job.scene.points.xyz - start.position) @ start.direction
    far = start.position - 0.5 * float(np.median(depth[depth > 0])) * start.direction
    third = SECONDS * _STEPS // 3
    steps = [*_between(along, third), *_between(_in_turn(list(walks)), third)]
    return [*steps, *_between([start, _moved(start, far), start], SECONDS * _STEPS - 2 * third)]


def _between(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """Cameras on the way through some, evenly."""
    at, times = np.arange(len(cameras)), np.linspace(0, len(cameras) - 1, count)
    turned = Slerp(at, Rotation.from_matrix([camera.w2c[:3, :3].T for camera in cameras]))(times)
    positions = np.stack([camera.position for camera in cameras])
    places = np.stack([np.interp(times, at, positions[:, axis]) for axis in range(3)], 1)
    out = []
    for rotation, position in zip(turned.as_matrix(), places, strict=True):
        w2c = np.eye(4)
        w2c[:3, :3] = rotation.T
        out.append(_moved(replace(cameras[0], w2c=w2c.astype(np.float32)), position))
    return out


def _moved(camera: Camera, position: np.ndarray) -> Camera:
    w2c = camera.w2c.copy()
    w2c[:3, 3] = -w2c[:3, :3] @ position
    return replace(camera, w2c=w2c)


def _in_turn(cameras: list[Camera]) -> list[Camera]:
    """Each followed by the nearest one left."""
    out = [cameras.pop(0)]
    while cameras:
        apart = [float(np.linalg.norm(one.position - out[-1].position)) for one in cameras]
        out.append(cameras.pop(int(np.argmin(apart))))
    return out


def sampled(url: str, cameras: Sequence[Camera], screen: Screen, every: int) -> list[dict[str, Any]]:
    """What the page shows and promises in every n-th frame of a visit."""
    found = []
    with launch() as browser, open_page(
        f"{url}?ui=0", (screen.width, screen.height), browser=browser, ratio=screen.ratio
    ) as opened:  # fmt: skip
        opened.wait_for("Boolean(window.sagesplat)")
        opened.page.evaluate("window.sagesplat.ready")
        for number, camera in enumerate(cameras):
            pose = pose_of(camera)
            if number % every == 0:
                found.append(opened.page.evaluate(SAMPLE, pose))
            else:
                opened.page.evaluate("(pose) => window.sagesplat.setPose(pose)", pose)
                opened.page.wait_for_timeout(1000 / _STEPS)
        if opened.complaints:
            raise SystemExit(f"the page complains: {opened.complaints[:3]}")
    return found


def pose_of(camera: Camera) -> dict[str, list[float]]:
    """A camera's pose as the page takes it."""
    return {
        "position": frames.position(camera).tolist(), "quaternion": frames.quaternion(camera).tolist()
    }  # fmt: skip


def camera_of(sample: dict[str, Any], like: Camera) -> Camera:
    """The camera of a sample: its pose in the capture's axes, on its canvas."""
    width, height, pose = sample["width"], sample["height"], sample["pose"]
    turned = Rotation.from_quat(pose["quaternion"]).as_matrix()
    w2c = np.eye(4)
    w2c[:3, :3] = (frames.FLIP[:, None] * turned * frames.FLIP).T
    w2c[:3, 3] = -w2c[:3, :3] @ (np.array(pose["position"]) * frames.FLIP)
    focal = height / (2 * math.tan(pose["fovY"] / 2))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
    return replace(like, w2c=w2c.astype(np.float32), K=K, width=width, height=height)


def checked(job: Job, samples: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each category of each sample that is promised something: what, and what it measures."""
    references = References(job.ladder, job.backend, job.antialiased, keep=0)
    like, drawn, names = capture_cameras(job.scene)[0], viewpoints_of(job), job.names()
    rows = []
    for number, sample in enumerate(samples):
        camera = camera_of(sample, like)
        screen = camera.focal / drawn.focal
        share = min(drawn.rule.screens[1] / screen, 1)
        smaller = camera.resized(*(max(round(share * side), 1) for side in (camera.width, camera.height)))
        at = references.at(smaller)
        levels = levels_of(sample)
        full = dict.fromkeys(job.by_cell.sizes, job.ladder.levels[-1])
        shown, whole = (picture(job, camera, one, smaller) for one in (levels, full))
        means = means_by_label(ssim_map(shown, whole), at.label_ids)
        for one in sample["labels"]:
            pixels = means.get(one["id"], (0, 0))[1]
            if pixels < PROMISED_SHARE * at.label_ids.size:
                continue
            rows.append(
                {
                    "frame": number,
                    "category": names[one["id"]],
                    "screen": screen,
                    "promised": one["promised"],
                    "measured": float(means[one["id"]][0]),
                    "share": one["shown"],
                }
            )
    return rows


def levels_of(sample: dict[str, Any]) -> dict[int, int]:
    """The levels that a sample draws, by cell id."""
    return {cell: level for one in sample["labels"] for cell, level, _ in one["cells"] if level}


def picture(job: Job, camera: Camera, levels: dict[int, int], smaller: Camera) -> np.ndarray:
    """The cells' levels in a camera's pixels, averaged down to those of a smaller one."""
    image = render_rgb(job.by_cell.compose(levels), camera, backend=job.backend, antialiased=job.antialiased)
    if camera.width == smaller.width:
        return image
    pixels = torch.from_numpy(image).permute(2, 0, 1)[None]
    size = (smaller.height, smaller.width)
    return torch.nn.functional.interpolate(pixels, size, mode="area")[0].permute(1, 2, 0).contiguous().numpy()


def measure(run: Path, screens: Sequence[str], every: int) -> dict[str, Any]:
    """The visit on each screen."""
    job, results = Job(RunDir(run, "nested"), lambda event: None), {}
    cameras = visit(job)
    with show(run, print, port=0) as view:
        thread = threading.Thread(target=view.run, args=(False,))
        thread.start()
        try:
            for name in screens:
                found = sampled(view.urls[0], cameras, SCREENS[name], every)
                results[name] = _on_screen(job, name, found, max(_TOGETHER * _STEPS // every, 1))
        finally:
            view.stop()
            thread.join()
    return results


def _on_screen(job: Job, name: str, found: Sequence[dict[str, Any]], together: int) -> dict[str, Any]:
    """The visit on one screen, and a line about it."""
    rows = checked(job, found)
    told = [row for row in rows if row["promised"] is not None]
    missed = [row for row in told if row["measured"] < row["promised"]]
    result = {
        "frames": len(found),
        "screen": float(np.median([row["screen"] for row in rows])),
        "decisions": len(rows),
        "promised": len(told) / max(len(rows), 1),
        "kept": 1 - len(missed) / max(len(told), 1),
        "interval": _interval(told, missed, len(found), together),
        "frames_with_a_miss": len({row["frame"] for row in missed}),
        "missed": missed,
    }
    print(
        f"{name}: {len(found)} frames at {result['screen']:.2f} times the photos' focal length; "
        f"promised {len(told)} of {len(rows)}, of these kept {result['kept']:.3f} "
        f"({result['interval'][0]:.3f} to {result['interval'][1]:.3f})"
    )
    return result


def _interval(
    told: Sequence[dict[str, Any]], missed: Sequence[dict[str, Any]], frames: int, together: int
) -> list[float]:
    """95 % interval of the share kept, by a circular bootstrap of frames that follow each other."""
    counts = np.stack(
        [np.bincount([row["frame"] for row in rows], minlength=frames) for rows in (told, missed)]
    )
    starts = np.random.default_rng(0).integers(frames, size=(_DRAWS, -(-frames // together)))
    drawn = (starts[..., None] + np.arange(together)).reshape(_DRAWS, -1)[:, :frames] % frames
    promised, broken = counts[:, drawn].sum(-1)
    return np.quantile(1 - broken / np.maximum(promised, 1), [0.025, 0.975]).tolist()


def main(
    run: tyro.conf.Positional[Path],
    screens: tuple[str, ...] = tuple(SCREENS),
    every: int = 4,
    write: bool = False,
) -> None:
    """A visit of 60 s in Chromium: every sampled frame's promises against renderings of the full model.

    Args:
        run: folder of a run with a bundle.
        screens: which of SCREENS.
        every: of how many frames (two a second) one is sampled.
        write: keep the figures in benchmarks/results/cpu/visitor.json.
    """
    unknown = set(screens) - set(SCREENS)
    if unknown:
        raise SystemExit(f"visitor: no screen {unknown.pop()!r}; choose of {', '.join(SCREENS)}")
    finish("visitor", measure(run, screens, every), write)


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.visitor")
