"""OpenSplat and sagesplat in turns: a program that behaves as OpenSplat's command line does stands for it."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import random_gaussians, write_capture
from test_benchmarks import run_benchmark

from benchmarks.opensplat import Course, Program, compared, course_of, main, training_workspace
from sagesplat import load_scene, write_ply
from sagesplat.core.errors import BackendUnavailable

# options, what is printed and what is saved, as a build of 2025 does; it "trains" by copying a file
STAND_IN = f"""#!{sys.executable}
import shutil, sys, time
from pathlib import Path
valued = {{"-n": "30000", "-o": "splat.ply", "-s": "-1", "--sh-degree": "3"}}
words, rest, flags = sys.argv[1:], [], set()
if words == ["--version"]:
    print("1.1.5")
    sys.exit()
while words:
    name, _, value = words.pop(0).partition("=")
    if name in valued:
        valued[name] = value or words.pop(0)
    elif name in ("--cpu", "--keep-crs"):
        flags.add(name)
    elif name.startswith("-"):
        print(f"Option '{{name.strip('-')}}' does not exist", file=sys.stderr)
        sys.exit(1)
    else:
        rest.append(name)
(project,), steps, out, every = rest, int(valued["-n"]), Path(valued["-o"]), int(valued["-s"])
if not (project := Path(project)).joinpath("sparse/0/points3D.bin").is_file():
    print("Invalid project folder", file=sys.stderr)
    sys.exit(1)
assert flags == {{"--cpu", "--keep-crs"}} and len(list((project / "images").glob("*.png"))) == 7
print("Using CPU", flush=True)
trained = Path(sys.argv[0]).with_name("trained.ply")
for step in range(1, steps + 1):
    time.sleep(0.001)
    print(f"Step {{step}}: {{1 / step}} [{{100 * step // steps}}%]", flush=True)
    if every > 0 and step % every == 0:
        shutil.copy(trained, out.with_name(f"{{out.stem}}_{{step}}{{out.suffix}}"))
(out.parent / "cameras.json").write_text("[]")
shutil.copy(trained, out)
print(f"Wrote {{out}}")
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture, and a build that always ends with what is in its photos."""
    folder = tmp_path_factory.mktemp("opensplat")
    truth = random_gaussians(60, degree=1, logit=2.0)
    write_capture(folder / "capture", truth, noise=0.02)
    write_ply(folder / "trained.ply", truth)
    (folder / "opensplat").write_text(STAND_IN)
    (folder / "opensplat").chmod(0o755)
    return folder


def test_both_train_in_turns_and_the_last_line_is_the_ratio_of_the_run(folder, capsys) -> None:
    main(folder / "opensplat", folder / "capture", steps=12, saves=3, rounds=2, threads=1, psnr=8.0)
    *lines, last = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["opensplat", "sagesplat", "sagesplat", "opensplat"]
    found = json.loads(last)
    assert (found["version"], found["steps"], found["views"], found["psnr"]) == ("1.1.5", 12, 7, 8.0)
    theirs, own = found["opensplat"], found["sagesplat"]
    assert [len(each) for each in theirs["psnr"] + own["psnr"]] == [3, 3, 3, 3]
    assert min(theirs["psnr"][0]) > 25 > max(own["psnr"][0])  # the one copies the truth
    assert theirs["gaussians"] == [60, 60]
    assert found["ratio"]["step"] == pytest.approx(theirs["step_ms"] / own["step_ms"], rel=1e-2)
    assert theirs["seconds_to_psnr"] > 0


def test_the_workspace_holds_the_training_views_alone(folder, tmp_path) -> None:
    given = load_scene(folder / "capture")
    scene = training_workspace(given, tmp_path / "work")
    assert len(scene.views) == len(given.train_ids) == 7
    assert len(scene.points.xyz) == len(given.points.xyz)
    before, after = given.views[given.train_ids[0]], scene.views[0]
    np.testing.assert_allclose(after.camera.w2c, before.camera.w2c, atol=1e-5)
    np.testing.assert_allclose(after.camera.K, before.camera.K, atol=1e-4)
    assert after.image_path.read_bytes() != b""


@pytest.mark.parametrize(
    ("path", "options", "says"),
    [
        ("opensplat", ("--fly",), "ended with 1 after 0 steps, and said \"Option 'fly' does not exist\""),
        ("absent", (), "absent: No such file or directory; give a build of OpenSplat"),
    ],
)
def test_what_fails_is_one_line_with_what_it_said(folder, tmp_path, path, options, says) -> None:
    program = Program(folder / path, 1, False, options)
    with pytest.raises(BackendUnavailable) as failed:
        program.course(folder / "capture", 4, 2, load_scene(folder / "capture"), False, tmp_path / "out")
    assert says in str(failed.value)
    assert "\n" not in str(failed.value)


def test_saving_is_not_training(folder) -> None:
    g = random_gaussians(60, degree=1, logit=2.0)
    held_out = load_scene(folder / "capture")
    stamps = {1: 9.0, 2: 10.0, 3: 11.0, 4: 21.0, 5: 22.0}  # saved after step 3
    course = course_of(stamps, {3: g, 5: g}, held_out, False, antialiased=False)
    assert course.step_seconds == 1.0
    assert course.seconds == {1: 1.0, 2: 2.0, 3: 3.0, 4: 4.0, 5: 5.0}


def test_a_psnr_that_is_not_reached_has_no_ratio() -> None:
    slow = Course({10: 10.0, 20: 20.0}, 1.0, {10: 18.0, 20: 20.0}, 5)
    fast = Course({10: 1.0, 20: 2.0}, 0.1, {10: 21.0, 20: 22.0}, 5)
    assert slow.seconds_to(19.0) == 15.0
    found = compared({"opensplat": [slow], "sagesplat": [fast]}, None)
    assert (found["psnr"], found["ratio"]["step"], found["ratio"]["seconds_to_psnr"]) == (20.0, 10.0, 20.0)
    found = compared({"opensplat": [slow], "sagesplat": [fast]}, 21.5)
    assert found["opensplat"]["seconds_to_psnr"] is None
    assert found["ratio"]["seconds_to_psnr"] is None
    assert found["sagesplat"]["seconds_to_psnr"] == 1.5


def test_it_is_a_benchmark_with_help(capsys, monkeypatch) -> None:
    with pytest.raises(SystemExit) as ended:
        run_benchmark(monkeypatch, "opensplat", "--help")
    assert not ended.value.code
    assert "--binary" in capsys.readouterr().out
