"""A run's own settings as defaults, and --force, which keeps earlier results until new ones are whole."""

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import Call

from sagesplat.adapt.plan_files import read_plans
from sagesplat.cli.console import Console
from sagesplat.core.config import (
    AdoptConfig,
    FitConfig,
    NestConfig,
    PlanConfig,
    RunConfig,
    SampleConfig,
    TrainConfig,
)
from sagesplat.core.errors import RunError
from sagesplat.core.events import Event, StageDone, StageSkipped, Training, Warned
from sagesplat.formats.levels import read_level
from sagesplat.io.files import read_json
from sagesplat.io.lock import locked
from sagesplat.run.job import Job
from sagesplat.run.recorded import recorded_settings, write_begun
from sagesplat.run.run_dir import RunDir
from sagesplat.stages import pipeline, preflight, train
from sagesplat.stages import plan as plan_stage
from sagesplat.stages.train import train_levels
from sagesplat.studies.paper.snapshots import adapt_snapshots

SETTINGS = "--train.max-steps 12 --train.level-every 6 --ladder snapshots --target-ssim 0.4 --test-every 6"


class Killed(Exception):
    """What a test kills a stage with."""


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from sagesplat import cli

    run = tmp_path_factory.mktemp("run") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["sagesplat", "run", str(capture), str(run), *SETTINGS.split()])
        cli.main()
    return run


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "run"))


def test_flags_of_earlier_commands_are_the_defaults(run: Path, capture: Path, command: Call) -> None:
    before = RunDir(run).provenance("train").read_bytes()
    code, said = command("run", capture, run)
    assert code == 0
    assert "✓" not in said  # nothing is redone
    for flag in SETTINGS.split("--")[1:]:
        assert f"--{flag.strip()}" in said
    code, said = command("run", capture, run, "--target-ssim", "0.5", "--force")
    assert code == 0
    assert [line.split()[1] for line in said.splitlines() if line.startswith("✓")] == [
        "plan", "compose", "evaluate", "report",
    ]  # fmt: skip
    assert RunDir(run).provenance("train").read_bytes() == before
    assert read_json(RunDir(run).scene)["settings"]["test_every"] == 6
    assert read_plans(RunDir(run, "snapshots").plan)[0][1].target == 0.5


def test_a_given_target_drops_the_recorded_ones(
    run: Path, monkeypatch: pytest.MonkeyPatch, command: Call
) -> None:
    seen = {}
    monkeypatch.setattr(plan_stage, "make_plan", lambda job, config: seen.update(config=config))
    monkeypatch.setattr(plan_stage, "show_plan", lambda job: None)
    record = RunDir(run, "snapshots").provenance("plan")
    made = read_json(record)

    def asked(recorded: dict[str, object], *words: str) -> PlanConfig:
        made["settings"] |= {"target_fidelity": None, "target_ssim": None} | recorded
        record.write_text(json.dumps(made))
        assert command("plan", run, *words)[0] == 0
        return seen["config"]

    both = {"target_fidelity": 0.9, "target_ssim": 0.7, "other_targets": [0.5], "share": 0.8}
    assert asked(both) == PlanConfig(0.9, 0.7, 0.8, other_targets=(0.5,))
    assert asked(both, "--target-ssim", "0.6") == PlanConfig(None, 0.6, 0.8)
    assert asked(both, "--target-fidelity=0.8") == PlanConfig(0.8, None, 0.8, other_targets=(0.5,))
    assert asked(both, "--target-fidelity", "0.8", "--target-ssim", "0.5").target_ssim == 0.5
    assert asked({"target_ssim": 0.4, "other_targets": None}, "--share", "0.7") == PlanConfig(None, 0.4, 0.7)
    budget: dict[str, object] = {"target_fidelity": 0.9, "budget": 3e5}
    assert asked(budget).budget == 3e5
    assert asked(budget, "--target-fidelity", "0.8").budget == 0  # a quality is asked for, no longer a size
    assert asked(budget, "--target-fidelity", "0.8", "--budget", "2e5").budget == 2e5


