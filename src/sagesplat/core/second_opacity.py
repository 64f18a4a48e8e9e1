"""Two opacities of a Gaussian of nested levels: one for the low levels, one for the full model.

A Gaussian of a low level also covers for those that are not there yet; with these it should not.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

FIRST_UP_TO = 0.3  # share of a category's Gaussians up to which the first opacity holds
_STEPS = 255  # of weights: streams keep them in a byte


@dataclass(frozen=True, eq=False)
class SecondOpacities:
    """The second opacities of N Gaussians; their first ones are `Gaussians.logit_opacities`.

    At level k a Gaussian of a category has the logit `blended(first, second, weights[label_id][k - 1])`.
    """

    logits: Float32[Tensor, " N"]
    weights: Mapping[int, tuple[float, ...]]  # of each level by label id, 0 to 1

    @classmethod
    def of_levels(cls, logits: Tensor, sizes: Mapping[int, Sequence[int]]) -> "SecondOpacities":
        """With the usual weights of levels, given by the Gaussians up to their ends, by label id."""
        return cls(logits, {label: weights_of(ends) for label, ends in sizes.items()})

    def select(self, rows: Tensor) -> "SecondOpacities":
        """Those of some Gaussians (indices or bool [N])."""
        return SecondOpacities(self.logits[rows], self.weights)


def blended(first: Tensor, second: Tensor, weight: float | Tensor) -> Tensor:
    """Logits of opacities between the first and the second ones, by the weight of the second, 0 to 1."""
    return torch.lerp(first, second, weight)


def weight_at(share: np.ndarray) -> Float32[np.ndarray, "..."]:
    """Weight of the second opacity where a share of a category is drawn, linear in the share's logarithm.

    It is 0 up to `FIRST_UP_TO`, and 1 in full.
    """
    return np.clip(1 - np.log(np.maximum(share, 1e-9)) / np.log(FIRST_UP_TO), 0, 1).astype(np.float32)


def weights_of(sizes: Sequence[int]) -> tuple[float, ...]:
    """The weight at each level of a category from the Gaussians up to its end, in steps of 1/255."""
    shares = np.array(sizes, np.float64) / max(sizes[-1], 1)
    return tuple((np.round(weight_at(shares) * _STEPS) / _STEPS).tolist())
