"""What an open-vocabulary network finds in a photo, and the label image that it makes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float32, Int16, Int64, UInt8
from PIL import Image

from sagesplat.segment.masks import UNLABELLED
from sagesplat.segment.segmenters import Segmented

_SAME = 0.7  # intersection over union of two boxes of one prompt, from which on they are the same thing


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of a photo with a score of at least the threshold."""

    prompts: Int64[np.ndarray, " N"]  # row of the prompt that each is for
    scores: Float32[np.ndarray, " N"]  # 0 ... 1
    corners: Float32[np.ndarray, "N 4"]  # left, top, right, bottom, pixels of the photo
    best: Float32[np.ndarray, " P"]  # highest score of each prompt, whether it reached the threshold or not


@dataclass(frozen=True, eq=False)
class Found:
    """Masks of a photo with a score of at least the threshold."""

    prompts: Int64[np.ndarray, " N"]  # row of the prompt that each is for
    scores: Float32[np.ndarray, " N"]  # 0 ... 1
    masks: Float32[np.ndarray, "N h w"]  # logits, above 0 inside; they cover the whole photo
    best: Float32[np.ndarray, " P"]  # highest score of each prompt, whether it reached the threshold or not
    things: bool = True  # whether each mask is one thing, so that it can be counted


class Finder(Protocol):
    """Finds the prompts that it was made for."""

    threshold: float  # least score, 0 ... 1

    def __call__(self, photo: UInt8[np.ndarray, "H W 3"], /) -> Found:
        """What is in a photo."""
        ...


def without_duplicates(boxes: Boxes) -> Boxes:
    """Non-maximum suppression: of boxes for one prompt that overlap closely, the one with the highest score.

    The rest come back by falling score.
    """
    kept: list[int] = []
    for row in np.argsort(-boxes.scores, kind="stable").tolist():
        same = [other for other in kept if boxes.prompts[other] == boxes.prompts[row]]
        if not (_overlap(boxes.corners[row], boxes.corners[same]) > _SAME).any():
            kept.append(row)
    return Boxes(boxes.prompts[kept], boxes.scores[kept], boxes.corners[kept], boxes.best)


def _overlap(box: Float32[np.ndarray, " 4"], others: Float32[np.ndarray, "N 4"]) -> Float32[np.ndarray, " N"]:
    """Intersection over union of a box with others."""
    inner = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    shared = inner.clip(0).prod(1)
    areas = (box[2:] - box[:2]).prod() + (others[:, 2:] - others[:, :2]).prod(1)
    return shared / np.maximum(areas - shared, 1e-6)


def confidence(scores: Float32[np.ndarray, "*S"], threshold: float) -> Float32[np.ndarray, "*S"]:
    """Scores of a network as probabilities: the threshold is 0.5, a score of 1 is 1, linear between them.

    A detector's score means little but whether it reaches its threshold, which differs from one to the next.
    """
    return (0.5 + 0.5 * (scores - threshold) / max(1 - threshold, 1e-6)).clip(0, 1).astype(np.float32)


def segmented(found: Found, label_ids: Sequence[int], threshold: float, size: tuple[int, int]) -> Segmented:
    """The label image (height, width) of what was found, by the id of each prompt.

    A pixel belongs to the mask that it is in; of several, to the one where confidence times the mask's
    probability is largest; without any it is unlabelled. Each mask's pixels are an instance, numbered by
    falling score.
    """
    sure = confidence(found.scores, threshold)
    height, width = size
    best = np.zeros(size, np.float32)
    winner = np.full(size, UNLABELLED, np.int16)
    order = np.argsort(-found.scores, kind="stable")
    for number, row in enumerate(order.tolist()):
        logits = found.masks[row]
        if logits.shape != size:
            logits = np.asarray(Image.fromarray(logits).resize((width, height), Image.Resampling.BILINEAR))
        value = sure[row] * (1 / (1 + np.exp(-logits.clip(-30, 30))))
        wins = (logits > 0) & (value > best)
        best[wins], winner[wins] = value[wins], number
    ids = np.array([*np.array(label_ids, np.int16)[found.prompts[order]], UNLABELLED], np.int16)
    return Segmented(ids[winner], _renumbered(winner) if found.things else None)


def shared_areas(found: Found, prompts: int) -> Float32[np.ndarray, "P P"]:
    """The share of the photo that the masks of two prompts have in common, and of one with itself."""
    pixels = np.zeros((prompts, *found.masks.shape[1:]), bool)
    for prompt, mask in zip(found.prompts.tolist(), found.masks, strict=True):
        pixels[prompt] |= mask > 0
    flat = pixels.reshape(prompts, -1).astype(np.float32)
    return flat @ flat.T / max(flat.shape[1], 1)


def painted_over(base: Segmented, top: Segmented) -> Segmented:
    """`top` where it has a label, else `base`."""
    has = top.label_ids != UNLABELLED
    label_ids = np.where(has, top.label_ids, base.label_ids)
    instances = top.instances
    if base.instances is not None:
        above = np.full_like(base.instances, -1) if instances is None else instances
        below = np.where(base.instances < 0, -1, base.instances + above.max() + 1)
        instances = _renumbered(np.where(has, above, below).astype(np.int16))
    return Segmented(label_ids, instances)


def _renumbered(numbers: Int16[np.ndarray, "H W"]) -> Int16[np.ndarray, "H W"]:
    """The same with 0, 1, ... for the numbers that occur; -1 stays."""
    present = np.unique(numbers[numbers >= 0])
    return np.where(numbers >= 0, np.searchsorted(present, numbers), -1).astype(np.int16)
