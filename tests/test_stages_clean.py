"""Floaters go from the last level, which is kept as it was trained."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import SMALL_RUN

from sagesplat.core.config import BlocksConfig, CleanConfig
from sagesplat.core.errors import DataError, RunError
from sagesplat.core.events import Event, StageDone, StageSkipped
from sagesplat.formats.levels import read_header, read_level, select_level, write_level
from sagesplat.io.files import write_json
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.stages.block_levels import nest_scene
from sagesplat.stages.blocks import train_scene
from sagesplat.stages.clean import clean_levels, clean_lines, read_clean_figures


@pytest.fixture
def run(run: Path) -> RunDir:
    return RunDir(run)


def job_of(run: RunDir, events: list[Event] | None = None, *, force: bool = False) -> Job:
    return Job(run, (events if events is not None else []).append, "cpu", force=force)


def last_level(run: RunDir) -> Path:
    return max(run.levels.glob("*.npz"))


def spoil(run: RunDir) -> int:
    """Put a few Gaussians of the last level where no view sees them, and forget its cleaning; how many."""
    g, header = read_level(last_level(run)), read_header(last_level(run))
    g.means[::10] = torch.tensor([0.0, 0, -50])
    for path in (run.cleaned, run.floaters, run.provenance("clean")):
        path.unlink(missing_ok=True)
    write_level(run.levels, header.step, g, recovering=header.recovering, sh_degree=header.sh_degree)
    return len(g.means[::10])


def test_hidden_gaussians_go_and_the_others_keep_every_bit(run: RunDir) -> None:
    hidden, events = spoil(run), list[Event]()
    before, recorded = read_level(last_level(run)), last_level(run).read_bytes()
    clean_levels(job_of(run, events), CleanConfig())
    after, figures = read_level(job_of(run).trained), read_clean_figures(run.floaters)
    assert figures is not None
    assert figures.removed["hardly shown"] >= hidden
    assert len(after) == figures.gaussians - sum(figures.removed.values()) < len(before)
    assert run.floaters_picture.exists()
    rows = set(map(tuple, before.select(before.means[:, 2] > -40).means.tolist()))
    assert set(map(tuple, after.means.tolist())) <= rows
    done = next(event for event in events if isinstance(event, StageDone))
    assert done.lines == tuple(clean_lines(figures))
    assert last_level(run).read_bytes() == recorded  # the snapshots are what training recorded


def test_it_is_done_once_and_can_be_switched_off(run: RunDir) -> None:
    spoil(run)
    clean_levels(job_of(run), CleanConfig())
    events: list[Event] = []
    clean_levels(job_of(run, events), CleanConfig())
    assert [type(event) for event in events] == [StageSkipped]
    run.cleaned.unlink()
    clean_levels(job_of(run), CleanConfig())
    assert run.cleaned.exists()
    with pytest.raises(RunError, match=r"made with other floaters .*--force"):
        clean_levels(job_of(run), CleanConfig(floaters="keep"))
    clean_levels(job_of(run, force=True), CleanConfig(floaters="keep"))
    assert not run.cleaned.exists()
    assert not run.floaters_picture.exists()
    assert job_of(run).trained == last_level(run)
    figures = read_clean_figures(run.floaters)
    assert figures is not None
    assert not figures.removed


def test_nested_levels_are_made_of_what_is_left(run: RunDir) -> None:
    spoil(run)
    clean_levels(job_of(run), CleanConfig())
    nest_scene(job_of(run, force=True), SMALL_RUN.nest, 0)
    job = job_of(run)
    assert job.ladder.size(job.ladder.levels[-1]) == sum(read_header(run.cleaned).counts.values())
    run.cleaned.write_bytes(b"PK")
    with pytest.raises(DataError, match=r"cleaned\.npz: .*delete it and run `sagesplat clean` again"):
        nest_scene(job_of(run, force=True), SMALL_RUN.nest, 0)


def test_another_training_is_cleaned_anew(run: RunDir) -> None:
    made = (run.cleaned, run.floaters, run.floaters_picture, run.provenance("clean"))
    for path in made:
        path.write_bytes(b"of this training")
    train_scene(job_of(run, force=True), replace(SMALL_RUN.train, max_steps=4), BlocksConfig(), 0)
    assert not any(path.exists() for path in made)


def test_a_scene_in_blocks_and_an_adopted_splat_are_refused(run: RunDir) -> None:
    write_json(run.division, {})
    with pytest.raises(RunError, match=r"blocks: floaters are not removed from a scene in blocks"):
        clean_levels(job_of(run), CleanConfig())
    run.adopted.write_bytes(b"")
    with pytest.raises(RunError, match=r"a splat that was trained elsewhere"):
        clean_levels(job_of(run), CleanConfig())


def test_a_level_is_selected_as_it_is_stored(run: RunDir, tmp_path: Path) -> None:
    source = last_level(run)
    g = read_level(source)
    keep = np.arange(len(g)) % 3 > 0
    keep[(g.label_ids == g.label_ids[0]).numpy()] = False  # a category that is gone
    select_level(source, tmp_path / "some.npz", keep)
    some = read_level(tmp_path / "some.npz")
    for name, values in g.select(torch.from_numpy(keep)).parameters().items():
        assert torch.equal(values, getattr(some, name)), name
    assert read_header(tmp_path / "some.npz").step == read_header(source).step
    with pytest.raises(ValueError, match="3 rows for"):
        select_level(source, tmp_path / "none.npz", np.ones(3, bool))
