"""Processes that train one model together, a view each: sums and gathers over all of them."""

from dataclasses import dataclass
from typing import Any

import torch.distributed as dist
from torch import Tensor


@dataclass(frozen=True)
class Group:
    """One of `size` processes. With more than one, torch.distributed must be initialised."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process writes files."""
        return self.rank == 0

    def share(self, things: list[Any]) -> list[Any]:
        """The part of a list that falls to this process."""
        return things[self.rank :: self.size]

    def add(self, *tensors: Tensor) -> None:
        """Sum each tensor over all processes, in place."""
        if self.size > 1:
            for tensor in tensors:
                dist.all_reduce(tensor)

    def collect(self, *tensors: Tensor) -> None:
        """Sum each tensor over all processes into the first one's; the others begin again at zero."""
        self.add(*tensors)
        if not self.leads:
            for tensor in tensors:
                tensor.zero_()

    def gather(self, thing: Any) -> list[Any]:
        """What all processes have, by rank."""
        things = [thing] * self.size
        if self.size > 1:
            dist.all_gather_object(things, thing)
        return things


ALONE = Group()
