"""What a run says beforehand of the time that it will take."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import random_gaussians

from sagesplat.core.config import BlocksConfig, NestConfig, RunConfig, SampleConfig, TrainConfig
from sagesplat.core.events import Event, Noted
from sagesplat.demo.capture import make_capture
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.stages import estimate
from sagesplat.stages.estimate import grown, tell_duration
from sagesplat.stages.label import lift_labels, make_masks
from sagesplat.stages.scene import open_scene

CONFIG = RunConfig(
    train=TrainConfig(max_steps=1000),
    nest=NestConfig(steps=1000, base_steps=500),
    sample=SampleConfig(views=8, calibration_views=8),
)


@pytest.fixture
def job(tmp_path: Path) -> Job:
    make_capture(tmp_path / "capture", views=6, width=48, height=32)
    job = Job(RunDir(tmp_path / "run"), lambda event: None, "cpu")
    open_scene(job, tmp_path / "capture", CONFIG.scene)
    make_masks(job, CONFIG.masks)
    lift_labels(job)
    return job


def said(job: Job, config: RunConfig = CONFIG) -> list[str]:
    events: list[Event] = []
    tell_duration(Job(job.run, events.append, job.backend), config)
    return [event.text for event in events if isinstance(event, Noted)]


def test_a_grown_model_covers_as_much_as_what_it_grew_from() -> None:
    g = random_gaussians(50)
    more = grown(g, 150)
    assert len(more) == 150
    areas = [torch.exp(some.log_scales.mean(1) * 2).sum() for some in (g, more)]
    assert torch.allclose(*areas, rtol=1e-5)
    assert len(grown(g, 120)) == 120


def test_a_run_of_minutes_is_announced_by_its_parts(job: Job, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate, "step_seconds", lambda *_: (0.25, 0.0))
    (text,) = said(job)
    assert text.startswith("from here on about ")
    assert "training 4 min" in text  # 1000 steps; photos of 48 x 32 pixels are never made smaller
    assert {part.split()[0] for part in text.partition(": ")[2].split(", ")} == {
        "training",
        "levels",
        "measuring",
    }
    longer = replace(CONFIG, train=replace(CONFIG.train, max_steps=2000))
    assert "training 8 min" in said(job, longer)[0]


def test_nothing_is_said_of_what_is_short_begun_or_not_done_here(
    job: Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimate, "step_seconds", lambda *_: (1e-4, 0.0))
    assert said(job) == []
    monkeypatch.setattr(estimate, "step_seconds", lambda *_: (1.0, 0.0))
    assert said(job, replace(CONFIG, blocks=BlocksConfig(count=2))) == []
    assert np.isfinite(estimate.training_seconds(job, CONFIG.train, 100, 1.0, 0.0))
    job.run.checkpoint.touch()
    assert said(job) == []
