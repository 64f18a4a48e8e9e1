"""labels.edit.json: reading, writing, refusing, and what ranks mean."""

import json
from pathlib import Path

import numpy as np
import pytest

from sagesplat.adapt.ladder import read_prefixes
from sagesplat.core.errors import LabelError
from sagesplat.formats.increments import read_increments
from sagesplat.formats.label_edits import (
    Full,
    Hide,
    LabelEdits,
    Merge,
    Rename,
    Split,
    Weigh,
    dump_edits,
    parse_edits,
    ranks_of,
    read_edits,
)
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.stages.export import increment_files
from sagesplat.stages.results import increments_of

EDITS = LabelEdits(
    "a" * 64,
    (
        Rename("car", "Ма́шина <b>"), Merge("van", "car 2"), Split("tree", "leaf", {"tree": ((0, 3), (9, 1))}),
        Hide("tree", True), Weigh("tree", 2.5), Full("tree", False),
    ),
)  # fmt: skip


def broken(**changes: object) -> bytes:
    return json.dumps({**json.loads(dump_edits(EDITS)), **changes}).encode()


def split(ranks: list[int]) -> bytes:
    return broken(operations=[{"op": "split", "category": "a", "to": "b", "gaussians": {"a": ranks}}])


def test_edits_are_read_as_they_were_written() -> None:
    assert parse_edits(dump_edits(EDITS)) == EDITS


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"[" * 100_000, "damaged"),
        (dump_edits(EDITS)[:-9], "damaged"),
        (broken(version=2), "reads up to 1"),
        (broken(ladder="../run"), "ladder: expected str"),
        (broken(operations=[{"op": "delete"}]), "'delete' is not known"),
        (broken(operations=[{"op": "rename", "category": "a"}]), "missing required field to"),
        (broken(operations=[{"op": "rename", "category": "a", "to": "x" * 300}]), "300 characters"),
        (broken(operations=[{"op": "weigh", "category": "a", "weight": -1}]), "weight: expected float >= 0"),
        (split([]), "empty selection"),
        (split([3, 2, 4, 1]), "rise"),
        (split([0, 2**40]), "expected int <= 2147483647"),
    ],
)  # fmt: skip
def test_what_is_none_is_one_line(content: bytes, why: str) -> None:
    with pytest.raises(LabelError, match=why) as error:
        parse_edits(content)
    assert len(str(error.value)) < 400


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(LabelError, match="cannot be read"):
        read_edits(tmp_path / "labels.edit.json")


def test_runs_are_what_they_are_of() -> None:
    assert ranks_of(((0, 3), (7, 1), (9, 2))).tolist() == [0, 1, 2, 7, 9, 10]


def test_a_rank_is_the_same_in_the_ladder_in_streams_and_in_spz(finished_run: Path, tmp_path: Path) -> None:
    job = Job(RunDir(finished_run), lambda event: None, "cpu")
    ladder, streams = read_prefixes(job.run.prefixes), increments_of(job)
    spz = increment_files(job, tmp_path / "spz", "spz")
    for label in ladder.sizes:
        known = ladder.load(ladder.levels[-1], [label]).means.numpy()
        for folder, listed in ((job.run.increments, streams), (tmp_path / "spz", spz)):
            mine = sorted((one for one in listed if one.label_id == label), key=lambda one: one.level)
            np.testing.assert_allclose(read_increments(folder, mine).means.numpy(), known, atol=0.04)
