"""Plans as JSON."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, get_args

from sagesplat.adapt.plan import STATUSES, Choice, Plan, Reached
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.core.errors import DataError, short
from sagesplat.io.files import read_json, write_json

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


def read_plans(path: Path | str) -> tuple[tuple[Plan, ...], tuple[Plan, ...]]:
    """The scene's plans and the single views' that `write_plans` wrote; DataError for unusable content."""
    path = Path(path)
    document = read_json(path, _CURE)
    with _usable(path):
        scene_plans = tuple(_from_json(entry) for entry in document["scene"])
        view_plans = tuple(_from_json(entry) for entry in document["views"])
        return scene_plans, view_plans


def read_budget_plan(path: Path) -> Plan | None:
    """The plan for a budget, if there is one; DataError for unusable content."""
    document = read_json(path, _CURE)
    with _usable(path):
        return _from_json(document["budget"]) if "budget" in document else None


@contextmanager
def _usable(path: Path) -> Iterator[None]:
    try:
        yield
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path}: not a file of plans ({short(repr(error))}); {_CURE}") from None


def _to_json(plan: Plan) -> dict[str, Any]:
    """A plan with its totals; NaN becomes null, which JSON has."""
    choices = [
        {name: None if value != value else value for name, value in asdict(choice).items()}
        | {"nbytes": choice.nbytes}
        for choice in plan.choices
    ]
    own = {f.name: getattr(plan, f.name) for f in fields(plan) if f.name != "choices"}
    own["target"] = None if math.isnan(plan.target) else plan.target
    totals = {n: getattr(plan, n) for n in ("count", "nbytes", "transfer_bytes", "status", "binding")}
    return {**own, **totals, "choices": choices}


def _from_json(entry: dict[str, Any]) -> Plan:
    def number(value: float | None) -> float:
        return math.nan if value is None else float(value)

    def maybe(kind: Callable[[Any], Any], value: Any) -> Any:
        return None if value is None else kind(value)

    choices = tuple(
        Choice(
            label_id=int(choice["label_id"]),
            level=int(choice["level"]),
            predicted=number(choice["predicted"]),
            distance=number(choice["distance"]),
            count=int(choice["count"]),
            status=str(choice["status"]),
            transfer_bytes=maybe(int, choice.get("transfer_bytes")),
            calibrated=maybe(bool, choice.get("calibrated")),
            reached=maybe(_reached, choice.get("reached")),
        )
        for choice in entry["choices"]
    )
    if unknown := {choice.status for choice in choices} - set(STATUSES):
        raise ValueError(f"unknown status {unknown.pop()!r}")
    quality = entry["quality"]
    if quality not in get_args(QualityKind):
        raise ValueError(f"unknown quality {quality!r}")
    return Plan(
        target=number(entry["target"]),
        view=maybe(int, entry["view"]),
        choices=choices,
        share=maybe(float, entry["share"]),
        budget=maybe(float, entry.get("budget")),
        unit=maybe(str, entry.get("unit")),
        fits=bool(entry["fits"]),
        quality=quality,
    )


def _reached(entry: dict[str, Any]) -> Reached:
    share, low, high = (float(entry[name]) for name in ("share", "low", "high"))
    found = Reached(share, low, high, int(entry["num_views"]))
    if not 0 <= found.low <= found.share <= found.high <= 1 or found.num_views < 0:
        raise ValueError("an impossible share of views")
    return found
