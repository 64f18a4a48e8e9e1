"""What a result was made from: every file that a stage reads is among its inputs, and all inputs count."""

import csv
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import job_of

from sagesplat.core.config import (
    BlocksConfig,
    LabelsConfig,
    NestConfig,
    PaperConfig,
    PlanConfig,
    RunConfig,
    SampleConfig,
    SceneConfig,
    TrainConfig,
)
from sagesplat.core.errors import OutOfMemory, RunError
from sagesplat.core.events import Event, Progress, StageDone
from sagesplat.io.files import read_json, write_json, write_text
from sagesplat.run import stage
from sagesplat.run.job import Job
from sagesplat.run.records import FORMAT, file_hash, input_hashes, is_done, is_made_from, record, settings_of
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage_table import needed_for
from sagesplat.stages import pipeline
from sagesplat.stages.fit import fit_ladder
from sagesplat.stages.label import fuse_masks, make_masks
from sagesplat.stages.nest import nest_levels
from sagesplat.stages.observe import observe_levels
from sagesplat.stages.pipeline import run_all
from sagesplat.stages.report_data import stage_records
from sagesplat.stages.train import train_levels
from sagesplat.studies.paper.run import paper_report
from sagesplat.train import nested

CONFIG = RunConfig(
    scene=SceneConfig(calibrate_every=4),
    train=TrainConfig(max_steps=20, level_every=10, sh_degree=1),
    nest=NestConfig(steps=12, levels=3, smallest=0.1, base_steps=10),
    sample=SampleConfig(views=8, calibration_views=8),
    plan=PlanConfig(target_ssim=0.4, other_targets=()),
)
BLOCKS = BlocksConfig(count=2)


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("run") / "run"
    work(run, capture)
    return run


@pytest.fixture
def copy(finished: Path, tmp_path: Path) -> Path:
    """The finished run, moved to where it may be changed."""
    shutil.copytree(finished, tmp_path / "moved")
    return tmp_path / "moved"


def work(run: Path, capture: Path, config: RunConfig = CONFIG, **options) -> list[Event]:
    events: list[Event] = []
    run_all(Job(RunDir(run, config.ladder), events.append, "cpu", **options), capture, config)
    return events


def done(events: list[Event]) -> list[str]:
    return [e.name for e in events if isinstance(e, StageDone)]


def rows_of(table: Path) -> list[dict[str, str]]:
    with table.open(newline="") as file:
        return list(csv.DictReader(file))


# every file that a stage reads

_reading: list[set[str]] = []  # paths opened for reading, of the stages at work; nothing is watched if empty


def _hear(event: str, arguments: tuple) -> None:
    if event == "open" and _reading and isinstance(arguments[0], str | bytes | os.PathLike):
        path, mode, flags = arguments
        writes = set(mode) & set("wax+") if mode else flags & (os.O_WRONLY | os.O_RDWR)
        if not writes:
            _reading[-1].add(os.path.abspath(os.fsdecode(path)))


sys.addaudithook(_hear)

# read, and yet no input: a stage's name, and the file's or its folder's
_NO_INPUTS = {
    ("train", "labels.json"),  # names that are shown on the way
    ("base", "train.json"),  # its settings are among those of the small model
    ("base", "levels"),  # their number of Gaussians is in the settings
    ("base", "labels.json"),  # only looked at: ids without a name are refused
    ("borders", "labels.json"),
}
# of a block: its scene.json, which is an input, has the fingerprint and the hashes of the photos
_CAPTURE = {"capture.npz", "photos.json"}


def _id(path: Path) -> tuple[int, int]:
    """The same for all links of a file."""
    found = path.stat()
    return found.st_dev, found.st_ino


def _files(path: Path) -> list[Path]:
    return [p for p in path.rglob("*") if p.is_file()] if path.is_dir() else [path]


def _run_of(record: Path) -> Path:
    """The run folder that a record is in, or a block's."""
    return next(folder for folder in record.parents[1:] if (folder / "scene.json").exists())


