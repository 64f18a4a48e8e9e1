"""The training state: what belongs to a Gaussian moves with it."""

import numpy as np
import pytest
import torch

from sagesplat.core.gaussians import PARAMETERS
from sagesplat.train.state import TrainState, initial_state
from tests.conftest import random_gaussians


@pytest.fixture
def state() -> TrainState:
    """Every value that belongs to a Gaussian is the x of its mean."""
    state = initial_state(random_gaussians(40), seed=0)
    x = state.gaussians.means[:, 0].clone()
    for name in PARAMETERS:
        for moments in (state.exp_avg, state.exp_avg_sq):
            moments[name] += x.reshape(-1, *[1] * (moments[name].ndim - 1))
    state.grad_sum, state.grad_count, state.order_share = x.clone(), x.clone(), x.clone()
    return state


def test_sorting_moves_all_that_belongs_to_a_gaussian(state: TrainState) -> None:
    before = state.gaussians.means[:, 0].clone()
    state.sort()
    x = state.gaussians.means[:, 0]
    assert not torch.equal(x, before)
    assert np.array_equal(np.sort(x.numpy()), np.sort(before.numpy()))
    assert state.order_share is not None
    for values in (state.grad_sum, state.grad_count, state.order_share):
        assert torch.equal(values, x)
    for name in PARAMETERS:
        for moments in (state.exp_avg, state.exp_avg_sq):
            assert torch.equal(moments[name].flatten(1)[:, 0] if moments[name].ndim > 1 else moments[name], x)


def test_a_nested_model_takes_no_new_rows(state: TrainState) -> None:
    keep = torch.ones(40, dtype=torch.bool)
    with pytest.raises(AssertionError):
        state.replace_rows(keep, random_gaussians(2))
    state.order_share = None
    state.replace_rows(keep, random_gaussians(2))
    assert len(state.gaussians) == len(state.grad_sum) == len(state.exp_avg["means"]) == 42
