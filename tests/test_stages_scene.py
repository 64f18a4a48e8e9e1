"""The scale that photos are trained at where nobody asks for one."""

from pathlib import Path

import pytest
from conftest import random_gaussians, write_capture

from sagesplat.core.config import SceneConfig
from sagesplat.core.events import Event, Warned
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
