"""Time to quality: seconds of training and the quality on test views, of checkouts that take turns.

Each training is a process of its own, this file again with the sources of a checkout: `quality.py --once`.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import tyro

sys.path.append(str(Path(__file__).parents[1]))  # for a process that runs this file

from benchmarks.common import GARDEN, ROOT, commit, finish


def main(
    scene: Path = GARDEN,
    downscale: int = 2,
    sources: tuple[Path, ...] = (ROOT,),
    steps: tuple[int, ...] = (1000,),
    repeats: int = 1,
    once: bool = False,
    write: bool = False,
) -> None:
    """Medians over repeats, by checkout: seconds of training, Gaussians, PSNR and SSIM on test views.

    Args:
        scene: capture.
        downscale: of its photos.
        sources: checkouts of the package, which take turns (`git worktree add`).
        steps: of training, one number for each checkout.
        repeats: times that each is trained, after a short training that fills its cache of kernels.
        once: one training by this process itself, which prints JSON.
        write: keep the results.
    """
    if once:
        print(json.dumps(train_once(scene, downscale, steps[0])))
        return
    runs: dict[str, list[dict[str, float]]] = {}
    for source in sources:
        _process(scene, downscale, source, 20)
    for _ in range(repeats):
        for source, count in zip(sources, steps, strict=True):
            name = f"{source.resolve()} {commit(source)}, {count} steps"
            runs.setdefault(name, []).append(_process(scene, downscale, source, count))
            print(f"{name}: {runs[name][-1]}", flush=True)
    medians = {
        name: {key: float(np.median([run[key] for run in of])) for key in of[0]} for name, of in runs.items()
    }
    for name, run in medians.items():
        print(f"{name}: {run['seconds']:.1f} s, {run['psnr']:.2f} dB, {run['ssim']:.4f}")
    finish(f"quality_{scene.name}", {"scene": scene.name, "downscale": downscale, "runs": medians}, write)


def _process(scene: Path, downscale: int, source: Path, steps: int) -> dict[str, float]:
    command = [sys.executable, __file__, "--once", "--scene", str(scene.resolve())]
    command += ["--downscale", str(downscale), "--steps", str(steps)]
    env = os.environ | {"PYTHONPATH": str(source.resolve() / "src"), "OMP_WAIT_POLICY": "PASSIVE"}
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=env)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def train_once(path: Path, downscale: int, steps: int) -> dict[str, float]:
    """Train; seconds, Gaussians, and means of PSNR [dB] and SSIM over the test views."""
    import torch

    from sagesplat.core.config import TrainConfig
    from sagesplat.metrics.image import psnr, ssim_map
    from sagesplat.raster import rasterize, set_threads
    from sagesplat.scene import load_scene
    from sagesplat.scene.images import Photos
    from sagesplat.train.events import Trained
    from sagesplat.train.trainer import train

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
    return {"seconds": seconds, "gaussians": len(last.gaussians), "psnr": dB, "ssim": ssim}


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.quality")
