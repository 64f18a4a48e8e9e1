"""Images of levels compared with those of their reference, view by view and category by category."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Int16

from sagesplat.adapt.observe import TOTAL, RenderedLabels, render_rgb
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.splats import Splat
from sagesplat.metrics.flip import flip_map
from sagesplat.metrics.image import means_by_label, psnr, squared_error_map, ssim_map
from sagesplat.metrics.lpips import Lpips
from sagesplat.metrics.ms_ssim import ms_ssim
from sagesplat.raster import Backend, Workspace, device_of, rasterize
from sagesplat.scene.scene import Camera
from sagesplat.segment.masks import UNLABELLED
from sagesplat.studies.measure.levels import Level

MS_SSIM, FLIP = "MS-SSIM", "FLIP"  # columns
COVERED = -4  # label id of the pixels that the reference covers: an empty background agrees with itself
LEAST_SHARE = 0.001  # of a view's pixels; a category with fewer is not measured there
_OPAQUE = 0.5
_TOGETHER = 3_000_000  # Gaussians in memory at a time, or one level


@dataclass(frozen=True)
class Row:
    """A level in a viewpoint: the whole image, what the reference covers of it, or one category."""

    level: int  # row of the levels
    view: int  # row of the cameras
    label_id: int  # TOTAL, COVERED or a category
    ssim: float
    psnr: float  # dB
    pixels: int
    others: Mapping[str, float]  # MS-SSIM, FLIP and LPIPS by column; of the whole image only


class Renderer:
    """Draws splats as their files say."""

    def __init__(self, backend: Backend):
        self.backend: Backend = backend
        self.workspace = Workspace()

    def rgb(self, splat: Splat, camera: Camera) -> Float32[np.ndarray, "H W 3"]:
        """An image in [0, 1]."""
        return render_rgb(
            splat.gaussians, camera,
            backend=self.backend, antialiased=splat.antialiased, workspace=self.workspace,
        )  # fmt: skip

    @torch.no_grad()
    def covered(self, splat: Splat, camera: Camera) -> np.ndarray:
        """Pixels that the Gaussians cover, bool [H, W]."""
        g = splat.gaussians.to(device_of(self.backend))
        options: dict[str, Any] = {"backend": self.backend, "antialiased": splat.antialiased, "sh_degree": 0}
        return (rasterize(g, camera, **options).alpha > _OPAQUE).cpu().numpy()


def compare(
    reference: Splat,
    levels: Sequence[Level],
    cameras: Sequence[Camera],
    metrics: Mapping[str, Lpips],
    renderer: Renderer,
    done: Callable[[int], None],
) -> tuple[list[Row], list[int]]:
    """Measure levels in all viewpoints: the measurements, and the number of Gaussians of each level.

    The labels of `reference` say where the categories are; `metrics`: LPIPS by column; `done` hears how many
    images were compared.
    """
    rows: list[Row] = []
    counts: list[int] = []
    images = 0
    labels = None
    if int(reference.gaussians.label_ids.max()) >= 0:
        labels = RenderedLabels(reference.gaussians, renderer.backend, reference.antialiased)
    for begin, splats in _groups(levels):
        counts += [len(splat.gaussians) for splat in splats]
        for view, camera in enumerate(cameras):
            truth = renderer.rgb(reference, camera).copy()
            covered = renderer.covered(reference, camera)
            ids = None if labels is None else labels.render(camera)
            seen = {name: metric.features(truth) for name, metric in metrics.items()}
            for number, splat in enumerate(splats, begin):
                image = renderer.rgb(splat, camera)
                others = {MS_SSIM: ms_ssim(image, truth), FLIP: float(flip_map(image, truth).mean())}
                others |= {
                    n: metric.distance(metric.features(image), seen[n]) for n, metric in metrics.items()
                }
                rows += _rows(number, view, image, truth, covered, ids, others)
                images += 1
                done(images)
    return rows, counts


def _groups(levels: Iterable[Level]) -> Iterator[tuple[int, list[Splat]]]:
    """Levels that are in memory together, with the row of the first."""
    begin, group = 0, []
    for number, level in enumerate(levels):
        splat = level.load()
        sizes: list[Gaussians] = [one.gaussians for one in group]
        if group and sum(map(len, sizes)) + len(splat.gaussians) > _TOGETHER:
            yield begin, group
            begin, group = number, []
        group.append(splat)
    if group:
        yield begin, group


def _rows(
    number: int,
    view: int,
    image: Float32[np.ndarray, "H W 3"],
    truth: Float32[np.ndarray, "H W 3"],
    covered: np.ndarray,
    ids: Int16[np.ndarray, "H W"] | None,
    others: Mapping[str, float],
) -> list[Row]:
    quality, error = ssim_map(image, truth), squared_error_map(image, truth)
    found = [Row(number, view, TOTAL, float(quality.mean()), float(psnr(error.mean())), quality.size, others)]
    regions = [np.where(covered, COVERED, UNLABELLED).astype(np.int16), *([] if ids is None else [ids])]
    for region in regions:
        errors = means_by_label(error, region)
        for label, (ssim, pixels) in means_by_label(quality, region).items():
            if label != UNLABELLED and pixels >= LEAST_SHARE * quality.size:
                found.append(Row(number, view, label, ssim, float(psnr(errors[label][0])), pixels, {}))
    return found
