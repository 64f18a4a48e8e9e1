"""Plans of a scene by cell: what is asked of categories that miss in compositions, and of neighbours."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sagesplat.adapt.bound_plans import Costs
from sagesplat.adapt.fidelity import SampledFidelity
from sagesplat.adapt.scene_plans import plan_for_scene
from sagesplat.stages import methods

VIEWS, LEVELS = 40, 5
LABEL_OF = {0: 3, 1: 3, 2: 7, 3: 7}  # tree, sky
NBYTES = np.array([10, 20, 40, 80, 160])[None].repeat(4, 0)


class Stub(methods.NestedLevels):
    """Of two categories; the sky misses by what trees below `enough` spill over it."""

    def __init__(self, enough: int) -> None:
        cells: Any = SimpleNamespace(label_of=LABEL_OF, labels=np.array([3, 3, 7, 7]))
        self.job: Any = SimpleNamespace(cells=cells)
        self.enough, self.asked, self.held = enough, 0, list[int]()
        self.cell_costs = Costs((0, 1, 2, 3), NBYTES, NBYTES, NBYTES)
        self.costs = self.cell_costs.by_label(LABEL_OF)

    def _in_composition(self, plans, cameras) -> np.ndarray:
        self.asked += 1
        measured = np.full((VIEWS, len(plans), 2), 0.95)
        for j, plan in enumerate(plans):
            assert plan.cells is not None
            if min(plan.cells[0], plan.cells[1]) < self.enough:
                measured[:, j, 1] = 0.85
            else:
                self.held.append(self.asked)
        return measured


def sampled() -> SampledFidelity:
    fidelity = np.broadcast_to(np.linspace(0.6, 1, LEVELS), (VIEWS, 4, LEVELS)).astype(np.float32)
    pixels, image = np.full((VIEWS, 4), 100, np.int32), np.full(VIEWS, 400, np.int32)
    distance = np.ones((VIEWS, 4), np.float32)
    return SampledFidelity((0, 1, 2, 3), fidelity, pixels, image, fidelity[:, 0], distance)


@pytest.mark.parametrize("enough", [4, 5])
def test_neighbours_that_spill_over_a_category_are_asked_for_more(monkeypatch, enough: int) -> None:
    """The sky cannot help itself: more of it changes nothing, so the trees go up as far as it takes."""
    monkeypatch.setattr(methods, "sampled_of", lambda job: sampled())
    method = Stub(enough)
    of_label = np.broadcast_to(np.linspace(0.6, 1, LEVELS), (VIEWS, 2, LEVELS))
    plan = plan_for_scene(of_label, np.zeros((VIEWS, 2)), method.costs, 0.9, 0.95, "fidelity")
    found = method._thinned([plan], 0.95, [None] * VIEWS)  # type: ignore[list-item]
    assert plan.levels == {3: 4, 7: 4}
    assert list(found) == [0]
    assert found[0].cells is not None
    assert min(found[0].cells[0], found[0].cells[1]) >= enough
    assert method.held[0] <= 6  # the first that holds; then it is asked for less
    assert method.asked <= 9


def test_what_nothing_cures_is_left_to_plans_of_equal_levels(monkeypatch) -> None:
    monkeypatch.setattr(methods, "sampled_of", lambda job: sampled())
    method = Stub(LEVELS + 1)
    of_label = np.broadcast_to(np.linspace(0.6, 1, LEVELS), (VIEWS, 2, LEVELS))
    plan = plan_for_scene(of_label, np.zeros((VIEWS, 2)), method.costs, 0.9, 0.95, "fidelity")
    assert method._thinned([plan], 0.95, [None] * VIEWS) == {}  # type: ignore[list-item]
