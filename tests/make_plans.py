"""Test vectors of `adapt.allocate`, `fill` and `cell_plans`: `python tests/make_plans.py` writes them.

A case of tests/data/plans.json has the arguments of a function (null: NaN in quality, inf in cost, an
argument left out) and under "expected" what it returns. Modes: "target" is `cheapest`, or
`along` where quality has positions, "fill" is `fill` from "levels" on, "cells" is
`reach` for labels that need a mean "theta" (null: no promise) over their cells; cells out of sight, and those
of a label of weight 0, have no share.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from sagesplat.adapt.allocate import along, cheapest
from sagesplat.adapt.cell_plans import reach
from sagesplat.adapt.fill import fill

PATH = Path(__file__).parent / "data" / "plans.json"
Case = dict[str, Any]
NAN, INF = math.nan, math.inf
ARGUMENTS = ("target", "previous", "slack")

Q = [[0.5, 0.7, 0.8, 0.85], [0.6, 0.75, 0.9, 0.95], [0.3, 0.4, 0.6, 0.7]]
C = [[10, 20, 40, 80], [5, 15, 30, 60], [20, 30, 70, 90]]
W = [1, 2, 0.5]


def _by_hand() -> list[Case]:
    some = ([[NAN, 0.7, 0.8, NAN], Q[1], [0.3, NAN, NAN, 0.7]], C)
    one = [[0.5, 0.7, 0.9]], [[1, 4, 9]]
    bumpy = ([[0.6, 0.9, 0.7, 0.9], [0.8, 0.5, 0.85, 0.6]], [[1, 3, 4, 6], [2, 3, 5, 9]])
    unknown = [Q[0], [NAN] * 4, Q[2]]
    cases = [
        ("one label", *one, {"target": 0.7}),
        ("one level", [[0.5], [0.9]], [[3], [4]], {"target": 0.6}),
        ("equal costs, the higher quality", [[0.5, 0.7, 0.6]], [[4, 4, 4]], {"target": 0.5}),
        ("equal levels, the lower index", [[0.5, 0.7, 0.7]], [[1, 4, 4]], {"target": 0.6}),
        ("quality that falls", *bumpy, {"target": 0.7}),
        ("target reached exactly", Q, C, {"target": 0.7}),
        ("target out of reach", Q, C, {"target": 0.9}),
        ("a target per label", Q, C, {"target": [0.6, 0.9, 0.7]}),
        ("target 1", [[0.9, 1.0, 1.0], [0.9, 0.95, 0.95]], [[1, 2, 2], [1, 2, 3]], {"target": 1}),
        ("no promise for a label", unknown, C, {"target": 0.7}),
        ("no promise at all", [[NAN] * 4] * 3, C, {"target": 0.7}),
        ("no promise for some levels", *some, {"target": 0.65}),
        ("fewer levels", Q, [C[0], [INF, 15, 30, INF], [20, INF, INF, INF]], {"target": 0.8}),
        ("up at once", Q, C, {"target": 0.7, "previous": [0, 0, 0]}),
        ("stays above", [[0.6, 0.705, 0.8]], [[1, 2, 3]], {"target": 0.7, "previous": [2]}),
        ("comes down", [[0.6, 0.715, 0.8]], [[1, 2, 3]], {"target": 0.7, "previous": [2]}),
        ("comes down half the way", [[0.7, 0.715, 0.9, 0.95]], [[1, 2, 3, 4]],
         {"target": 0.7, "previous": [3]}),
        ("comes down near 1", [[0.9, 0.997, 1.0]], [[1, 2, 3]], {"target": 0.99, "previous": [2]}),
        ("stays near the best", [[0.5, 0.595, 0.6]], [[1, 2, 3]], {"target": 0.7, "previous": [1]}),
        ("leaves what is far from the best", [[0.5, 0.58, 0.6]], [[1, 2, 3]],
         {"target": 0.7, "previous": [1]}),
        ("no level before", Q, C, {"target": 0.7, "previous": [3, -1, -1]}),
        ("a level before that cannot be had", [[0.7, 0.8, 0.9]], [[1, 2, INF]],
         {"target": 0.75, "previous": [2]}),
    ]  # fmt: skip
    return [{"name": name, "mode": "target", "quality": q, "cost": c, **rest} for name, q, c, rest in cases]


def _fills() -> list[Case]:
    rising = [[0.3, 0.4, 0.9], [0.5, 0.95, 1.0]], [[10, 20, 60], [10, 30, 90]]
    free = [[0.2, 0.5, 0.9], [0.5, 0.8, 1.0]], [[10, 10, 60], [10, 30, 90]]
    bumpy = [[0.4, 0.45, 0.7, 0.75], [0.5, 0.6, 0.65, 1.0]], [[5, 10, 12, 90], [20, 30, 60, 70]]
    cases = [
        ("a hard category that is small", *rising, [1, 9], [2, 0]),
        ("nothing to add", *rising, [1, 9], [0, 1]),
        ("equal levels", *rising, [1, 9], [1, 1]),
        ("all at the top", *rising, [1, 9], [2, 2]),
        ("weight 0 stays", *rising, [1, 0], [0, 2]),
        ("all weights 0", *rising, [0, 0], [2, 0]),
        ("an unknown mean stays, its bytes count", [[NAN, 0.4, 0.9], Q[0][:3]], rising[1], [5, 9], [2, 0]),
        ("a gain without bytes comes first", *free, [3, 2], [0, 2]),
        ("a gain without bytes where all is well", *free, [3, 2], [0, 0]),
        ("levels below the hull are passed over", *bumpy, [2, 5], [3, 0]),
        ("equal labels, the lower first", [rising[0][1]] * 3, [rising[1][1]] * 3, [1, 1, 1], [2, 0, 0]),
        ("one level", [[0.5], [0.9]], [[3], [4]], [1, 1], [0, 0]),
        ("one label", [[0.5, 0.6, 0.9]], [[3, 4, 9]], [2], [1]),
        ("no cost at all", [[0.5, 0.7], [0.6, 0.6]], [[0, 0], [0, 0]], [1, 1], [0, 0]),
    ]  # fmt: skip
    names = "name", "quality", "cost", "weight", "levels"
    found: list[Case] = [{"mode": "fill", **dict(zip(names, case, strict=True))} for case in cases]
    rng = np.random.default_rng(3)
    for labels, levels in ((2, 3), (3, 5), (5, 8), (12, 16), (40, 6), (128, 16)):
        for target in (0.6, 0.8):
            quality, cost, weight = scene(rng, 1, labels, levels)
            quality = np.maximum.accumulate(quality[0], 1)
            begin = cheapest(quality, cost, target).levels.tolist()
            case = {"quality": quality.tolist(), "cost": cost.tolist(), "weight": weight.tolist()}
            name = f"{labels} labels of {levels} levels, from {target}"
            found.append({"name": name, "mode": "fill", **case, "levels": begin})
    return found


def _cells() -> list[Case]:
    rng = np.random.default_rng(5)
    found = []
    for name, sizes, levels, theta in (
        ("a cell", [1], 3, [0.7]),
        ("cells of a label", [5], 4, [0.8]),
        ("nothing to reach", [3], 4, [-1.0]),
        ("out of reach", [3], 4, [0.995]),
        ("no promise", [3, 2], 4, [None, 0.8]),
        ("everything", [3, 2], 4, [1.0, 0.7]),
        ("labels", [2, 6, 1, 4], 6, [0.6, 0.8, 0.9, 0.7]),
        ("many", [16] * 8, 16, [0.9] * 8),
    ):
        labels = []
        for n, wanted in zip(sizes, theta, strict=True):
            quality, cost, _ = scene(rng, 1, n, levels)
            mean = np.maximum.accumulate(quality[0], 1)
            visible = rng.uniform(size=n) < 0.75
            share = np.where(visible, rng.exponential(0.05, n).round(5) + 1e-5, 0.0)
            cells = [
                {"cost": c, "mean": m, "share": s, "visible": bool(s > 0)}
                for c, m, s in zip(cost.tolist(), mean.tolist(), share.tolist(), strict=True)
            ]
            weight = 0.0 if name == "labels" and n == 1 else 1.0
            labels.append({"cells": cells, "weight": weight, "theta": wanted})
        found.append({"name": name, "mode": "cells", "labels": labels})
    return found


def reached(case: Case) -> list[list[int]]:
    """The levels of the cells of a case's labels."""
    labels = case["labels"]
    every = [(i, label, cell) for i, label in enumerate(labels) for cell in label["cells"]]
    found = reach(
        np.array([cell["cost"] for _, _, cell in every], np.int64),
        np.array([cell["mean"] for _, _, cell in every]),
        np.array([cell["share"] if label["weight"] else 0.0 for _, label, cell in every]),
        np.array([i for i, _, _ in every]),
        np.array([math.nan if label["theta"] is None else label["theta"] for label in labels]),
    ).levels
    ends = np.cumsum([len(label["cells"]) for label in labels])
    return [part.tolist() for part in np.split(found, ends[:-1])]


