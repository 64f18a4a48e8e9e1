"""The whole flow on a small procedural capture."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import DemoRun, draw_nothing

from sagesplat.adapt.evaluate import read_evaluation
from sagesplat.adapt.observe import TOTAL, read_observations
from sagesplat.adapt.plan_files import read_plans
from sagesplat.core.config import FitConfig, PlanConfig, RunConfig, SceneConfig, TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Event, RunDone, StageDone, StageSkipped
from sagesplat.formats.ply import read_ply
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.stages.export import export_scene
from sagesplat.stages.pipeline import run_all
from sagesplat.stages.report import make_report

STAGES = ["scene", "segment", "masks", "lift", "train"]  # that both kinds of levels share
NESTED = ["clean", "base", "nest"]
PLANNED = ["plan", "compose", "evaluate", "report"]


def work(run: Path, capture: Path, config: RunConfig, *, force: bool = False) -> list[Event]:
    events: list[Event] = []
    run_all(Job(RunDir(run, config.ladder), events.append, force=force), capture, config)
    return events


def named(events: list[Event], kind: type) -> list[str]:
    return [e.name for e in events if isinstance(e, kind)]  # type: ignore


@pytest.fixture(scope="module")
def config(demo_run: DemoRun) -> RunConfig:
    return replace(demo_run.config, ladder="snapshots")


@pytest.fixture(scope="module")
def capture(demo_run: DemoRun) -> Path:
    return demo_run.capture


@pytest.fixture(scope="module")
def finished(demo_run: DemoRun) -> Path:
    return demo_run.path


def test_stages_are_done_in_order_and_shared_ones_once(demo_run: DemoRun) -> None:
    events = demo_run.events
    assert named(events["nested"], StageDone) == [*STAGES, *NESTED, "observe", "sample", "fit", *PLANNED]
    assert named(events["snapshots"], StageSkipped) == STAGES
    assert named(events["snapshots"], StageDone) == ["observe", "fit", *PLANNED]
    assert all(isinstance(heard[-1], RunDone) for heard in events.values())


def test_every_artefact_is_there_and_agrees_with_the_others(finished: Path, tmp_path: Path) -> None:
    run = RunDir(finished, "snapshots")
    observations, evaluation = read_observations(run.observations), read_evaluation(run.evaluation)
    assert set(observations.level) == {30, 60, 90}
    assert set(observations.view) == set(range(16))
    whole = observations.select(observations.label_id == TOTAL)
    first, last = (whole.ssim[whole.level == level].mean() for level in (30, 90))
    assert last > first + 0.02
    scene_plans, view_plans = read_plans(run.plan)
    assert [p.target for p in scene_plans] == [0.3, 0.4, 0.5]
    assert len(view_plans) == 16
    composed = read_ply(run.composed)
    assert len(composed) == scene_plans[1].count
    for choice in scene_plans[1].choices:
        assert composed.counts()[choice.label_id] == choice.count
    assert set(evaluation.view) == {0, 8}
    copy = RunDir(Path(shutil.copytree(finished, tmp_path / "run")), "snapshots")
    copy.provenance("report").unlink()
    make_report(Job(copy, print))  # with figures
    page = (copy.report / "index.html").read_text()
    assert ">grass<" in page or "grass</td>" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert str(tmp_path.parent) not in page  # it may be moved: names, and paths relative to the run


def test_whole_image_row_is_the_pixel_weighted_mean_of_the_categories(finished: Path) -> None:
    table = read_observations(RunDir(finished, "snapshots").observations)
    table = table.select((table.level == 90) & (table.view == 3))
    parts = table.select(table.label_id != TOTAL)
    whole = table.select(table.label_id == TOTAL)
    assert parts.num_pixels.sum() == whole.num_pixels[0] == 80 * 60
    assert np.average(parts.ssim, weights=parts.num_pixels) == pytest.approx(whole.ssim[0], abs=1e-5)


def test_a_second_run_has_nothing_to_do(demo_run: DemoRun, config: RunConfig) -> None:
    for again in (demo_run.config, config):
        assert not named(work(demo_run.path, demo_run.capture, again), StageDone)


def test_other_settings_need_force_and_redo_only_what_depends_on_them(
    finished: Path, capture: Path, config: RunConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw_nothing(monkeypatch)
    run = Path(shutil.copytree(finished, tmp_path / "run"))
    other = replace(config, plan=PlanConfig(target_ssim=0.5))
    with pytest.raises(RunError, match=r"plan\.json: made with other .*--force"):
        work(run, capture, other)
    assert named(work(run, capture, other, force=True), StageDone) == PLANNED


@pytest.mark.parametrize(
    ("changes", "option"),
    [
        ({"plan": PlanConfig(target_ssim=1.5)}, "--target-ssim 1.5"),
        ({"scene": SceneConfig(downscale=-1)}, "--downscale -1"),
        ({"train": TrainConfig(max_steps=0)}, "--train.max-steps 0"),
        ({"fit": FitConfig(confidence=1.0)}, "--fit.confidence 1.0"),
    ],
)
def test_impossible_settings_are_refused_by_their_options_before_anything_is_made(
    capture: Path, tmp_path: Path, changes: dict[str, Any], option: str
) -> None:
    with pytest.raises(RunError, match=f"^{option} is impossible; choose"):
        work(tmp_path / "run", capture, RunConfig(**changes))
    assert not (tmp_path / "run").exists()


def test_a_run_folder_of_another_scene_is_refused(
    finished: Path, capture: Path, config: RunConfig, tmp_path: Path
) -> None:
    shutil.copytree(capture, tmp_path / "other")
    with pytest.raises(RunError, match=r"scene\.json: made with other path"):
        work(finished, tmp_path / "other", config)


def test_a_folder_that_is_no_run_is_left_alone(capture: Path, config: RunConfig, tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(RunError, match="not a run folder"):
        work(tmp_path, capture, config)
    assert [p.name for p in tmp_path.iterdir()] == ["letter.txt"]


def test_export_takes_levels_and_categories(finished: Path, tmp_path: Path) -> None:
    job = Job(RunDir(finished, "snapshots"), print)
    count = export_scene(job, tmp_path / "a.ply", level=60, labels=["vase", "grass-merged"], target=None)
    g = read_ply(tmp_path / "a.ply")
    assert len(g) == count
    assert set(g.counts()) == {86, 193}
    expected = job.ladder.load(60, [86, 193])
    np.testing.assert_array_equal(g.means, expected.means)
    with pytest.raises(RunError, match=r"a\.ply: exists"):
        export_scene(job, tmp_path / "a.ply", level=None, labels=[], target=None)
    with pytest.raises(RunError, match="no category 'cat'"):
        export_scene(job, tmp_path / "b.ply", level=None, labels=["cat"], target=None)
    with pytest.raises(RunError, match=r"no plan for SSIM 0\.77"):
        export_scene(job, tmp_path / "b.ply", level=None, labels=[], target=("ssim", 0.77))
