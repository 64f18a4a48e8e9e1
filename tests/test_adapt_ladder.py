"""Ladders read from disk: how levels blend second opacities, and what damage of these says."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import random_gaussians

from sagesplat.adapt.ladder import NestedLadder, read_prefixes
from sagesplat.core.errors import DataError
from sagesplat.core.second_opacity import SecondOpacities, weight_at, weights_of
from sagesplat.formats.levels import write_set

SIZES = {0: (3, 10, 20), 7: (2, 9, 15)}
WEIGHTS: dict[int, tuple[float, ...]] = {label: weights_of(n) for label, n in SIZES.items()}
SECOND = SecondOpacities(torch.linspace(-4, 4, 35), WEIGHTS)


def ladder(folder: Path, second: SecondOpacities | None = SECOND, **arrays):
    g = replace(
        random_gaussians(35, degree=1), label_ids=torch.tensor([0] * 20 + [7] * 15, dtype=torch.int16)
    )
    write_set(folder / "ladder.npz", g, 1, SIZES, second=second, exact=True, **arrays)
    return g, read_prefixes(folder / "ladder.npz")


def test_weights_rise_from_the_low_levels_to_the_full_model():
    assert weight_at(np.array([0.0, 0.05, 0.3, 1.0])).tolist() == [0, 0, 0, 1]
    assert weight_at(np.array([0.3**0.5])) == pytest.approx(0.5)
    assert weights_of([1, 3, 10]) == (0, 0, 1)
    assert weights_of([0, 0]) == (0, 0)  # of a category without Gaussians


def test_a_level_shows_opacities_between_the_two(tmp_path):
    g, found = ladder(tmp_path)
    full = found.load(3)
    assert torch.equal(full.logit_opacities, SECOND.logits)
    mixed = found.compose({0: 2, 7: 1})  # each category by its own level
    weight = weights_of(SIZES[0])[1]
    assert 0 < weight < 1
    assert weights_of(SIZES[7])[0] == 0
    expected = torch.cat(
        [(1 - weight) * g.logit_opacities[:10] + weight * SECOND.logits[:10], g.logit_opacities[20:22]]
    )
    torch.testing.assert_close(mixed.logit_opacities, expected)
    torch.testing.assert_close(mixed.means, torch.cat([g.means[:10], g.means[20:22]]))
    assert len(found.compose({})) == 0


@pytest.mark.parametrize(
    "second",
    [
        SecondOpacities(SECOND.logits.clone().fill_(torch.nan), SECOND.weights),
        SecondOpacities(SECOND.logits, WEIGHTS | {7: (0, 1, 1.5)}),
    ],
)  # fmt: skip
def test_second_opacities_that_do_not_fit_are_one_line(tmp_path, second):
    _, found = ladder(tmp_path, second)
    with pytest.raises(DataError, match=r"ladder.npz: impossible second opacities .*sagesplat nest` again$"):
        found.load(1)


CELLS = {0: (1, 4, 8), 1: (2, 5, 12), 2: (2, 9, 15)}  # sizes
LABEL_OF = {0: 7, 1: 3, 2: 7}  # the cells of a category do not lie together


def by_category(folder: Path) -> NestedLadder:
    ids = torch.tensor([0] * 8 + [1] * 12 + [2] * 15, dtype=torch.int16)
    g = replace(random_gaussians(35, degree=1), label_ids=ids)
    write_set(folder / "ladder.npz", g, 1, CELLS, exact=True)
    return NestedLadder(read_prefixes(folder / "ladder.npz"), LABEL_OF)


def test_a_category_is_the_union_of_its_cells(tmp_path):
    found = by_category(tmp_path)
    g = found.cells.gaussians
    assert found.levels == [1, 2, 3]
    assert found.counts == {
        (3, 1): 2, (3, 2): 5, (3, 3): 12, (7, 1): 1 + 2, (7, 2): 4 + 9, (7, 3): 8 + 15
    }  # fmt: skip
    mixed = found.compose({7: 2, 3: 1})
    assert mixed.label_ids.tolist() == [3] * 2 + [7] * 13  # the rows of each category together
    assert torch.equal(mixed.means, torch.cat([g.means[8:10], g.means[:4], g.means[20:29]]))
    assert found.of_cells({7: 2}) == {0: 2, 2: 2}
    assert len(found.load(3)) == 35
    assert found.load(2, [3]).label_ids.tolist() == [3] * 5
    apart = found.compose_cells({0: 3, 2: 1})  # cells of a category at levels of their own
    assert torch.equal(apart.means, torch.cat([g.means[:8], g.means[20:22]]))
    assert len(found.compose({})) == 0


def test_by_label_changes_only_ids_and_the_order(tmp_path):
    found = by_category(tmp_path)
    g = found.cells.gaussians
    labelled = found.by_label(g)
    rows = torch.cat([torch.arange(8, 20), torch.arange(8), torch.arange(20, 35)])
    for name, values in g.parameters().items():
        assert torch.equal(labelled.parameters()[name], values[rows])
    assert labelled.label_ids.tolist() == [LABEL_OF[cell] for cell in g.label_ids[rows].tolist()]