class Watch:
    """Stands for `run_stages`, and notes what stages read that earlier ones wrote and that is no input."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.run_stages = stage.run_stages
        self.owners: dict[tuple[int, int], set[Path]] = {}  # records of the stages that wrote a file
        self.at_work = 0
        self.read = 0
        self.missed: list[str] = []

    def __call__(self, job, stages, make) -> None:
        (one,) = stages
        mine = job.run.provenance(one.name)
        before = self._state()
        if self.at_work:
            _reading.append(set())
        self.at_work += 1
        self.run_stages(job, stages, make)
        self.at_work -= 1
        read, others = _reading.pop(), _reading[:]
        _reading.clear()  # what we read ourselves is nobody's
        for file, written in self._state().items():
            if before.get(file) != written:
                self.owners.setdefault(file, set()).add(mine)
        self._check(one, mine, read)
        if not self.at_work:
            others = [set()]  # of the next one: it reads before it is a stage
            scene = ("_opened", "given_scene", "_refined", "photos")
            for name in (*scene, "masks", "recorded", "ladder", "antialiased"):
                vars(job).pop(name, None)  # else only the first stage would read them
        _reading.extend(others)

    def _state(self) -> dict[tuple[int, int], int]:
        return {_id(path): path.stat().st_mtime_ns for path in _files(self.root)}

    def _check(self, one: stage.Stage, mine: Path, read: set[str]) -> None:
        known = self._known([*one.inputs, mine])
        for path in map(Path, sorted(read)):
            if not path.is_relative_to(self.root) or not path.is_file() or _id(path) not in self.owners:
                continue
            self.read += 1
            makers = self.owners[_id(path)]
            fine = _id(path) in known or any(p == mine or (p.exists() and _id(p) in known) for p in makers)
            spared = {(one.name, path.name), (one.name, path.parent.name)} & _NO_INPUTS
            if not (fine or spared or path.name in _CAPTURE):
                self.missed.append(f"{one.name} reads {path.relative_to(self.root)}")
            mates = {p.stem for p in makers if _run_of(p) == _run_of(mine)}
            if mates and not mates & {one.name, *needed_for(one.name)}:
                self.missed.append(f"{one.name} reads what {', '.join(mates)} made, and does not need it")

    def _known(self, inputs: list[Path]) -> set[tuple[int, int]]:
        """Files that inputs stand for: a stage's record stands for all that the stage was made from."""
        known: set[tuple[int, int]] = set()
        while inputs:
            path = inputs.pop()
            new = {_id(file) for file in _files(path)} - known if path.exists() else set()
            known |= new
            if new and path.parent.name == "provenance":
                inputs += [_run_of(path) / name for name in read_json(path)["inputs"]]
        return known


@pytest.mark.parametrize(
    "changes",
    [
        {
            "fuse": True,
            "plan": PlanConfig(target_ssim=0.4, other_targets=(), budget=1e4),
            "train": replace(CONFIG.train, poses=True),
        },
        pytest.param(
            {"ladder": "snapshots", "train": replace(CONFIG.train, freeze_at=0.5, poses=True)},
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"fuse": True, "blocks": BLOCKS, "train": replace(CONFIG.train, freeze_at=0.5)},
            marks=pytest.mark.slow,
        ),
    ],
    ids=["nested", "snapshots", "blocks"],
)
def test_all_that_a_stage_reads_is_among_its_inputs(
    capture: Path, tmp_path: Path, monkeypatch, changes: dict
) -> None:
    watch = Watch(tmp_path.resolve())
    monkeypatch.setattr(stage, "run_stages", watch)
    monkeypatch.setattr(stage, "sync_changed", lambda *args: None)  # it opens all that is new
    _reading[:] = [set()]
    try:
        config = replace(CONFIG, **changes)
        work(tmp_path.resolve() / "run", capture, config)
        _reading[:] = [set()]  # what a run's last lines read is no stage's
        if config.ladder == "snapshots":
            job = Job(RunDir(tmp_path.resolve() / "run", "snapshots"), lambda event: None, "cpu")
            paper_report(job, PaperConfig(tune_steps=2))
    finally:
        _reading.clear()
    assert watch.missed == [], "\n".join(watch.missed)
    assert watch.read > 50


# records


def test_inputs_of_one_name_are_told_apart(tmp_path: Path) -> None:
    run = RunDir(tmp_path / "run")
    files = [run.segmented / "labels.json", run.masks / "labels.json"]
    for path in files:
        write_text(path, path.parent.name)
    write_text(tmp_path / "blocks.json", "{}")
    assert list(input_hashes(run, [*files, tmp_path / "blocks.json"])) == [
        "segmented/labels.json",
        "masks/labels.json",
        "../blocks.json",
    ]
    record(run, "lift", {}, files, 1.0)
    assert is_done(run, "lift", {}, files, files, force=False)
    write_text(files[0], "changed")
    with pytest.raises(RunError, match=r"other segmented/labels\.json \(its content changed\); choose"):
        is_done(run, "lift", {}, files, files, force=False)
    assert not is_made_from(run, "lift", files[0])
    assert is_made_from(run, "lift", files[1])


