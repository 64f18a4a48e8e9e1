"""Densification strategies: the registry, and when each hook acts."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
import torch
from conftest import random_gaussians, write_capture

from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import PARAMETERS
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.train import schedule
from sagesplat.train.events import LevelSaved, Trained
from sagesplat.train.lr_schedule import LrSchedule
from sagesplat.train.state import TrainState, initial_state
from sagesplat.train.strategy import STRATEGIES, Densification, make_strategy, schedule_of
from sagesplat.train.trainer import train

# densification from step 60 to 150, every 10 steps
CONFIG = TrainConfig(max_steps=300, refine_every=10, lr_schedule="published", grow_grad=0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return write_capture(tmp_path_factory.mktemp("cloud"), random_gaussians(40, seed=3, degree=0))


def state_at(step: int) -> TrainState:
    state = initial_state(random_gaussians(30, degree=0), seed=0)
    state.step, state.grad_sum, state.grad_count = step, torch.ones(30), torch.ones(30)
    return state


def parameters(state: TrainState) -> list[torch.Tensor]:
    return [getattr(state.gaussians, name).clone() for name in PARAMETERS]


def same(before: list[torch.Tensor], state: TrainState) -> bool:
    return all(torch.equal(a, b) for a, b in zip(before, parameters(state), strict=True))


def made(scene: Scene, name: str, **options: Any) -> Densification:
    config = replace(CONFIG, strategy=name, **options)
    return make_strategy(config, scene, LrSchedule(config, scene.extent))


@pytest.mark.parametrize("name", STRATEGIES)
@pytest.mark.parametrize(
    ("step", "refines"), [(60, False), (65, False), (70, True), (140, True), (290, False)]
)
def test_refinement_follows_the_schedule(scene: Scene, name: str, step: int, refines: bool) -> None:
    state = state_at(step)
    before = parameters(state)
    assert made(scene, name, max_gaussians=1000).step_post(state) is refines
    assert same(before, state) is not refines


def test_statistics_are_collected_until_densification_ends(scene: Scene) -> None:
    strategy = made(scene, "default")
    stop = strategy.schedule.refine_stop
    assert stop == 150
    means2d = torch.zeros(30, 2)
    means2d.grad = torch.ones(30, 2)
    render: Any = SimpleNamespace(means2d=means2d, radii=torch.ones(30), rgb=torch.zeros(8, 8, 3))
    for done, count in ((stop - 2, 2), (stop - 1, 1)):  # in step 149 and in step 150
        state = state_at(done)
        strategy.step_post_backward(state, render, torch.ones(30, dtype=torch.bool))
        assert (state.grad_count == count).all()


def test_opacities_are_reset_for_categories_that_still_train(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(schedule, "_MIN_RESET_INTERVAL", 40)
    strategy = made(scene, "default", refine_stop=30_000, refine_every=1000)
    assert [step for step in range(300) if strategy.schedule.resets(step)] == [
        80,
        120,
        160,
        200,
        240,
        280,
    ]
    state = state_at(80)
    state.frozen = {3: 7}
    frozen = state.gaussians.label_ids == 3
    before = state.gaussians.logit_opacities.clone()
    assert not strategy.step_post(state)
    after = state.gaussians.logit_opacities
    assert torch.equal(after[frozen], before[frozen])
    assert after[~frozen].sigmoid().max() <= 0.0101
    assert state.last_reset == 80


def test_mcmc_regularises_and_adds_noise(scene: Scene) -> None:
    strategy, state, everything = made(scene, "mcmc"), state_at(5), torch.ones(30, dtype=torch.bool)
    grads = {name: torch.zeros_like(p) for name, p in state.gaussians.parameters().items()}
    strategy.step_pre_update(state, grads, everything)
    assert not any(grad.any() for grad in grads.values())  # in a short training it costs quality
    strategy = replace(strategy, config=replace(strategy.config, max_steps=30_000))
    strategy.step_pre_update(state, grads, everything)
    assert {name for name, grad in grads.items() if grad.any()} == {"logit_opacities", "log_scales"}
    means = state.gaussians.means.clone()
    strategy.step_post_update(state, everything)
    assert not torch.equal(state.gaussians.means, means)


@dataclass(frozen=True, eq=False)
class Halving(Densification):
    """Half of the Gaussians vanish at each refinement."""

    initial_opacity: ClassVar[float] = 0.7

    def refine(self, state: TrainState, trainable: torch.Tensor) -> None:
        keep = torch.arange(len(state.gaussians)) % 2 == 0
        state.replace_rows(keep, state.gaussians.select(torch.zeros(len(keep), dtype=torch.bool)))


def test_a_new_strategy_is_one_entry(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(STRATEGIES, "halving", Halving)
    monkeypatch.setattr(
        "sagesplat.train.trainer.check_limits", lambda *_: None
    )  # knows the names of the package
    config: Any = replace(CONFIG, max_steps=40, level_every=15, refine_stop=24_000)
    config = replace(config, strategy="halving")  # type: ignore[arg-type]
    assert schedule_of(config).refine_stop == 32
    labels = torch.full((40,), 3).numpy()
    events = list(train(scene, Photos(scene.views), labels, config))
    counts = [sum(event.counts.values()) for event in events if isinstance(event, LevelSaved)]
    assert counts == [20, 10, 5]  # a level is recorded before the refinement of its step
    assert isinstance(events[-1], Trained)
