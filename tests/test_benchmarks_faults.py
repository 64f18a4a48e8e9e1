"""Disturbed runs: what is compared of two run folders, what runs print, and the table."""

import json
import sys
from pathlib import Path

import pytest

from benchmarks import faults_run
from benchmarks.faults_run import AGAIN, Asked, Command, differing, digests, ends, stages

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="kills and mounts are POSIX only")
SAID = """✓ scene        0.5 s  46 training, 8 test views
! block 1 (2 of 3): its process on vm was lost; done again (1 of 3)
! block 0: needs about 0.6 GiB
✓ block 0/train    2.0 s  13,039 Gaussians after 300 steps
! block 1: resuming from step 60
✓ block 1/train    3.0 s  16,999 Gaussians after 300 steps
✓ train        5.5 s  18,000 Gaussians of 2 blocks
"""


def record(seconds: float, levels: str = "1", masks: str = "1") -> str:
    return json.dumps({"seconds": seconds, "inputs": {"levels": levels, "masks.json": masks}})


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run folder in small."""
    run = tmp_path / "run"
    for folder in ("provenance", "levels", "nested"):
        (run / folder).mkdir(parents=True)
    (run / "levels" / "000100.npz").write_bytes(bytes(5000))
    (run / "provenance" / "train.json").write_text(record(1.5))
    (run / "nested" / "blocks.csv").write_text("block,views,train s\n0,5,1.25\n")
    (run / "nested" / "blocks.md").write_text("1.25")
    (run / ".lock").write_text("1")
    return run


def test_seconds_are_not_compared(run: Path) -> None:
    first = digests(run)
    (run / "provenance" / "train.json").write_text(record(9.0))
    (run / "nested" / "blocks.csv").write_text("block,views,train s\n0,5,9.75\n")
    (run / "nested" / "blocks.md").write_text("9.75")
    (run / ".lock").write_text("2")
    assert differing(first, digests(run)) == []


def test_everything_else_is(run: Path) -> None:
    first = digests(run)
    (run / "levels" / "000100.npz").write_bytes(bytes(4999) + b"\1")
    (run / "provenance" / "train.json").write_text(record(1.5, levels="2"))
    (run / "nested" / "blocks.csv").unlink()
    (run / "nested" / ".a.tmp-1.csv").write_text("")
    assert differing(first, digests(run)) == [
        "levels/000100.npz",
        "nested/.a.tmp-1.csv (left over)",
        "nested/blocks.csv (missing)",
        "provenance/train.json",
    ]


def test_what_a_run_prints_is_understood() -> None:
    found = stages(SAID)
    assert found == {"scene": 0.5, "block 0/train": 2.0, "block 1/train": 3.0, "train": 5.5}
    assert ends(found) == {"scene": 0.5, "block 0/train": 2.5, "block 1/train": 5.5, "train": 6.0}
    assert AGAIN.findall(SAID) == [
        "block 1 (2 of 3): its process on vm was lost; done again (1 of 3)",
        "block 1: resuming from step 60",
    ]


def program(folder: Path, monkeypatch: pytest.MonkeyPatch, does: str) -> Asked:
    """A program in the place of sagesplat."""
    script = folder / "program"
    script.write_text(f"#!/bin/sh\n{does}\n")
    script.chmod(0o755)
    monkeypatch.setattr(faults_run, "PROGRAM", (str(script),))
    return Asked(folder / "scene", folder / "out", ("--downscale=4",))


def test_a_command_is_killed(tmp_path: Path, monkeypatch) -> None:
    asked = program(tmp_path, monkeypatch, 'echo "✓ lift         0.3 s  97 %"; exec sleep 60')
    with Command(asked, "a") as command:
        command.wait_for("lift")
        assert command.done == ["lift"]
        assert command.end(0.01) is None
        assert command.kill()
        assert not command.kill()
    assert command.end() == -9
