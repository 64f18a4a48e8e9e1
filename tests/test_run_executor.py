"""Work in pieces gives what it gives in one: whatever the order, and in whatever process."""

import pickle
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from sagesplat.core.config import (
    CompareConfig,
    MasksConfig,
    NestConfig,
    PlanConfig,
    RunConfig,
    SampleConfig,
    TrainConfig,
)
from sagesplat.core.errors import LabelError, RunError
from sagesplat.core.events import Event, Progress, StageDone, StageStarted, Training, Warned
from sagesplat.io.files import write_text
from sagesplat.run.executor import LOCAL, ProgressAggregator, Task, results, split
from sagesplat.run.job import Job
from sagesplat.run.remote import work_all
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import Stage, run_stages
from sagesplat.segment import hf
from sagesplat.segment.masks import Taxonomy
from sagesplat.segment.segmenters import Segmented
from sagesplat.stages.fit import fit_ladder
from sagesplat.stages.label import make_masks
from sagesplat.stages.observe import observe_levels
from sagesplat.stages.pipeline import run_all
from sagesplat.stages.sample import sample_levels
from sagesplat.stages.scene import open_scene
from sagesplat.studies.compare import report as comparison
from sagesplat.studies.compare.run import compare
from sagesplat.studies.sweep.file import read_sweep
from sagesplat.studies.sweep.run import run_sweep

CONFIG = RunConfig(
    train=TrainConfig(max_steps=40, level_every=20, sh_degree=1),
    nest=NestConfig(steps=6, levels=3, base_steps=10),
    sample=SampleConfig(views=8, calibration_views=8),
    plan=PlanConfig(target_ssim=0.4, other_targets=()),
)
COMPARE = CompareConfig(
    snapshots=2, shares=(0.3, 0.5), tune_steps=2, caps=(0.5,), budgets=2, lpips=Path("no")
)


class Shuffled:
    """Does tasks in any order, with nothing shared but files; what goes in and out is pickled."""

    parallel = 3
    backend: Literal["cuda"] | None = None
    memory = 0

    def __init__(self, seed: int = 1) -> None:
        self.random = np.random.default_rng(seed)
        self.names: list[str] = []

    def run(self, tasks: Sequence[Task], emit) -> Iterator[tuple[int, Any]]:
        together = ProgressAggregator(tasks, emit)
        self.names += [task.name for task in tasks]
        for number in self.random.permutation(len(tasks)).tolist():
            task = pickle.loads(pickle.dumps(tasks[number]))

            def tell(event: Event, number: int = number) -> None:
                together.tell(number, pickle.loads(pickle.dumps(event)))

            found = task.function(*task.arguments, tell)
            together.end(number)
            yield number, pickle.loads(pickle.dumps(found))


def square(number: int, emit) -> int:
    emit(Progress("inner", 1, 1))
    return number * number


def add(job: Job, number: int) -> int:
    job.emit(Warned("adding"))
    return number + len(job.scene.views)


@pytest.fixture(scope="module", autouse=True)
def plain_comparison() -> Iterator[None]:
    """Figures take most of the time of so small a run, and have their own tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparison, "write_report", lambda folder, *_: write_text(folder / "compare.md", ""))
        yield


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of this process alone."""
    run = tmp_path_factory.mktemp("run") / "run"
    run_all(Job(RunDir(run), lambda event: None), capture, CONFIG)
    return run


@pytest.mark.parametrize("executor", [LOCAL, Shuffled()])
def test_results_come_in_the_order_of_the_tasks(executor) -> None:
    tasks = [Task("squares", square, (number,)) for number in range(7)]
    assert results(executor, tasks, lambda event: None) == [0, 1, 4, 9, 16, 25, 36]
    assert results(executor, [], lambda event: None) == []


@pytest.mark.parametrize("parts", [1, 2, 3, 7, 100])
def test_a_split_keeps_all_items_in_pieces_alike(parts: int) -> None:
    found = split(range(7), parts)
    assert [item for piece in found for item in piece] == list(range(7))
    assert len(found) == min(parts, 7)
    assert max(map(len, found)) - min(map(len, found)) <= 1
    assert [list(piece) for piece in split([], parts)] == [[]]


def test_progress_of_several_tasks_is_one_bar() -> None:
    heard: list[Event] = []
    tasks = [Task("observe", square), Task("observe", square), Task("other", square)]
    together = ProgressAggregator(tasks, heard.append)
    together.tell(0, Progress("x", 2, 10))
    together.tell(1, Progress("x", 5, 20, "text"))
    together.tell(0, Training(4, 10, 0.5, {}, 7))
    together.end(0)
    together.tell(0, Progress("x", 6, 10, "late"))  # of another machine
    together.tell(2, Progress("alone", 1, 3))
    together.end(2)
    assert heard == [
        Progress("observe", 2, 20),  # the other one is thought to be as long
        Progress("observe", 7, 30, "text"),
        Progress("observe", 9, 30, "loss 0.500"),
        Progress("observe", 15, 30),
        Progress("observe", 15, 30, "late"),
        Progress("alone", 1, 3),
    ]


