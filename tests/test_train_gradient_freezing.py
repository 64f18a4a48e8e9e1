"""Gaussians that rest by their gradients."""

import torch

from sagesplat.train.gradient_freezing import GradientFreezing


def grads(size: torch.Tensor) -> dict[str, torch.Tensor]:
    return {"means": size[:, None].repeat(1, 3), "sh0": size[:, None, None].repeat(1, 1, 3)}


def test_those_with_small_gradients_rest_every_other_stretch():
    rest, everyone = GradientFreezing(0.5), torch.ones(6, dtype=torch.bool)
    assert rest.turn(everyone).all()
    rest.watch(grads(torch.tensor([1.0, 5.0, 0.1, 7.0, 0.2, 9.0])))
    rest.watch(grads(torch.tensor([1.0, 5.0, 0.1, 7.0, 0.2, 9.0])))
    assert rest.turn(everyone).tolist() == [False, True, False, True, False, True]
    rest.watch(grads(torch.ones(6)))  # nobody is watched while some rest
    assert rest.turn(everyone).all()


def test_both_gradients_have_to_be_small():
    rest, everyone = GradientFreezing(0.5), torch.ones(4, dtype=torch.bool)
    rest.turn(everyone)
    uneven = grads(torch.tensor([0.1, 0.2, 3.0, 4.0]))
    uneven["sh0"] = uneven["sh0"].flip(0)
    rest.watch(uneven)
    assert rest.turn(everyone).all()


def test_stopped_categories_do_not_count():
    rest, trainable = GradientFreezing(0.5), torch.tensor([True, True, False, False])
    rest.turn(trainable)
    rest.watch(grads(torch.tensor([1.0, 2.0, 0.0, 0.0])))
    assert rest.turn(trainable).tolist() == [False, True, False, False]


def test_who_came_or_went_begins_anew():
    rest = GradientFreezing(0.5)
    rest.turn(torch.ones(3, dtype=torch.bool))
    rest.watch(grads(torch.ones(3)))
    assert rest.turn(torch.ones(5, dtype=torch.bool)).all()
