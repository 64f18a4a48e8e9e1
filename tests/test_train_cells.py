"""Cells of categories: compact, of enough Gaussians, the same again; and ordered models split into them."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import torch

from sagesplat.train.cells import FEWEST, MOST, cells_wanted, contracted, split_cells
from sagesplat.train.nested import Nested, in_cells
from tests.conftest import random_gaussians


def cloud() -> tuple[np.ndarray, np.ndarray]:
    """Two clouds of a category, a wide one, and a shell far around of another."""
    rng = np.random.default_rng(0)
    shell = rng.normal(size=(2000, 3))
    shell *= 50 / np.linalg.norm(shell, axis=1, keepdims=True)
    near = [rng.normal(at, 0.5, (3000, 3)) for at in ([-4, 0, 0], [4, 0, 0])]
    means = np.concatenate([*near, rng.uniform(-3, 3, (4000, 3)), shell]).astype(np.float32)
    return means, np.repeat([3, 9, 12], [6000, 4000, 2000]).astype(np.int16)


def test_every_gaussian_is_in_a_cell_of_its_category():
    means, labels = cloud()
    cells, label_of = split_cells(means, labels, 20)
    assert sorted(set(cells.tolist())) == sorted(label_of) == list(range(len(label_of)))
    assert [label_of[cell] for cell in cells.tolist()] == labels.tolist()
    assert list(label_of.values()) == sorted(label_of.values())  # numbered by category
    assert 15 <= len(label_of) <= 25
    assert np.bincount(cells).min() >= FEWEST // 2
    again, same = split_cells(means, labels, 20)
    assert np.array_equal(again, cells)
    assert same == label_of


def test_gaussians_outside_of_a_block_join_the_cells_inside():
    means, labels = cloud()
    inside = means[:, 0] < 0
    cells, label_of = split_cells(means, labels, 20, inside)
    assert 15 <= len(label_of) <= 25
    assert np.bincount(cells[inside], minlength=len(label_of)).min() >= FEWEST // 2
    assert [label_of[cell] for cell in cells.tolist()] == labels.tolist()
    _, without = split_cells(means, labels, 20, inside & (labels != 12))
    assert list(without.values()).count(12) == 1  # outside only


def test_cells_are_compact():
    means, labels = cloud()
    cells, label_of = split_cells(means, labels, 20)
    own = [means[cells == cell] for cell, label in label_of.items() if label == 3]
    sides = [np.sign(points[:, 0]) for points in own]
    assert all(abs(side.mean()) > 0.99 for side in sides)  # none is of both clouds
    whole = means[labels == 3].var(0).sum()
    assert np.mean([points.var(0).sum() for points in own]) < whole / 10


def test_a_shell_far_away_is_split_by_direction():
    means, labels = cloud()
    cells, label_of = split_cells(means, labels, 24)
    directions = means / np.linalg.norm(means, axis=1, keepdims=True)
    parts = [directions[cells == cell] for cell, label in label_of.items() if label == 12]
    assert len(parts) >= 4
    # a cap of a quarter of the sphere has a mean direction of length 0.75, all of the sphere of 0
    assert all(np.linalg.norm(part.mean(0)) > 0.6 for part in parts)


def test_contracted_is_a_ball_of_radius_2_and_linear_inside():
    means, _ = cloud()
    places = contracted(means)
    radius = np.linalg.norm(places, axis=1)
    assert radius.max() < 2
    centred = means.astype(float) - np.median(means, 0)
    reach = np.linalg.norm(centred, axis=1)
    one = np.quantile(reach, 0.8)
    np.testing.assert_allclose(places[reach <= one], centred[reach <= one] / one)
    np.testing.assert_allclose(radius[reach > one], (2 - one / reach)[reach > one])
    assert contracted(means[:0]).shape == (0, 3)
    assert np.isfinite(contracted(np.zeros((5, 3), np.float32))).all()


@pytest.mark.parametrize("count", [0, 1])
def test_without_a_count_a_category_is_a_cell(count):
    means, labels = cloud()
    cells, label_of = split_cells(means, labels, count)
    assert label_of == {0: 3, 1: 9, 2: 12}
    assert np.array_equal(cells, np.repeat([0, 1, 2], [6000, 4000, 2000]))


def test_equal_places_and_small_categories_are_one_cell():
    cells, label_of = split_cells(np.zeros((50, 3), np.float32), np.repeat([1, 2], 25).astype(np.int16), 30)
    assert label_of == {0: 1, 1: 2}
    assert cells.tolist() == [0] * 25 + [1] * 25
    few = np.repeat(np.eye(3, dtype=np.float32), 1000, 0)  # three places
    cells, label_of = split_cells(few, np.zeros(3000, np.int16), 10)
    assert cells.tolist() in [np.repeat(order, 1000).tolist() for order in permutations(range(3))]
    cells, label_of = split_cells(np.zeros((0, 3), np.float32), np.zeros(0, np.int16), 5)
    assert (len(cells), label_of) == (0, {})


def test_cells_wanted_grow_with_the_scene_to_a_limit():
    assert [cells_wanted(n) for n in (0, 1499, 1500, 30_000, 10**7)] == [0, 0, 1, 20, MOST]


def ordered() -> Nested:
    means, labels = (torch.from_numpy(values[::2].copy()) for values in cloud())
    g = random_gaussians(len(means), degree=0)
    g = replace(g, means=means, label_ids=labels, logit_opacities=torch.arange(len(means)) * 1e-3)
    base = torch.zeros(len(means), dtype=torch.bool)
    for label in labels.unique():
        base[torch.nonzero(labels == label)[:200, 0]] = True
    return Nested(g, base.numpy())


def test_in_cells_keeps_the_order_within_cells_and_the_base_first():
    nested = ordered()
    found, label_of = in_cells(nested, 16)
    cells, row = found.gaussians.label_ids.numpy(), found.gaussians.logit_opacities.numpy() * 1e3
    row = np.round(row).astype(int)
    assert (np.diff(cells) >= 0).all()
    assert sorted(row.tolist()) == list(range(len(row)))
    assert [label_of[cell] for cell in cells.tolist()] == nested.gaussians.label_ids[row].tolist()
    assert np.array_equal(found.of_base, nested.of_base[row])
    for cell in label_of:
        assert (np.diff(row[cells == cell]) > 0).all()
        assert (np.diff(found.of_base[cells == cell].astype(int)) <= 0).all()
    same, label_of = in_cells(nested, 0)
    assert same is nested
    assert label_of == {3: 3, 9: 9, 12: 12}
