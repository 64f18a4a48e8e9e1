"""The table of stages: complete, in order, and what follows from what."""

import ast
from pathlib import Path

import sagesplat
from sagesplat.run.stage_table import STAGES, following, needed_for, stage_kind


def names_in_calls() -> set[str]:
    """The names that the package passes to functions that do a stage, those that it computes left out."""
    found = set()
    for path in Path(sagesplat.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                at = {"run_stage": 1, "Stage": 0, "_import": 3}.get(node.func.id)
                if at is not None and len(node.args) > at and isinstance(node.args[at], ast.Constant):
                    found.add(node.args[at].value)  # type: ignore
    return found


def test_every_stage_is_in_the_table_and_every_entry_is_a_stage() -> None:
    assert names_in_calls() | {"pruned", "mcmc"} == set(STAGES)


def test_a_stage_comes_after_what_it_is_made_of() -> None:
    order = list(STAGES)
    for name, kind in STAGES.items():
        assert all(order.index(needed) < order.index(name) for needed in kind.needs), name


def test_what_follows() -> None:
    assert following("given")[:3] == ["segment", "masks", "photo_instances"]
    assert {"borders", "compare", "compared", "paper"} <= set(following("nest"))
    assert "clean" not in following("fuse")
    assert following("pruned-0.5-600") == ["compare", "compared"]
    assert "scene" not in needed_for("scene") | needed_for("adopt") | needed_for("poses")
    assert stage_kind("mcmc-0.2") is STAGES["mcmc"]
