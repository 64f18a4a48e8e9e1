"""Single training steps, and short trainings of a fixed set of Gaussians."""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from sagesplat.config import TrainConfig
from sagesplat.errors import RunError
from sagesplat.gaussians import Gaussians
from sagesplat.metrics import photometric_loss
from sagesplat.raster import Backend, Render, Workspace, rasterize
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.sh import num_bases
from sagesplat.train.freeze import trainable_rows
from sagesplat.train.optim import adam_step
from sagesplat.train.pace import Pace, smaller
from sagesplat.train.state import TrainState, initial_state


@dataclass(frozen=True, eq=False)
class Stepper:
    """Takes training steps on a state: render one view, compare it with its photo, move the Gaussians."""

    scene: Scene
    photos: Photos
    config: TrainConfig
    backend: Backend = "auto"
    workspace: Workspace = field(default_factory=Workspace)

    def __call__(
        self, state: TrainState, degree: int, rates: dict[str, float], trainable: Tensor, factor: int = 1
    ) -> tuple[float, Render]:
        """One step on a photo `factor` times smaller; the loss, and the render with its gradients."""
        view = self._next_view(state)
        pixels, camera = smaller(self.photos[view], self.scene.views[view].camera, factor)
        photo = torch.from_numpy(pixels).float() / 255
        leaves = {name: p.detach().requires_grad_() for name, p in state.gaussians.parameters().items()}
        render = rasterize(
            replace(state.gaussians, **leaves),
            camera,
            sh_degree=degree,
            antialiased=self.config.antialiased,
            workspace=self.workspace,
            backend=self.backend,
        )
        loss = photometric_loss(render.rgb, photo, self.config.ssim_weight, self.workspace)
        value = float(loss.detach())
        if not np.isfinite(value):
            raise RunError(
                f"the loss became {value} at step {state.step + 1}; lower the learning rates and train again"
            )
        loss.backward()
        state.step += 1
        in_use = 3 * (num_bases(degree) - 1)
        for name, leaf in leaves.items():
            assert leaf.grad is not None
            adam_step(
                leaf.detach().numpy(),
                leaf.grad.numpy(),
                state.first[name].numpy(),
                state.second[name].numpy(),
                lr=rates[name],
                step=state.step,
                trainable=trainable.numpy(),
                columns=in_use if name == "shN" else None,
            )
        return value, render

    def _next_view(self, state: TrainState) -> int:
        """Views in random order, each once a round."""
        if not state.queue:
            state.queue = state.rng.permutation(self.scene.train_ids).tolist()
        return state.queue.pop()


def tune(
    gaussians: Gaussians,
    scene: Scene,
    photos: Photos,
    config: TrainConfig,
    steps: int,
    *,
    seed: int = 0,
    backend: Backend = "auto",
) -> Gaussians:
    """The same Gaussians, trained a little further: none comes, none goes, no reset.

    The rates are those of the last third of a published run of three times `steps`.
    """
    rates = Pace(replace(config, max_steps=3 * steps, pace="published"), scene.extent).rates
    copies = {name: p.detach().clone() for name, p in gaussians.parameters().items()}
    state = initial_state(replace(gaussians, **copies), seed)
    state.sort()
    stepper, everything = Stepper(scene, photos, config, backend), trainable_rows(gaussians, {})
    for step in range(1, steps + 1):
        stepper(state, gaussians.sh_degree, rates(2 * steps + step), everything)
    return state.gaussians