@pytest.mark.parametrize(
    ("settings", "inputs", "says"),
    [
        ({"a": 1, "b": 2}, "xy", None),
        ({"a": 1}, "xy", r"b \(2 then, not set now\)"),
        ({"a": 1, "b": 2, "c": None}, "xy", r"c \(not set then, None now\)"),
        ({"a": 1, "b": 2}, "x", r"y \(not used any more\)"),
        ({"a": 1, "b": 2}, "xyz", r"z \(not used then\)"),
    ],
)
def test_settings_and_inputs_that_are_dropped_or_new_count(tmp_path: Path, settings, inputs, says) -> None:
    run = RunDir(tmp_path)
    for name in "xyz":
        write_text(tmp_path / name, name)
    record(run, "lift", {"a": 1, "b": 2}, [tmp_path / "x", tmp_path / "y"], 1.0)

    def found(force: bool) -> bool:
        given = [tmp_path / name for name in inputs]
        return is_done(run, "lift", settings, given, [tmp_path / "x"], force)

    if says is None:
        assert found(force=False)
    else:
        with pytest.raises(RunError, match=says):
            found(force=False)
        assert not found(force=True)


def test_a_moved_run_has_nothing_to_do(copy: Path, capture: Path) -> None:
    assert done(work(copy, capture)) == []


def test_a_run_folder_of_an_older_format_is_refused_by_every_stage(copy: Path, capture: Path) -> None:
    for path in copy.rglob("provenance/*.json"):
        write_json(path, read_json(path) | {"format": FORMAT - 1})
    job = job_of(copy, force=True)
    shutil.rmtree(job.run.increments)  # their names were others
    older = rf"of format {FORMAT - 1}, this sagesplat \(.*\) reads {FORMAT}; run again into a new folder$"
    for act in (
        lambda: work(copy, capture),
        lambda: nest_levels(job, CONFIG.nest, 0),
        lambda: fit_ladder(job, CONFIG.fit),
        lambda: settings_of(job.run, "train"),
    ):
        with pytest.raises(RunError, match=older):
            act()


def test_a_broken_record_is_one_line_and_force_redoes_the_stage(copy: Path, capture: Path) -> None:
    write_text(RunDir(copy).provenance("plan"), f'{{"format": {FORMAT}}}')
    with pytest.raises(RunError, match=r"plan\.json: not .*; run that stage again with --force"):
        work(copy, capture)
    assert "plan" in done(work(copy, capture, force=True))


# results that label images decide


@pytest.mark.slow
def test_deleting_fused_label_images_is_noticed(copy: Path, capture: Path) -> None:
    fused = replace(CONFIG, fuse=True)
    with pytest.raises(RunError, match=r"ladder\.npz: made with other provenance/fuse\.json \(not used then"):
        work(copy, capture, fused)
    work(copy, capture, fused, force=True)
    shutil.rmtree(copy / "fused")
    with pytest.raises(
        RunError, match=r"ladder\.npz: made with other provenance/fuse\.json \(not used any mo"
    ):
        work(copy, capture)
    again = done(work(copy, capture, force=True))
    assert {"nest", "observe", "fit", "report"} <= set(again)
    assert "fuse" not in (path.stem for path in stage_records(RunDir(copy)))


def test_other_label_images_are_noticed_though_points_keep_their_labels(copy: Path) -> None:
    job = job_of(copy, force=True)
    before = job.run.labels.read_bytes()
    make_masks(job, CONFIG.masks, LabelsConfig(min_share=1e-9))
    assert job.run.labels.read_bytes() == before
    job = job_of(copy)
    with pytest.raises(RunError, match=r"provenance/masks\.json \(its content changed\)"):
        nest_levels(job, CONFIG.nest, 0)
    record = job.run.provenance("observe").read_bytes()
    observe_levels(job, CONFIG.fit)  # measured again without --force: it follows its inputs
    assert job.run.provenance("observe").read_bytes() != record


@pytest.mark.slow
def test_early_stopping_depends_on_label_images_and_other_training_does_not(copy: Path) -> None:
    early = replace(CONFIG.train, freeze_at=0.5, sky="off")
    job = job_of(copy, force=True)
    assert "provenance/masks.json" in read_json(job.run.provenance("train"))["inputs"]  # photos show some sky
    train_levels(job, replace(early, freeze_at=None), 0)
    assert "provenance/masks.json" not in read_json(job.run.provenance("train"))["inputs"]
    train_levels(job, early, 0)
    assert "provenance/masks.json" in read_json(job.run.provenance("train"))["inputs"]
    make_masks(job, CONFIG.masks, LabelsConfig(min_share=1e-9))
    with pytest.raises(RunError, match=r"provenance/masks\.json \(its content changed\)"):
        train_levels(job_of(copy), early, 0)


