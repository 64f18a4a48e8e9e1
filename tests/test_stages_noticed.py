"""What a run noticed is told at its end: on the console and in the report."""

import io
from pathlib import Path

import numpy as np
import pytest
from conftest import job_of
from PIL import Image
from rich.console import Console as RichConsole

from sagesplat.cli.console import Console
from sagesplat.core.events import Event, RunDone
from sagesplat.io.files import write_json
from sagesplat.output.report_data import ReportData
from sagesplat.run.job import Job
from sagesplat.segment.masks import mask_path
from sagesplat.stages import report
from sagesplat.stages.noticed import noticed

POSES = {
    "pixels": 0.31, "degrees": 0.01, "shift": 0.001, "diverged": 0, "fitted": 2, "held_out": 2,
    "psnr": None, "ssim": None,
}  # fmt: skip
EXPOSURE = {"range_ev": 0.84, "psnr": None, "ssim": None}
FLOATERS = {
    "gaussians": 9000, "found": {"hardly shown": 300, "in front": 1300, "category": 40},
    "removed": {"hardly shown": 300, "in front": 1200, "category": 40},
    "before": {"train": 20.0}, "after": {"train": 20.0},
}  # fmt: skip
WORDS = (
    "exposure varies by 0.8 EV",
    "2.8 % of pixels ignored",
    "1,240 floaters removed",
    "300 Gaussians removed that hardly any photo shows",
    "poses moved by 0.3 px",
)


@pytest.fixture
def job(run: Path) -> Job:
    for name in ("floaters.json", "floaters.png"):
        (run / name).unlink(missing_ok=True)
    return job_of(run)


def disturb(job: Job) -> None:
    """Leave what a run on a disturbed capture leaves."""
    write_json(job.run.refined, {"poses": POSES, "exposure": EXPOSURE})
    write_json(job.run.floaters, FLOATERS)
    for view in job.scene.views[::2]:
        counts = np.ones((view.camera.height, view.camera.width), bool)
        counts[:2, : view.camera.width * 9 // 10] = False
        path = mask_path(job.run.valid, view)
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(counts).save(path)


def test_nothing_is_told_of_a_clean_capture(job: Job) -> None:
    assert noticed(job) == ()


def test_the_console_and_the_page_get_it(job: Job, monkeypatch: pytest.MonkeyPatch) -> None:
    disturb(job)
    events, pages = list[Event](), list[ReportData]()
    monkeypatch.setattr("sagesplat.output.report.write_report", lambda folder, data: pages.append(data))
    job.run.provenance("report").unlink()
    report.make_report(Job(job.run, events.append, "cpu"))
    report.make_report(Job(job.run, events.append, "cpu"))  # there already, and yet it is told
    assert [page.noticed for page in pages] == [WORDS]
    done = [event for event in events if isinstance(event, RunDone)]
    assert [event.noticed for event in done] == [WORDS, WORDS]
    printed = io.StringIO()
    console = Console(RichConsole(file=printed, width=300))
    console(done[0])
    console(RunDone(Path("report")))
    assert printed.getvalue().splitlines()[0] == f"· noticed: {'; '.join(WORDS)}"
    assert printed.getvalue().count("noticed") == 1
