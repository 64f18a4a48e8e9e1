"""Nothing is lost: by a full disk, a damaged file, a killed process, a second one, or too little memory."""

import builtins
import errno
import io
import json
import os
import random
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import random_gaussians, write_capture
from test_io_lock import HOLDS, held_by_another

from sagesplat.core.config import PlanConfig, RunConfig, SampleConfig, TrainConfig
from sagesplat.core.errors import DataError, RunError
from sagesplat.core.gaussians import PARAMETERS
from sagesplat.demo.capture import make_capture
from sagesplat.formats.levels import check_level, read_level, write_level
from sagesplat.io import lock
from sagesplat.io.files import (
    atomic_folder,
    atomic_path,
    remove_temporary,
    sync_changed,
    write_json,
    write_text,
)
from sagesplat.run import stage
from sagesplat.run.job import Job
from sagesplat.run.records import is_done, record
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import run_stage
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.stages.compose import compose_plan
from sagesplat.stages.export import export_scene
from sagesplat.stages.fit import fit_ladder
from sagesplat.stages.label import lift_labels, make_masks
from sagesplat.stages.observe import observe_levels
from sagesplat.stages.plan import make_plan
from sagesplat.stages.scene import open_scene
from sagesplat.stages.train import train_levels
from sagesplat.train import checkpoint as checkpoint_module
from sagesplat.train.checkpoint import latest_checkpoint, previous, remove_checkpoints, write_checkpoint
from sagesplat.train.events import Event, Resumed, Trained
from sagesplat.train.state import TrainState, initial_state
from sagesplat.train.trainer import train

CONFIG = RunConfig(
    train=TrainConfig(max_steps=40, level_every=10),
    plan=PlanConfig(target_ssim=0.4),
    sample=SampleConfig(views=8, calibration_views=8),
)
TRAINING = TrainConfig(max_steps=24, level_every=4, sh_degree=1)
FULL = r"no space left, the disk is full; free [\d,]+ MB and run the same command again \(nothing was lost\)"
EXACT = (
    "scene.json", "cap.json", "frozen.json", "observations.csv", "models.json", "plan.json", "composed.ply",
    "evaluation.csv",
)  # fmt: skip
# Forks: what has been imported need not be imported again by each that is killed.
KILLED = """
import os, sys
from pathlib import Path
from sagesplat.run.job import Job
from sagesplat.raster import set_threads
from sagesplat.run.run_dir import RunDir
from test_durability import most_stages

def work(capture, run, left):
    def tick(*what):
        nonlocal left
        left -= 1
        if not left:
            os.kill(os.getpid(), 9)

    def audit(name, args):
        if name in ("open", "os.rename", "os.remove", "os.link", "os.mkdir") and run in str(args[0]):
            tick()

    sys.addaudithook(audit)
    set_threads(1)
    most_stages(Job(RunDir(Path(run), "snapshots"), tick), Path(capture))
    os._exit(0)

for run, left in zip(sys.argv[2::2], sys.argv[3::2]):
    pid = os.fork()
    if not pid:
        work(sys.argv[1], run, int(left))
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
"""


def most_stages(job: Job, capture: Path, config: RunConfig = CONFIG) -> None:
    """A run without its report, which takes as long as all the rest."""
    open_scene(job, capture, config.scene)
    make_masks(job, config.masks, config.labels)
    lift_labels(job)
    train_levels(job, config.train, config.seed)
    observe_levels(job, config.fit)
    fit_ladder(job, config.fit)
    make_plan(job, config.plan)
    compose_plan(job)


def state_at(step: int) -> TrainState:
    state = initial_state(random_gaussians(40, seed=step, degree=1), seed=step)
    state.step = step
    return state


def arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def content(folder: Path) -> dict[str, bytes]:
    """What a run holds, but for what tells the time: of archives their arrays."""
    found = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        name = str(path.relative_to(folder))
        if path.suffix == ".npz":
            for key, value in arrays(path).items():
                found[f"{name}/{key}"] = value.tobytes()
        elif path.parent.name == "provenance":
            found[name] = json.dumps(json.loads(path.read_text())["settings"]).encode()
        elif path.name in EXACT or path.parent.name in ("masks", "segmented"):
            found[name] = path.read_bytes()
        elif path.name != lock.FILE:
            found[name] = b""
    return found


