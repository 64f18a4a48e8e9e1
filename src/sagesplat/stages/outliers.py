"""Writes the outlier masks that a training ended with, for what is fitted to the photos after it."""

import shutil

import numpy as np
import torch
from torch import Tensor

from sagesplat.adapt.observe import render_rgb
from sagesplat.core.config import TrainConfig
from sagesplat.core.events import Progress
from sagesplat.core.gaussians import Gaussians
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.refined import read_refined, with_cameras
from sagesplat.segment.valid import write_view
from sagesplat.train.outliers import inliers


def write_inliers(job: Job, place: RunDir, config: TrainConfig, g: Gaussians) -> list[str]:
    """Write the pixels without outliers, by the trained model; without --train.outliers remove earlier ones.

    Held-out views keep all pixels that count: a figure does not rise by what is left out of it.
    """
    shutil.rmtree(place.inliers, ignore_errors=True)
    if not config.outliers:
        return []
    scene = job.given_scene
    if place.cameras.exists():
        scene = with_cameras(scene, read_refined(place.cameras, len(scene.views)))
    place.inliers.mkdir()
    rows, shares = set(job.valid.rows(scene, scene.train_ids)), []
    for row, view in enumerate(scene.views):
        counted = job.valid[view]
        valid = None if counted is None else torch.from_numpy(counted)
        left = valid
        if row in rows:
            image = render_rgb(g, view.camera, backend=job.backend, antialiased=config.antialiased)
            left = inliers(torch.from_numpy(image), torch.from_numpy(job.photos[row]), valid)
            shares.append(_share(valid) - _share(left))
        if left is not None:
            write_view(place.inliers, view, left.numpy())
        job.emit(Progress("outliers", row + 1, len(scene.views)))
    count = sum(share > 0 for share in shares)
    text = f"outliers in {count} of {len(shares)} training photos, {np.mean(shares):.1%} of their pixels"
    return [f"{text}; {place.inliers} shows them in black" if count else text]


def _share(valid: Tensor | None) -> float:
    return 1.0 if valid is None else float(valid.float().mean())
