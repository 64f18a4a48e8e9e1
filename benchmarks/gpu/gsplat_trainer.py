"""gsplat's example trainer with its defaults, on gsplat's public API: what ours is raced against.

Written anew after the documentation of gsplat 1.5.3 (Apache-2.0); the rates, the order of operations and the
schedule are those of its `examples/simple_trainer.py`, which the wheel does not hold: DefaultStrategy, Adam
`fused`, one for each parameter, rates of 3DGS, the means' falling to a hundredth, a degree of harmonics each
1000 steps, `packed=False`, near 0.01, far 1e10, loss 0.8 L1 + 0.2 (1 - SSIM). What it does beside training is
left out, in its favour: the data loader (photos lie on the GPU as floats), the progress bar, which waits for
the loss at every step, and tensorboard; and its loss is our fused one, as a slow SSIM must not decide a race.
With `cap` it is that example's `mcmc` setting.

1.5.3's strategy never resets opacities: `step % reset_every == 0 & step > 0` is never true. It is raced as
it is.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import Gaussians
from sagesplat.metrics.image import SSIM_WEIGHT, photometric_loss
from sagesplat.scene.scene import Camera
from sagesplat.train.densify import PRUNE_OPACITY
from sagesplat.train.lr_schedule import PUBLISHED_RATES
from sagesplat.train.strategy import schedule_of

NAMES = {  # gsplat's name: ours
    "means": "means", "scales": "log_scales", "quats": "quats", "opacities": "logit_opacities",
    "sh0": "sh0", "shN": "shN",
}  # fmt: skip


def train(
    initial: Gaussians,  # on the device
    cameras: Sequence[Camera],
    photos: Sequence[Tensor],  # float32 [H, W, 3] in [0, 1], on the device
    extent: float,
    config: TrainConfig,  # of ours: its steps and thresholds are used
    seed: int = 0,
    cap: int = 0,  # Gaussians of 3DGS-MCMC; 0: its default strategy
) -> Iterator[tuple[int, Gaussians]]:
    """Train; steps taken and the Gaussians, each `level_every` steps of our schedule and at the end."""
    import gsplat
    from gsplat.strategy import DefaultStrategy, MCMCStrategy

    device, plan = initial.means.device, schedule_of(replace(config, lr_schedule="published"))
    params: dict[str, Any] = {
        name: torch.nn.Parameter(getattr(initial, ours).detach().clone()) for name, ours in NAMES.items()
    }
    if cap:
        params["opacities"].data.zero_()  # 0.5
        params["scales"].data += math.log(0.1)
    rates = {name: PUBLISHED_RATES[ours] for name, ours in NAMES.items()}
    rates["means"] *= extent
    optimizers: dict[str, torch.optim.Optimizer] = {
        name: torch.optim.Adam([{"params": p, "lr": rates[name], "name": name}], eps=1e-15, fused=True)
        for name, p in params.items()
    }
    slower = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], 0.01 ** (1 / config.max_steps))
    strategy: Any = MCMCStrategy(
        cap_max=cap, refine_start_iter=plan.refine_start, refine_stop_iter=config.max_steps * 5 // 6,
        refine_every=config.refine_every,
    ) if cap else DefaultStrategy(
        prune_opa=PRUNE_OPACITY, grow_grad2d=config.grow_grad, grow_scale3d=0.01,
        prune_scale3d=0.1, refine_start_iter=plan.refine_start,
        refine_stop_iter=plan.refine_stop, reset_every=plan.reset_every, refine_every=config.refine_every,
    )  # fmt: skip
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state() if cap else strategy.initialize_state(scene_scale=extent)
    poses, Ks = (
        torch.stack([torch.from_numpy(getattr(camera, name)) for camera in cameras]).to(device)
        for name in ("w2c", "K")
    )
    generator, queue = torch.Generator().manual_seed(seed), []
    for step in range(config.max_steps):
        if not queue:
            queue = torch.randperm(len(cameras), generator=generator).tolist()
        view = queue.pop()
        camera, photo = cameras[view], photos[view]
        images, _, info = gsplat.rasterization(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
            torch.cat([params["sh0"], params["shN"]], 1), poses[view, None], Ks[view, None],
            camera.width, camera.height, near_plane=0.01, far_plane=1e10, packed=False,
            sh_degree=min(step // plan.raise_sh_every, config.sh_degree),
        )  # fmt: skip
        strategy.step_pre_backward(params, optimizers, state, step, info)
        value = photometric_loss(images[0], photo, SSIM_WEIGHT)
        if cap:  # its regularisation of opacities and scales
            value = value + 0.01 * (params["opacities"].sigmoid().mean() + params["scales"].exp().mean())
        value.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        slower.step()
        more = {"lr": slower.get_last_lr()[0]} if cap else {"packed": False}
        strategy.step_post_backward(params, optimizers, state, step, info, **more)
        done = step + 1
        if done % plan.level_every == 0 or done == config.max_steps:
            yield done, gaussians(params)


def gaussians(params: dict[str, Tensor]) -> Gaussians:
    """gsplat's parameters as Gaussians without categories."""
    tensors: dict[str, Any] = {ours: params[name].detach() for name, ours in NAMES.items()}
    labels = torch.full((len(params["means"]),), -1, dtype=torch.int16, device=params["means"].device)
    return Gaussians(**tensors, label_ids=labels)
