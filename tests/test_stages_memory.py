"""Memory of nesting and networks is predicted, and refused in one line before it runs out."""

from dataclasses import replace
from pathlib import Path

import pytest
from conftest import random_gaussians, write_capture

from sagesplat.core.config import SceneConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Event, Warned
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.stages.memory import check_nest, check_network, network_memory
from sagesplat.stages.scene import open_scene
from sagesplat.train.memory import GIB


@pytest.fixture
def told() -> list[Event]:
    return []


@pytest.fixture
def job(tmp_path: Path, told: list[Event]) -> Job:
    write_capture(tmp_path / "capture", random_gaussians(20, degree=0))
    job = Job(RunDir(tmp_path / "run"), told.append)
    open_scene(job, tmp_path / "capture", SceneConfig())
    told.clear()
    return job


def test_nesting_needs_what_training_did(job: Job, told: list[Event]) -> None:
    small = replace(job, memory_limit=GIB)
    with pytest.raises(RunError) as caught:
        check_nest(small, 10**6, 3)
    line = str(caught.value)
    assert line == (
        f"{job.run.path}: nesting 1,000,000 Gaussians needs about 2.2 GiB, the limit is 1.0; raise "
        "--memory-limit of `sagesplat run`, or train fewer: --train.max-gaussians 340000 --force"
    )
    check_nest(small, 340_000, 3)  # the cure works
    warned = [event.text for event in told if isinstance(event, Warned)]
    assert warned == [f"{job.run.path}: nesting needs about 1.2 GiB, the limit is 1.0"]
    check_nest(small, 100_000, 3)
    check_nest(replace(job, memory_limit=4 * GIB), 10**6, 3)
    check_nest(replace(small, backend="cuda"), 10**7, 3)
    assert len(told) == 1


# megabytes: (kind, of the weights, megapixels) -> peak that was measured, one thread
MEASURED = {
    ("onnx", 2.3, 0.02): 465,
    ("onnx", 2.3, 6.0): 593,
    ("onnx", 1.9, 0.02): 406,
    ("onnx", 1.9, 6.0): 533,
    ("hf", 95.9, 0.02): 1634,
    ("hf", 95.9, 6.0): 1699,
    ("deeplabv2", 224.3, 0.02): 825,
    ("deeplabv2", 224.3, 0.48): 851,
}


@pytest.mark.parametrize("case", MEASURED, ids=str)
def test_what_is_needed_at_least_is_no_more_than_what_was_measured(case: tuple) -> None:
    kind, megabytes, megapixels = case
    needed = network_memory(kind, megabytes * 1e6, int(megapixels * 1e6)) / 1e6
    assert 0.6 * MEASURED[case] < needed < 1.02 * MEASURED[case]


def test_a_network_that_cannot_fit_is_one_line(job: Job, tmp_path: Path) -> None:
    model = tmp_path / "network.onnx"
    model.write_bytes(bytes(10**6))
    small = replace(job, memory_limit=GIB // 4)
    with pytest.raises(RunError) as caught:
        check_network(small, "onnx", {"model": model})
    line = str(caught.value)
    assert line.startswith(
        f"{model}: segmenting photos of 0.0 megapixels needs at least about 0.4 GiB, the l"
    )
    assert "\n" not in line
    check_network(replace(job, memory_limit=GIB), "onnx", {"model": model})
    check_network(replace(small, backend="cuda"), "onnx", {"model": model})
