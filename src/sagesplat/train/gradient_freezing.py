"""Gaussians that rest by themselves (GSta, Armagan et al. 2025), to compare the freeze of categories with."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

_WATCHED = ("means", "sh0")  # position and base colour, as GSta


@dataclass(eq=False)
class GradientFreezing:
    """Every other stretch of steps, Gaussians whose gradients were among the smallest in the one before rest.

    `share`: those rest whose summed gradient norms lie in this lowest share for position and for colour too.
    """

    share: float
    sums: dict[str, Tensor] = field(default_factory=dict)  # gradient norms [N]; empty while some rest

    def watch(self, grads: Mapping[str, Tensor]) -> None:
        """Add a step's gradients, unless some Gaussians rest."""
        for name in self.sums:
            self.sums[name] += grads[name].flatten(1).norm(dim=1)

    def turn(self, trainable: Tensor) -> Tensor:
        """Bool [N]: who trains in the stretch that begins, of those who may."""
        if not self.sums:
            self.sums = {name: trainable.new_zeros(len(trainable), dtype=torch.float32) for name in _WATCHED}
            return trainable
        norms, self.sums = self.sums, {}
        resting = torch.ones_like(trainable)
        for norm in norms.values():
            if len(norm) != len(trainable) or not trainable.any():  # Gaussians came or went
                return trainable
            known = norm[trainable]
            resting &= norm <= known.kthvalue(max(1, int(self.share * len(known)))).values
        return trainable & ~resting