def test_recorded_dictionaries_and_flags_that_are_off_can_be_given_again(
    run: Path, monkeypatch: pytest.MonkeyPatch, command: Call
) -> None:
    seen = {}
    monkeypatch.setattr(plan_stage, "make_plan", lambda job, config: seen.update(config=config))
    monkeypatch.setattr(plan_stage, "show_plan", lambda job: None)
    for stage, more in (("plan", {"weights": {"vase": 5.0}}), ("train", {"antialiased": False})):
        record = RunDir(run, "snapshots").provenance(stage)
        made = read_json(record)
        made["settings"] |= more
        record.write_text(json.dumps(made))
    for words, weights in (
        ((), {"vase": 5.0}),
        (("--weights", "tree", "3"), {"tree": 3.0}),
        (("--weights",), {}),
    ):
        code, said = command("plan", run, *words)
        assert code == 0, said
        assert seen["config"].weights == weights
    code, said = command("run", run / "nowhere", run)
    assert "--train.no-antialiased" in said
    code, said = command("run", run / "nowhere", run, "--train.no-antialiased")
    assert "no option" not in said
    assert "antialiased" not in said.partition("settings of")[2].partition("nowhere")[0]


def test_a_run_that_did_not_end_has_its_settings(tmp_path: Path) -> None:
    """Also those of stages that were not reached."""
    run = RunDir(tmp_path)
    asked = RunConfig(
        nest=NestConfig(steps=100),
        sample=SampleConfig(views=30),
        plan=PlanConfig(0.8, weights={"a": 2.0}),
        seed=3,
    )
    write_begun(run, asked, AdoptConfig(fit="none", cameras=tmp_path))
    known = recorded_settings(run, of="nest")
    assert (known["nest"], known["sample"], known["plan"], known["seed"]) == (
        asked.nest, asked.sample, asked.plan, 3,
    )  # fmt: skip
    assert "adopt" not in known  # there is no splat yet
    run.begun.write_text("{")
    assert "nest" not in recorded_settings(run)


@pytest.mark.slow
def test_settings_of_a_run_are_kept_until_it_ends(
    run: Path, capture: Path, monkeypatch: pytest.MonkeyPatch, command: Call
) -> None:
    begun, written = RunDir(run).begun, []
    monkeypatch.setattr(pipeline, "write_begun", lambda *asked: written.append(asked))
    assert command("run", capture, run)[0] == 0
    assert not written  # a finished run is only read
    monkeypatch.undo()
    assert command("run", capture, run, "--target-ssim", "0.5", "--force")[0] == 0
    assert not begun.exists()
    RunDir(run, "snapshots").provenance("report").unlink()
    with locked(run):
        said = subprocess.run(
            [sys.executable, "-m", "sagesplat", "run", str(capture), str(run)], capture_output=True, text=True
        )
    assert said.returncode == 2
    assert not begun.exists()  # another process works there


def test_a_refusal_says_what_differs_and_its_cure_works(run: Path, command: Call) -> None:
    code, said = command("plan", run, "--target-ssim", "0.5")
    assert code == 2
    assert "target-ssim (0.4 then, 0.5 now)" in said
    assert "add --force" in said
    code, said = command("plan", run, "--target-ssim", "0.5", "--force")
    assert code == 0
    assert "--force: " in said
    assert "made with other target-ssim (0.4 then, 0.5 now)" in said
    assert re.search(r"plan is redone \(it took \d+ s\)", said)  # a second on a busy machine
    assert "compose, evaluate, report" in said
    assert command("compose", run)[0] == 0  # it follows the plan without --force
    assert command("evaluate", run)[0] == 0


def test_settings_of_a_run_reach_every_command(run: Path) -> None:
    known = recorded_settings(RunDir(run, "snapshots"))
    assert known["train"] == TrainConfig(max_steps=12, level_every=6)
    assert known["plan"] == PlanConfig(target_ssim=0.4)
    assert known["fit"] == FitConfig()
    assert known["masks"].segmenter == "auto"
    assert known["seed"] == 0
    assert "nest" not in known
    assert "poses" not in known
    for record in (run / "provenance").glob("*.json"):
        record.write_text("[1")  # what cannot be read is no default
    (run / "cap.json").write_text("{}")
    assert {"train", "masks", "seed"} & set(recorded_settings(RunDir(run))) == {"masks"}


