"""2D instances of several views become 3D instances, whatever single views have cut, lost or mixed up."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sagesplat.core.gaussians import Gaussians
from sagesplat.segment.masks import Taxonomy
from sagesplat.train.instances import label
from sagesplat.train.view_consensus import Sightings

TAXONOMY = Taxonomy({62: "chair", 184: "tree-merged"})
CHAIR = 1  # column of chairs: the first one is of what is unlabelled
COLUMNS = 3


def adjusted_rand_index(a: np.ndarray, b: np.ndarray) -> float:
    """Agreement of two partitions: 1 where they are the same, about 0 by chance (Hubert and Arabie 1985)."""
    _, a = np.unique(a, return_inverse=True)
    _, b = np.unique(b, return_inverse=True)
    rows, columns = int(a.max()) + 1, int(b.max()) + 1
    table = np.bincount(a * columns + b, minlength=rows * columns).reshape(rows, columns).astype(float)

    def pairs(counts: np.ndarray) -> float:
        return float((counts * (counts - 1) / 2).sum())

    both, of_a, of_b = pairs(table), pairs(table.sum(1)), pairs(table.sum(0))
    chance, most = of_a * of_b / max(pairs(np.array([len(a)])), 1), (of_a + of_b) / 2
    return 1.0 if most == chance else (both - chance) / (most - chance)


def seen(objects: np.ndarray, views: int, damage: float, seed: int) -> Sightings:
    """Gaussians of `objects` (-1: none) in views that number them anew, cut or lose some of the masks."""
    rng, n = np.random.default_rng(seed), len(objects)
    columns, starts = np.full((n, views), CHAIR, np.int16), [0]
    for view in range(views):
        count = 0
        for number in rng.permutation(objects.max() + 1):
            rows = np.flatnonzero(objects == number)
            cut, lost = rng.random(2) < damage
            if lost:
                continue
            columns[rows, view] = COLUMNS + count
            if cut:
                columns[rows[: len(rows) // 2], view] = COLUMNS + count + 1
            count += 1 + cut
        starts.append(starts[-1] + count)
    categories = np.full(starts[-1], CHAIR, np.int16)
    return Sightings(
        columns[..., None], np.ones((n, views, 1), np.float32), COLUMNS, np.array(starts), categories
    )


def model(n: int, label_id: int = 62) -> Gaussians:
    z, ids = torch.zeros, torch.full((n,), label_id, dtype=torch.int16)
    return Gaussians(z(n, 3) + torch.arange(n)[:, None], z(n, 4), z(n, 3), z(n), z(n, 1, 3), z(n, 0, 3), ids)


@settings(max_examples=15)
@given(seed=st.integers(0, 1000), count=st.integers(2, 6))
def test_numbers_of_single_views_do_not_matter(seed: int, count: int) -> None:
    objects = np.repeat(np.arange(count), range(20, 20 + count))
    found = label(model(len(objects)), seen(objects, 8, 0.0, seed), TAXONOMY)
    assert adjusted_rand_index(objects, found.label_ids) == 1
    assert sorted(found.taxonomy.names.values()) == sorted(
        [*TAXONOMY.names.values(), *(f"chair {i + 1}" for i in range(count))]
    )
    largest = next(i for i, name in found.taxonomy.names.items() if name == "chair 1")
    assert (found.label_ids == largest).sum() == 20 + count - 1
    assert set(found.parents.values()) == {62}
    assert min(found.parents) >= 201
    assert found.alone == {}


@pytest.mark.parametrize("seed", range(4))
def test_masks_that_are_cut_or_lost_in_some_views_do_no_harm(seed: int) -> None:
    objects = np.repeat(np.arange(5), 40)
    found = label(model(len(objects)), seen(objects, 16, 0.3, seed), TAXONOMY)
    assert adjusted_rand_index(objects, found.label_ids) > 0.95


def test_an_instance_of_one_view_stays_in_its_category() -> None:
    objects = np.repeat(np.arange(2), 30)
    sightings = seen(objects, 6, 0.0, 0)
    own = sightings.columns.copy()
    own[objects == 1] = CHAIR
    own[objects == 1, 2] = sightings.columns[objects == 1, 2]
    alone = Sightings(own, sightings.weights, COLUMNS, sightings.starts, sightings.categories)
    found = label(model(len(objects)), alone, TAXONOMY)
    assert list(found.taxonomy.names.values()) == ["chair", "tree-merged", "chair 1"]
    assert (found.label_ids[objects == 1] == 62).all()
    assert found.alone[62] >= 1


def test_gaussians_that_no_view_sees_follow_their_neighbours() -> None:
    objects = np.repeat(np.arange(2), 30)
    sightings = seen(objects, 6, 0.0, 0)
    sightings.columns[[10, 50]] = -1
    sightings.weights[[10, 50]] = 0
    found = label(model(len(objects)), sightings, TAXONOMY)
    assert adjusted_rand_index(objects, found.label_ids) == 1


def test_a_gaussian_at_a_border_counts_with_both_sides() -> None:
    objects = np.repeat(np.arange(2), 30)
    one = seen(objects, 6, 0.0, 0)
    both = np.concatenate([one.columns, np.full_like(one.columns, -1)], axis=2)
    weights = np.repeat([[1.0, 0.0]], both[..., 0].size, axis=0).reshape(both.shape).astype(np.float32)
    # row 30 paints a bit more of the other object in half of the views, and in the rest none of it
    other, own = one.columns[0, :3, 0], one.columns[31, :3, 0]
    both[30, :3], weights[30, :3] = np.stack([other, own], 1), (0.6, 0.5)
    both[30, 3:, 0], weights[30, 3:, 0] = one.columns[31, 3:, 0], 0.2
    sightings = replace(one, columns=both, weights=weights)
    found = label(model(len(objects)), sightings, TAXONOMY)
    assert found.label_ids[30] == found.label_ids[31]


def test_what_views_leave_open_is_that_of_most_neighbours() -> None:
    objects = np.repeat(np.arange(2), 30)
    sightings = seen(objects, 6, 0.0, 0)
    sightings.columns[[10, 45]] = CHAIR  # in no instance, though within one
    found = label(model(len(objects)), sightings, TAXONOMY)
    assert adjusted_rand_index(objects, found.label_ids) == 1
    sightings.columns[45:] = CHAIR  # no longer within one
    found = label(model(len(objects)), sightings, TAXONOMY)
    assert (found.label_ids[50:] == 62).all()


def test_without_instances_all_stays_as_it_was() -> None:
    sightings = Sightings(
        np.full((4, 2, 1), CHAIR, np.int16), np.ones((4, 2, 1), np.float32), COLUMNS, np.zeros(3, np.int64),
        np.zeros(0, np.int16),
    )  # fmt: skip
    found = label(model(4), sightings, TAXONOMY)
    assert found.label_ids.tolist() == [62] * 4
    assert (found.parents, found.alone) == ({}, {})


def test_views_that_lost_the_mask_have_no_say() -> None:
    objects = np.repeat(np.arange(2), 30)
    sightings = seen(objects, 8, 0.0, 0)
    sightings.columns[objects == 0, 2:] = CHAIR  # six of eight views have no mask of it
    sightings.columns[5, 0] = CHAIR  # beside the mask in one of the two views that have it
    found = label(model(len(objects)), sightings, TAXONOMY)
    assert adjusted_rand_index(objects, found.label_ids) == 1
