"""Parameters of single views: Adam as torch's, for the views of a step alone."""

import torch

from sagesplat.train.view_parameters import ViewGradients, ViewParameters


def test_adam_is_torchs_of_each_view_by_itself():
    generator = torch.Generator().manual_seed(0)
    mine = ViewParameters.zeros(3, 4)
    theirs = [torch.zeros(4, requires_grad=True) for _ in range(3)]
    optimisers = [torch.optim.Adam([p], lr=0.01, eps=1e-15) for p in theirs]
    for views in ([0], [2], [0, 2], [1], [0], [2, 0]):
        grad = torch.randn(len(views), 4, generator=generator)
        mine.adam_step(views, grad, 0.01)
        for view, row in zip(views, grad, strict=True):
            theirs[view].grad = row
            optimisers[view].step()
    assert torch.allclose(mine.values, torch.stack([p.detach() for p in theirs]), atol=1e-7)
    assert mine.counts.tolist() == [4, 1, 3]


def test_a_rate_for_each_parameter():
    mine = ViewParameters.zeros(2, 2)
    mine.adam_step([1], torch.ones(1, 2), torch.tensor([0.5, 0.0]))
    assert torch.allclose(mine.values, torch.tensor([[0, 0], [-0.5, 0]]), atol=1e-7)


def test_gradients_of_a_view_that_comes_twice_are_summed():
    gradients = ViewGradients({"pose": ViewParameters.zeros(5, 2)}, [4, 1, 4])
    for view in (4, 1, 4):
        leaves = gradients.leaves(view)
        (leaves["pose"] * view).sum().backward()
        gradients.add(view, leaves)
    assert gradients.views == [1, 4]
    assert gradients.grads["pose"].tolist() == [[1, 1], [8, 8]]
