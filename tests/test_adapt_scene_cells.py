"""Plans of a scene by cell: they hold where equal levels do, and take fewer bytes."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sagesplat.adapt.bound_plans import Costs
from sagesplat.adapt.plan import Choice, Plan
from sagesplat.adapt.scene_cells import Search, thinned
from sagesplat.adapt.scene_plans import measured_in_composition, plan_for_scene

VIEWS, CELLS, LEVELS = 40, 6, 5
LABEL_OF = {0: 3, 1: 3, 2: 3, 3: 3, 4: 3, 5: 7}


def _costs() -> Costs:
    nbytes = np.arange(1, CELLS + 1)[:, None] * np.array([1, 2, 4, 8, 16])
    return Costs(tuple(range(CELLS)), nbytes, nbytes, nbytes)


def _measured(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Fidelity [V, C, K] of cells, some of which are hard, and their pixels; each view shows some of them."""
    rng = np.random.default_rng(seed)
    hard = rng.uniform(0.3, 3, (1, CELLS, 1)) * rng.uniform(0.8, 1.2, (VIEWS, CELLS, 1))
    fidelity = np.linspace(0.4, 1, LEVELS) ** hard
    pixels = np.where(rng.random((VIEWS, CELLS)) < 0.7, rng.integers(50, 500, (VIEWS, CELLS)), 0)
    pixels[:, 0] = np.maximum(pixels[:, 0], 1)
    return np.where(pixels[..., None] > 0, fidelity, np.nan), pixels.astype(float)