@pytest.mark.slow
def test_blocks_lose_fused_label_images_that_the_run_lost(capture: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(pipeline, "measure_and_plan", lambda *_: None)  # only levels are compared
    run = tmp_path / "run"
    config = replace(CONFIG, blocks=BLOCKS, fuse=True)
    work(run, capture, config)
    block = RunDir(run).block(1)
    assert (block.fused / "labels.json").exists()
    assert (block.masks / "labels.json").exists()
    fused = (RunDir(run).prefixes).read_bytes()
    shutil.rmtree(run / "fused")
    with pytest.raises(RunError, match=r"fuse\.json \(not used any more\)"):
        work(run, capture, replace(config, fuse=False))
    work(run, capture, replace(config, fuse=False), force=True)
    assert not block.fused.exists()
    assert not block.provenance("fuse").exists()
    assert (RunDir(run).prefixes).read_bytes() != fused
    # the same as if nothing had ever been fused
    work(tmp_path / "plain", capture, replace(config, fuse=False))
    assert RunDir(run).prefixes.read_bytes() == RunDir(tmp_path / "plain").prefixes.read_bytes()


@pytest.mark.slow
def test_the_ladders_of_a_run_in_blocks_share_its_categories_and_its_training(capture, tmp_path) -> None:
    config = replace(CONFIG, blocks=BLOCKS, ladder="snapshots")
    work(tmp_path / "run", capture, config)
    more = replace(config, ladder="nested", blocks=BLOCKS)
    again = done(work(tmp_path / "run", capture, more))
    assert "train" not in again
    assert again[-1] == "report"
    table = RunDir(tmp_path / "run").adapted / "blocks.csv"
    assert "" not in [row["boundaries s"] for row in rows_of(table)]
    work(tmp_path / "run", capture, replace(more, nest=replace(more.nest, steps=4)), force=True)
    assert [row["boundaries s"] for row in rows_of(table)] == ["", ""]


# checkpoints


class Killed(Exception):
    """In the place of a signal."""


def killed_in_nest(run: Path, config: NestConfig) -> None:
    def emit(event: Event) -> None:
        if isinstance(event, Progress) and event.name == "nest" and event.done == 8:
            raise Killed

    with pytest.raises(Killed):
        nest_levels(Job(RunDir(run), emit, "cpu"), config, 0)


@pytest.mark.slow
@pytest.mark.parametrize("change", ["fuse", "base"])
def test_a_killed_nest_does_not_resume_with_other_labels_or_another_base_model(
    copy: Path, monkeypatch, change: str
) -> None:
    monkeypatch.setattr(nested, "_SAVE_EVERY", 5)
    run = RunDir(copy)
    shutil.rmtree(run.adapted)
    killed_in_nest(copy, CONFIG.nest)
    assert run.nest_checkpoint.exists()
    if change == "fuse":
        fuse_masks(job_of(copy))
    else:
        shutil.copy(copy / "levels" / "000010.npz", run.base_model)
    with pytest.raises(RunError, match=r"checkpoint\.npz: made with other settings or inputs; delete .*"):
        nest_levels(job_of(copy), CONFIG.nest, 0)
    nest_levels(job_of(copy, force=True), CONFIG.nest, 0)
    assert not run.nest_checkpoint.exists()


def test_a_killed_nest_resumes_with_the_same_inputs(copy: Path, finished: Path, monkeypatch) -> None:
    monkeypatch.setattr(nested, "_SAVE_EVERY", 5)
    shutil.rmtree(copy / "nested")
    killed_in_nest(copy, CONFIG.nest)
    steps: list[int] = []

    def emit(event: Event) -> None:
        if isinstance(event, Progress) and event.name == "nest":
            steps.append(event.done)

    nest_levels(Job(RunDir(copy), emit, "cpu"), CONFIG.nest, 0)
    assert steps == list(range(6, 13))
    assert RunDir(copy).prefixes.read_bytes() == RunDir(finished).prefixes.read_bytes()


# models of other observations


def test_models_are_fitted_to_what_was_observed(copy: Path) -> None:
    other = replace(CONFIG.fit, distance="minimum")
    observe_levels(job_of(copy, force=True), other)
    with pytest.raises(RunError, match=r"observed with distance minimum; add --fit\.distance minimum"):
        fit_ladder(job_of(copy, force=True), CONFIG.fit)
    fit_ladder(job_of(copy, force=True), other)
    assert job_of(copy).fit_config.distance == "minimum"


def test_a_folder_of_any_names_has_a_hash(tmp_path: Path) -> None:
    (tmp_path / os.fsdecode(b"caf\xe9.png")).write_bytes(b"1")
    first = file_hash(tmp_path)
    (tmp_path / os.fsdecode(b"caf\xe9.png")).rename(tmp_path / os.fsdecode(b"caf\xe8.png"))
    assert file_hash(tmp_path) != first


def test_memory_that_runs_out_names_the_stage(tmp_path: Path) -> None:
    run = RunDir(tmp_path)
    run.scene.write_text("{}")

    def make() -> list[str]:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes")

    with pytest.raises(OutOfMemory, match=f"{tmp_path}: lift: out of memory; close other programs"):
        stage.run_stage(Job(run, lambda event: None), "lift", {}, [run.scene], [run.labels], make)
    assert not run.provenance("lift").exists()