def test_a_warning_of_several_tasks_is_said_once() -> None:
    heard: list[Event] = []
    together = ProgressAggregator([Task("a", square), Task("a", square), Task("b", square)], heard.append)
    for number in (0, 1, 0, 2, 2):
        together.tell(number, Warned("same"))
    together.tell(1, StageDone("a", 1.0, ()))
    assert heard == [Warned("same")] * 3 + [StageDone("a", 1.0, ())]


def again(finished: Path, to: Path, executor, *gone: str) -> tuple[Job, list[Event]]:
    """A copy of a finished run, some of its stages to be done again."""
    shutil.copytree(finished, to)
    events: list[Event] = []
    job = Job(RunDir(to), events.append, executor=executor)
    for stage in gone:
        job.run.provenance(stage).unlink()
    return job, events


def test_observations_and_fits_are_the_same_bit_for_bit(finished: Path, tmp_path: Path) -> None:
    executor = Shuffled()
    job, events = again(finished, tmp_path / "run", executor, "observe", "sample", "fit")
    observe_levels(job, CONFIG.fit)
    sample_levels(job, CONFIG.sample, CONFIG.fit)
    fit_ladder(job, CONFIG.fit)
    trials = 3 * 4 + 2 * 6  # of compositions, at 4 viewpoints and at 20, less what is known already
    assert executor.names[:12] == ["observe"] * 6 + ["sample"] * 6
    others = 6 + len(job.scene.calibration_ids)
    assert set(executor.names[12:]) == {"fit"}
    assert others + 4 + 6 <= len(executor.names[12:]) <= others + trials
    before = RunDir(finished)
    for name in ("observations", "models", "promises", "viewpoints", "sampled", "fidelity"):
        assert getattr(job.run, name).read_bytes() == getattr(before, name).read_bytes(), name
    bar = [event for event in events if isinstance(event, Progress) and event.name == "observe"]
    views, levels = len(job.scene.views), 3
    assert (bar[-1].done, bar[-1].total) == (views * levels, views * levels)


