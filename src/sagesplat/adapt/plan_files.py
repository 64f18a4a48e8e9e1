"""Plans as JSON."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from sagesplat.adapt.plan import Plan
from sagesplat.io.files import write_json
from sagesplat.io.typed import read_json_as

_CURE = "delete it and run `sagesplat plan` again"


def write_plans(
    path: Path, scene_plans: Sequence[Plan], view_plans: Sequence[Plan] = (), budget_plan: Plan | None = None
) -> None:
    """plan.json: the plans of the scene (one or more targets), those of single views, one for a budget."""
    document = {
        "targets": sorted({plan.target for plan in (*scene_plans, *view_plans)}),
        "scene": [_to_json(plan) for plan in scene_plans],
        "views": [_to_json(plan) for plan in view_plans],
    }
    if budget_plan:
        document["budget"] = _to_json(budget_plan)
    write_json(path, document)


@dataclass(frozen=True)
class _Plans:
    scene: tuple[Plan, ...]
    views: tuple[Plan, ...]
    budget: Plan | None = None


def read_plans(path: Path | str) -> tuple[tuple[Plan, ...], tuple[Plan, ...]]:
    """The scene's plans and the single views' that `write_plans` wrote; DataError for unusable content."""
    plans = _read(Path(path))
    return plans.scene, plans.views


def read_budget_plan(path: Path) -> Plan | None:
    """The plan for a budget, if there is one; DataError for unusable content."""
    return _read(path).budget


def _read(path: Path) -> _Plans:
    return read_json_as(path, _Plans, "a file of plans", _CURE)


def _to_json(plan: Plan) -> dict[str, Any]:
    """A plan with its totals; NaN becomes null, which JSON has."""
    choices = [
        {name: None if value != value else value for name, value in asdict(choice).items()}
        | {"nbytes": choice.nbytes}
        for choice in plan.choices
    ]
    own = {f.name: getattr(plan, f.name) for f in fields(plan) if f.name not in ("choices", "titles")}
    own["target"] = None if math.isnan(plan.target) else plan.target
    totals = {n: getattr(plan, n) for n in ("count", "nbytes", "transfer_bytes", "status", "binding")}
    return {**own, **totals, "choices": choices}
