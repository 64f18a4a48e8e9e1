"""Single training steps, and short trainings of a fixed set of Gaussians."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.second_opacity import blended
from sagesplat.formats.quantisation import rounded
from sagesplat.metrics.image import photometric_loss
from sagesplat.raster import Backend, Render, Workspace, device_of, expose, rasterize
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera, Scene
from sagesplat.segment.valid import ALL_VALID, ValidPixels
from sagesplat.train import optim, rate
from sagesplat.train.early_stopping import ActiveTiles, trainable_rows
from sagesplat.train.exposure import transform
from sagesplat.train.group import ALONE, Group
from sagesplat.train.lr_schedule import LrSchedule
from sagesplat.train.outliers import OutlierSchedule, inliers
from sagesplat.train.photo_loader import PhotoLoader
from sagesplat.train.poses import PoseUpdate, moved_camera
from sagesplat.train.sky import Shell
from sagesplat.train.state import SECOND, TrainState, initial_state
from sagesplat.train.strategy import Strategy
from sagesplat.train.view_parameters import ViewGradients, ViewUpdate

FINISHED_SHARE = 1 / 8  # of the rounds include a view whose categories have all stopped; it is drawn in full


@dataclass(eq=False)
class Stepper:
    """Takes training steps on a state: render views, compare them with their photos, update the Gaussians."""

    photo_loader: PhotoLoader
    config: TrainConfig
    active_tiles: ActiveTiles
    backend: Backend = "auto"
    group: Group = ALONE
    strategy: Strategy = field(default_factory=Strategy)  # without one the set of Gaussians is fixed
    sh_bits: tuple[int, int] | None = None  # render Gaussians rounded as SPZ files will store them
    rate_weight: float = 0.0  # loss per bit that the harmonics of a Gaussian take, rounded so
    view_updates: Mapping[str, ViewUpdate] = field(default_factory=dict)  # of `TrainState.per_view`
    outliers: OutlierSchedule | None = None  # when those of the photos are left out; None: never
    shell: Shell | None = None  # that Gaussians of the sky stay on
    sky: Tensor | None = None  # bool [N], which do, of a fixed set; None: looked up in each step
    drawn: float = 1.0  # share of the tiles that the last step drew
    workspace: Workspace = field(default_factory=Workspace)

    def __call__(
        self,
        state: TrainState,
        degree: int,
        learning_rates: Mapping[str, float],
        trainable: Tensor,
        factor: int = 1,
        drawn_rows: Tensor | None = None,
        second_weights: Tensor | None = None,
    ) -> Tensor:
        """Take one step; returns its loss (a scalar on the device, mean over the batch).

        Args:
            state: Changed in place; its `step` is one more afterwards.
            degree: Degree of the harmonics in use.
            learning_rates: Adam's, by parameter name.
            trainable: Bool [N]; the other rows keep every bit.
            factor: Train on photos this many times smaller.
            drawn_rows: Indices of the Gaussians to render, in a fixed set; the others take no part in this
                step.
            second_weights: [N], of `state.second_opacities` in this step's opacities; None: 0.
        """
        batch = max(self.config.batch, self.group.size)
        of_batch = [self._next_view(state) for _ in range(batch)]
        views = self.group.share(of_batch)
        refined = [n for n, update in self.view_updates.items() if update.first_step <= state.step + 1]
        of_views = ViewGradients({name: state.per_view[name] for name in refined}, of_batch)
        if state.queue:
            self.photo_loader.expect(state.queue[-1 - self.group.rank % len(state.queue)], factor)
        shown = self._shown(state.gaussians, drawn_rows)
        leaves = {name: p.detach().requires_grad_() for name, p in shown.parameters().items()}
        moving = replace(shown, **leaves)
        if second_weights is not None:
            moving = _with_second(moving, leaves, state, second_weights, drawn_rows)
        losses: list[Tensor] = []
        self.drawn = 0.0
        grads: dict[str, Tensor] = {}
        for view in views:
            own = of_views.leaves(view)
            loss, render = self._draw(moving, view, degree, trainable, factor, own, state.step)
            loss.backward()
            of_views.add(view, own)
            losses.append(loss.detach())
            self.strategy.step_post_backward(state, render, trainable)
            for name, leaf in leaves.items():
                assert leaf.grad is not None
                if name in grads:
                    grads[name] += leaf.grad
                else:  # the workspace lends its memory until the next view comes
                    grads[name] = leaf.grad.clone() if len(views) > 1 else leaf.grad
                leaf.grad = None
        self.drawn /= len(views)
        total = torch.stack(losses).sum()
        if batch > 1:
            self.group.add(total, *grads.values(), *of_views.grads.values())
            grads = {name: grad / batch for name, grad in grads.items()}
        if self.sh_bits and self.rate_weight:
            rate.add_gradient(grads["shN"], state.gaussians.shN, self.sh_bits, self.rate_weight, drawn_rows)
        state.step += 1
        self.strategy.step_pre_update(state, grads, trainable)
        scaled = {name: rate * math.sqrt(batch) for name, rate in learning_rates.items()}
        sky, before = self._on_shell(state, trainable, drawn_rows)
        optim.update(state, grads, scaled, degree, trainable, second_weights, drawn_rows)
        of_views.update(self.view_updates, state.step)
        self.strategy.step_post_update(state, trainable)
        if self.shell:
            self.shell.step(state.gaussians.means, before, sky)
        return total / batch

    def camera(self, state: TrainState, view: int) -> Camera:
        """A view's camera with what is refined of it so far."""
        camera, update = self.photo_loader.scene.views[view].camera, self.view_updates.get("pose")
        if "exposure" in self.view_updates:
            exposure = transform(state.per_view["exposure"].values[view]).cpu().numpy()
            camera = replace(camera, exposure=exposure)
        if not isinstance(update, PoseUpdate):
            return camera
        return moved_camera(camera, update.motion(view, state.per_view["pose"].values[view]))

    def stop(self, frozen: Collection[int]) -> None:
        """From now on, skip tiles that show nothing but the categories `frozen` (label ids)."""
        if len(frozen) > len(self.active_tiles.frozen):
            self.active_tiles = replace(self.active_tiles, frozen=frozenset(frozen))

    def _shown(self, g: Gaussians, rows: Tensor | None) -> Gaussians:
        """The Gaussians that a step renders, with the values that it renders."""
        if self.sh_bits:
            return rounded(g, self.sh_bits, rows)
        return g if rows is None else g.select(rows)

    def _on_shell(self, state: TrainState, trainable: Tensor, drawn: Tensor | None) -> tuple[Tensor, Tensor]:
        """Indices of the Gaussians of the sky that a step may move, and their means before it."""
        means = state.gaussians.means
        if not self.shell:
            return trainable.new_zeros(0, dtype=torch.int64), means[:0]
        sky = (self.shell.holds(means) if self.sky is None else self.sky) & trainable
        rows = torch.nonzero(sky)[:, 0] if drawn is None else drawn[sky[drawn]]
        return rows, means[rows]

    def _draw(
        self,
        moving: Gaussians,
        view: int,
        degree: int,
        trainable: Tensor,
        factor: int,
        own: Mapping[str, Tensor],  # parameters of this view alone, by kind
        step: int,
    ) -> tuple[Tensor, Render]:
        photo, camera = self.photo_loader(view, factor)
        # nobody may paint over what is finished, so it is looked at now and then
        finished, left = self.active_tiles.finished(view), self.active_tiles.tiles(view, factor)
        self.drawn += 1.0 if finished or left is None else float(left.mean())
        tiles = None if finished else self.active_tiles.mask(view, factor)
        pose, update = None, self.view_updates.get("pose")
        if isinstance(update, PoseUpdate) and "pose" in own:
            motion = update.motion(view, own["pose"])
            camera, pose = moved_camera(camera, motion), motion - motion.detach()
        exposure = _exposure(own, camera, photo.device)
        render = rasterize(
            moving,
            camera if camera.exposure is None else camera.neutral,
            sh_degree=degree,
            antialiased=self.config.antialiased,
            tile_mask=tiles,
            trainable=trainable if self.active_tiles.frozen else None,
            pose=pose,
            workspace=self.workspace,
            backend=self.backend,
        )
        rgb = render.rgb if exposure is None else expose(render.rgb, exposure, photo)
        valid = self.photo_loader.valid(view, factor)
        if self.outliers is not None and self.outliers(step):
            valid = inliers(rgb, photo, valid, tiles)
        loss = photometric_loss(rgb, photo, tile_mask=tiles, workspace=self.workspace, valid=valid)
        return loss, render

    def _next_view(self, state: TrainState) -> int:
        """Views in random order, each once a round; finished ones in a round out of eight."""
        while not state.queue:
            state.queue = [
                view
                for view in state.rng.permutation(self.photo_loader.rows).tolist()
                if not self.active_tiles.finished(view) or state.rng.random() < FINISHED_SHARE
            ]
        return state.queue.pop()