def scene(rng: np.random.Generator, *shape: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quality [P, L, K] as on a walk, cost [L, K] and weight [L] as in a scene, of 4 digits."""
    _, labels, levels = shape
    share = np.linspace(0.1, 1, levels) ** rng.uniform(1, 2, (labels, 1))
    cost = np.ceil(np.exp(rng.normal(9, 1.2, (labels, 1))) * share) * 16
    phase = rng.uniform(0, 2 * np.pi, labels) + np.linspace(0, 6, shape[0])[:, None]
    rise = (5 + 3 * np.sin(phase))[..., None]
    quality = rng.uniform(0.75, 0.98, (labels, 1)) * (1 - np.exp(-rise * (share + 0.05)))
    return quality.round(4), cost, rng.exponential(1000, labels).round()


def _random() -> list[Case]:
    rng, cases = np.random.default_rng(7), []
    for labels, levels in ((2, 3), (3, 4), (4, 4), (5, 5), (12, 16), (40, 6)):
        quality, cost, _ = scene(rng, 1, labels, levels)
        case = {"quality": quality[0].tolist(), "cost": cost.tolist()}
        name = f"{labels} labels of {levels} levels"
        cases.append({"name": name, "mode": "target", **case, "target": 0.8})
        before = rng.integers(0, levels, labels).tolist()
        cases.append({"name": name, "mode": "target", **case, "target": 0.7, "previous": before})
    for labels, levels in ((3, 4), (6, 5)):
        quality, cost, _ = scene(rng, 12, labels, levels)
        case = {"quality": quality.tolist(), "cost": cost.tolist()}
        name = f"a walk past {labels} labels of {levels} levels"
        cases.append({"name": name, "mode": "target", **case, "target": 0.8})
    return cases


def arguments(case: Case) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Quality, cost and the other arguments of a case, as the functions take them."""
    quality = np.array(case["quality"], np.float64)
    cost = np.array([[INF if c is None else c for c in row] for row in case["cost"]], np.float64)
    return quality, cost, {name: case[name] for name in ARGUMENTS if case.get(name) is not None}


def expected(case: Case) -> Case:
    """What the implementation here makes of a case."""
    if case["mode"] == "cells":
        return {"levels": reached(case)}
    quality, cost, rest = arguments(case)
    if case["mode"] == "fill":
        weight = np.array(case["weight"], np.float64)
        return {"levels": fill(np.array(case["levels"]), quality, cost, weight).tolist()}
    if quality.ndim == 3:
        return {"levels": along(quality, cost, **rest).tolist()}
    plan = cheapest(quality, cost, **rest)
    return {**vars(plan), "levels": plan.levels.tolist(), "missed": plan.missed.tolist()}


def cases() -> list[Case]:
    """All cases, as in the file."""

    def plain(value: Any) -> Any:
        if isinstance(value, list):
            return [plain(v) for v in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    made = _by_hand() + _random() + _fills() + _cells()
    whole = [{key: plain(value) for key, value in case.items()} for case in made]
    return [case | {"expected": expected(case)} for case in whole]


def main() -> None:
    """Write the file, a case a line."""
    PATH.parent.mkdir(exist_ok=True)
    lines = ",\n".join(json.dumps(case) for case in cases())
    PATH.write_text(f"[\n{lines}\n]\n")


if __name__ == "__main__":
    main()
