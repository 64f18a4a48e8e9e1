"""What scripts call gives what the commands give."""

import math
from dataclasses import replace

import pytest
import torch
from conftest import DemoRun

from sagesplat import (
    FinishedRun,
    open_run,
    read_ply,
)
from sagesplat.adapt.plan_files import read_plans
from sagesplat.core.errors import RunError
from sagesplat.formats.labels import sidecar
from sagesplat.formats.splats import read_splat
from sagesplat.stages.export import export_increments, export_scene


@pytest.fixture(scope="module")
def runs(demo_run: DemoRun) -> dict[str, FinishedRun]:
    return {"nested": open_run(demo_run.path), "snapshots": open_run(demo_run.path, "snapshots")}


def test_a_composed_scene_is_for_viewers_that_do_not_antialias(runs, tmp_path):
    run = runs["nested"]
    assert run.antialiased is True
    written = read_splat(run.job.run.composed)
    assert not written.antialiased
    (plan,) = (plan for plan in run.plans if plan.target == 0.4)
    assert (written.gaussians.logit_opacities <= run.compose(plan).logit_opacities + 1e-4).all()
    for mode in ("classic", "antialiased"):
        path = tmp_path / f"{mode}.ply"
        export_scene(run.job, path, level=1, labels=(), target=None, rasterize_mode=mode)
        assert read_splat(path).antialiased is (mode == "antialiased")
    for name in ("a.glb", "a.compressed.ply", "a.splat", "inside.ply"):
        inside = name == "inside.ply"
        export_scene(run.job, tmp_path / name, level=1, labels=(), target=None, labels_inside=inside)
        splat = read_splat(tmp_path / name)
        assert splat.gaussians.counts() == read_splat(tmp_path / "classic.ply").gaussians.counts()
        assert splat.names == read_splat(tmp_path / "classic.ply").names
        assert not splat.antialiased
        assert sidecar(tmp_path / name).exists() != (name in ("a.glb", "inside.ply"))
    with pytest.raises(RunError, match=r"--labels-inside is for \.ply"):
        export_scene(run.job, tmp_path / "b.spz", level=1, labels=(), target=None, labels_inside=True)
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
    assert set(run.promises) <= set(run.names)
    assert run.costs.count.shape[1] == 5
    plan = run.plan_camera(camera)
    assert (plan.quality, plan.target, plan.view) == ("fidelity", 0.95, None)
    assert {choice.status for choice in plan.choices} <= {"ok", "no promise", "no model"}
    low, full = (run.plan_camera(camera, target_fidelity=target) for target in (0.3, 1.0))
    assert low.count <= plan.count <= full.count <= len(run.job.ladder.load(5))  # less what is out of sight
    assert {choice.predicted for choice in full.choices if choice.predicted == choice.predicted} <= {1.0}
    w2c = camera.w2c.copy()
    w2c[2, 3] += 30  # far from all that was sampled
    lost = run.plan_camera(replace(camera, w2c=w2c), target_fidelity=0.3)
    assert lost.status == "no promise"
    highest = {c.label_id: c.level for c in lost.choices if c.status == "no promise"}
    assert set(highest.values()) == {5}
    assert all(c.calibrated is None for c in lost.choices)


def test_a_higher_window_knows_the_distances_of_the_highest_shape(runs):
    run = runs["nested"]
    photo = run.scene.views[0].camera

    def distances(times: float) -> dict[int, float]:
        K = photo.K.copy()
        height = round(times * photo.height)
        K[1, 2] += (height - photo.height) / 2
        choices = run.plan_camera(replace(photo, K=K, height=height)).choices
        return {choice.label_id: choice.distance for choice in choices}

    wanted, found = distances(3), distances(5)  # shapes go up to about 1.7
    assert any(map(math.isfinite, wanted.values()))
    for label, distance in wanted.items():
        if math.isfinite(distance):  # else it is only on the phone
            assert found[label] == distance


def test_impossible_targets_of_a_camera_are_one_line(runs):
    camera = runs["nested"].scene.views[0].camera
    with pytest.raises(RunError, match=r"--target-fidelity 1\.5 is impossible; choose"):
        runs["nested"].plan_camera(camera, target_fidelity=1.5)
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
    assert [plan.target for plan in run.plans] == [0.3, 0.4, 0.5]
