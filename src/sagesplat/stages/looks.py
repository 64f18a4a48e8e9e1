"""What plans for fidelities look like: the same part of a view at each of them."""

import numpy as np
from scipy.ndimage import uniform_filter

from sagesplat.adapt.observe import render_rgb
from sagesplat.core.gaussians import Gaussians
from sagesplat.metrics.image import ssim_map
from sagesplat.output.report_data import Look
from sagesplat.output.tables import bytes_of, last_counts
from sagesplat.raster import Workspace
from sagesplat.run.job import Job
from sagesplat.scene.scene import Camera
from sagesplat.stages.methods import method_of
from sagesplat.stages.results import plans_of

_VIEWS = 4  # that the part is looked for in
_PART = 3  # of the sides of a view


def looks(job: Job, scale: float = 1.0) -> list[Look]:
    """The part of a view where the plan for the lowest fidelity is furthest from the full model, at each.

    Ascending, the full model last; none without plans for fidelity. Views are those kept aside, where there
    are any, rendered at `scale` times their pixels.
    """
    plans = sorted((p for p in plans_of(job) if p.quality == "fidelity"), key=lambda plan: plan.target)
    sizes = method_of(job).bytes_to_send
    if not plans or not sizes:
        return []
    scene, full = job.scene, job.came_in or job.ladder.load(job.ladder.levels[-1])
    rows = scene.test_ids if len(scene.test_ids) else scene.train_ids
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, _VIEWS).round().astype(int))]
    cameras = [_scaled(scene.views[row].camera.neutral, scale) for row in rows.tolist()]
    space = Workspace()

    def picture(g: Gaussians, camera: Camera) -> np.ndarray:
        return render_rgb(g, camera, backend=job.backend, antialiased=job.antialiased, workspace=space)

    lowest, worst, found = plans[0].compose(job.ladder), -1.0, None
    for camera in cameras:
        whole, image = picture(full, camera), picture(lowest, camera)
        difference, part = _furthest(1 - ssim_map(image, whole))
        if difference > worst:
            worst, found = difference, (camera, whole, image, part)
    assert found is not None  # a scene has views
    camera, whole, image, part = found
    shown, levels = [], (plans[0].levels, plans[0].cells)
    for plan in plans:
        if (plan.levels, plan.cells) != levels:  # low targets often have one plan; one composition at a time
            image, levels = picture(plan.compose(job.ladder), camera), (plan.levels, plan.cells)
        similar = ssim_map(image, whole)
        nbytes = sum(map(bytes_of, plan.choices))
        shown.append(
            Look(plan.target, nbytes, float(similar.mean()), float(similar[part].mean()), _bytes(image[part]))
        )
    return [*shown, Look(1.0, sum(last_counts(sizes).values()), 1.0, 1.0, _bytes(whole[part]))]


def _scaled(camera: Camera, scale: float) -> Camera:
    """The same view with `scale` times the pixels a side."""
    return camera.resized(round(camera.width * scale), round(camera.height * scale))


def _furthest(difference: np.ndarray) -> tuple[float, tuple[slice, ...]]:
    """The largest mean of a part of an image [H, W], and where that part is."""
    size = [max(1, side // _PART) for side in difference.shape]
    first = [side // 2 for side in size]  # of the middles of parts that are inside
    inside = tuple(
        slice(at, full - side + at + 1) for at, side, full in zip(first, size, difference.shape, strict=True)
    )
    means = uniform_filter(difference.astype(np.float64), size)[inside]  # pyright: ignore[reportArgumentType]
    corner = np.unravel_index(int(means.argmax()), means.shape)
    part = tuple(slice(int(at), int(at) + side) for at, side in zip(corner, size, strict=True))
    return float(means.max()), part


def _bytes(image: np.ndarray) -> np.ndarray:
    return np.round(255 * image).astype(np.uint8)
