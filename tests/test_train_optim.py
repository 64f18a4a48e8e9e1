"""The fused Adam against torch's, and rows that are left alone."""

from typing import Any

import numpy as np
import pytest
import torch
from conftest import random_gaussians

from sagesplat.train.optim import adam_steps, update
from sagesplat.train.state import initial_state


def adam_step(*arrays: np.ndarray, lr: float, columns: int | None = None, **how: Any) -> None:
    """One Adam step of one parameter: it, its gradient and both moments."""
    adam_steps(*([array] for array in arrays), rates=[lr], columns=[columns], **how)


def gradients(shape: tuple[int, ...], steps: int) -> list[np.ndarray]:
    """Gradients whose entries differ by many orders of magnitude, some of them zero."""
    rng = np.random.default_rng(1)
    scale = 10.0 ** rng.uniform(-9, 2, shape)
    grads = [rng.normal(size=shape) * scale for _ in range(steps)]
    return [np.where(rng.random(shape) < 0.2, 0, g).astype(np.float32) for g in grads]


# rows around the chunk of 4096 that a thread works on
@pytest.mark.parametrize("shape", [(7,), (50, 3), (4097, 1, 3), (9000, 4), (5, 15, 3)])
def test_steps_are_torchs(shape):
    start = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    expected = torch.tensor(start, requires_grad=True)
    adam = torch.optim.Adam([expected], lr=3e-3, betas=(0.9, 0.999), eps=1e-15)
    actual, exp_avg, exp_avg_sq = start.copy(), np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    everything = np.ones(shape[0], bool)
    grads = gradients(shape, 6)
    for step, grad in enumerate(grads, start=1):
        expected.grad = torch.from_numpy(grad)
        adam.step()
        adam_step(actual, grad, exp_avg, exp_avg_sq, lr=3e-3, step=step, trainable=everything)
    state = adam.state[expected]
    largest = np.abs(grads).max(0) + 1e-30
    np.testing.assert_allclose(exp_avg / largest, state["exp_avg"].numpy() / largest, atol=1e-6)
    np.testing.assert_allclose(exp_avg_sq, state["exp_avg_sq"].numpy(), rtol=3e-5, atol=1e-30)
    np.testing.assert_allclose(actual, expected.detach().numpy(), rtol=1e-6, atol=1e-6)
    assert np.abs(actual - start).max() > 5e-3


@pytest.mark.parametrize("columns", [None, 9, 0])
def test_frozen_rows_and_columns_keep_every_bit_and_the_others_do_not_notice(columns):
    n = 5000
    moving = np.zeros((n, 45), bool)
    some = np.random.default_rng(2).random(n) < 0.5
    moving[some, :columns] = True
    start = [np.random.default_rng(4).random((n, 15, 3)).astype(np.float32) for _ in range(3)]
    part, free = [a.copy() for a in start], [a.copy() for a in start]
    rows = some if columns != 0 else np.ones(n, bool)
    for step, grad in enumerate(gradients((n, 15, 3), 3), start=10):
        adam_step(free[0], grad, *free[1:], lr=0.01, step=step, trainable=np.ones(n, bool))
        grad.reshape(n, 45)[~moving] = np.nan
        adam_step(part[0], grad, *part[1:], lr=0.01, step=step, trainable=rows, columns=columns)
    there = moving.reshape(n, 15, 3)
    for before, after, unmasked in zip(start, part, free, strict=True):
        np.testing.assert_array_equal(after[~there], before[~there])
        np.testing.assert_array_equal(after[there], unmasked[there])
        assert (after[there] != before[there]).all()


@pytest.mark.parametrize("columns", [None, 3])
def test_gradients_of_drawn_rows_alone_do_what_a_mask_does(columns):
    n = 5000
    rng = np.random.default_rng(3)
    drawn = np.flatnonzero(rng.random(n) < 0.9)
    trainable = rng.random(n) < 0.7
    start = [rng.random((n, 2, 3)).astype(np.float32) for _ in range(3)]
    masked, rows = [a.copy() for a in start], [a.copy() for a in start]
    there = trainable & np.isin(np.arange(n), drawn)
    for step, grad in enumerate(gradients((n, 2, 3), 3), start=10):
        how = {"lr": 0.01, "step": step, "columns": columns}
        adam_step(masked[0], grad, *masked[1:], trainable=there, **how)
        adam_step(rows[0], grad[drawn], *rows[1:], trainable=trainable, drawn=drawn, **how)
    for expected, actual in zip(masked, rows, strict=True):
        np.testing.assert_array_equal(actual, expected)


@pytest.mark.parametrize("some", [False, True])
def test_all_parameters_at_once_are_each_by_itself(some):
    g = random_gaussians(5000, seed=6)
    state, apart = initial_state(g, 0), {name: p.numpy().copy() for name, p in g.parameters().items()}
    rng = np.random.default_rng(7)
    drawn = torch.from_numpy(np.flatnonzero(rng.random(5000) < 0.6)) if some else None
    trainable = torch.from_numpy(rng.random(5000) < 0.8)
    moments = {name: [np.zeros_like(p), np.zeros_like(p)] for name, p in apart.items()}
    rates = {name: 1e-3 * (1 + k) for k, name in enumerate(apart)}
    for state.step in (1, 2):
        grads = {name: torch.from_numpy(gradients(p.shape, 1)[0] * state.step) for name, p in apart.items()}
        if drawn is not None:
            grads = {name: grad[drawn] for name, grad in grads.items()}
        update(state, grads, rates, 1, trainable, drawn=drawn)
        for name, p in apart.items():
            adam_step(
                p, grads[name].numpy(), *moments[name], lr=rates[name], step=state.step,
                trainable=trainable.numpy(), columns=9 if name == "shN" else None,
                drawn=None if drawn is None else drawn.numpy(),
            )  # fmt: skip
    for name, p in apart.items():
        np.testing.assert_array_equal(getattr(state.gaussians, name), p)
        np.testing.assert_array_equal(state.exp_avg_sq[name], moments[name][1])
    assert (state.gaussians.means.numpy() != random_gaussians(5000, seed=6).means.numpy()).any()


def test_no_rows_and_no_columns():
    for shape in ((0, 3), (5, 0, 3)):
        empty = np.zeros(shape, np.float32)
        adam_step(empty, empty, empty, empty, lr=1.0, step=1, trainable=np.ones(shape[0], bool))
