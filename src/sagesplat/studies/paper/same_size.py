"""Quality at equal model size (Table IV of the paper): compositions against 3DGS of the same size."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Int32

from sagesplat.adapt.ladder import Ladder
from sagesplat.adapt.observe import as_unit, measure_total, render_rgb
from sagesplat.adapt.plan import Plan
from sagesplat.core.gaussians import Gaussians
from sagesplat.io.columns import ColumnTable, read_columns
from sagesplat.metrics.image import pasted
from sagesplat.metrics.lpips import Lpips
from sagesplat.raster import Workspace
from sagesplat.run.job import Job
from sagesplat.studies.lpips import features_of
from sagesplat.train.importance import importance

METHODS = ("SAGE", "SAGE, tuned", "3DGS, snapshot", "3DGS, pruned and tuned", "3DGS, full model")
FULL = len(METHODS) - 1


class Contender(NamedTuple):
    """A set of Gaussians to be measured."""

    target: float  # SSIM of the plan that set the size; NaN for the full model of 3DGS
    method: int  # index in METHODS
    gaussians: Gaussians


@dataclass(frozen=True, eq=False)
class SameSize(ColumnTable):
    """One row per (contender, view)."""

    of_view: Int32[np.ndarray, " R"]  # view that the compositions were planned for; -1 = for the scene
    target: Float32[np.ndarray, " R"]  # SSIM of the plan that set the size; NaN for the full model of 3DGS
    method: Int32[np.ndarray, " R"]  # index in METHODS
    view: Int32[np.ndarray, " R"]  # row in Scene.views
    count: Int32[np.ndarray, " R"]  # Gaussians
    ssim: Float32[np.ndarray, " R"]
    psnr: Float32[np.ndarray, " R"]  # dB
    lpips_alex: Float32[np.ndarray, " R"]  # NaN where it could not be measured
    lpips_vgg: Float32[np.ndarray, " R"]  # fed as the evaluation of 3DGS feeds it


def read_same_size(path: Path) -> SameSize:
    """The table that `write_csv` wrote. DataError where it is not one."""
    return read_columns(path, SameSize, "delete it and run `sagesplat report --paper` again")


def prune_to(g: Gaussians, count: int, weights: np.ndarray) -> Gaussians:
    """The `count` Gaussians of the largest weight, in their order."""
    kept = np.sort(np.argsort(-weights, kind="stable")[:count])
    return g.select(torch.from_numpy(kept))


def nearest_snapshot(ladder: Ladder, count: int) -> int:
    """The level nearest in size to `count`, the latest of several; one soon after a reset only if all are."""
    not_recovering = [level for level in ladder.levels if level not in ladder.recovering] or ladder.levels
    return min(not_recovering, key=lambda level: (abs(ladder.size(level) - count), -level))


def contenders(job: Job, plans: Sequence[Plan], tuned: Callable[[Gaussians], Gaussians]) -> list[Contender]:
    """For each plan: its composition, the same tuned, 3DGS's snapshot nearest in size, 3DGS pruned to it and
    tuned; last the full model of 3DGS.
    """
    ladder, scene = job.ladder, job.scene
    full = ladder.load(ladder.levels[-1])
    weights = importance(full, scene, scene.train_ids.tolist(), antialiased=job.antialiased)
    found = []
    for plan in plans:
        composed = plan.compose(ladder)
        sets = [
            composed,
            tuned(composed),
            ladder.load(nearest_snapshot(ladder, plan.count)),
            tuned(prune_to(full, plan.count, weights)),
        ]
        found += [Contender(plan.target, method, g) for method, g in enumerate(sets)]
    return [*found, Contender(np.nan, FULL, full)]


def compare(
    job: Job, views: Sequence[int], sets: Sequence[Contender], metrics: Mapping[str, Lpips], of_view: int
) -> Iterator[dict[str, float]]:
    """Rows of `SameSize`: every contender in every view (rows of Scene.views).

    `metrics`: LPIPS by column name; at pixels that do not count it sees the image itself.
    """
    workspace = Workspace()
    for row in views:
        photo, view = as_unit(job.photos[row]), job.scene.views[row]
        valid, of_photo = job.valid[view], features_of(metrics, photo)
        for target, method, g in sets:
            image = render_rgb(
                g, view.camera, backend=job.backend, antialiased=job.antialiased, workspace=workspace
            )
            found = measure_total(image, photo, valid)
            if valid is not None:
                of_photo = features_of(metrics, pasted(photo, image, valid))
            lpips = {n: metric.distance(metric.features(image), of_photo[n]) for n, metric in metrics.items()}
            yield {
                "of_view": of_view, "target": target, "method": method, "view": row, "count": len(g),
                "ssim": found["ssim"], "psnr": found["psnr"],
                "lpips_alex": np.nan, "lpips_vgg": np.nan, **lpips,
            }  # fmt: skip
