"""What it saves to stop categories: the same training with and without, one after the other."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sagesplat.adapt.observe import TOTAL, as_unit, measure, render_rgb
from sagesplat.core.config import TrainConfig
from sagesplat.raster import Backend, device_of
from sagesplat.scene import load_scene
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.segment.lift import lift
from sagesplat.segment.mask_files import import_masks
from sagesplat.segment.masks import Masks, Taxonomy
from sagesplat.train.events import LabelFrozen, Step, Trained
from sagesplat.train.trainer import train

_PARTS = 10  # stretches of a run that are timed apart


@dataclass(frozen=True, eq=False)
class Capture:
    """A capture that is ready to train: photos and label images in memory."""

    scene: Scene
    photos: Photos
    masks: Masks
    labels: np.ndarray  # int16 [P]


def open_capture(path: Path, folder: Path, downscale: int) -> Capture:
    """Read a capture; its label images are brought into `folder`."""
    scene = load_scene(path, downscale=downscale)
    import_masks(scene, path / "masks", folder)
    photos, masks = Photos(scene.views), Masks(folder, Taxonomy.read(folder / "labels.json"))
    for row, view in enumerate(scene.views):
        _ = photos[row], masks[view]
    labels = lift(scene, masks, views=set(scene.train_ids.tolist())).label_ids
    return Capture(scene, photos, masks, labels)


def timed(capture: Capture, config: TrainConfig, backend: Backend = "auto") -> dict:  # type: ignore[type-arg]
    """Train, and say how long each tenth took, what it drew, and what came out."""
    stops, frozen, last, ended = np.linspace(0, config.max_steps, _PARTS + 1)[1:], {}, 0, None
    milliseconds, shares, drawn = [], [], []
    begin = mark = time.perf_counter()
    masks = capture.masks if config.freeze_at is not None else None
    for event in train(capture.scene, capture.photos, capture.labels, config, masks=masks, backend=backend):
        match event:
            case LabelFrozen(step, label, ssim, _):
                frozen[label] = {"step": step, "ssim": ssim}
            case Step(step, _, _, share):
                drawn.append(share)
                if step >= stops[len(shares)] or step == config.max_steps:
                    now = time.perf_counter()
                    milliseconds.append(1e3 * (now - mark) / (step - last))
                    shares.append(float(np.mean(drawn)))
                    mark, last, drawn = now, step, []
            case Trained():
                ended = event
    seconds = time.perf_counter() - begin
    assert ended is not None
    quality = {
        name: by_label(capture, ended, rows.tolist(), backend, config.antialiased)
        for name, rows in (("train", capture.scene.train_ids), ("test", capture.scene.test_ids))
    }
    return {
        "seconds": seconds,
        "steps": ended.step,
        "gaussians": len(ended.gaussians),
        "frozen": frozen,
        "ms_per_step": milliseconds,
        "tiles_drawn": shares,
        **quality,
    }


def by_label(
    capture: Capture, trained: Trained, rows: list[int], backend: Backend, antialiased: bool
) -> dict:  # type: ignore[type-arg]
    """Mean SSIM by label id over the views that show it, and SSIM and PSNR of whole images."""
    found: dict[int, dict[str, list[float]]] = {}
    gaussians = trained.gaussians.to(device_of(backend))
    for row in rows:
        view = capture.scene.views[row]
        image = render_rgb(gaussians, view.camera, backend=backend, antialiased=antialiased)
        for label, values in measure(image, as_unit(capture.photos[row]), capture.masks[view]).items():
            for name in ("ssim", "psnr"):
                found.setdefault(label, {}).setdefault(name, []).append(values[name])
    means = {label: {name: float(np.mean(v)) for name, v in of.items()} for label, of in found.items()}
    whole = means.pop(TOTAL)
    return {**whole, "labels": {label: of["ssim"] for label, of in sorted(means.items())}}


def pixel_shares(capture: Capture) -> dict[int, float]:
    """Each label's share of the training views' pixels."""
    counts: dict[int, int] = {}
    for row in capture.scene.train_ids.tolist():
        ids, n = np.unique(capture.masks[capture.scene.views[row]], return_counts=True)
        for label, count in zip(ids.tolist(), n.tolist(), strict=True):
            counts[label] = counts.get(label, 0) + count
    return {label: count / sum(counts.values()) for label, count in counts.items()}


def compare(capture: Capture, config: TrainConfig, targets: list[float]) -> dict:  # type: ignore[type-arg]
    """The full run, and one for each target."""
    shares = pixel_shares(capture)
    full = timed(capture, config)
    result = {"pixel_shares": shares, "full": full}
    variants = [(f"freeze at {t}", replace(config, freeze_at=t)) for t in targets]
    for name, variant in variants:
        run = timed(capture, variant)
        half = config.max_steps / 2
        run["share_of_time"] = run["seconds"] / full["seconds"]
        run["pixels_frozen_by_mid_run"] = sum(
            shares[label] for label, at in run["frozen"].items() if at["step"] <= half
        )
        result[name] = run
    return result
