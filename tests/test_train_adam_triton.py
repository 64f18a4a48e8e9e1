"""The GPU's Adam against torch's and the CPU's; on a machine without a GPU, in Triton's interpreter."""

import os

import numpy as np
import pytest
import torch
from test_train_optim import adam_step as on_cpu
from test_train_optim import gradients
from torch import Tensor

GPU = torch.cuda.is_available()
DEVICE = "cuda" if GPU else "cpu"
if not GPU:
    os.environ.setdefault("TRITON_INTERPRET", "1")  # read when kernels are defined, Triton's own too
pytest.importorskip("triton", reason="needs Triton, which comes with torch where there is a GPU")
from sagesplat.train.adam_triton import adam_step  # noqa: E402


def on_device(arrays: list[np.ndarray]) -> list[Tensor]:
    return [torch.from_numpy(a.copy()).to(DEVICE) for a in arrays]


def start(shape: tuple[int, ...]) -> list[np.ndarray]:
    """A parameter and empty moments."""
    zeros = np.zeros(shape, np.float32)
    return [np.random.default_rng(0).normal(size=shape).astype(np.float32), zeros, zeros]


def plain_adam(parameter: Tensor, grads: list[np.ndarray], lr: float) -> tuple[Tensor, Tensor, Tensor]:
    """Kingma and Ba 2015, algorithm 1; float64."""
    exp_avg = exp_avg_sq = torch.zeros_like(parameter)
    for step, grad in enumerate(grads, start=1):
        g = torch.from_numpy(grad).double()
        exp_avg, exp_avg_sq = 0.9 * exp_avg + 0.1 * g, 0.999 * exp_avg_sq + 0.001 * g * g
        unbiased = exp_avg / (1 - 0.9**step), exp_avg_sq / (1 - 0.999**step)
        parameter = parameter - lr * unbiased[0] / (unbiased[1].sqrt() + 1e-15)
    return parameter, exp_avg, exp_avg_sq


# around the block of 1024 values
@pytest.mark.parametrize("shape", [(7,), (50, 3), (1025, 1, 3), (256, 4), (40, 15, 3)])
def test_steps_are_adams_and_the_cpus(shape):
    arrays, grads = start(shape), gradients(shape, 6)
    actual, of_cpu = on_device(arrays), [a.copy() for a in arrays]
    everything = np.ones(shape[0], bool)
    for step, grad in enumerate(grads, start=1):
        (g,) = on_device([grad])
        adam_step(actual[0], g, *actual[1:], lr=3e-3, step=step, trainable=None)
        on_cpu(of_cpu[0], grad, *of_cpu[1:], lr=3e-3, step=step, trainable=everything)
    expected = plain_adam(torch.from_numpy(arrays[0]).double(), grads, 3e-3)
    largest = torch.from_numpy(np.abs(grads).max(0) + 1e-30)
    parameter, exp_avg, exp_avg_sq = (a.cpu().double() for a in actual)
    close = torch.testing.assert_close
    # the CPU's 1 - 0.999 is one of float32, 1.3e-5 off
    for reference, rtol in ((expected, 1e-6), ([torch.from_numpy(a).double() for a in of_cpu], 3e-5)):
        close(parameter, reference[0], rtol=2e-7, atol=2e-7)
        close(exp_avg / largest, reference[1] / largest, rtol=0, atol=2e-7)
        close(exp_avg_sq, reference[2], rtol=rtol, atol=1e-30)
    assert (parameter - torch.from_numpy(arrays[0])).abs().max() > 5e-3


@pytest.mark.parametrize("columns", [None, 9, 0])
def test_frozen_rows_and_columns_keep_every_bit_and_the_others_do_not_notice(columns):
    arrays = [np.random.default_rng(2).random((700, 15, 3)).astype(np.float32) for _ in range(3)]
    moving = np.zeros((700, 45), bool)
    moving[np.random.default_rng(4).random(700) < 0.5, :columns] = True
    part, free = on_device(arrays), on_device(arrays)
    rows = torch.from_numpy(moving.any(1) if columns != 0 else np.ones(700, bool)).to(DEVICE)
    for step, grad in enumerate(gradients((700, 15, 3), 3), start=10):
        adam_step(free[0], *on_device([grad]), *free[1:], lr=0.01, step=step, trainable=None)
        grad.reshape(700, 45)[~moving] = np.nan
        how = {"lr": 0.01, "step": step, "trainable": rows, "columns": columns}
        adam_step(part[0], *on_device([grad]), *part[1:], **how)
    there = torch.from_numpy(moving.reshape(700, 15, 3)).to(DEVICE)
    for before, after, unmasked in zip(on_device(arrays), part, free, strict=True):
        assert torch.equal(after[~there], before[~there])
        assert torch.equal(after[there], unmasked[there])
        assert bool((after[there] != before[there]).all())


def test_a_leaf_moves_in_place_by_a_gradient_in_other_memory():
    (value, exp_avg, exp_avg_sq), (grad,) = on_device(start((20, 3))), gradients((20, 3), 1)
    expected = [a.cpu().numpy().copy() for a in (value, exp_avg, exp_avg_sq)]
    on_cpu(expected[0], grad, *expected[1:], lr=0.1, step=1, trainable=np.ones(20, bool))
    leaf = value.requires_grad_()
    turned = torch.from_numpy(np.ascontiguousarray(grad.T)).to(DEVICE).T
    adam_step(leaf, turned, exp_avg, exp_avg_sq, lr=0.1, step=1, trainable=None)
    torch.testing.assert_close(leaf.detach().cpu(), torch.from_numpy(expected[0]), rtol=1e-6, atol=2e-6)


def test_no_rows_and_no_columns():
    for shape in ((0, 3), (5, 0, 3)):
        empty = torch.zeros(shape, device=DEVICE)
        trainable = torch.ones(shape[0], dtype=torch.bool, device=DEVICE)
        adam_step(empty, empty, empty, empty, lr=1.0, step=1, trainable=trainable)


@pytest.mark.skipif(not GPU, reason="needs a GPU")
def test_more_values_than_32_bits_count():
    """Two to the 31 and some, in bytes that fit a large GPU."""
    n = 2**31 // 64 + 3
    if torch.cuda.mem_get_info()[0] < 5 * 4 * 64 * n:
        pytest.skip("needs 43 GB on the GPU")
    parameter, exp_avg, exp_avg_sq = (torch.zeros(n, 64, device=DEVICE) for _ in range(3))
    grad = torch.ones(n, 64, device=DEVICE)
    adam_step(parameter, grad, exp_avg, exp_avg_sq, lr=0.5, step=1, trainable=None)
    assert float(parameter.min()) == pytest.approx(-0.5)
    assert float(parameter.max()) == pytest.approx(-0.5)
