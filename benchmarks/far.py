"""Levels from far away: SSIM at lower resolutions, from farther viewpoints, and the bytes that those need.

Photos at a lower resolution are averages over areas. From farther away there are no photos: there the full
model, rendered at four times the resolution and averaged, is the reference.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float32

from sagesplat.adapt.fidelity import measure_levels, shown_enough
from sagesplat.adapt.observe import as_unit, render_rgb
from sagesplat.adapt.viewpoints import Rule, capture_cameras, draw
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.geometry import project
from sagesplat.metrics.image import psnr, squared_error_map, ssim_map
from sagesplat.raster import Workspace
from sagesplat.run.job import Job
from sagesplat.scene.scene import Camera, Scene
from sagesplat.stages.methods import NestedLevels

TIMES = (1, 2, 4, 8)  # lower resolution
FARTHER = (2, 4)
TARGETS = (0.8, 0.9, 0.95)
_SAMPLES = 4  # along each side of a pixel, of the reference

Image = Float32[np.ndarray, "H W 3"]
Quality = dict[str, float]


def averaged(image: Image, times: int) -> Image:
    """An image `times` smaller: means over areas; what is left over at the right and below is cut off."""
    height, width = (side // times for side in image.shape[:2])
    blocks = image[: height * times, : width * times].reshape(height, times, width, times, 3)
    return np.ascontiguousarray(blocks.mean((1, 3)))


def smaller(camera: Camera, times: int) -> Camera:
    """The camera of an `averaged` image."""
    return _scaled(camera, 1 / times, camera.width // times, camera.height // times)


def larger(camera: Camera, times: int) -> Camera:
    """A camera that takes `times` as many pixels along each side."""
    return _scaled(camera, times, camera.width * times, camera.height * times)


def _scaled(camera: Camera, by: float, width: int, height: int) -> Camera:
    K = camera.K * np.array([by, by, 1], np.float32)[:, None]
    return replace(camera, K=K, width=width, height=height)


def farther(camera: Camera, times: float, depth: float) -> Camera:
    """The camera moved back along its direction, until what was `depth` away is `times` as far."""
    w2c = camera.w2c.copy()
    w2c[2, 3] += (times - 1) * depth
    return replace(camera, w2c=w2c)


def median_depth(scene: Scene, camera: Camera) -> float:
    """Of the capture's points in the frame, along the camera's direction; all of them if none is."""
    pixels, depths = project(scene.points.xyz, camera.w2c, camera.K)
    inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(1)
    return float(np.median(depths[inside] if inside.any() else np.abs(depths)))


def at_resolutions(
    job: Job, sets: Mapping[str, Gaussians], times: Sequence[int] = TIMES, antialiased: bool | None = None
) -> dict[str, dict[int, Quality]]:
    """PSNR and SSIM of sets against photos reduced by area averaging, means over the test views."""
    space, found = Workspace(), {name: {n: [] for n in times} for name in sets}
    for row in job.scene.test_ids.tolist():
        camera, photo = job.scene.views[row].camera, as_unit(job.photos[row])
        for n in times:
            small, wanted = smaller(camera, n), averaged(photo, n)
            for name, g in sets.items():
                found[name][n].append(_compared(_drawn(job, g, small, space, antialiased), wanted))
    return {name: {n: _mean(rows) for n, rows in of.items()} for name, of in found.items()}


def from_farther(
    job: Job, sets: Mapping[str, Gaussians], full: Gaussians, times: Sequence[int] = FARTHER
) -> dict[str, dict[int, Quality]]:
    """PSNR and SSIM of sets against the full model, supersampled, from viewpoints behind the test views'."""
    space, found = Workspace(), {name: {n: [] for n in times} for name in sets}
    for row in job.scene.test_ids.tolist():
        camera = job.scene.views[row].camera.neutral
        depth = median_depth(job.scene, camera)
        for n in times:
            there = farther(camera, n, depth)
            wanted = averaged(_drawn(job, full, larger(there, _SAMPLES), space), _SAMPLES)
            for name, g in sets.items():
                found[name][n].append(_compared(_drawn(job, g, there, space), wanted))
    return {name: {n: _mean(rows) for n, rows in of.items()} for name, of in found.items()}


def bytes_needed(job: Job, views: int = 24, times: Sequence[int] = (1, 4)) -> dict[str, Any]:
    """Mean bytes with which each category keeps a fidelity, near, at lower resolutions and from farther.

    They are those of the cheapest levels from which on the measured fidelity stays at the target or above:
    what a plan that knows everything would send. Near viewpoints are drawn by the run's rule, anew.
    """
    near = draw(job.scene, capture_cameras(job.scene), Rule(90_000), {"test": views}).cameras
    depths = [median_depth(job.scene, camera) for camera in near]
    found: dict[str, Any] = {}
    for n in times:
        cases = {"resolution": [smaller(camera, n) for camera in near]}
        cases["farther"] = [farther(camera, n, depth) for camera, depth in zip(near, depths, strict=True)]
        for name, cameras in cases.items():
            found.setdefault(name, {})[n] = _least_bytes(job, cameras)
    return found


def _least_bytes(job: Job, cameras: Sequence[Camera]) -> dict[float, float]:
    fidelity, pixels, _ = measure_levels(
        job.ladder, cameras, backend=job.backend, antialiased=job.antialiased
    )
    cost = np.broadcast_to(NestedLevels(job).costs.transfer_bytes, fidelity.shape)
    shown = shown_enough(pixels, cameras)[..., None]
    return {target: least_cost(~shown | (fidelity >= target), cost) for target in TARGETS}


def least_cost(keeps: np.ndarray, cost: np.ndarray) -> float:
    """Arrays [V, L, K]: cost of the first level from which on all keep a target, sum over L, mean over V."""
    from_here_on = np.logical_and.accumulate(keeps[..., ::-1], -1)[..., ::-1]
    level = from_here_on.argmax(-1)
    return float(np.take_along_axis(cost, level[..., None], -1).sum((1, 2)).mean())


def _drawn(
    job: Job, g: Gaussians, camera: Camera, space: Workspace, antialiased: bool | None = None
) -> Image:
    filtered = job.antialiased if antialiased is None else antialiased
    return render_rgb(g, camera, backend=job.backend, antialiased=filtered, workspace=space).copy()


def _compared(image: Image, wanted: Image) -> tuple[float, float]:
    return float(psnr(squared_error_map(image, wanted).mean())), float(ssim_map(image, wanted).mean())


def _mean(rows: Sequence[tuple[float, float]]) -> Quality:
    return dict(zip(("psnr", "ssim"), np.mean(rows, 0).tolist(), strict=True))
