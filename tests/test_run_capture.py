"""Whether a run notices that its photos changed, and only then."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import random_gaussians, write_capture
from PIL import Image

from sagesplat.core.config import SceneConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Event, StageDone, StageSkipped
from sagesplat.run import capture as run_capture
from sagesplat.run.job import Job
from sagesplat.run.records import file_hash
from sagesplat.run.run_dir import RunDir
from sagesplat.stages import scene as scene_stage
from sagesplat.stages.scene import open_scene


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_capture(folder / "capture", random_gaussians(30, degree=0), views=4)
    for path in (folder / "capture" / "images").iterdir():  # equal sizes, whatever they show
        Image.open(path).save(path.with_suffix(".bmp"))
        path.with_suffix(".bmp").replace(path)
    return folder


@pytest.fixture
def capture(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made / "capture", tmp_path / "capture"))


def begin(run: Path, capture: Path, force: bool = False) -> list[Event]:
    events: list[Event] = []
    open_scene(Job(RunDir(run), events.append, "cpu", force=force), capture, SceneConfig())
    return events


def replace_photo(path: Path) -> None:
    """By another one of the same size in bytes, and from the same second as far as it can be said."""
    before = path.stat()
    pixels = np.asarray(Image.open(path)).copy()
    Image.fromarray(255 - pixels).save(path, "BMP")
    assert path.stat().st_size == before.st_size
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def await_later_time(path: Path) -> None:
    """Return when the clock of the file system, which is coarse, gives later times than that of `path`."""
    probe = path.with_name("probe")
    while not probe.exists() or probe.stat().st_ctime_ns <= path.stat().st_ctime_ns:
        probe.touch()
    probe.unlink()


def test_a_photo_of_the_same_size_and_time_is_noticed(tmp_path: Path, capture: Path) -> None:
    begin(tmp_path / "run", capture)
    await_later_time(capture / "images" / "01.png")
    replace_photo(capture / "images" / "01.png")
    for act in (
        lambda: begin(tmp_path / "run", capture),
        lambda: Job(RunDir(tmp_path / "run"), lambda event: None).scene,
    ):
        with pytest.raises(RunError, match=r"images/01\.png: not the photo that this run began with"):
            act()
    assert any(isinstance(event, StageDone) for event in begin(tmp_path / "run", capture, force=True))
    assert Job(RunDir(tmp_path / "run"), lambda event: None).scene.views
    assert isinstance(begin(tmp_path / "run", capture)[-1], StageSkipped)


def test_photos_that_were_touched_or_copied_are_the_same(tmp_path: Path, capture: Path) -> None:
    begin(tmp_path / "run", capture)
    (capture / "images" / "00.png").touch()
    aside = capture.rename(tmp_path / "aside")
    shutil.copytree(aside, capture, copy_function=shutil.copyfile)
    before = RunDir(tmp_path / "run").scene.read_bytes()
    assert isinstance(begin(tmp_path / "run", capture)[-1], StageSkipped)
    assert RunDir(tmp_path / "run").scene.read_bytes() == before
    RunDir(tmp_path / "run").photo_hashes.unlink()
    assert isinstance(begin(tmp_path / "run", capture)[-1], StageSkipped)


def test_photos_are_read_once_unless_they_changed(tmp_path: Path, capture: Path, monkeypatch) -> None:
    read: list[str] = []

    def watched(path: Path) -> str:
        read.append(path.name)
        return file_hash(path)

    monkeypatch.setattr(run_capture, "file_hash", watched)
    begin(tmp_path / "run", capture)
    assert sorted(read) == ["00.png", "01.png", "02.png", "03.png"]
    begin(tmp_path / "run", capture)
    assert Job(RunDir(tmp_path / "run"), lambda event: None).scene.views
    assert len(read) == 4
    (capture / "images" / "02.png").touch()
    begin(tmp_path / "run", capture)
    begin(tmp_path / "run", capture)
    assert read[4:] == ["02.png"]


@pytest.mark.parametrize("content", ["{", '{"00.png": [1, 2, 3, "x"]}'])
def test_a_damaged_list_of_hashes_is_made_anew(tmp_path: Path, capture: Path, content: str) -> None:
    begin(tmp_path / "run", capture)
    RunDir(tmp_path / "run").photo_hashes.write_text(content)
    assert isinstance(begin(tmp_path / "run", capture)[-1], StageSkipped)


def test_photos_without_poses_are_known_by_their_content(tmp_path: Path) -> None:
    photos, job = tmp_path / "photos", Job(RunDir(tmp_path / "run"), lambda event: None)
    photos.mkdir()
    (photos / "a.jpg").write_bytes(b"one")
    hashes = scene_stage._hashes(job, photos)
    hashes.keep()
    (photos / "a.jpg").touch()
    assert scene_stage._hashes(job, photos).sha256 == hashes.sha256
    (photos / "a.jpg").write_bytes(b"two")
    assert scene_stage._hashes(job, photos).sha256 != hashes.sha256
