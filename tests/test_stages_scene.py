"""The scale that photos are trained at where nobody asks for one."""

import shutil
from pathlib import Path

import pytest
from conftest import random_gaussians, write_capture

from sagesplat.core.config import SceneConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Event, StageDone, Warned
from sagesplat.io.files import read_json
from sagesplat.raster import Backend
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.stages import scene as scene_stage
from sagesplat.stages.scene import cpu_downscale, open_scene


def begin(
    folder: Path,
    config: SceneConfig = SceneConfig(),
    backend: Backend = "cpu",
) -> tuple[list[str], int]:
    """What is said of the photos' scale, and the recorded factor."""
    events: list[Event] = []
    open_scene(Job(RunDir(folder / "run"), events.append, backend), folder / "capture", config)
    said = [event.text for event in events if isinstance(event, Warned)]
    return said, read_json(folder / "run" / "scene.json")["settings"]["downscale"]


@pytest.fixture
def capture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_capture(tmp_path / "capture", random_gaussians(30, degree=0), views=4)  # of 48 x 32 pixels
    monkeypatch.setattr(scene_stage, "_CPU_PIXELS", 100.0)
    return tmp_path


def test_large_photos_are_trained_on_smaller_on_a_cpu_and_a_line_says_so(capture: Path) -> None:
    said, factor = begin(capture)
    assert factor == 4
    assert said == [
        "photos of 48 x 32 px: trained at a quarter of that on a CPU (--downscale 1 keeps their size)"
    ]


@pytest.mark.parametrize(("config", "backend"), [(SceneConfig(downscale=1), "cpu"), (SceneConfig(), "cuda")])
def test_what_was_asked_for_and_what_a_gpu_trains_on_stay_as_they_are(
    capture: Path, config: SceneConfig, backend: Backend
) -> None:
    assert begin(capture, config, backend) == ([], 1)


def test_a_run_keeps_the_factor_that_it_began_with(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begin(capture)
    monkeypatch.setattr(scene_stage, "_CPU_PIXELS", 1e9)
    assert begin(capture) == ([], 4)
    assert begin(capture, backend="cuda") == ([], 4)


def test_the_factor_grows_with_the_photos() -> None:
    sizes = [(512, 512), (1280, 960), (1920, 1080), (3000, 3000), (5187, 3361)]
    factors = [cpu_downscale(float(width * height)) for width, height in sizes]
    assert factors == [1, 1, 2, 4, 4]
    assert cpu_downscale(1e9) == 8


def test_what_was_decided_is_said_when_the_capture_is_read(tmp_path: Path) -> None:
    write_capture(tmp_path / "capture", random_gaussians(30, degree=0), views=5)
    next((tmp_path / "capture" / "images").iterdir()).unlink()
    events: list[Event] = []
    open_scene(Job(RunDir(tmp_path / "run"), events.append, "cpu"), tmp_path / "capture", SceneConfig())
    (done,) = [event for event in events if isinstance(event, StageDone)]
    assert "4 of 4 photos have poses" in done.lines
    assert any(line.startswith("1 of 5 posed photos are gone and left out") for line in done.lines)


def test_photos_are_kept_with_the_run(tmp_path: Path) -> None:
    write_capture(tmp_path / "capture", random_gaussians(30, degree=0), views=5)
    (tmp_path / "capture/images").rename(tmp_path / "photos")
    config = SceneConfig(images=tmp_path / "photos")
    open_scene(Job(RunDir(tmp_path / "run"), lambda _: None, "cpu"), tmp_path / "capture", config)
    again = Job(RunDir(tmp_path / "run"), lambda _: None, "cpu")
    assert [view.image_path.parent for view in again.scene.views] == [tmp_path / "photos"] * 5
    open_scene(again, tmp_path / "capture", config)
    with pytest.raises(RunError, match="no poses for the photos of --images"):
        open_scene(Job(RunDir(tmp_path / "other"), lambda _: None, "cpu"), tmp_path / "photos", config)


def test_poses_that_are_not_read_are_named_before_others_are_estimated(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(scene_stage, "_find_poses", lambda *_: (_ for _ in ()).throw(RunError("estimated")))
    write_capture(tmp_path / "capture", random_gaussians(30, degree=0), views=5)
    photos = tmp_path / "capture/images"
    (photos / "reconstruction.json").write_text("[]")

    def said(number: int) -> list[str]:
        events: list[Event] = []
        with pytest.raises(RunError, match="estimated"):
            open_scene(Job(RunDir(tmp_path / f"run{number}"), events.append, "cpu"), photos, SceneConfig())
        return [event.text for event in events if isinstance(event, Warned)]

    (line,) = said(1)
    assert line.startswith(f"{tmp_path}/capture/sparse/0: poses of a folder that was not given")
    shutil.rmtree(tmp_path / "capture/sparse")
    (line,) = said(2)
    assert line.startswith(f"{photos}/reconstruction.json: poses of a format that is not read")
    (photos / "reconstruction.json").rename(tmp_path / "capture/transforms.json")
    (line,) = said(3)
    assert line.startswith(f"{tmp_path}/capture/transforms.json: poses of a file that was not given")
    (tmp_path / "capture/transforms.json").unlink()
    (tmp_path / "capture/cameras.xml").write_text("<document><chunk/></document>")  # Metashape's are read
    (line,) = said(4)
    assert line.startswith(f"{tmp_path}/capture/cameras.xml: poses of a file that was not given")
    (tmp_path / "capture/cameras.xml").unlink()
    assert said(5) == []