def temporary(folder: Path) -> list[Path]:
    return [p for p in folder.rglob(".*") if p.name != lock.FILE]


# the disk


@contextmanager
def space_for(nbytes: int, monkeypatch: pytest.MonkeyPatch, number: int = errno.ENOSPC) -> Iterator[None]:
    """A disk that is full after so many bytes, in the middle of a write."""
    left, opened = nbytes, io.open

    class Limited(io.FileIO):
        def write(self, data):
            nonlocal left
            size = memoryview(data).nbytes
            if size > left:
                if left:
                    super().write(memoryview(data).cast("B")[:left])
                left = 0
                raise OSError(number, os.strerror(number))
            left -= size
            return super().write(data)

    def limited(file, mode="r", *args, **options):
        if not set(mode) & set("wxa+") or isinstance(file, int):
            return opened(file, mode, *args, **options)
        raw = Limited(file, mode.replace("b", "").replace("t", ""))
        return raw if "b" in mode else io.TextIOWrapper(raw, options.get("encoding"), write_through=True)

    with monkeypatch.context() as patch:
        for module in (io, builtins):
            patch.setattr(module, "open", limited)
        yield


def test_a_full_disk_is_one_line_and_costs_nothing(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old" * 10)
    for number, reason in ((errno.ENOSPC, "the disk is full"), (errno.EDQUOT, "the quota is used up")):
        for nbytes in (0, 1, 5000):
            with space_for(nbytes, monkeypatch, number), pytest.raises(RunError) as caught:
                write_text(path, "new " * 10**6)
            line = str(caught.value)
            assert re.fullmatch(
                rf"{re.escape(str(path))}: no space left, {reason}; free \d+ MB and run.*", line
            )
            assert path.read_text() == "old" * 10
            assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: shutil._ntuple_diskusage(9, 8, 500_000))  # type: ignore[attr-defined]
    with pytest.raises(RunError, match="free 1,234 MB"), atomic_path(path, nbytes=1_234_400_000):
        raise OSError(errno.ENOSPC, "")


