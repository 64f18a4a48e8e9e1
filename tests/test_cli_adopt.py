"""`sagesplat adopt` as typed: repeated, refused, and what other commands do with its run."""

import json
import math
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import Call, random_gaussians

from sagesplat.formats.ply import read_ply, write_ply
from sagesplat.stages import pipeline

SMALL = ("--fit", "none", "--views", "14", "--size", "48", "36", "--shares", "0.3", "1", "--kind", "object")
FEW = ("--sample.views", "6", "--sample.calibration-views", "6", "--target-fidelity", "0.6")


@pytest.fixture
def up_to_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    """What follows the levels takes most of the time, and is the same for all of them."""
    monkeypatch.setattr(pipeline, "measure_and_plan", lambda job, config: None)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of ball.ply, which is beside it, as is other.ply."""
    from sagesplat import cli

    folder = tmp_path_factory.mktemp("adopted")
    g = random_gaussians(400, degree=1, logit=2.0)
    write_ply(folder / "ball.ply", g, {3: "car", 184: "tree-merged"})
    write_ply(folder / "other.ply", replace(g, means=g.means + 1), {3: "car", 184: "tree-merged"})
    with pytest.MonkeyPatch.context() as patch:
        words = ["sagesplat", "adopt", str(folder / "ball.ply"), str(folder / "run"), *SMALL, *FEW]
        patch.setattr(sys, "argv", words)
        cli.main()
    return folder / "run"


def _files(run: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(run)): path.read_bytes()
        for path in sorted(run.rglob("*"))
        if path.is_file() and path.name != ".lock"
    }


def _refused(command: Call, *words: str | Path) -> str:
    code, said = command(*words)
    assert code == 2, said
    assert "Traceback" not in said
    assert said.splitlines()[-1].startswith("sagesplat: ")
    return said


def test_its_settings_are_the_defaults_of_the_next_call(finished: Path, command: Call) -> None:
    code, said = command("adopt", finished.parent / "ball.ply", finished)
    assert code == 0
    assert "--fit none" in said
    assert "--views 14" in said
    assert "--masks" not in said  # label images that adopt made are none that somebody gave
    assert "✓" not in said  # nothing is redone


def test_its_report_is_right_where_the_run_is_moved(finished: Path) -> None:
    """Commands are typed in the folder that holds the run, and no path is absolute."""
    page = (finished / "nested" / "report" / "index.html").read_text()
    assert str(finished.parent) not in page
    assert "<code>sagesplat view run</code>" in page
    assert "typed in the folder that holds the run" in page


@pytest.mark.usefixtures("up_to_levels")
def test_another_splat_replaces_it_only_with_force(finished: Path, tmp_path: Path, command: Call) -> None:
    run = Path(shutil.copytree(finished, tmp_path / "run"))
    before = _files(run)
    said = _refused(command, "adopt", finished.parent / "other.ply", run)
    assert "--force" in said
    assert _files(run) == before
    code, said = command("adopt", finished.parent / "other.ply", run, "--force")
    assert code == 0, said
    assert (run / "capture" / "other").is_dir()


@pytest.mark.parametrize(
    "words",
    [
        *(("train", "--force"), ("nest",), ("fuse",), ("lift",), ("compare",)),
        *(("report", "--paper"), ("crossview",)),
        ("plan", "--target-ssim", "0.7", "--force"),
    ],
)
def test_what_came_in_is_not_trained_again(finished: Path, command: Call, words: tuple[str, ...]) -> None:
    before = _files(finished)
    said = _refused(command, words[0], finished, *words[1:])
    assert "splat" in said
    assert _files(finished) == before


def test_its_capture_is_not_run_over_it(finished: Path, command: Call) -> None:
    before, capture = _files(finished), finished / "capture" / "ball"
    for words in (("run", capture, finished, "--force"), ("masks", capture, finished, "--force")):
        assert "trained elsewhere" in _refused(command, *words)
    assert "trained elsewhere" in _refused(command, "transfer", finished, finished)
    ball = finished.parent / "ball.ply"  # nor does it overwrite what it reads
    assert "run folder" in _refused(command, "adopt", ball, finished, "--cameras", capture, "--force")
    assert _files(finished) == before


def test_a_run_of_a_capture_is_kept(finished_run: Path, finished: Path, command: Call) -> None:
    before = _files(finished_run)
    said = _refused(command, "adopt", finished.parent / "ball.ply", finished_run, "--force")
    assert "choose a new folder" in said
    assert _files(finished_run) == before


@pytest.mark.usefixtures("up_to_levels")
def test_ssim_needs_photos_which_is_told_before_levels_are_made(
    finished: Path, tmp_path: Path, command: Call
) -> None:
    said = _refused(
        command, "adopt", finished.parent / "ball.ply", tmp_path / "run", *SMALL, "--target-ssim", "0.7"
    )
    assert "--cameras" in said
    assert not (tmp_path / "run" / "nested" / "ladder.npz").exists()
    code, said = command("adopt", finished.parent / "ball.ply", tmp_path / "run", *SMALL, *FEW)
    assert code == 0, said


def test_bad_files_are_one_line_and_make_nothing(finished: Path, tmp_path: Path, command: Call) -> None:
    ball = (finished.parent / "ball.ply").read_bytes()
    g = read_ply(finished.parent / "ball.ply")
    write_ply(tmp_path / "nan.ply", replace(g, means=g.means * float("nan")))
    write_ply(tmp_path / "zeros.ply", replace(g, quats=g.quats * 0))
    damaged = {
        "cut.ply": ball[: len(ball) // 2],
        "none.ply": ball.replace(b"element vertex 400", b"element vertex 0"),
        "scene.obj": b"v 0 0 0",
    }
    for name, content in damaged.items():
        (tmp_path / name).write_bytes(content)
    for name in (*damaged, "nan.ply", "zeros.ply", "missing.ply"):
        said = _refused(command, "adopt", tmp_path / name, tmp_path / "run", *SMALL)
        assert name in said
        assert len(said.splitlines()) == 1
        assert not (tmp_path / "run" / "levels").exists()


@pytest.mark.usefixtures("up_to_levels")
def test_cameras_that_look_elsewhere_are_told(finished: Path, tmp_path: Path, command: Call) -> None:
    away = [
        {
            **{"id": i, "img_name": str(i), "width": 48, "height": 36, "fx": 40, "fy": 40},
            **{"position": [1000, i, 0], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},
        }
        for i in range(12)
    ]
    (tmp_path / "cameras.json").write_text(json.dumps(away))
    ball = finished.parent / "ball.ply"
    said = _refused(command, "adopt", ball, tmp_path / "run", *SMALL, "--cameras", tmp_path / "cameras.json")
    assert "no viewpoint shows" in said
    code, said = command("adopt", ball, tmp_path / "run", *SMALL, *FEW)
    assert code == 0, said


def test_a_splat_before_the_near_plane_is_refused(finished: Path, tmp_path: Path, command: Call) -> None:
    g, factor = read_ply(finished.parent / "ball.ply"), 1e-3
    small = replace(g, means=g.means * factor, log_scales=g.log_scales + math.log(factor))
    write_ply(tmp_path / "small.ply", small)
    for words in (
        ("adopt", tmp_path / "small.ply", tmp_path / "run", *SMALL),
        ("measure", tmp_path / "small.ply", finished.parent / "ball.ply", "--out", tmp_path / "out"),
    ):
        said = _refused(command, *words)
        assert "small.ply --scale 1000 larger.ply" in said


@pytest.mark.usefixtures("up_to_levels")
def test_a_killed_one_resumes_with_the_same_command(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Call
) -> None:
    from sagesplat.stages import adopt_levels

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    words = ("adopt", finished.parent / "ball.ply", tmp_path / "run", *SMALL, *FEW)
    with monkeypatch.context() as patch:
        patch.setattr(adopt_levels, "_streams", killed)
        code, said = command(*words)
    assert code != 0
    assert "Traceback" not in said
    code, said = command(*words)
    assert code == 0, said
    made, undisturbed = _files(tmp_path / "run"), _files(finished)
    for name in ("nested/ladder.npz", "nested/increments/index.json"):
        assert made[name] == undisturbed[name]
