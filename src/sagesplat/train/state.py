"""The training state: all that training changes."""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from sagesplat.core import geometry
from sagesplat.core.gaussians import PARAMETERS, Gaussians, concat
from sagesplat.core.sh import num_bases, rgb_to_sh0
from sagesplat.scene.scene import Points
from sagesplat.segment.lift import IGNORED
from sagesplat.train.view_parameters import ViewParameters

INITIAL_OPACITY = 0.1
SECOND = "second_opacities"  # name of these logits among Adam's moments and gradients


@dataclass(eq=False)
class TrainState:
    """Gaussians, Adam's moments, densification statistics and the order of the views."""

    gaussians: Gaussians
    exp_avg: dict[str, Tensor]  # Adam's moments by parameter name
    exp_avg_sq: dict[str, Tensor]
    grad_sum: Tensor  # [N] summed screen-space gradient norms, half images
    grad_count: Tensor  # [N] times seen
    rng: np.random.Generator
    queue: list[int]  # views still to come in this round
    step: int = 0
    last_reset: int = -1  # step of the last opacity reset, -1 = none yet
    frozen: dict[int, int] = field(default_factory=dict)  # label id -> step from which on it stays as it is
    withheld: int = 0  # Gaussians that stopped categories did not get
    order_share: Tensor | None = None  # [N] of a nested model: share of its category that comes before it
    second_opacities: Tensor | None = None  # [N] logits, of a nested model; moments under SECOND
    per_view: dict[str, ViewParameters] = field(default_factory=dict)  # "pose" and "exposure", if refined

    def replace_rows(self, keep: Tensor, new: Gaussians) -> None:
        """Keep some rows (bool [N]) and append new Gaussians with fresh moments and statistics."""
        assert self.order_share is None, "the rows of a nested model stay"
        kept = self.gaussians.select(keep)
        self.gaussians = concat([kept, new])
        for name in PARAMETERS:
            fresh = torch.zeros_like(getattr(new, name))
            self.exp_avg[name] = torch.cat([self.exp_avg[name][keep], fresh])
            self.exp_avg_sq[name] = torch.cat([self.exp_avg_sq[name][keep], fresh])
        self.clear_statistics()

    def sort(self) -> None:
        """Sort rows by Morton code, so that the CPU kernels find neighbours together; nothing on a GPU."""
        if self.gaussians.means.is_cuda:
            return
        order = torch.from_numpy(geometry.morton_order(self.gaussians.means.numpy()))
        self.gaussians = self.gaussians.select(order)
        for moments in (self.exp_avg, self.exp_avg_sq):
            for name in PARAMETERS:
                moments[name] = moments[name][order]
        self.grad_sum, self.grad_count = self.grad_sum[order], self.grad_count[order]
        if self.order_share is not None:
            self.order_share = self.order_share[order]

    def add_second_opacities(self, logits: Tensor | None = None) -> None:
        """Give every Gaussian a second opacity; None: to begin with its first one."""
        self.second_opacities = self.gaussians.logit_opacities.clone() if logits is None else logits
        for moments in (self.exp_avg, self.exp_avg_sq):
            moments[SECOND] = torch.zeros_like(self.second_opacities)

    def clear_statistics(self) -> None:
        """Reset the densification statistics to zero."""
        self.grad_sum = self.gaussians.means.new_zeros(len(self.gaussians))
        self.grad_count = self.grad_sum.clone()

    def to(self, device: torch.device) -> "TrainState":
        """The same on a device; tensors that are there already are shared."""
        exp_avg, exp_avg_sq = (
            {name: m.to(device) for name, m in moments.items()} for moments in (self.exp_avg, self.exp_avg_sq)
        )
        return replace(
            self, gaussians=self.gaussians.to(device), exp_avg=exp_avg, exp_avg_sq=exp_avg_sq,
            grad_sum=self.grad_sum.to(device), grad_count=self.grad_count.to(device),
            order_share=None if self.order_share is None else self.order_share.to(device),
            second_opacities=None if self.second_opacities is None else self.second_opacities.to(device),
            per_view={name: parameters.to(device) for name, parameters in self.per_view.items()},
        )  # fmt: skip


def from_points(
    points: Points,
    label_ids: np.ndarray,
    sh_degree: int,
    opacity: float = INITIAL_OPACITY,
    scale: float = 1.0,
) -> Gaussians:
    """Gaussians at the SfM points: isotropic, scale `scale` times the mean distance to three neighbours.

    There is none at the points labelled `IGNORED`, which show what does not belong to the scene.
    """
    kept = label_ids != IGNORED
    xyz, label_ids = points.xyz[kept], label_ids[kept]
    n = len(xyz)
    scales = scale * geometry.mean_neighbour_distance(xyz)
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    rgb = torch.from_numpy(points.rgb[kept].astype(np.float32) / 255)
    return Gaussians(
        means=torch.from_numpy(xyz),
        quats=quats,
        log_scales=torch.from_numpy(np.log(scales))[:, None].repeat(1, 3),
        logit_opacities=torch.full((n,), float(np.log(opacity / (1 - opacity)))),
        sh0=rgb_to_sh0(rgb)[:, None, :].contiguous(),
        shN=torch.zeros(n, num_bases(sh_degree) - 1, 3),
        label_ids=torch.from_numpy(label_ids.astype(np.int16)),
    )


def initial_state(gaussians: Gaussians, seed: int) -> TrainState:
    """A state before the first step."""
    exp_avg, exp_avg_sq = (
        {name: torch.zeros_like(p) for name, p in gaussians.parameters().items()} for _ in range(2)
    )
    zeros = torch.zeros(len(gaussians))
    return TrainState(gaussians, exp_avg, exp_avg_sq, zeros, zeros.clone(), np.random.default_rng(seed), [])