def test_given_flags_win_and_another_source_of_label_images_drops_the_recorded_one(
    run: Path, capture: Path, monkeypatch: pytest.MonkeyPatch, command: Call
) -> None:
    seen = {}
    monkeypatch.setattr(
        pipeline, "run_all", lambda job, scene, config: seen.update(config=config, run=job.run)
    )
    (run / "segmented" / "options.json").write_text('{"segmenter": "hf", "model": "a/b", "crf": true}')
    assert command("run", capture, run, "--train.max-steps=70", "--seed", "4")[0] == 0
    config = seen["config"]
    assert (config.train.max_steps, config.train.level_every, config.seed) == (70, 6, 4)
    assert (config.masks.model, config.masks.crf, seen["run"].ladder) == ("a/b", True, "snapshots")
    assert command("run", capture, run, "--masks", capture / "masks")[0] == 0
    assert (seen["config"].masks.segmenter, seen["config"].masks.model) == ("auto", None)


@pytest.mark.parametrize("answer", ["n", "y"])
def test_force_asks_on_a_terminal(
    answer: str, run: Path, monkeypatch: pytest.MonkeyPatch, command: Call
) -> None:
    asked = []
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("rich.console.Console.is_terminal", property(lambda self: True))
    monkeypatch.setattr(Console, "ask", lambda self, question: asked.append(question) or answer == "y")
    words = ("plan", run, "--target-ssim", "0.5", "--force")
    code, said = command(*words)
    assert asked == ["Redo?"]
    assert code == (0 if answer == "y" else 2)
    assert ("nothing was redone" in said) == (answer == "n")
    target = read_plans(RunDir(run, "snapshots").plan)[0][1].target
    assert target == (0.5 if answer == "y" else 0.4)
    if answer == "n":
        assert command(*words, "--yes")[0] == 0
        assert len(asked) == 1


def job(run: Path, emit: Callable[[Event], None], *, force: bool = True) -> Job:
    return Job(RunDir(run, "nested"), emit, "cpu", force=force)


