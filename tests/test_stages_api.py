"""What scripts call gives what the commands give."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sagesplat import (
    FinishedRun,
    NestConfig,
    PlanConfig,
    RunConfig,
    SageError,
    StageDone,
    TrainConfig,
    open_run,
    read_ply,
    run_scene,
)
from sagesplat.adapt.plan import Plan
from sagesplat.adapt.plan_files import read_plans
from sagesplat.core.config import SampleConfig
from sagesplat.core.errors import RunError
from sagesplat.demo.capture import make_capture
from sagesplat.formats.splats import read_splat
from sagesplat.stages.export import export_increments, export_scene

CONFIG = RunConfig(
    train=TrainConfig(max_steps=120, level_every=40),
    nest=NestConfig(steps=20, levels=4, base_steps=20),
    sample=SampleConfig(views=8, calibration_views=8),
    plan=PlanConfig(target_ssim=0.4),
)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, FinishedRun]:
    folder = tmp_path_factory.mktemp("runs")
    make_capture(folder / "capture", views=9, width=64, height=48)
    events = []
    found = {
        ladder: run_scene(folder / "capture", folder / "run", config, on_event=events.append, threads=1)
        for ladder, config in (("nested", CONFIG), ("snapshots", replace(CONFIG, ladder="snapshots")))
    }
    stages = [event.name for event in events if isinstance(event, StageDone)]
    assert stages.count("train") == 1  # both ladders are of one training
    assert stages.count("plan") == 2
    return found


def test_a_composed_scene_is_for_viewers_that_do_not_antialias(runs, tmp_path):
    run = runs["nested"]
    assert run.antialiased is CONFIG.train.antialiased is True
    written = read_splat(run.job.run.composed)
    assert not written.antialiased
    (plan,) = (plan for plan in run.plans if plan.target == 0.4)
    assert (written.gaussians.logit_opacities <= run.compose(plan).logit_opacities + 1e-4).all()
    for mode in ("classic", "antialiased"):
        path = tmp_path / f"{mode}.ply"
        export_scene(run.job, path, level=1, labels=(), target=None, rasterize_mode=mode)
        assert read_splat(path).antialiased is (mode == "antialiased")
    export_increments(run.job, tmp_path / "chunks", "ply")
    assert not any(read_splat(path).antialiased for path in (tmp_path / "chunks").glob("*.ply"))
    levels = tmp_path / "lod-meta.json"
    with pytest.raises(RunError, match=r"lod-meta.json: says how it is drawn; leave out --rasterize-mode$"):
        export_scene(run.job, levels, level=None, labels=(), target=None, rasterize_mode="classic")


@pytest.mark.parametrize("ladder", ["nested", "snapshots"])
def test_a_plan_for_the_camera_of_a_view_is_the_plan_of_that_view(runs, ladder):
    run = runs[ladder]
    _, view_plans = read_plans(run.job.run.plan)
    for row in (0, 4):
        plan = run.plan_camera(run.scene.views[row].camera, target_ssim=0.4)
        # of a category that the photo's label image does not show, only the view's plan knows that
        shown = {c.label_id for c in view_plans[row].choices if not math.isnan(c.predicted)}
        assert shown
        for one, other in ((plan, view_plans[row]), (view_plans[row], plan)):
            theirs = {c.label_id: (c.level, c.status) for c in other.choices}
            assert all(theirs[c.label_id] == (c.level, c.status) for c in one.choices if c.label_id in shown)
        assert plan.view is None


def test_a_camera_is_planned_for_fidelity_by_default(runs):
    run = runs["nested"]
    camera = run.scene.views[0].camera
    plan = run.plan_camera(camera)
    assert (plan.quality, plan.target, plan.view) == ("fidelity", 0.95, None)
    assert {choice.status for choice in plan.choices} <= {"ok", "no promise", "no model"}
    low, full = (run.plan_camera(camera, target_fidelity=target) for target in (0.3, 1.0))
    assert low.count <= plan.count <= full.count == len(run.job.ladder.load(4))
    w2c = camera.w2c.copy()
    w2c[2, 3] += 30  # far from all that was sampled
    lost = run.plan_camera(replace(camera, w2c=w2c), target_fidelity=0.3)
    assert lost.status == "no promise"
    highest = {c.label_id: c.level for c in lost.choices if c.status == "no promise"}
    assert set(highest.values()) == {4}
    assert all(c.calibrated is None for c in lost.choices)


def test_a_phone_knows_the_distances_of_the_photos(runs):
    run = runs["nested"]
    photo = run.scene.views[0].camera
    K = photo.K.copy()
    K[1, 2] += photo.height
    phone = replace(photo, K=K, height=3 * photo.height)
    wanted = {c.label_id: c.distance for c in run.plan_camera(photo).choices}
    found = {c.label_id: c.distance for c in run.plan_camera(phone).choices}
    assert any(map(math.isfinite, wanted.values()))
    for label, distance in wanted.items():
        if math.isfinite(distance):  # else it is only on the phone
            assert found[label] == distance


def test_impossible_targets_of_a_camera_are_one_line(runs):
    camera = runs["nested"].scene.views[0].camera
    for target in (0.0, 1.5, math.nan):
        with pytest.raises(RunError, match=r"target fidelity .* is impossible; choose"):
            runs["nested"].plan_camera(camera, target_fidelity=target)
        with pytest.raises(RunError, match=r"target SSIM .* is impossible; choose"):
            runs["nested"].plan_camera(camera, target_ssim=target)
    with pytest.raises(RunError, match="one target; give"):
        runs["nested"].plan_camera(camera, target_fidelity=0.9, target_ssim=0.5)
    with pytest.raises(RunError, match="needs the nested ladder; give --target-ssim"):
        runs["snapshots"].plan_camera(camera, target_fidelity=0.9)
    assert runs["snapshots"].plan_camera(camera).quality == "ssim"


@pytest.mark.parametrize("ladder", ["nested", "snapshots"])
def test_a_composition_is_what_the_run_wrote(runs, ladder):
    run = runs[ladder]
    (plan,) = (plan for plan in run.plans if plan.target == 0.4)
    g, written = run.compose(plan), read_ply(run.job.run.composed)
    assert torch.equal(g.means, written.means)
    assert torch.equal(run.compose(plan.levels).label_ids, written.label_ids)
    assert set(run.names) >= set(plan.levels)


def test_a_run_is_opened_again(runs):
    run = open_run(runs["nested"].job.run.path)
    assert [plan.target for plan in run.plans] == [0.3, 0.4, 0.5]
    assert isinstance(run.plans[0], Plan)
    assert set(run.promises) <= set(run.names)
    assert run.costs.count.shape[1] == 4


def test_what_is_no_run_folder_is_said(tmp_path: Path):
    with pytest.raises(RunError, match="not a run folder"):
        open_run(tmp_path)


def test_an_impossible_backend_is_said(tmp_path: Path):
    with pytest.raises(SageError, match="backend cuda does not run on cpu"):
        run_scene(tmp_path, tmp_path / "run", device="cpu", backend="cuda")
