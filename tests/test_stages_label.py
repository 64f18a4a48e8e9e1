"""Label images in a run: given or made, merged and left out, and agreed on by all views."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sagesplat.core.config import LabelsConfig, MasksConfig, PosesConfig, SceneConfig, TrainConfig
from sagesplat.core.errors import LabelError, RunError
from sagesplat.core.events import Event, Warned
from sagesplat.demo.capture import make_capture
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene import photos as photos_module
from sagesplat.segment import hf
from sagesplat.segment.lift import IGNORED
from sagesplat.segment.masks import Taxonomy, mask_path
from sagesplat.segment.segmenters import Segmented
from sagesplat.stages import label
from sagesplat.stages.label import fuse_masks, lift_labels, make_masks
from sagesplat.stages.scene import open_scene
from sagesplat.stages.train import train_levels


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "capture"
    make_capture(folder, views=8, width=64, height=48)
    return folder


def begun(run: Path, capture: Path, **options) -> tuple[Job, list[Event]]:
    events: list[Event] = []
    job = Job(RunDir(run, "snapshots"), events.append, **options)
    open_scene(job, capture, SceneConfig(calibrate_every=0))
    return job, events


def test_categories_are_merged_left_out_and_folded(capture: Path, tmp_path: Path) -> None:
    job, _ = begun(tmp_path / "run", capture)
    make_masks(job, MasksConfig())
    before = {
        name: np.mean([(job.masks[v] == i).mean() for v in job.scene.views])
        for i, name in job.taxonomy.names.items()
    }
    first, second, *_ = sorted(before, key=lambda name: before[name])
    job, _ = begun(tmp_path / "run", capture, force=True)
    make_masks(job, MasksConfig(), LabelsConfig(merge=f"{first}={second}"))
    assert first not in job.taxonomy.names.values()
    after = {
        name: np.mean([(job.masks[v] == i).mean() for v in job.scene.views])
        for i, name in job.taxonomy.names.items()
    }
    assert after[second] == pytest.approx(before[first] + before[second])
    job, _ = begun(tmp_path / "run", capture, force=True)
    both = LabelsConfig(keep=f"{first},{second}", min_share=float(before[second]))
    make_masks(job, MasksConfig(), both)
    assert list(job.taxonomy.names.values()) == [second]
    with pytest.raises(LabelError, match="no category 'nothing'"):
        make_masks(job, MasksConfig(), LabelsConfig(keep="nothing"))


class Halves:
    """A network that calls the upper half of a photo sky and the rest grass."""

    taxonomy = Taxonomy({187: "sky-other-merged", 193: "grass-merged"})
    note = "names were not trusted"
    calls = 0

    def __init__(self, model, **_) -> None:
        assert model == "some/network"

    def __call__(self, photos):
        Halves.calls += len(photos)
        return [self.answer(photo.shape[:2]) for photo in photos]

    def answer(self, shape) -> Segmented:
        sky = np.arange(shape[0])[:, None] < np.full(shape[1], shape[0] // 2)
        return Segmented(np.where(sky, 187, 193).astype(np.int16))


def test_label_images_of_a_network_are_fused(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hf, "HfSegmenter", Halves)
    monkeypatch.setattr(Halves, "calls", 0)
    job, events = begun(tmp_path / "run", capture)
    config = MasksConfig(segmenter="hf", model="some/network")
    make_masks(job, config)
    assert Halves.calls == len(job.scene.views)
    assert Warned("names were not trusted") in events
    make_masks(job, config)  # done
    make_masks(Job(job.run, events.append, force=True), config, LabelsConfig(merge="grass-merged=ground"))
    assert Halves.calls == len(job.scene.views)  # other categories, the same network
    job, _ = begun(tmp_path / "run", capture)
    assert set(job.taxonomy.names.values()) == {"sky-other-merged", "ground"}
    lift_labels(job)
    train_levels(job, TrainConfig(max_steps=40, level_every=40), 0)
    assert job.level_masks is job.masks
    fuse_masks(job)
    assert job.level_masks.folder == job.run.fused
    made = json.loads((job.run.fused / "fused.json").read_text())
    assert 0 < made["changed"] < 0.5
    assert all(0 <= share <= 1 for share in made["agreement"])


def test_photos_without_poses_become_a_capture(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What structure from motion itself does is tested with `scene.photos`."""
    asked = []

    def reconstruct(source, workspace, config, on_progress, **_):
        asked.append((source, config))
        shutil.copytree(capture, workspace)
        (workspace / "poses.json").write_text("{}")
        on_progress("features", 1, 2)
        return photos_module.Reconstruction(workspace, 9, 8, {"a.jpg": "too few features"}, 10, 0.97, {})

    monkeypatch.setattr(photos_module, "reconstruct", reconstruct)
    events: list[Event] = []
    job = Job(RunDir(tmp_path / "run"), events.append)
    monkeypatch.chdir(capture)
    for path in (capture / "images", Path("images"), Path("..") / capture.name / "images"):
        open_scene(replace(job), path, SceneConfig(), PosesConfig(matching="sequential"))
    assert asked == [(capture / "images", PosesConfig(matching="sequential"))]
    warned = [event.text for event in events if isinstance(event, Warned)]
    assert "a.jpg: too few features" in warned
    (high,) = (text for text in warned if "0.97 px is high" in text)
    assert "--poses.camera per-image" in high
    assert job.scene.path == (tmp_path / "run" / "capture" / "images").resolve()
    assert len(job.scene.views) == 8


