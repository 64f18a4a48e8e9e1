"""Densification as a Markov chain: what moves where, what stays, and what the noise looks like."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import pinhole, random_gaussians, write_capture
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sagesplat.core.config import TrainConfig
from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.raster import rasterize, set_threads
from sagesplat.raster.reference import rotation_matrices
from sagesplat.scene.images import Photos
from sagesplat.train import mcmc
from sagesplat.train.densify import PRUNE_OPACITY
from sagesplat.train.early_stopping import ActiveTiles, trainable_rows
from sagesplat.train.lr_schedule import LrSchedule
from sagesplat.train.photo_loader import PhotoLoader
from sagesplat.train.state import TrainState, from_points, initial_state
from sagesplat.train.stepper import Stepper
from sagesplat.train.strategy import make_strategy

DEAD = -9.0  # a logit


def state_of(g: Gaussians, seed: int = 0) -> TrainState:
    """Moments and statistics are those of no other row."""
    state = initial_state(g, seed)
    n = len(g)
    for moments in (state.exp_avg, state.exp_avg_sq):
        for name in PARAMETERS:
            moments[name] += torch.arange(1.0, n + 1).reshape(-1, *[1] * (moments[name].ndim - 1))
    state.grad_sum, state.grad_count = torch.arange(n) + 0.5, torch.arange(n) + 1.0
    return state


def snapshot(state: TrainState) -> dict[str, Tensor]:
    g = state.gaussians
    tensors = {"label_ids": g.label_ids, "sum": state.grad_sum, "count": state.grad_count, **g.parameters()}
    for key, moments in (("exp_avg", state.exp_avg), ("exp_avg_sq", state.exp_avg_sq)):
        tensors |= {f"{key} {name}": m for name, m in moments.items()}
    return {name: t.clone() for name, t in tensors.items()}


def all_of(state: TrainState) -> Tensor:
    return torch.ones(len(state.gaussians), dtype=torch.bool)


@st.composite
def states(draw: st.DrawFn) -> tuple[TrainState, Tensor]:
    """Some Gaussians dead, some transparent, some opaque; some categories stopped."""
    n = draw(st.integers(1, 40))
    logits = draw(st.lists(st.floats(-12, 30, width=32), min_size=n, max_size=n))
    g = replace(
        random_gaussians(n, seed=draw(st.integers(0, 99)), degree=1), logit_opacities=torch.tensor(logits)
    )
    frozen = draw(st.sets(st.sampled_from([-1, 3, 184])))
    return state_of(g, draw(st.integers(0, 99))), trainable_rows(g, dict.fromkeys(frozen, 1))


# ---- equation 9


def series(opacity: float, count: int) -> float:
    """The double sum of equation 9, term by term."""
    return math.fsum(
        math.comb(i - 1, k) * (-1) ** k * opacity ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, count + 1)
        for k in range(i)
    )


@pytest.mark.parametrize("old", [0.006, 0.1, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("count", [1, 2, 3, 7, 20, 51])
def test_shares_are_those_of_equation_9(old, count):
    logits, log_factors = mcmc.shares(
        torch.tensor([math.log(old / (1 - old))], dtype=torch.float64), torch.tensor([count])
    )
    new = 1 - (1 - old) ** (1 / count)
    assert float(logits.sigmoid()) == pytest.approx(new, rel=1e-12)
    assert float(log_factors.exp()) == pytest.approx(old / series(new, count), rel=1e-9)
    # the centre as it was, and so the integral along a line through it
    assert 1 - (1 - float(logits.sigmoid())) ** count == pytest.approx(old, rel=1e-12)
    x = np.linspace(-12, 12, 4001)
    bump = float(logits.sigmoid()) * np.exp(-0.5 * (x / float(log_factors.exp())) ** 2)
    together = np.trapezoid(1 - (1 - bump) ** count, x)
    assert together == pytest.approx(old * math.sqrt(2 * math.pi), rel=1e-6)


def test_more_than_51_are_treated_as_51():
    logits = torch.tensor([0.3, 0.3])
    for result in mcmc.shares(logits, torch.tensor([51, 400])):
        assert result[0] == result[1]


# ---- relocation and growth


def test_the_dead_take_everything_from_their_hosts():
    g = random_gaussians(400, degree=1)
    g.logit_opacities[:] = torch.where(torch.arange(400) % 4 == 0, DEAD, 1.0)
    g.logit_opacities[1] = 6.0
    state = state_of(g)
    before = snapshot(state)
    assert mcmc.relocate(state, all_of(state)) == 100
    g = state.gaussians
    dead = torch.arange(400) % 4 == 0
    assert (g.means[:, None] == before["means"][~dead]).all(-1).any(1).all()  # all are in living places
    hosts = set()
    for row in dead.nonzero().flatten().tolist():
        host = int(((before["means"] == g.means[row]).all(-1) & ~dead).nonzero())
        hosts.add(host)
        for name in (*PARAMETERS, "label_ids"):
            assert torch.equal(getattr(g, name)[row], getattr(g, name)[host])
    for key in ("exp_avg", "exp_avg_sq"):
        for name in PARAMETERS:
            moments = getattr(state, key)[name]
            assert not moments[dead].any()
            assert torch.equal(moments[~dead], before[f"{key} {name}"][~dead])
    for name in ("means", "quats", "sh0", "shN", "label_ids"):  # hosts fade and shrink, no more
        assert torch.equal(getattr(g, name)[~dead], before[name][~dead])
    assert (g.logit_opacities[list(hosts)] < before["logit_opacities"][list(hosts)]).all()


def test_hosts_are_drawn_by_opacity():
    g = random_gaussians(20_003, degree=0)
    g.logit_opacities[:] = DEAD
    g.logit_opacities[:3] = torch.logit(torch.tensor([0.1, 0.3, 0.6]))
    state = state_of(g)
    mcmc.relocate(state, all_of(state))
    shares = [(state.gaussians.means == g.means[i]).all(-1).float().mean().item() for i in range(3)]
    assert shares == pytest.approx([0.1, 0.3, 0.6], abs=0.015)


@settings(max_examples=60)
@given(drawn=states())
def test_relocation_keeps_counts_and_leaves_stopped_rows_alone(drawn):
    state, trainable = drawn
    before, withheld = snapshot(state), state.withheld
    alive = before["logit_opacities"].sigmoid() > PRUNE_OPACITY
    moved = mcmc.relocate(state, trainable)
    after = snapshot(state)
    dead = trainable & ~alive
    assert moved == (int(dead.sum()) if (trainable & alive).any() else 0)
    assert state.withheld == withheld
    for name, tensor in after.items():
        assert tensor.shape == before[name].shape
        assert torch.isfinite(tensor).all()
        assert torch.equal(tensor[~trainable], before[name][~trainable])
    if moved:  # nobody of a trainable category is dead, up to rounding
        assert after["logit_opacities"][trainable].sigmoid().min() >= PRUNE_OPACITY * (1 - 1e-5)
        living = set(before["label_ids"][trainable & alive].tolist())
        assert set(after["label_ids"][trainable].tolist()) == living


@settings(max_examples=60)
@given(drawn=states(), most=st.integers(0, 60), rounds=st.integers(1, 4))
def test_growth_keeps_to_the_cap_and_withholds_what_stopped(drawn, most, rounds):
    state, trainable = drawn
    start = len(state.gaussians)
    stopped = {label for label in (-1, 3, 184) if not trainable[state.gaussians.label_ids == label].all()}
    for _ in range(rounds):
        before, n, withheld = snapshot(state), len(state.gaussians), state.withheld
        living = trainable & (state.gaussians.logit_opacities.sigmoid() > PRUNE_OPACITY)
        added = mcmc.add(state, most, trainable)
        after = snapshot(state)
        free = max(0, min(most - n - withheld, math.ceil(0.05 * n)))
        given_out = round(free * float(trainable.float().mean()))
        assert state.withheld == withheld + free - given_out
        assert added == (given_out if living.any() else 0)
        assert len(state.gaussians) == n + added <= max(start, most - state.withheld)
        for name, tensor in after.items():
            assert len(tensor) == n + added
            assert torch.isfinite(tensor).all()
            if name not in ("sum", "count"):
                assert torch.equal(tensor[:n][~trainable], before[name][~trainable])
        for row in range(n, n + added):
            hosts = living.clone()
            for name in (*PARAMETERS, "label_ids"):
                hosts &= (after[name][:n] == after[name][row]).reshape(n, -1).all(-1)
            assert hosts.any()
        for key in (f"{moment} {name}" for moment in ("exp_avg", "exp_avg_sq") for name in PARAMETERS):
            assert torch.equal(after[key][:n], before[key])  # hosts keep theirs
            assert not after[key][n:].any()
        assert all(p.is_contiguous() for p in state.gaussians.parameters().values())
        trainable = trainable_rows(state.gaussians, dict.fromkeys(stopped, 1))


# ---- noise


def one_shape(count: int, logit: float) -> Gaussians:
    g = random_gaussians(count, degree=0)
    return replace(
        g,
        means=torch.zeros(count, 3),
        quats=torch.tensor([0.9, -0.4, 0.3, 0.7]).repeat(count, 1),
        log_scales=torch.tensor([-1.0, 0.2, -0.3]).repeat(count, 1),
        logit_opacities=torch.full((count,), logit),
    )


def test_noise_has_the_covariance_of_equation_8():
    n, opacity, rate = 60_000, 0.01, 0.7
    state = state_of(one_shape(n, math.log(opacity / (1 - opacity))))
    mcmc.perturb(state, rate, all_of(state))
    g = state.gaussians
    rotation = rotation_matrices(g.quats[:1])[0].double()
    covariance = rotation @ torch.diag((2 * g.log_scales[0].double()).exp()) @ rotation.T
    gate = 1 / (1 + math.exp(-100 * ((1 - opacity) - 0.995)))
    expected = (rate * gate) ** 2 * covariance @ covariance
    assert torch.allclose(g.means.double().T.cov(), expected, atol=0.02 * float(expected.diagonal().max()))
    # each number by itself is nearly normal
    normal = (torch.linalg.inv(covariance) @ g.means.double().T / (rate * gate)).T
    assert normal.mean(0).abs().max() < 0.02
    assert (normal.pow(3).mean(0)).abs().max() < 0.05
    assert (normal.pow(4).mean(0) - 3).abs().max() < 0.15
    for bound, share in ((0.5, 0.6915), (1.0, 0.8413), (2.0, 0.9772), (3.0, 0.99865)):
        assert float((normal < bound).double().mean()) == pytest.approx(share, abs=0.005)
    following = (normal[1:] * normal[:-1]).mean(0)  # rows know nothing of each other
    assert following.abs().max() < 0.02


def test_the_kernel_computes_what_torch_does():
    g = random_gaussians(500, logit=-2.5)
    trainable = torch.arange(500) % 3 > 0
    state = state_of(g)
    seed = np.uint64(np.random.default_rng(0).integers(1 << 63))
    normal = torch.tensor([[mcmc._normal(seed, np.uint64(3 * i + k)) for k in range(3)] for i in range(500)])
    expected = g.means.clone()
    mcmc.sgld_noise(expected, g.quats, g.log_scales, g.logit_opacities, trainable, 20.0, normal)
    before = g.means.clone()
    mcmc.perturb(state, 20.0, trainable)
    torch.testing.assert_close(state.gaussians.means, expected, rtol=1e-4, atol=1e-5)
    assert torch.equal(state.gaussians.means[~trainable], before[~trainable])
    assert (state.gaussians.means - before).abs().max() > 0.1


@pytest.mark.threads
def test_noise_is_the_same_with_any_number_of_threads_and_for_a_seed():
    results = []
    for threads, seed in ((1, 5), (2, 5), (1, 6)):
        assert set_threads(threads) == threads
        state = state_of(random_gaussians(5000, logit=-3), seed)
        for _ in range(2):
            mcmc.perturb(state, 0.3, all_of(state))
        results.append(state.gaussians.means)
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


def test_nothing_is_perturbed_where_nothing_is():
    state = initial_state(random_gaussians(0), 0)
    mcmc.perturb(state, 1.0, all_of(state))
    assert mcmc.relocate(state, all_of(state)) == 0
    assert len(state.gaussians) == 0


# ---- regularisers


def test_regularisers_have_the_gradients_that_autograd_finds():
    state = state_of(random_gaussians(50))
    trainable = torch.arange(50) % 4 > 0
    leaves = {n: p.clone().requires_grad_() for n, p in state.gaussians.parameters().items()}
    (0.3 * leaves["logit_opacities"].sigmoid().mean() + 0.7 * leaves["log_scales"].exp().mean()).backward()
    grads = {name: torch.full_like(p, 0.25) for name, p in leaves.items()}
    mcmc.add_regularisation_gradients(state, grads, 0.3, 0.7, trainable)
    for name, grad in grads.items():
        own = leaves[name].grad
        added = torch.zeros_like(grad) if own is None else own
        torch.testing.assert_close(grad[trainable], 0.25 + added[trainable])
        assert (grad[~trainable] == 0.25).all()


# ---- a small training


@pytest.mark.parametrize(("logit", "moved", "tolerance"), [(-1.0, 3, 0.02), (0.5, 1, 0.02), (2.0, 4, 0.07)])
def test_a_pile_renders_like_the_one_it_was(logit, moved, tolerance):
    g = random_gaussians(moved + 1, degree=0, log_scale=-1.2)
    g = replace(
        g,
        logit_opacities=torch.tensor([logit] + [DEAD] * moved),
        means=torch.tensor([0.1, 0.2, 4.0]) + torch.arange(moved + 1)[:, None],
        sh0=torch.ones_like(g.sh0),
    )
    state = state_of(g)
    camera = pinhole()
    before = rasterize(state.gaussians, camera).alpha.clone()
    assert mcmc.relocate(state, all_of(state)) == moved
    after = rasterize(state.gaussians, camera).alpha
    assert float(before.max()) > 0.2
    assert float((after - before).abs().max()) < tolerance
    at = int(before.argmax())  # the centre is conserved exactly, up to where pixels and the low-pass lie
    assert float(after.flatten()[at]) == pytest.approx(float(before.flatten()[at]), abs=0.01)
    assert float(after.sum()) == pytest.approx(float(before.sum()), rel=0.15)


def test_chance_comes_from_the_state_alone():
    def run(seed: int) -> TrainState:
        state = state_of(random_gaussians(300, logit=-4), seed)
        for _ in range(3):
            mcmc.relocate(state, all_of(state))
            mcmc.add(state, 1000, all_of(state))
            mcmc.perturb(state, 0.1, all_of(state))
        return state

    first, again, other = (snapshot(run(seed)) for seed in (1, 1, 2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["means"], other["means"])


def test_opaque_ones_hardly_move():
    moved = {}
    for opacity in (0.001, 0.005, 0.05, 0.15, 0.19, 0.5):
        state = state_of(one_shape(1000, math.log(opacity / (1 - opacity))))
        mcmc.perturb(state, 1.0, all_of(state))
        moved[opacity] = float(state.gaussians.means.norm(dim=1).mean())
    assert moved[0.001] / moved[0.005] == pytest.approx(2 / (1 + math.exp(-0.4)), rel=1e-3)
    assert list(moved.values()) == sorted(moved.values(), reverse=True)
    assert moved[0.19] < 1e-7 * moved[0.005]
    assert moved[0.5] == 0


def test_a_chain_learns(tmp_path):
    truth = random_gaussians(60, seed=12, degree=0, log_scale=-1.6, logit=1.0)
    scene = write_capture(tmp_path / "cloud", truth)
    config = TrainConfig(max_steps=105, sh_degree=0, strategy="mcmc")
    labels = np.array([-1, 3, 184], np.int16)[np.arange(60) % 3]
    state = initial_state(from_points(scene.points, labels, 0), seed=0)
    feed = PhotoLoader(scene, Photos(scene.views), torch.device("cpu"))
    rates = LrSchedule(config, scene.extent)
    strategy = make_strategy(config, scene, rates)
    stepper = Stepper(feed, config, ActiveTiles(scene, None), strategy=strategy)
    losses, kept = [], torch.empty(0)
    trainable = all_of(state)
    for step in range(1, 106):
        if step == 42:  # one category stops
            state.frozen = {3: step}
            trainable = trainable_rows(state.gaussians, state.frozen)
            kept = state.gaussians.of_labels([3]).means.sort(0).values
        losses.append(float(stepper(state, 0, rates.learning_rates(step), trainable)))
        if 14 <= step < 90 and step % 7 == 0:
            mcmc.relocate(state, trainable)
            mcmc.add(state, 90, trainable)
            state.sort()
            trainable = trainable_rows(state.gaussians, state.frozen)
    assert np.mean(losses[-7:]) < 0.65 * np.mean(losses[:7])
    assert 80 < len(state.gaussians) <= 90 - state.withheld
    assert state.withheld > 0
    assert torch.equal(state.gaussians.of_labels([3]).means.sort(0).values, kept)
