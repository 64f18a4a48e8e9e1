"""Levels of cells by which categories reach what they need."""

import json
from typing import Any

import make_plans
import numpy as np
import pytest

from sagesplat.adapt.cell_plans import reach

VECTORS = [case for case in json.loads(make_plans.PATH.read_text()) if case["mode"] == "cells"]


@pytest.mark.parametrize("case", VECTORS, ids=[case["name"] for case in VECTORS])
def test_vectors(case: dict[str, Any]) -> None:
    assert make_plans.reached(case) == case["expected"]["levels"]
    for label, levels in zip(case["labels"], case["expected"]["levels"], strict=True):
        seen = [(one, k) for one, k in zip(label["cells"], levels, strict=True) if one["visible"]]
        if label["theta"] is None or not seen or not label["weight"]:
            continue
        total = sum(one["share"] for one, _ in seen)
        mean = sum(one["share"] * one["mean"][k] for one, k in seen) / total
        best = sum(one["share"] * one["mean"][-1] for one, _ in seen) / total
        assert mean >= min(label["theta"], best) - 1e-8


def test_a_category_that_cannot_reach_it_says_so() -> None:
    cost, mean = np.array([[1, 2], [1, 3]]), np.array([[0.2, 0.5], [0.4, 0.9]])
    found = reach(cost, mean, np.array([0.1, 0.1]), np.array([0, 1]), np.array([0.8, 0.8]))
    assert (found.levels.tolist(), found.met.tolist()) == ([1, 1], [False, True])