def test_content_is_on_the_disk_before_its_name(tmp_path: Path, monkeypatch) -> None:
    done: list[str] = []
    fsync, replace_ = os.fsync, Path.replace

    def synced(handle: int) -> None:
        done.append("folder" if os.path.isdir(f"/proc/self/fd/{handle}") else "file")
        fsync(handle)

    def renamed(self: Path, target: Path) -> Path:
        done.append("name")
        return replace_(self, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(Path, "replace", renamed)
    write_json(tmp_path / "a.json", {})
    assert done == (["file", "name", "folder"] if sys.platform == "linux" else ["file", "name"])
    done.clear()
    with atomic_path(tmp_path / "b", sync=False) as path:
        path.write_text("b")
    assert done == ["name"]
    done.clear()
    sync_changed(tmp_path, time.time() - 3600)
    assert sorted(done) == ["file", "file", "folder"]
    done.clear()
    sync_changed(tmp_path, time.time() + 3600)
    assert done == []


def test_a_folder_is_replaced_whole_or_not_at_all(tmp_path: Path, monkeypatch) -> None:
    folder = tmp_path / "chunks"
    for text in ("old", "new"):
        with atomic_folder(folder) as fresh:
            (fresh / text).write_text(text)
        assert [p.name for p in folder.iterdir()] == [text]

    def fill() -> None:
        with atomic_folder(folder) as fresh:
            (fresh / "half").write_bytes(bytes(100))

    with space_for(50, monkeypatch), pytest.raises(RunError, match=rf"chunks: {FULL}"):
        fill()
    assert [p.name for p in folder.iterdir()] == ["new"]
    assert list(tmp_path.iterdir()) == [folder]


def test_only_what_was_half_written_is_removed(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "levels" / "000300.npz") as path:
        shutil.copy(path, tmp_path / "kept")
        (path.parent / f"{path.name}x").write_text("as of a killed process")
    (tmp_path / "levels" / ".hidden").write_text("somebody's")
    bundle = tmp_path / "bundle-live" / ".manifest.tmp-abc.json"
    write_text(bundle, "a viewer's")
    write_text(tmp_path / ".bundle.tmp-new" / "manifest.json", "the same")
    remove_temporary(tmp_path, but="bundle")
    left = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert left == {
        "levels/000300.npz",
        "levels/.hidden",
        "kept",
        f"bundle-live/{bundle.name}",
        ".bundle.tmp-new/manifest.json",
    }


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return write_capture(tmp_path_factory.mktemp("capture") / "c", random_gaussians(150, degree=0))


def training(scene: Scene, folder: Path) -> Iterator[Event]:
    labels = np.arange(150, dtype=np.int16) % 3
    return train(scene, Photos(scene.views), labels, TRAINING, folder=folder, settings="s")


@pytest.fixture(scope="module")
def trained(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An undisturbed training."""
    folder = tmp_path_factory.mktemp("trained")
    assert isinstance(list(training(scene, folder))[-1], Trained)
    return folder


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "capture"
    make_capture(folder, views=9, width=40, height=30)
    return folder


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An undisturbed run."""
    run = tmp_path_factory.mktemp("run") / "run"
    most_stages(Job(RunDir(run, "snapshots"), lambda event: None), capture)
    return run


# checkpoints and levels


def damaged(path: Path, kind: str) -> None:
    data = bytearray(path.read_bytes())
    if kind == "cut":
        del data[len(data) // 3 :]
    elif kind == "empty":
        data.clear()
    else:
        data[len(data) // 2] ^= 0x10
    path.write_bytes(data)


@pytest.mark.parametrize("kind", ["cut", "empty", "bit"])
def test_a_damaged_checkpoint_gives_way_to_the_one_before(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "checkpoint.npz"
    for step in (10, 20, 30):
        write_checkpoint(path, state_at(step), "s")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["checkpoint-1.npz", "checkpoint.npz"]
    state, damage = latest_checkpoint(path, "s")
    assert (state.step, damage) == (30, "")
    damaged(path, kind)
    state, damage = latest_checkpoint(path, "s")
    assert state.step == 20
    assert damage.startswith(f"{path}: ")
    assert torch.equal(state.gaussians.means, state_at(20).gaussians.means)
    damaged(previous(path), kind)
    with pytest.raises(RunError, match=r"checkpoint\.npz: .*, and .*checkpoint-1\.npz: .*; delete both"):
        latest_checkpoint(path, "s")
    remove_checkpoints(path)
    assert list(tmp_path.iterdir()) == []


def test_other_settings_do_not_fall_back(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.npz"
    write_checkpoint(path, state_at(1), "a")
    write_checkpoint(path, state_at(2), "b")
    with pytest.raises(RunError, match="other settings"):
        latest_checkpoint(path, "a")


def test_the_checksum_sees_what_the_archive_does_not(tmp_path: Path) -> None:
    """Arrays that are intact by themselves, but of another checkpoint."""
    path = tmp_path / "checkpoint.npz"
    for name, other in (("means", "exp_avg/means"), ("grad_sum", "grad_count"), ("meta", "")):
        write_checkpoint(path, state_at(10), "s")
        found = arrays(path)
        if other:
            found[name] = found[other] + np.float32(1)
        else:
            found["meta"] = np.array(json.dumps(json.loads(str(found["meta"])) | {"step": 11}))
        np.savez(path, **found)  # type: ignore[arg-type]
        with pytest.raises(RunError, match="damaged, its content does not match its checksum"):
            checkpoint_module.read_checkpoint(path, "s")


def test_what_does_not_read_back_takes_nobodys_place(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "checkpoint.npz"
    write_checkpoint(path, state_at(10), "s")
    sync = checkpoint_module.sync_files

    def rots(paths) -> None:
        sync(paths)
        damaged(paths[0], "bit")

    monkeypatch.setattr(checkpoint_module, "sync_files", rots)
    with pytest.raises(RunError, match="does not read back as written; check the disk"):
        write_checkpoint(path, state_at(20), "s")
    assert latest_checkpoint(path, "s")[0].step == 10
    assert list(tmp_path.iterdir()) == [path]


def test_disks_without_links(tmp_path: Path, monkeypatch) -> None:
    def no_link(*paths) -> None:
        raise OSError(errno.EPERM, "no links")

    monkeypatch.setattr(os, "link", no_link)
    path = tmp_path / "checkpoint.npz"
    for step in (10, 20):
        write_checkpoint(path, state_at(step), "s")
    assert checkpoint_module.read_checkpoint(previous(path), "s").step == 10


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_checkpoint_on_a_full_disk_leaves_those_before(tmp_path: Path, monkeypatch, share: float) -> None:
    path = tmp_path / "checkpoint.npz"
    for step in (10, 20):
        write_checkpoint(path, state_at(step), "s")
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    nbytes = int(share * (path.stat().st_size - 1))
    with space_for(nbytes, monkeypatch), pytest.raises(RunError, match=FULL):
        write_checkpoint(path, state_at(30), "s")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def stopped_at(scene: Scene, folder: Path, step: int) -> None:
    for event in training(scene, folder):
        if getattr(event, "step", 0) == step:
            return


def test_training_goes_on_from_the_checkpoint_before(scene: Scene, trained: Path, tmp_path: Path) -> None:
    stopped_at(scene, tmp_path, 18)
    damaged(tmp_path / "checkpoint.npz", "cut")
    events = list(training(scene, tmp_path))
    assert isinstance(events[0], Resumed)
    assert events[0].step == 12
    assert "not a readable checkpoint" in events[0].damage
    assert content(tmp_path) == content(trained)
    assert not previous(tmp_path / "checkpoint.npz").exists()


def test_training_does_not_go_on_with_a_damaged_level(scene: Scene, trained: Path, tmp_path: Path) -> None:
    stopped_at(scene, tmp_path, 18)
    level = tmp_path / "levels" / "000008.npz"
    damaged(level, "bit")
    message = r"000008\.npz: a damaged level .*; delete it to resume without that level, or .*checkpoint\.npz"
    with pytest.raises(RunError, match=message):
        list(training(scene, tmp_path))
    (tmp_path / "checkpoint.npz").unlink()
    list(training(scene, tmp_path))
    assert content(tmp_path) == content(trained)


def test_any_changed_bit_of_a_level_is_seen(tmp_path: Path) -> None:
    g = random_gaussians(60, degree=1)
    path = write_level(tmp_path, 5, g, recovering=False, sh_degree=1)
    good, expected = path.read_bytes(), read_level(path)
    check_level(path)
    chance = random.Random(3)
    seen = 0
    for _ in range(40):
        data = bytearray(good)
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        path.write_bytes(data)
        try:
            found = read_level(path)
        except DataError:
            seen += 1
            continue
        for name in PARAMETERS:  # a bit that means nothing, such as the time in the archive
            assert torch.equal(getattr(found, name), getattr(expected, name))
    assert seen > 15


# stages


def test_stages_are_refused_and_readers_are_not(finished: Path, capture: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    job = Job(RunDir(run, "snapshots"), lambda event: None)
    with held_by_another(run):
        most_stages(job, capture)  # all is there: nobody writes
        assert export_scene(job, tmp_path / "a.ply", level=40, labels=[], target=None) > 0
        again = replace(job, force=True)
        with pytest.raises(RunError, match="works on it; wait for it or stop it"):
            most_stages(again, capture, replace(CONFIG, plan=PlanConfig(target_ssim=0.5)))
    assert content(run) == content(finished)


def test_a_job_may_keep_its_lock_between_stages(finished: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    with ExitStack() as locks:
        job = Job(RunDir(run, "snapshots"), lambda event: None, locks=locks)
        run_stage(job, "compared", {}, [], [run / "extra"], lambda: [])
        code = HOLDS.replace("time.sleep(3600)", "pass")
        command = [sys.executable, "-c", code, str(run)]
        assert "works on it" in subprocess.run(command, capture_output=True, text=True).stderr
    subprocess.run(command, capture_output=True, check=True)


def test_a_result_that_is_being_redone_does_not_count(finished: Path, tmp_path: Path) -> None:
    """A forced stage that is killed leaves neither result: the next run makes it, whatever was asked for."""
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    job = Job(RunDir(run, "snapshots"), lambda event: None, force=True)
    output = run / "extra.txt"

    def make(text: str) -> Callable[[], list[str]]:
        def write() -> list[str]:
            output.write_text(text)
            if text == "half":
                raise KeyboardInterrupt
            return []

        return write

    run_stage(job, "compared", {"n": 1}, [], [output], make("one"))
    with pytest.raises(KeyboardInterrupt):
        run_stage(job, "compared", {"n": 2}, [], [output], make("half"))
    run_stage(replace(job, force=False), "compared", {"n": 1}, [], [output], make("one"))
    assert output.read_text() == "one"


def test_a_full_disk_in_any_stage_is_one_line(finished: Path, tmp_path: Path, monkeypatch) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    job = Job(RunDir(run, "snapshots"), lambda event: None)

    def make() -> list[str]:
        (run / "plain.txt").write_text("x" * 100)
        return []

    with space_for(10, monkeypatch), pytest.raises(RunError, match=rf"run: {FULL}"):
        run_stage(job, "compared", {}, [], [run / "plain.txt"], make)
    assert not job.run.provenance("compared").exists()
    monkeypatch.setattr(stage, "sync_changed", lambda *args: 1 / 0)
    with pytest.raises(ZeroDivisionError):  # what is not on the disk is not done
        run_stage(job, "compared", {}, [], [run / "plain.txt"], make)
    assert not job.run.provenance("compared").exists()


# kill -9


needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")


def killed(capture: Path, turns: list[tuple[Path, int]]) -> list[int]:
    """Run everything in processes that are killed after so many events and file operations; exit codes."""
    words = [word for run, left in turns for word in (str(run), str(left))]
    command = [sys.executable, "-c", KILLED, str(capture), *words]
    here = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, sys.path))}
    ended = subprocess.run(command, capture_output=True, text=True, env=here)
    assert ended.returncode == 0, ended.stderr
    codes = [int(line) for line in ended.stdout.split()]
    assert set(codes) <= {0, -9}, ended.stderr
    return codes


@needs_fork
def test_a_killed_run_goes_on_and_ends_the_same(capture: Path, finished: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert killed(capture, [(run, 120), (run, 0)]) == [-9, 0]
    assert content(run) == content(finished)
    assert temporary(run) == []


@pytest.mark.slow
@needs_fork
def test_runs_killed_at_any_time_end_the_same(capture: Path, finished: Path, tmp_path: Path) -> None:
    """Twenty runs that are killed once, and one that is killed again and again."""
    chance = random.Random(8)
    for turn in range(20):
        run = tmp_path / f"run{turn}"
        assert killed(capture, [(run, chance.randrange(1, 250)), (run, 0)]) == [-9, 0]
        assert content(run) == content(finished)
    again = tmp_path / "again"
    turns = [(again, chance.randrange(1, 160)) for _ in range(5)]
    assert killed(capture, [*turns, (again, 0)]) == [*[-9] * 5, 0]
    assert content(again) == content(finished)


def test_a_stage_made_again_is_the_same_input_whatever_time_it_took(tmp_path: Path) -> None:
    run = RunDir(tmp_path)
    run.labels.write_bytes(b"labels")
    record(run, "masks", {"keep": ""}, [], seconds=1.0)
    record(run, "lift", {}, [run.provenance("masks")], seconds=1.0)

    def lifted() -> bool:
        return is_done(run, "lift", {}, [run.provenance("masks")], [run.labels], force=False)

    assert lifted()
    record(run, "masks", {"keep": ""}, [], seconds=2.0)
    assert lifted()
    record(run, "masks", {"keep": "grass"}, [], seconds=2.0)
    with pytest.raises(RunError, match=r"masks\.json \(its content changed\)"):
        lifted()