def test_a_task_opens_the_job_of_its_scene(finished: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(finished.parent)
    job = Job(RunDir(Path("run")), lambda event: None, executor=Shuffled(), threads=3, memory_limit=10**9)
    assert work_all(job, "add", add, [1, 2, 3, 4]) == [13, 14, 15, 16]
    assert job.spec.run.path == finished.absolute()
    opened = job.spec.open(print)
    assert (opened.threads, opened.memory_limit, opened.executor) == (3, 10**9, LOCAL)
    assert opened.lock_wait > job.lock_wait == 0
    assert (job.pieces, replace(job, executor=LOCAL).pieces, job.gpus) == (6, 1, 0)


def photos_of(job: Job, number: int) -> tuple[int, int]:
    return id(job.scene), id(job.photos)


def test_tasks_of_one_process_share_the_scene_and_the_photos(finished: Path) -> None:
    job = Job(RunDir(finished), lambda event: None, executor=Shuffled())
    assert len(set(work_all(job, "look", photos_of, [1, 2, 3]))) == 1
    opened = job.spec.open(print, source=job)
    assert opened.scene is job.scene
    assert opened.photos is job.photos
    assert replace(opened, run=RunDir(finished, "snapshots")).photos is job.photos


def test_what_an_executor_has_decides_what_tasks_compute_with(tmp_path: Path) -> None:
    executor = Shuffled()
    executor.backend, executor.memory = "cuda", 5 * 10**9
    job = Job(RunDir(tmp_path), lambda event: None, "cpu", executor=executor)
    assert (job.spec.backend, job.spec.memory_limit, job.gpus) == ("cuda", 5 * 10**9, 1)
    assert replace(job, memory_limit=10**9).spec.memory_limit == 10**9


def test_a_capture_that_a_node_does_not_see_is_one_line(finished: Path, tmp_path: Path) -> None:
    job, _ = again(finished, tmp_path / "run", Shuffled())
    text = job.run.scene.read_text()
    job.run.scene.write_text(text.replace('"path": "/', '"path": "/nowhere/'))
    with pytest.raises(RunError, match=r"^/nowhere.*: .* does not see the capture; all nodes"):
        work_all(job, "add", add, [1])


class Bright:
    """Two categories by brightness; `die` ends it after so many photos."""

    note = ""
    left: float = np.inf
    names = ({1: "tree", 2: "sky"},)

    def __init__(self, *_: object, **__: object) -> None:
        self.taxonomy = Taxonomy(Bright.names[0])
        Bright.names = Bright.names[1:] + Bright.names[:1]

    def __call__(self, photos: Sequence[np.ndarray], /) -> list[Segmented]:
        Bright.left -= len(photos)
        if Bright.left < 0:
            raise KeyboardInterrupt
        return [Segmented(np.where(p[..., 0] > 127, 2, 1).astype(np.int16)) for p in photos]


def segmented(run: Path, capture: Path, executor) -> dict[str, bytes]:
    job = Job(RunDir(run), lambda event: None, executor=executor)
    open_scene(job, capture, CONFIG.scene)
    make_masks(job, MasksConfig(segmenter="hf", model="bright"))
    files = [path for path in job.run.segmented.rglob("*") if path.suffix in (".png", ".json")]
    return {str(path.relative_to(run)): path.read_bytes() for path in files}


def test_segmentation_in_pieces_writes_the_same_and_goes_on(
    capture: Path, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(hf, "HfSegmenter", Bright)
    whole = segmented(tmp_path / "whole", capture, LOCAL)
    assert len([name for name in whole if name.endswith(".png")]) == 12
    monkeypatch.setattr(Bright, "left", 6)
    with pytest.raises(KeyboardInterrupt):
        segmented(tmp_path / "pieces", capture, Shuffled())
    monkeypatch.setattr(Bright, "left", 6)
    assert segmented(tmp_path / "pieces", capture, Shuffled()) == whole
    monkeypatch.setattr(Bright, "left", np.inf)
    monkeypatch.setattr(Bright, "names", ({1: "tree", 2: "sky"}, {1: "tree", 2: "cloud"}))
    with pytest.raises(LabelError, match="the nodes' networks have other categories"):
        segmented(tmp_path / "other", capture, Shuffled())


SWEEP = """
targets = [0.4]
seeds = [0]
settings.ladder = "snapshots"
settings.train = { max_steps = 20, level_every = 10, sh_degree = 1 }
scenes.plot = "capture"
variants.a = {}
variants.b.fit.distance = "minimum"
variants.c.train.sh_degree = 0
"""


@pytest.mark.slow
def test_a_sweep_in_any_order_writes_the_same_tables(capture: Path, tmp_path: Path) -> None:
    (tmp_path / "capture").symlink_to(capture)
    (tmp_path / "sweep.toml").write_text(SWEEP)
    cells = read_sweep(tmp_path / "sweep.toml")
    tables, starts = {}, {}
    for name, executor in (("local", LOCAL), ("shuffled", Shuffled(3))):
        events: list[Event] = []
        run_sweep(cells, tmp_path / name, events.append, executor=executor)
        rows = (tmp_path / name / "cells.csv").read_text().splitlines()
        at = rows[0].split(",").index("training s")  # a clock's
        tables[name] = [[value for i, value in enumerate(row.split(",")) if i != at] for row in rows]
        starts[name] = [event.name for event in events if isinstance(event, StageDone) and "-" in event.name]
    assert tables["local"] == tables["shuffled"]
    assert [row[1] for row in tables["local"][1:]] == ["a", "b", "c"]
    assert starts["shuffled"][-1] == "plot-b-seed0"  # it waited for the training of a
    shared = [tmp_path / "shuffled" / "runs" / f"plot-{v}-seed0" / "labels.npz" for v in "ab"]
    assert shared[0].samefile(shared[1])


@pytest.mark.slow
def test_baselines_are_trained_side_by_side(finished: Path, tmp_path: Path) -> None:
    files = {}
    for name, executor in (("local", LOCAL), ("shuffled", Shuffled())):
        job, events = again(finished, tmp_path / name, executor)
        compare(job, COMPARE)
        files[name] = {path.name: path.read_bytes() for path in (job.run.path / "compare").glob("*.npz")}
        began = [event.name for event in events if isinstance(event, StageStarted)]
        ended = [event.name for event in events if isinstance(event, StageDone)]
        trained = ["pruned-0.3-2", "pruned-0.5-2", "mcmc-0.5"]
        assert sorted(began) == sorted(ended)
        assert [stage for stage in began if stage in trained] == trained
    assert len(files["local"]) == 3
    assert files["local"] == files["shuffled"]


def test_of_several_stages_those_that_are_done_are_skipped(finished: Path, tmp_path: Path) -> None:
    job, events = again(finished, tmp_path / "run", LOCAL)
    parts = [Stage(name, {}, [], [job.run.path / name]) for name in ("mcmc-1", "mcmc-2", "mcmc-3")]

    def make(missing: Sequence[int], last: int = 3) -> Iterator[tuple[int, Sequence[str]]]:
        for number in list(missing)[::-1][:last]:
            (job.run.path / parts[number].name).touch()
            yield number, [str(number)]
        if last < 3:
            raise RunError("broken")

    with pytest.raises(RunError, match="broken"):
        run_stages(job, parts, lambda missing: make(missing, 1))
    assert [e.name for e in events if isinstance(e, StageDone)] == ["mcmc-3"]
    run_stages(job, parts, make)
    assert [e.name for e in events if isinstance(e, StageDone)] == ["mcmc-3", "mcmc-2", "mcmc-1"]
