"""Densification strategies: what each does at the points of a training step that the trainer offers.

A new strategy is a class here, an entry of `STRATEGIES` and a name for `--train.strategy`.
"""

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from sagesplat.core.config import TrainConfig
from sagesplat.raster.render import Render
from sagesplat.scene.scene import Scene
from sagesplat.train import densify, mcmc
from sagesplat.train.early_stopping import trainable_rows
from sagesplat.train.group import ALONE, Group
from sagesplat.train.lr_schedule import LrSchedule
from sagesplat.train.schedule import Schedule, scaled_schedule
from sagesplat.train.sky import Shell
from sagesplat.train.state import INITIAL_OPACITY, TrainState


class Strategy:
    """A fixed set of Gaussians: every hook does nothing. Strategies override those that they need."""

    def step_post_backward(self, state: TrainState, render: Render, trainable: Tensor) -> None:
        """After the backward pass of each view: collect statistics. `state.step` steps are complete."""

    def step_pre_update(self, state: TrainState, grads: dict[str, Tensor], trainable: Tensor) -> None:
        """Before Adam's update: change the gradients (by parameter name) in place."""

    def step_post_update(self, state: TrainState, trainable: Tensor) -> None:
        """After Adam's update of step `state.step`: change the parameters in place."""

    def step_post(self, state: TrainState) -> bool:
        """After step `state.step`: densify when the schedule says so; whether rows were added or moved."""
        return False


@dataclass(frozen=True, eq=False)
class Densification(Strategy):
    """What the strategies that change the set of Gaussians have in common."""

    initial_opacity: ClassVar[float] = INITIAL_OPACITY
    initial_scale: ClassVar[float] = 1.0  # times that of 3DGS: the mean distance to three neighbours

    config: TrainConfig
    scene: Scene
    schedule: Schedule
    rates: LrSchedule
    group: Group = ALONE
    shell: Shell | None = None  # of the sky

    @classmethod
    def schedule_of(cls, config: TrainConfig) -> Schedule:
        """The step numbers of a training with this strategy."""
        return scaled_schedule(config, config.refine_stop)

    @classmethod
    def max_count(cls, config: TrainConfig, num_pixels: int, num_points: int) -> int:
        """How many Gaussians there can be at most, for photos of `num_pixels` and `num_points` SfM points."""
        return densify.cap(config, num_pixels, num_points)

    @property
    def num_pixels(self) -> int:
        """Pixels of a photo at full size."""
        camera = self.scene.views[0].camera
        return camera.width * camera.height

    @property
    def num_points(self) -> int:
        """SfM points that the training starts from."""
        return len(self.scene.points.xyz)

    def step_post(self, state: TrainState) -> bool:
        """Refine every `refine_every` steps while densification is active; see `Strategy`."""
        step = state.step
        refines = self.schedule.refines(step) and step % self.config.refine_every == 0
        if refines:
            self.refine(state, trainable_rows(state.gaussians, state.frozen))
            state.sort()
        return refines

    def _near(self, state: TrainState, trainable: Tensor) -> Tensor:
        """Those of the `trainable` rows (bool [N]) that are not on the shell."""
        return trainable & ~self.shell.holds(state.gaussians.means) if self.shell else trainable

    def refine(self, state: TrainState, trainable: Tensor) -> None:
        """Add, move and remove Gaussians, of the `trainable` rows (bool [N]) only."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class DefaultStrategy(Densification):
    """Adaptive density control of 3DGS: clone, split, prune, and reset opacities."""

    @classmethod
    def max_count(cls, config: TrainConfig, num_pixels: int, num_points: int) -> int:
        """See `Densification`; the resolution of the photos sets a limit too."""
        schedule = cls.schedule_of(config)
        return densify.budget(config, schedule, schedule.refine_stop, num_pixels, num_pixels, num_points)

    def step_post_backward(self, state: TrainState, render: Render, trainable: Tensor) -> None:
        """Add the screen-space gradients of a view to the statistics, until densification ends."""
        if state.step + 1 < self.schedule.refine_stop:
            height, width, _ = render.rgb.shape
            densify.observe_gradients(state, render, width, height, trainable)

    def refine(self, state: TrainState, trainable: Tensor) -> None:
        """Clone, split and prune, within the budget of the step."""
        pixels_now = self.num_pixels // self.rates.factor(state.step) ** 2
        budget = densify.budget(
            self.config, self.schedule, state.step, self.num_pixels, pixels_now, self.num_points
        )
        self.group.add(state.grad_sum, state.grad_count)
        room = densify.room(state, budget, trainable)
        densify.refine(state, self.config, self.scene.extent, room, trainable, self.shell)

    def step_post(self, state: TrainState) -> bool:
        """Refine, then reset opacities; see `Strategy`."""
        refined = super().step_post(state)
        if self.schedule.resets(state.step):
            trainable = trainable_rows(state.gaussians, state.frozen)
            # nothing on the shell stands before anything, and what no photo shows would never come back
            densify.reset_opacities(state, self._near(state, trainable))
        return refined


@dataclass(frozen=True, eq=False)
class McmcStrategy(Densification):
    """3DGS-MCMC: SGLD noise, relocation of dead Gaussians, and growth by a share of the present count."""

    initial_opacity: ClassVar[float] = 0.5
    initial_scale: ClassVar[float] = 0.1

    @classmethod
    def schedule_of(cls, config: TrainConfig) -> Schedule:
        """See `Densification`; refinement ends at 25,000 of 30,000 steps, as published."""
        return scaled_schedule(config, max(config.refine_stop, mcmc.REFINE_STOP))

    def step_pre_update(self, state: TrainState, grads: dict[str, Tensor], trainable: Tensor) -> None:
        """Add the gradients of the regularisation of opacities and scales."""
        if self.config.max_steps >= mcmc.REGULARISED_FROM:
            near = self._near(state, trainable)
            scale = mcmc.SCALE_WEIGHT / self.scene.extent
            mcmc.add_regularisation_gradients(state, grads, mcmc.OPACITY_WEIGHT, scale, near)

    def step_post_update(self, state: TrainState, trainable: Tensor) -> None:
        """Add SGLD noise to the means."""
        mcmc.perturb(state, self.rates.sgld_noise(state.step), self._near(state, trainable))

    def refine(self, state: TrainState, trainable: Tensor) -> None:
        """Relocate dead Gaussians, then add new ones up to the cap."""
        most = densify.cap(self.config, self.num_pixels, self.num_points)
        refinements = (self.schedule.refine_stop - self.schedule.refine_start) // self.config.refine_every
        mcmc.relocate(state, trainable)
        growth = mcmc.growth(most, self.num_points, refinements)
        mcmc.add(state, most, trainable, growth)


STRATEGIES: dict[str, type[Densification]] = {"default": DefaultStrategy, "mcmc": McmcStrategy}


def make_strategy(
    config: TrainConfig, scene: Scene, rates: LrSchedule, group: Group = ALONE, shell: Shell | None = None
) -> Densification:
    """The strategy that `config.strategy` names, for one training."""
    kind = STRATEGIES[config.strategy]
    return kind(config, scene, kind.schedule_of(config), rates, group, shell)


def schedule_of(config: TrainConfig) -> Schedule:
    """The step numbers of a training with `config`."""
    return STRATEGIES[config.strategy].schedule_of(config)
