"""What the benchmarks run on: clouds of Gaussians of every size, and captures."""

from pathlib import Path

import numpy as np
import torch

from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import Gaussians
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera, Scene
from sagesplat.train.events import Trained
from sagesplat.train.state import from_points
from sagesplat.train.trainer import train

GARDEN = Path(__file__).parents[2] / "shared" / "scenes" / "garden"
# standard deviation on the image in pixels, and opacity
OVERLAPS = {"sparse": (2.0, 0.5), "dense": (20.0, 0.03)}


def camera(width: int = 800, height: int = 533) -> Camera:
    """At the origin, looking along z with a focal length of the image's width."""
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], np.float32)
    return Camera(np.eye(4, dtype=np.float32), K, width, height)


def cloud(count: int, overlap: str, view: Camera, degree: int = 3, seed: int = 0) -> Gaussians:
    """Gaussians all over an image, between 3 and 5 units deep, round and of one size on the image."""
    sigma, opacity = OVERLAPS[overlap]
    rng = np.random.default_rng(seed)
    z = rng.uniform(3, 5, count)
    uv = rng.random((count, 2)) * [view.width, view.height] - [view.width / 2, view.height / 2]
    means = np.column_stack([uv * (z / view.width)[:, None], z])
    scales = np.log(sigma * z / view.width)[:, None] + rng.normal(0, 0.2, (count, 3))

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values.astype(np.float32))

    return Gaussians(
        means=tensor(means),
        quats=tensor(rng.normal(size=(count, 4))),
        log_scales=tensor(scales),
        logit_opacities=tensor(np.full(count, np.log(opacity / (1 - opacity)))),
        sh0=tensor(rng.normal(0, 0.5, (count, 1, 3))),
        shN=tensor(rng.normal(0, 0.1, (count, (degree + 1) ** 2 - 1, 3))),
        label_ids=torch.zeros(count, dtype=torch.int16),
    )


def initial(scene: Scene) -> Gaussians:
    """What training begins with."""
    return from_points(scene.points, np.full(len(scene.points.xyz), -1, np.int16), 3)


def trained(scene: Scene, steps: int) -> Gaussians:
    """The Gaussians after a short run of the fast pace."""
    config = TrainConfig(max_steps=steps, level_every=steps)
    labels = np.full(len(scene.points.xyz), -1, np.int16)
    for event in train(scene, Photos(scene.views), labels, config):
        if isinstance(event, Trained):
            return event.gaussians
    raise AssertionError("training ends with Trained")
