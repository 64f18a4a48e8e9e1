"""Parameters that every view has of its own (pose, exposure), and Adam for one view at a time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

_B1, _B2, _EPS = 0.9, 0.999, 1e-15  # Adam's


@dataclass(eq=False)
class ViewParameters:
    """D parameters for each of V views, with Adam's moments and the number of updates of each view.

    A view is updated only in the steps that draw it: its own count corrects the bias of its moments.
    """

    values: Float32[Tensor, "V D"]
    exp_avg: Float32[Tensor, "V D"]
    exp_avg_sq: Float32[Tensor, "V D"]
    counts: Int64[Tensor, " V"]

    @classmethod
    def zeros(cls, views: int, size: int) -> "ViewParameters":
        """Zeros for `views` views of `size` parameters, before the first update."""
        values, exp_avg, exp_avg_sq = (torch.zeros(views, size) for _ in range(3))
        return cls(values, exp_avg, exp_avg_sq, torch.zeros(views, dtype=torch.int64))

    def adam_step(
        self,
        views: Sequence[int],
        grad: Float32[Tensor, "R D"],
        lr: float | Tensor,
        *,
        joint: bool = False,
    ) -> None:
        """One Adam step on R different views.

        Args:
            views: Rows.
            grad: Their gradients.
            lr: A number, or a tensor that broadcasts to [R, D].
            joint: The parameters of a view share their second moment: a step keeps the gradient's direction.
        """
        rows = torch.tensor(views, device=self.values.device)
        self.counts[rows] += 1
        unbiased1, unbiased2 = (
            (1 - b ** self.counts[rows][:, None].double()).to(grad.dtype) for b in (_B1, _B2)
        )
        m = _B1 * self.exp_avg[rows] + (1 - _B1) * grad
        squares = (grad * grad).mean(1, keepdim=True).expand_as(grad) if joint else grad * grad
        v = _B2 * self.exp_avg_sq[rows] + (1 - _B2) * squares
        self.exp_avg[rows], self.exp_avg_sq[rows] = m, v
        self.values[rows] -= lr * (m / unbiased1) / ((v / unbiased2).sqrt() + _EPS)

    def to(self, device: torch.device) -> "ViewParameters":
        """The same on a device; tensors that are there already are shared."""
        names = ("values", "exp_avg", "exp_avg_sq", "counts")
        return replace(self, **{name: getattr(self, name).to(device) for name in names})


class ViewUpdate(Protocol):
    """Updates one kind of parameters of the views, a value of `Stepper.view_updates`."""

    size: ClassVar[int]  # D of its `ViewParameters`

    @property
    def first_step(self) -> int:
        """The step from which on gradients of the parameters are taken."""
        ...

    def __call__(
        self, parameters: ViewParameters, views: Sequence[int], grad: Float32[Tensor, "R D"], step: int
    ) -> None:
        """Update the parameters of the views of a step from their gradients; also fixes the gauge."""


class ViewGradients:
    """The gradients that one step finds for the parameters of its views."""

    def __init__(self, parameters: Mapping[str, ViewParameters], views: Sequence[int]) -> None:
        self.parameters = parameters
        self.views = sorted(set(views))
        self.grads = {name: torch.zeros_like(p.values[: len(self.views)]) for name, p in parameters.items()}

    def leaves(self, view: int) -> dict[str, Tensor]:
        """Copies of the view's parameters by kind, which take gradients, to be used in its loss."""
        return {name: p.values[view].clone().requires_grad_() for name, p in self.parameters.items()}

    def add(self, view: int, leaves: Mapping[str, Tensor]) -> None:
        """Take up the gradients of a view's leaves."""
        for name, leaf in leaves.items():
            if leaf.grad is not None:
                self.grads[name][self.views.index(view)] += leaf.grad

    def update(self, updates: Mapping[str, ViewUpdate], step: int) -> None:
        """Update the parameters of the step's views."""
        for name, parameters in self.parameters.items():
            updates[name](parameters, self.views, self.grads[name], step)
