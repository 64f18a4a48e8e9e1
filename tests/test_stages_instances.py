"""Instances of a small capture, from its own 2D instances to label images, names and parents."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sagesplat.core.config import LabelsConfig, MasksConfig, PosesConfig, SceneConfig, TrainConfig
from sagesplat.core.errors import LabelError, RunError
from sagesplat.core.events import StageDone, StageSkipped, Warned
from sagesplat.demo.capture import make_capture
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.segment.instances import read_instances, write_instances
from sagesplat.segment.lift import LiftedLabels
from sagesplat.segment.masks import mask_path
from sagesplat.stages.instances import make_instances
from sagesplat.stages.label import lift_labels, make_masks
from sagesplat.stages.scene import open_scene
from sagesplat.stages.train import train_levels

PLANTS = LabelsConfig(instances="potted plant,vase")
VASE = 86  # its id


def job_on(run: Path, events: list, *, force: bool = False) -> Job:
    return Job(RunDir(run), events.append, force=force)


def stages(events: Sequence[object], kind: type = StageDone) -> list[str]:
    return [event.name for event in events if isinstance(event, kind)]  # type: ignore


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("instances")
    make_capture(folder / "capture", views=12, width=80, height=60)
    job = job_on(folder / "run", [])
    open_scene(job, folder / "capture", SceneConfig(), PosesConfig(), MasksConfig(), LabelsConfig())
    make_masks(job, MasksConfig())
    lift_labels(job)
    train_levels(job, TrainConfig(max_steps=60, level_every=60), 0)
    return folder / "run"


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    shutil.copytree(trained, tmp_path / "run")
    return tmp_path / "run"


def test_instances_are_categories_of_their_own_and_can_be_folded_back(run: Path) -> None:
    events: list[object] = []
    job = job_on(run, events)
    before = job.names()
    make_instances(job, MasksConfig(), PLANTS)
    assert stages(events) == ["photo_instances", "instances"]
    names = set(job.names().values())
    assert {"potted plant 1", "vase 1"} <= names
    assert set(before.values()) <= names
    assert job.parents["vase 1"] == "vase"
    assert "vase 1" in {job.names()[int(i)] for i in set(job.point_labels.tolist())}
    assert set(job.initial_labels.tolist()) <= set(before)
    assert Job(RunDir(run, "snapshots"), print).names() == before
    view = job.scene.views[int(job.scene.test_ids[0])]
    assert set(job.level_masks[view].ravel().tolist()) <= set(job.names())
    make_instances(job, MasksConfig(), PLANTS)
    assert stages(events, StageSkipped) == ["photo_instances", "instances"]
    with pytest.raises(RunError, match="add --force to fold them back"):
        make_instances(job, MasksConfig(), LabelsConfig())
    again = job_on(run, [], force=True)
    merged = replace(PLANTS, merge="vase 1=vase,potted plant 1=fern")
    make_instances(again, MasksConfig(), merged)
    assert "vase 1" not in again.names().values()
    assert again.parents["fern"] == "potted plant"
    make_instances(again, MasksConfig(), LabelsConfig())
    assert job_on(run, []).names() == before
    assert not again.run.parents.exists()


def test_what_cannot_be_told_apart_is_one_line_with_a_cure(run: Path, trained: Path) -> None:
    job = job_on(run, [])
    with pytest.raises(LabelError, match="no category 'sofa'; there are building"):
        make_instances(job, MasksConfig(), LabelsConfig(instances="sofa"))
    given = trained.parent / "capture" / "instances"
    given.rename(given.with_name("elsewhere"))
    try:
        with pytest.raises(LabelError, match=r"instances: no instances of any photo; put PNGs there"):
            make_instances(job, MasksConfig(), PLANTS)
    finally:
        given.with_name("elsewhere").rename(given)
    one = job.scene.views[int(job.scene.train_ids[0])]
    source = MasksConfig(masks=run.parent / "few" / "masks")  # the vase in one photo only
    shutil.copytree(given.parent / "masks", run.parent / "few" / "masks")
    shutil.copytree(given, run.parent / "few" / "instances")
    for view in job.scene.views:
        path = mask_path(run.parent / "few" / "instances", view)
        numbers = np.where(job.masks[view] == VASE, -1, read_instances(path))
        if view != one:
            write_instances(path, numbers)
    events: list[object] = []
    with pytest.raises(LabelError, match="no instance of vase is seen in two training photos"):
        make_instances(job_on(run, events, force=True), source, LabelsConfig(instances="vase"))
    said = [event.text for event in events if isinstance(event, Warned)]
    assert said == ["1 instance of vase in a single photo is left to vase: no other view agrees"]
    for view in job.scene.views:
        if view != one:
            mask_path(run.parent / "few" / "instances", view).unlink()
    with pytest.raises(RunError, match=r"instances of 1 of \d+ training photos; give those of two at least"):
        make_instances(job_on(run, [], force=True), source, PLANTS)
    job = job_on(run, [], force=True)
    points = LiftedLabels.read(job.run.labels, len(job.scene.points.xyz))
    replace(points, ignored=points.label_ids == points.label_ids[0]).write(job.run.labels)
    make_instances(job, MasksConfig(), PLANTS)
    assert set(job.point_labels.tolist()) <= set(job.names())  # ignored ones too