def _whole(measured: np.ndarray, pixels: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Fidelity of the category 3 in each view, its cells at `levels`."""
    at = np.nan_to_num(measured[:, np.arange(5), levels])
    return (at * pixels[:, :5]).sum(1) / pixels[:, :5].sum(1)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("target", [0.7, 0.9])
def test_as_many_viewpoints_keep_the_target_with_fewer_bytes(seed: int, target: float) -> None:
    measured, pixels = _measured(seed)
    of_label = np.stack([_whole(measured, pixels, np.full(5, k)) for k in range(LEVELS)], 1)
    both = np.stack([of_label, np.nan_to_num(measured[:, 5], nan=np.nan)], 1)
    costs = _costs()
    equal = plan_for_scene(both, np.zeros((VIEWS, 2)), costs.by_label(LABEL_OF), target, 0.95, "fidelity")
    asked = {choice.label_id: target for choice in equal.choices if choice.status == "ok"}
    plan = thinned(equal, measured, pixels, costs, LABEL_OF, asked)
    assert plan.cells is not None
    levels = np.array([plan.cells[cell] - 1 for cell in range(5)])
    kept = (_whole(measured, pixels, levels) >= target).sum()
    assert kept >= math.ceil((VIEWS + 1) * 0.95)
    first, second = plan.choices
    assert (first.transfer_bytes or 0) < (equal.choices[0].transfer_bytes or 0)
    assert first.level == levels.max() + 1
    assert first.transfer_bytes == sum(costs.transfer_bytes[c, levels[c]] for c in range(5))
    assert second == equal.choices[1]  # one cell has nothing to choose from


def test_cells_that_no_viewpoint_shows_stay_at_the_level_of_the_category() -> None:
    measured, pixels = _measured(0)
    measured[:, 4], pixels[:, 4] = np.nan, 0
    of_label = np.stack([_whole(measured, pixels, np.full(5, k)) for k in range(LEVELS)], 1)
    both = np.stack([of_label, measured[:, 5]], 1)
    equal = plan_for_scene(both, np.zeros((VIEWS, 2)), _costs().by_label(LABEL_OF), 0.9, 0.95, "fidelity")
    plan = thinned(equal, measured, pixels, _costs(), LABEL_OF, {3: 0.9})
    assert plan.cells is not None
    assert plan.cells[4] == equal.levels[3]


def test_a_category_that_is_asked_for_more_goes_up() -> None:
    """Also one of a single cell, whose level is then the cheapest that keeps what is asked."""
    measured, pixels = _measured(0)
    of_label = np.stack([_whole(measured, pixels, np.full(5, k)) for k in range(LEVELS)], 1)
    both = np.stack([of_label, measured[:, 5]], 1)
    equal = plan_for_scene(both, np.zeros((VIEWS, 2)), _costs().by_label(LABEL_OF), 0.3, 0.95, "fidelity")
    asked = plan_for_scene(both, np.zeros((VIEWS, 2)), _costs().by_label(LABEL_OF), 0.7, 0.95, "fidelity")
    plan = thinned(equal, measured, pixels, _costs(), LABEL_OF, {3: 2.0, 7: 0.7})
    assert equal.levels[7] < plan.levels[7] == asked.levels[7]
    assert plan.levels[3] == LEVELS  # nothing keeps that, and its last level comes nearest


def test_what_cannot_be_asked_for_stays() -> None:
    """Of too few viewpoints for the share."""
    measured, pixels = _measured(1)
    of_label = np.stack([_whole(measured, pixels, np.full(5, k)) for k in range(LEVELS)], 1)
    both = np.stack([of_label, measured[:, 5]], 1)
    equal = plan_for_scene(both, np.zeros((VIEWS, 2)), _costs().by_label(LABEL_OF), 0.8, 0.95, "fidelity")
    plan = thinned(equal, measured[:18], pixels[:18], _costs(), LABEL_OF, {3: 0.9})
    assert plan.choices == equal.choices
    assert plan.cells == equal.levels_of_cells(LABEL_OF)


def test_by_how_much_a_composition_exceeds_its_target_is_said() -> None:
    measured, pixels = _measured(2)
    of_label = np.stack([_whole(measured, pixels, np.full(5, k)) for k in range(LEVELS)], 1)
    both = np.stack([of_label, measured[:, 5]], 1)
    equal = plan_for_scene(both, np.zeros((VIEWS, 2)), _costs().by_label(LABEL_OF), 0.8, 0.95, "fidelity")
    plan, over = measured_in_composition(equal, np.tile([0.75, 0.9], (30, 1)))
    assert over == {3: pytest.approx(-0.05), 7: pytest.approx(0.1)}
    assert [choice.calibrated for choice in plan.choices] == [False, True]
    assert plan.levels == equal.levels
    one = np.where(np.arange(20) == 3, 0.79, 0.85)[:, None] * np.ones(2)  # in 20 viewpoints, 19 of 20
    assert measured_in_composition(equal, one)[1] == dict.fromkeys((3, 7), pytest.approx(0.05))
    least = measured_in_composition(equal, one, proven=False)[1]
    assert least == dict.fromkeys((3, 7), pytest.approx(-0.01))


def _searched(response, target: float) -> list[tuple[list, list]]:
    """What a search asks for in each round, and by how much categories are over the target by `response`.

    `response` takes what is asked, and gives the bytes of categories (1: all) and what they measure.
    """
    choices = tuple(Choice(label, 1, target, math.nan, 1, "ok") for label in range(3))
    most = np.ones((3, 1), int)
    search, tried = Search(Plan(target, None, choices, 0.95), Costs((0, 1, 2), most, most, most)), []
    while True:
        asked = [search.asked[label] for label in range(3)]
        sent, measured = response(np.array(asked))
        over = [got - target for got in measured]
        tried.append((asked, over))
        choices = tuple(Choice(i, 1, target, math.nan, 1, "ok", sent[i]) for i in range(3))
        plan = Plan(target, None, choices, 0.95)
        if not search.narrow(plan, dict(enumerate(over))):
            return tried


@given(
    st.tuples(*[st.floats(-0.06, 0.06)] * 3),
    st.tuples(*[st.sampled_from([1e-4, 0.003, 0.012])] * 3),
    st.floats(0, 0.2),
    st.sampled_from([0.8, 0.9]),
)
def test_a_search_ends_close_to_its_target(error, step, spill, target) -> None:
    """Whatever compositions measure above or below what is asked, in steps of levels, beside neighbours."""

    def response(asked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        levels = np.ceil(asked / step) * step
        return np.zeros(3, int), np.minimum(levels + np.array(error) + spill * (levels.mean() - target), 1)

    tried = _searched(response, target)
    assert tried[0][0] == [target] * 3
    held = [over for _, over in tried if min(over) >= 0]
    assert held
    assert len(tried) <= 9
    assert max(min(held, key=sum)) < 0.03 + 0.012


def test_neighbours_are_asked_for_more_where_a_category_has_all_it_can_get() -> None:
    def response(asked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The first lies below the target until the second has 0.93."""
        first = 0.85 + 0.1 * (asked[1] >= 0.93)
        return (asked >= [0.92, 2, 2]).astype(int), np.array([first, *asked[1:]])

    asked, over = _searched(response, 0.9)[-1]
    assert min(over) >= 0
    assert asked[1] >= 0.93
