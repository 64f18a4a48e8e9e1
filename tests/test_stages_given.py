"""A splat that a script has in memory becomes a run, as a file does."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import orbit, random_gaussians

from sagesplat import AdoptConfig, Event, FinishedRun, Gaussians, StageDone, StageSkipped, adopt_splat
from sagesplat.core.errors import RunError
from sagesplat.core.events import Progress
from sagesplat.formats.increments import read_index
from sagesplat.formats.levels import read_level
from sagesplat.formats.sog_write import sog_order
from sagesplat.scene.scene import Camera
from sagesplat.stages import pipeline

SPLAT = random_gaussians(200, degree=1, logit=2.0)
NAMES = {3: "car", 184: "tree-merged"}
SMALL = AdoptConfig(fit="none", shares=(0.3, 1.0), views=14, size=(48, 36), kind="object")


@pytest.fixture(autouse=True)
def up_to_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    """What follows the levels takes most of the time, and is the same for files."""
    monkeypatch.setattr(pipeline, "measure_and_plan", lambda job, config: None)
    monkeypatch.setattr("sagesplat.output.contact_sheet.contact_sheet", lambda path, *_, **__: path.touch())


def adopted(folder: Path, events: list[Event], g: Gaussians = SPLAT, **options) -> FinishedRun:  # type: ignore[no-untyped-def]
    return adopt_splat(g, folder, SMALL, names=NAMES, on_event=events.append, threads=1, **options)


def same(cameras: Sequence[Camera], others: Sequence[Camera]) -> bool:
    pairs = zip(cameras, others, strict=True)
    return all(np.allclose(a.w2c, b.w2c, atol=1e-6) and np.allclose(a.K, b.K, atol=1e-4) for a, b in pairs)


def test_gaussians_and_cameras_become_a_run_that_resumes(tmp_path: Path) -> None:
    events: list[Event] = []
    cameras = orbit(14)
    run = adopted(tmp_path / "place", events, cameras=cameras)
    assert {event.name for event in events if isinstance(event, StageDone)} >= {"adopt", "lift", "nest"}
    assert any(isinstance(event, Progress) for event in events)
    assert same([view.camera for view in run.scene.views], cameras)
    assert run.scene.name == "place"
    found = read_level(run.job.run.adopted)
    order = torch.from_numpy(sog_order(SPLAT))
    for name, tensor in SPLAT.parameters().items():
        assert torch.equal(getattr(found, name), tensor[order]), name  # bit by bit, by category
    assert {"car", "tree-merged"} <= set(run.names.values())
    assert str(run) == f"{tmp_path / 'place'}: nested levels, not planned yet"
    (nest,) = (event for event in events if isinstance(event, StageDone) and event.name == "nest")
    full = run.costs.transfer_bytes[:, -1].sum()
    everything = sum(one.nbytes for one in read_index(run.job.run.increments))
    assert f"takes {full / 1e6:.2f} MB, all together {everything / 1e6:.2f} MB, " in nest.lines[0]
    assert full < everything
    events.clear()
    adopted(tmp_path / "place", events, cameras=cameras)
    assert {type(event) for event in events} == {StageSkipped}
    other = replace(SPLAT, means=SPLAT.means + 1)
    with pytest.raises(RunError, match="--force"):
        adopted(tmp_path / "place", events, other, cameras=cameras)


def test_what_cannot_be_is_one_line_and_nothing_is_written(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("not a run")
    with pytest.raises(RunError, match="mine: not empty and not a run folder"):
        adopted(tmp_path / "mine", [])
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["letter.txt"]
    with pytest.raises(RunError, match="an empty list of cameras; leave them out"):
        adopted(tmp_path / "new", [], cameras=[])
    with pytest.raises(RunError, match=r"scene\.ply: a file says names and antialiasing itself"):
        adopt_splat(tmp_path / "scene.ply", tmp_path / "new", names=NAMES)
