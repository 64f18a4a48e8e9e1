"""Gradient-based freezing of Gaussians (GSta, Armagan et al. 2025), the baseline of early stopping."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

_WATCHED = ("means", "sh0")  # position and base colour, as GSta


@dataclass(eq=False)
class GradientFreezing:
    """Freezes the Gaussians with the smallest gradients in alternate windows of steps.

    `share`: frozen are those whose summed gradient norms of the window before are in this lowest fraction,
    for position and for colour.
    """

    share: float
    sums: dict[str, Tensor] = field(
        default_factory=dict
    )  # gradient norms [N]; empty in a window with frozen Gaussians

    def watch(self, grads: Mapping[str, Tensor]) -> None:
        """Add the gradient norms of a step, in windows without frozen Gaussians."""
        for name in self.sums:
            self.sums[name] += grads[name].flatten(1).norm(dim=1)

    def turn(self, trainable: Tensor) -> Tensor:
        """Begin a window; the `trainable` rows (bool [N]) that are not frozen in it."""
        if not self.sums:
            self.sums = {name: trainable.new_zeros(len(trainable), dtype=torch.float32) for name in _WATCHED}
            return trainable
        norms, self.sums = self.sums, {}
        frozen = torch.ones_like(trainable)
        for norm in norms.values():
            if len(norm) != len(trainable) or not trainable.any():  # rows were added or removed
                return trainable
            known = norm[trainable]
            frozen &= norm <= known.kthvalue(max(1, int(self.share * len(known)))).values
        return trainable & ~frozen
