"""Trains a small DeepLabV2 on the built-in garden and says what it finds in views that it has not seen."""

import time
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Int16, UInt8
from torch.nn import functional as F

from sagesplat.demo.capture import demo_cameras
from sagesplat.demo.render import lit_world, render_view
from sagesplat.demo.world import LABELS
from sagesplat.segment import coco
from sagesplat.segment.deeplabv2 import MEAN_BGR, SCALES, DeepLabV2, DeepLabV2Segmenter, HeadClasses

BLOCKS, WIDTH = (1, 1, 2, 1), 16  # of the small network
HELD_OUT = 5  # every n-th view is for the test
GOAL = 0.65  # mIoU on them that `measure` has to reach with its defaults; 0.74 was measured

Photos = Sequence[UInt8[np.ndarray, "H W 3"]]
LabelImages = Sequence[Int16[np.ndarray, "H W"]]


def train_small(
    photos: Photos,
    labels: LabelImages,
    num_classes: int,
    *,
    steps: int,
    blocks: Sequence[int] = BLOCKS,
    width: int = WIDTH,
    batch: int = 4,
    rate: float = 3e-3,
    seed: int = 0,
    on_step: Callable[[int, float], None] | None = None,
) -> DeepLabV2:
    """A network from random weights; labels are classes 0 ... C - 1, negative ones do not count.

    All photos are of one size. Each step sees a batch at one of the scales of inference, half of it mirrored;
    unlike in the paper, batch norm learns too, since there are no weights to start from. `on_step(steps done,
    loss)` is called after each.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    model = DeepLabV2(num_classes, blocks, width).train()
    x = torch.from_numpy(np.stack(photos)[..., ::-1].astype(np.float32)) - torch.tensor(MEAN_BGR)
    x, y = x.permute(0, 3, 1, 2), torch.from_numpy(np.stack(labels).astype(np.int64))
    optimizer = torch.optim.AdamW(model.parameters(), rate, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
    for step in range(steps):
        rows = torch.from_numpy(rng.choice(len(photos), min(batch, len(photos)), replace=False))
        photo, label = x[rows], y[rows]
        if rng.random() < 0.5:
            photo, label = photo.flip(3), label.flip(2)
        small = F.interpolate(photo, scale_factor=float(rng.choice(SCALES)), mode="bilinear")
        logits = F.interpolate(model(small), tuple(label.shape[1:]), mode="bilinear")
        loss = F.cross_entropy(logits, label.clamp(min=-1), ignore_index=-1)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if on_step is not None:
            on_step(step + 1, float(loss.detach()))
    return model.eval()


def mean_iou(predicted: LabelImages, truth: LabelImages) -> float:
    """Mean intersection over union of the truth's labels; its unlabelled pixels do not count."""
    p, t = (np.concatenate([image.ravel() for image in images]) for images in (predicted, truth))
    p, t = p[t >= 0], t[t >= 0]
    return float(np.mean([((p == i) & (t == i)).sum() / ((p == i) | (t == i)).sum() for i in np.unique(t)]))


def garden(views: int, width: int, height: int) -> tuple[Photos, LabelImages]:
    """Photos of the built-in garden and their true label images (COCO ids)."""
    lit_world(0)
    drawn = [render_view(camera) for camera in demo_cameras(views, width, height, 0)]
    return [rgb for rgb, _, _ in drawn], [label for _, label, _ in drawn]


def measure(steps: int = 160, views: int = 30, width: int = 128, height: int = 96) -> dict[str, float]:
    """mIoU on every fifth view of the garden, with and without the CRF, after training on the others.

    The defaults take half a minute of one core to train.
    """
    photos, labels = garden(views, width, height)
    ids = sorted(LABELS)
    index = np.full(max(coco.NAMES) + 2, -1, np.int16)  # the last one is for -1
    index[ids] = np.arange(len(ids))
    test = [i for i in range(views) if i % HELD_OUT == 0]
    train = [i for i in range(views) if i % HELD_OUT]
    begin = time.perf_counter()
    model = train_small([photos[i] for i in train], [index[labels[i]] for i in train], len(ids), steps=steps)
    result = {
        "goal": GOAL,
        "steps": float(steps),
        "views": float(views),
        "train_seconds": time.perf_counter() - begin,
    }
    classes, truth = HeadClasses(tuple(range(len(ids))), tuple(ids)), [labels[i] for i in test]
    for name, crf in (("miou", False), ("miou_crf", True)):
        segmenter = DeepLabV2Segmenter(model, classes, size=None, crf=crf)
        begin = time.perf_counter()
        found = segmenter([photos[i] for i in test])
        result[f"{name}_seconds_per_view"] = (time.perf_counter() - begin) / len(test)
        result[name] = mean_iou([segmented.label_ids for segmented in found], truth)
    return result