def files(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


def test_a_killed_forced_training_resumes_and_the_earlier_levels_stay_until_then(run: Path) -> None:
    paths, other = RunDir(run), TrainConfig(max_steps=16, level_every=4)
    levels, record = files(paths.levels), paths.provenance("train").read_bytes()

    def kill(event: Event) -> None:
        if isinstance(event, Training) and event.step == 9:
            raise Killed

    with pytest.raises(Killed):
        train_levels(job(run, kill), other, 0)
    assert files(paths.levels) == levels
    assert paths.provenance("train").read_bytes() == record
    train_levels(job(run, print, force=False), TrainConfig(max_steps=12, level_every=6), 0)  # up to date
    events: list[Event] = []
    train_levels(job(run, events.append), other, 0)
    assert min(e.step for e in events if isinstance(e, Training)) == 9
    assert sorted(files(paths.levels)) == ["000004.npz", "000008.npz", "000012.npz", "000016.npz"]
    assert read_json(paths.provenance("train"))["settings"]["max_steps"] == 16
    assert not paths.replacement.path.exists()
    assert recorded_settings(paths)["train"] == other


@pytest.mark.parametrize("at", [0, 1, 2, 3, 4])
def test_a_swap_that_is_killed_is_finished_by_the_same_command(
    at: int, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths, other, moves = RunDir(run), TrainConfig(max_steps=4, level_every=2), []

    def dying(move: Callable[..., object]) -> Callable[..., object]:
        def moved(self: Path, *args: object) -> object:
            if len(moves) == at:
                raise Killed
            moves.append(self)
            return move(self, *args)

        return moved

    def swap(run: RunDir, made: RunDir, swap: Callable[[RunDir, RunDir], None] = train._swap) -> None:
        for name in ("rename", "replace"):
            monkeypatch.setattr(Path, name, dying(getattr(Path, name)))
        swap(run, made)

    monkeypatch.setattr(train, "_swap", swap)
    with pytest.raises(Killed):
        train_levels(job(run, print), other, 0)
    monkeypatch.undo()
    events: list[Event] = []
    train_levels(job(run, events.append, force=False), recorded_settings(paths)["train"], 0)
    assert not [e for e in events if isinstance(e, Training)]
    assert sorted(files(paths.levels)) == ["000002.npz", "000004.npz"]
    assert len(read_level(paths.levels / "000004.npz"))
    assert not paths.replacement.path.exists()


def test_snapshots_are_adapted_with_the_settings_of_the_nested_levels(run: Path) -> None:
    """What `report --paper` and `transfer` need after a plain run."""
    shutil.move(run / "snapshots", run / "nested")
    record = RunDir(run).provenance("plan")
    record.write_text(record.read_text().replace('"budget": 0.0', '"budget": 5000.0'))
    events: list[Event] = []
    snapshots = Job(RunDir(run, "snapshots"), events.append, "cpu")
    adapt_snapshots(snapshots)
    assert [e.name for e in events if isinstance(e, StageDone)] == ["observe", "fit", "plan"]
    plans = read_plans(snapshots.run.plan)[0]
    assert [plan.target for plan in plans] == [0.3, 0.4, 0.5]
    events.clear()
    adapt_snapshots(snapshots)
    assert [e.name for e in events if isinstance(e, StageSkipped)] == ["observe", "fit", "plan"]


def test_a_missing_network_is_told_before_structure_from_motion(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Call
) -> None:
    monkeypatch.setattr("sagesplat.scene.photos.reconstruct", lambda *args: pytest.fail("hours were spent"))
    photos = Path(shutil.copytree(capture / "images", tmp_path / "photos"))
    for words, says in (
        (["--segmenter", "onnx"], "--model"),
        (["--model", "no/such/network/here"], "no such folder"),
    ):
        code, said = command("run", photos, tmp_path / "out", *words)
        assert code == 2
        assert says in said.splitlines()[-1]
        assert not said.strip().count("Traceback")


def test_missing_extras_are_told_at_once_and_together(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Call
) -> None:
    photos = Path(shutil.copytree(capture / "images", tmp_path / "photos"))
    found = importlib.util.find_spec
    absent = {"pycolmap", "transformers"}
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in absent else found(name))
    code, said = command("run", photos, tmp_path / "out")
    assert code == 2
    assert f"{photos}: poses from photos need pycolmap and label images need transformers; " in said
    assert said.strip().endswith("install 'sagesplat[poses,hf]'")
    absent = {"pycolmap"}
    _, said = command("run", photos, tmp_path / "out", "--masks", capture / "masks")
    assert said.strip().endswith("install 'sagesplat[poses]'")


def test_a_training_that_does_not_fit_is_told_before_label_images(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sagesplat.core.config import SceneConfig
    from sagesplat.stages.scene import open_scene

    events: list[Event] = []
    work = Job(RunDir(tmp_path / "run"), events.append, "cpu", memory_limit=2**20)
    open_scene(work, capture, SceneConfig())
    with pytest.raises(RunError, match="raise --memory-limit"):
        preflight.check_training(work, TrainConfig())
    usage = shutil.disk_usage(tmp_path)
    roomy = replace(work, memory_limit=0)
    # levels are stored in 34 to 79 bytes a Gaussian, not as float32: such a disk may do
    enough = 4 * 59 * 30 * len(work.scene.points.xyz)
    for free, told in ((2**15, None), (enough, [Warned]), (30_000_000, [])):
        monkeypatch.setattr(shutil, "disk_usage", lambda path, free=free: usage._replace(free=free))
        if told is None:
            with pytest.raises(RunError, match=r"GiB, 0\.0 are free; free some"):
                preflight.check_training(roomy, TrainConfig())
        else:
            events.clear()
            preflight.check_training(roomy, TrainConfig())
            assert [type(e) for e in events] == told
