"""One training and its quality on test views, for quality.py: `quality_process.py SCENE DOWNSCALE STEPS`.

Prints JSON. It imports `sagesplat` from PYTHONPATH, which may be another checkout than this file's.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
import torch

from sagesplat.core.config import TrainConfig
from sagesplat.metrics.image import psnr, ssim_map
from sagesplat.raster import rasterize, set_threads
from sagesplat.scene import load_scene
from sagesplat.scene.images import Photos
from sagesplat.train.events import Trained
from sagesplat.train.trainer import train


def main() -> None:
    """Train and compare."""
    path, downscale, steps = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    set_threads(0)
    scene = load_scene(path, downscale=downscale)
    photos = Photos(scene.views)
    labels = np.full(len(scene.points.xyz), -1, np.int16)
    config = TrainConfig(max_steps=steps, level_every=steps)
    begin = time.perf_counter()
    *_, last = train(scene, photos, labels, config)
    seconds = time.perf_counter() - begin
    assert isinstance(last, Trained)
    qualities = []
    for row in scene.test_ids:
        camera = scene.views[row].camera
        with torch.no_grad():
            render = rasterize(last.gaussians, camera, antialiased=config.antialiased)
        shown = render.rgb.clamp(0, 1).contiguous().numpy()
        photo = photos[row].astype(np.float32) / 255
        qualities.append((psnr(np.square(shown - photo).mean()), ssim_map(shown, photo).mean()))
    dB, ssim = np.mean(qualities, axis=0).tolist()
    print(json.dumps({"seconds": seconds, "gaussians": len(last.gaussians), "psnr": dB, "ssim": ssim}))


if __name__ == "__main__":
    main()
