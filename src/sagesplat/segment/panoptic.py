"""Instances of a photo from the queries of a universal segmentation network."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int16
from torch import Tensor
from torch.nn.functional import interpolate

from sagesplat.segment.instances import NO_INSTANCE

LEAST_SCORE = 0.5  # probability of a query's class
LEAST_OVERLAP = 0.8  # of a mask: what other queries have to leave of it


def instances_of(
    scores: Sequence[tuple[Float32[Tensor, "Q K"], Float[Tensor, "Q h w"]]],
    places: Sequence[tuple[slice, slice]],
    things: Bool[np.ndarray, " K"],
    size: tuple[int, int],
) -> Int16[np.ndarray, "H W"]:
    """The panoptic post-processing of DETR and MaskFormer, of things alone.

    Of the queries whose class is sure, each pixel goes to that of the largest class probability times mask
    probability; a query that keeps less than 0.8 of its mask is no instance.

    Args:
        scores: Of each crop of the photo (most networks take it whole) the class probabilities of queries,
            "no object" left out, and the logits of their masks.
        places: Rows and columns of `size` that each crop covers; an earlier one wins where they overlap.
        things: The classes that are countable.
        size: Height and width of the photo.

    Returns:
        Numbers of instances, -1 where there is none. An object in two crops has two.
    """
    found, count = np.full(size, NO_INSTANCE, np.int16), 0
    for (weights, logits), place in zip(scores, places, strict=True):
        score, best = weights.max(1)
        kept = torch.nonzero(score >= LEAST_SCORE)[:, 0]
        if not len(kept):
            continue
        height, width = (s.stop - s.start for s in place)
        masks = interpolate(logits[kept].float()[None], (height, width), mode="bilinear")[0].sigmoid()
        owner = (masks * score[kept, None, None]).argmax(0).cpu().numpy()
        inside = (masks >= 0.5).cpu().numpy()
        view = found[place]
        for row, query in enumerate(kept.tolist()):
            mine = inside[row] & (owner == row)
            if things[int(best[query])] and mine.sum() >= LEAST_OVERLAP * inside[row].sum() and mine.any():
                view[mine & (view == NO_INSTANCE)] = count
                count += 1
    return found
