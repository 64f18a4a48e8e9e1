"""The table of stages: complete, in order, and what follows from what."""

import ast
from pathlib import Path

import pytest

import sagesplat
from sagesplat import cli
from sagesplat.core.errors import RunError
from sagesplat.run.job import Job
from sagesplat.run.records import settings_of
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import run_stage
from sagesplat.run.stage_table import STAGES, command_of, following, needed_for, stage_kind


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


def test_the_command_of_a_stage_can_be_typed() -> None:
    commands = {name: command_of(name).split() for name in STAGES}
    assert all(words[0] == "sagesplat" and words[1] in cli.commands() for words in commands.values())
    assert commands["photo_instances"] == ["sagesplat", "instances"]
    assert command_of("pruned-0.5-600") == "sagesplat compare"
    assert command_of("paper") == "sagesplat report --paper"


def test_a_missing_input_names_a_command(tmp_path: Path) -> None:
    job = Job(RunDir(tmp_path), print)
    job.run.scene.touch()
    with pytest.raises(RunError, match=r"levels: missing; run what comes before `sagesplat nest`, or"):
        run_stage(job, "base", {}, [job.run.levels], [job.run.base_model], list)
    with pytest.raises(RunError, match="stage scene is not done; run `sagesplat masks` or `sagesplat run`"):
        settings_of(job.run, "scene")
