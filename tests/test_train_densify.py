"""Adaptive density control: who grows, who goes, and who inherits what."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import random_gaussians

from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import PARAMETERS
from sagesplat.raster.render import Render
from sagesplat.train import densify
from sagesplat.train.schedule import Schedule
from sagesplat.train.state import TrainState, initial_state
from sagesplat.train.strategy import schedule_of

CONFIG = TrainConfig()
EXTENT = 10.0  # so that 0.1 divides clones from splits, and more than 1 is huge
ROOM = 1000  # Gaussians that may come
SMALL, LARGE, HUGE = np.log(0.05), np.log(0.5), np.log(5.0)


def state_of(log_sizes: list[float], grads: list[float], opacity: float = 0.5) -> TrainState:
    """One Gaussian per entry, with moments and statistics that can be told apart."""
    n = len(log_sizes)
    g = random_gaussians(n, degree=1)
    shape = torch.tensor([0.0, -0.5, -1.0])
    g = replace(
        g,
        log_scales=torch.tensor(log_sizes, dtype=torch.float32)[:, None] + shape,
        logit_opacities=torch.full((n,), float(np.log(opacity / (1 - opacity)))),
    )
    state = initial_state(g, seed=0)
    for moments in (state.exp_avg, state.exp_avg_sq):
        for name in PARAMETERS:
            moments[name] = (
                torch.arange(1.0, n + 1).reshape(-1, *[1] * (moments[name].ndim - 1)) + moments[name]
            )
    state.grad_sum = torch.tensor(grads) * 4
    state.grad_count = torch.full((n,), 4.0)
    return state


def all_of(state: TrainState) -> torch.Tensor:
    return torch.ones(len(state.gaussians), dtype=torch.bool)


def assert_consistent(state: TrainState) -> None:
    n = len(state.gaussians)
    for name, p in state.gaussians.parameters().items():
        assert state.exp_avg[name].shape == p.shape
        assert torch.equal(
            state.exp_avg[name], state.exp_avg_sq[name]
        )  # they started equal and move together
        assert p.is_contiguous()  # Adam works on its memory
    assert state.gaussians.label_ids.shape == state.grad_sum.shape == state.grad_count.shape == (n,)
    assert not state.grad_sum.any()
    assert not state.grad_count.any()


def test_small_ones_are_cloned():
    state = state_of([SMALL, SMALL, SMALL], [1e-3, 0, 1e-3])
    before = state.gaussians
    densify.refine(state, CONFIG, EXTENT, ROOM, all_of(state))
    assert_consistent(state)
    parents = torch.tensor([0, 1, 2, 0, 2])
    for name in (*PARAMETERS, "label_ids"):
        assert torch.equal(getattr(state.gaussians, name), getattr(before, name)[parents])
    for moments in (state.exp_avg, state.exp_avg_sq):
        assert moments["means"][:, 0].tolist() == [1, 2, 3, 0, 0]  # the copy starts afresh


def test_large_ones_are_split():
    count = 400
    state = state_of([LARGE] * count, [1e-3] * (count - 1) + [0])
    before = state.gaussians
    densify.refine(state, CONFIG, EXTENT, ROOM, all_of(state))
    assert_consistent(state)
    after = state.gaussians
    assert len(after) == 1 + 2 * (count - 1)
    parents = torch.cat([torch.tensor([count - 1]), torch.arange(count - 1).repeat(2)])
    assert torch.equal(after.label_ids, before.label_ids[parents])
    for name in ("quats", "logit_opacities", "sh0", "shN"):
        assert torch.equal(getattr(after, name), getattr(before, name)[parents])
    children, parents = slice(1, None), parents[1:]
    torch.testing.assert_close(after.log_scales[children].exp() * 1.6, before.log_scales[parents].exp())
    assert (state.exp_avg["means"][children] == 0).all()
    # children are drawn from the parent: in its own axes, in units of its sizes, they are standard normal
    shift = after.means[children] - before.means[parents]
    rotation = densify.rotation_matrices(before.quats[parents])
    local = (rotation.transpose(1, 2) @ shift[..., None]).squeeze(-1) / before.log_scales[parents].exp()
    assert (local.mean(0).abs() < 0.15).all()
    assert ((local.std(0) - 1).abs() < 0.15).all()
    assert local.abs().max() < 5


def test_faint_ones_go_and_huge_ones_only_after_a_reset():
    state = state_of([SMALL, LARGE, HUGE, SMALL], [0, 0, 0, 0])
    state.gaussians.logit_opacities[0] = -6.0  # opacity 0.0025
    labels = state.gaussians.label_ids
    densify.refine(state, CONFIG, EXTENT, ROOM, all_of(state))
    assert_consistent(state)
    assert torch.equal(state.gaussians.label_ids, labels[1:])
    assert state.exp_avg["means"][:, 0].tolist() == [2, 3, 4]  # moments move with their rows
    state.last_reset = 100
    densify.refine(state, CONFIG, EXTENT, ROOM, all_of(state))
    assert torch.equal(state.gaussians.label_ids, labels[[1, 3]])


@pytest.mark.parametrize(("room", "grown"), [(0, 0), (2, 2), (100, 6)])
def test_the_cap_holds_and_the_strongest_go_first(room, grown):
    state = state_of([SMALL, LARGE] * 3 + [SMALL], [3e-4, 9e-4, 5e-4, 7e-4, 4e-4, 6e-4, 0])
    densify.refine(state, CONFIG, EXTENT, room, all_of(state))
    assert len(state.gaussians) == 7 + grown
    if room == 2:  # rows 1 and 3, both split
        assert state.exp_avg["means"][:, 0].tolist() == [1, 3, 5, 6, 7, 0, 0, 0, 0]


def test_frozen_rows_neither_grow_nor_go():
    state = state_of([SMALL, LARGE, SMALL, HUGE], [1, 1, 0, 0])
    state.gaussians.logit_opacities[2] = -9.0
    state.last_reset = 10
    before = state.gaussians
    densify.refine(state, CONFIG, EXTENT, ROOM, torch.zeros(4, dtype=torch.bool))
    for name in (*PARAMETERS, "label_ids"):
        assert torch.equal(getattr(state.gaussians, name), getattr(before, name))
    assert state.exp_avg["means"][:, 0].tolist() == [1, 2, 3, 4]


def test_everything_may_go():
    state = state_of([SMALL] * 3, [0] * 3, opacity=0.001)
    densify.refine(state, CONFIG, EXTENT, ROOM, all_of(state))
    assert_consistent(state)
    assert len(state.gaussians) == 0
    densify.refine(state, CONFIG, EXTENT, ROOM, all_of(state))
    assert len(state.gaussians) == 0


def test_a_reset_lowers_opacities_of_trainable_rows():
    state = state_of([SMALL] * 4, [0] * 4)
    state.step = 3000
    state.gaussians.logit_opacities[1] = -7.0
    trainable = torch.tensor([True, True, True, False])
    densify.reset_opacities(state, trainable)
    opacities = state.gaussians.logit_opacities.sigmoid()
    expected = torch.tensor([0.01, torch.tensor(-7.0).sigmoid(), 0.01, 0.5])
    torch.testing.assert_close(opacities, expected)
    for moments in (state.exp_avg, state.exp_avg_sq):
        assert moments["logit_opacities"].tolist() == [0, 0, 0, 4]
        assert moments["means"][:, 0].tolist() == [1, 2, 3, 4]
    assert state.last_reset == 3000


def test_gradients_are_observed_in_half_images():
    state = state_of([SMALL] * 3, [0] * 3)
    state.clear_statistics()
    means2d = torch.zeros(3, 2, requires_grad=True)
    means2d.grad = torch.tensor([[3e-3, 4e-3], [1.0, 1.0], [1.0, 1.0]])
    radii = torch.tensor([2.0, 0.0, 5.0])  # the second is not seen
    render = Render(torch.zeros(1, 1, 3), torch.zeros(1, 1), None, means2d, radii)
    for _ in range(2):
        densify.observe_gradients(state, render, 200, 100, torch.tensor([True, True, False]))
    expected = 2 * np.hypot(3e-3 * 100, 4e-3 * 50)
    assert state.grad_sum.tolist() == pytest.approx([expected, 0, 0])
    assert state.grad_count.tolist() == [2, 0, 0]


def test_schedule_is_the_published_one_at_full_length():
    plan = schedule_of(TrainConfig(max_steps=30_000, lr_schedule="published"))
    published = Schedule(
        level_every=1000,
        refine_start=500,
        refine_stop=15_000,
        reset_every=3000,
        raise_sh_every=1000,
        recovery=1000,
    )
    assert plan == published


@pytest.mark.parametrize(("steps", "stop"), [(900, 630), (2000, 1200), (3000, 1500), (30_000, 15_000)])
def test_the_fast_pace_grows_for_longer_in_short_runs_and_never_resets(steps, stop):
    fast, published = (
        schedule_of(TrainConfig(max_steps=steps, lr_schedule=pace)) for pace in ("fast", "published")
    )
    assert fast.refine_stop == stop
    assert not any(map(fast.resets, range(steps)))
    assert fast == replace(published, refine_stop=stop, reset_every=0, recovery=0)


def test_room_of_stopped_categories_is_not_given_away():
    state = initial_state(random_gaussians(100), seed=0)
    everything, half = torch.ones(100, dtype=torch.bool), torch.arange(100) % 2 == 0
    assert densify.room(state, 180, everything) == 80
    assert densify.room(state, 180, half) == 40
    assert state.withheld == 40
    assert densify.room(state, 180, everything) == 40  # what was withheld stays so
    assert densify.room(state, 90, everything) == 0
    assert state.withheld == 40


@pytest.mark.parametrize("steps", [1, 30, 300, 3000, 7000, 60_000])
def test_schedule_scales_with_the_length(steps):
    plan = schedule_of(TrainConfig(max_steps=steps, lr_schedule="published"))
    assert plan.level_every == -(-steps // 30)
    assert plan.refine_stop == max(1, steps // 2)
    assert plan.reset_every == max(1500, steps // 10)  # a model needs time to come back
    assert plan.recovery <= plan.reset_every // 2
    assert schedule_of(TrainConfig(max_steps=steps, level_every=17)).level_every == 17