def _exposure(own: Mapping[str, Tensor], camera: Camera, device: torch.device) -> Tensor | None:
    """The colour transform of a view: the one that is learned, else its camera's, else none."""
    if "exposure" in own:
        return transform(own["exposure"])
    return None if camera.exposure is None else torch.from_numpy(camera.exposure).to(device)


def _with_second(
    g: Gaussians, leaves: dict[str, Tensor], state: TrainState, weights: Tensor, rows: Tensor | None
) -> Gaussians:
    """`g`, the rows of a state, with opacities blended with the second ones, which join the leaves."""
    assert state.second_opacities is not None
    second, weights = (t if rows is None else t[rows] for t in (state.second_opacities, weights))
    leaves[SECOND] = second.detach().requires_grad_()
    return replace(g, logit_opacities=blended(g.logit_opacities, leaves[SECOND], weights))


def tune(
    gaussians: Gaussians,
    scene: Scene,
    photos: Photos,
    config: TrainConfig,
    steps: int,
    *,
    valid: ValidPixels = ALL_VALID,
    seed: int = 0,
    backend: Backend = "auto",
    shell: Shell | None = None,
) -> Gaussians:
    """Train a fixed set of Gaussians for `steps` more steps; returns the result on the CPU.

    Learning rates are those of the last third of a published run of three times `steps`.
    """
    config = replace(config, batch=1)
    learning_rates = LrSchedule(
        replace(config, max_steps=3 * steps, lr_schedule="published"), scene.extent
    ).learning_rates
    device = device_of(backend)
    copies = {name: p.detach().clone() for name, p in gaussians.parameters().items()}
    state = initial_state(replace(gaussians, **copies).to(device), seed)
    state.sort()
    loader = PhotoLoader(scene, photos, device, valid)
    stepper = Stepper(loader, config, ActiveTiles(scene, None), backend, shell=shell)
    trainable = trainable_rows(state.gaussians, {})
    for step in range(1, steps + 1):
        stepper(state, gaussians.sh_degree, learning_rates(2 * steps + step), trainable)
    return state.gaussians.to("cpu")