def test_a_run_among_the_photos_is_refused(capture: Path) -> None:
    job = Job(RunDir(capture / "images" / "run"), lambda event: None)
    with pytest.raises(RunError, match="lies among the photos"):
        open_scene(job, capture / "images", SceneConfig())


def valid_in(job: Job) -> list[np.ndarray | None]:
    return [job.valid[view] for view in job.scene.views]


def test_ignored_categories_have_no_pixel_no_vote_and_no_gaussian(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(label, "_DILATION", 0)
    job, events = begun(tmp_path / "run", capture)
    make_masks(job, MasksConfig())
    lift_labels(job)
    with_all, tree = job.initial_labels, next(i for i, n in job.taxonomy.names.items() if n == "tree-merged")
    trees = [job.masks[view] == tree for view in job.scene.views]
    shutil.rmtree(tmp_path / "run")

    job, events = begun(tmp_path / "run", capture)
    make_masks(job, MasksConfig(), LabelsConfig(ignore="tree-merged,person"))
    assert [str(e.text) for e in events if isinstance(e, Warned)] == ["ignore: no photo shows person"]
    assert "tree-merged" not in job.taxonomy.names.values()
    for pixels, valid, view in zip(trees, valid_in(job), job.scene.views, strict=True):
        np.testing.assert_array_equal(pixels, np.zeros_like(pixels) if valid is None else ~valid)
        assert (job.masks[view][pixels] == -1).all()
    lift_labels(job)
    assert (job.initial_labels[with_all == tree] == IGNORED).mean() > 0.9
    assert (job.initial_labels == IGNORED).sum() > 10
    assert job.point_labels.min() == -1
    train_levels(job, TrainConfig(max_steps=3, level_every=3, sky="off"), 0)
    assert job.recorded.size(3) == (job.initial_labels != IGNORED).sum()

    for wrong, message in (
        (LabelsConfig(ignore="dgo"), "no category 'dgo'"),
        (LabelsConfig(ignore="a,,b"), "a name is empty"),
        (LabelsConfig(ignore="tree-merged", keep="tree-merged"), "keep: no category 'tree-merged'"),
    ):
        again, _ = begun(tmp_path / "run", capture, force=True)
        with pytest.raises(LabelError, match=message):
            make_masks(again, MasksConfig(), wrong)


def test_masks_of_a_capture_are_found_and_photos_without_a_pixel_are_named(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(label, "_DILATION", 0)
    shutil.copytree(capture, tmp_path / "capture")
    job, _ = begun(tmp_path / "run", tmp_path / "capture")
    folder, first, second = tmp_path / "capture" / "masks_valid", *job.scene.views[1:3]
    folder.mkdir()
    Image.new("1", (64, 48)).save(mask_path(folder, first))
    half = Image.new("L", (64, 48))
    half.paste(255, (0, 0, 32, 48))
    half.save(mask_path(folder, second))
    job, events = begun(tmp_path / "run", tmp_path / "capture")
    make_masks(job, MasksConfig(), LabelsConfig())
    texts = [e.text for e in events if isinstance(e, Warned)]
    assert texts == [f"1 of 8 photos have no pixel that counts: {first.name}"]
    assert job.valid.rows(job.scene, range(8)) == [0, *range(2, 8)]
    make_masks(job, MasksConfig(), LabelsConfig())  # done already
    half.rotate(180).save(mask_path(folder, second))
    with pytest.raises(RunError, match="made with other valid"):
        make_masks(job, MasksConfig(), LabelsConfig())
