"""What scripts call gives what the commands give."""

import math
import re
from dataclasses import replace
from html import unescape

import browser as chromium
import pytest
import torch
from conftest import DemoRun, wait_for

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
    sizes = {}
    export_increments(run.job, tmp_path / "chunks", "ply")
    assert not any(read_splat(path).antialiased for path in (tmp_path / "chunks").glob("*.ply"))
    for mode in (None, "classic", "antialiased"):  # None: for PlayCanvas's engine, which does not antialias
        levels = tmp_path / f"{mode}.ssog"
        export_scene(run.job, levels, level=None, labels=(), target=None, levels=[1], rasterize_mode=mode)
        splat = read_splat(levels)
        assert splat.antialiased is (mode == "antialiased")
        sizes[mode] = float(splat.gaussians.log_scales.mean())
    assert sizes[None] > sizes["classic"] + 0.04
    assert sizes["classic"] == pytest.approx(sizes["antialiased"], abs=0.01)  # but opacities differ


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


@pytest.mark.parametrize("ladder", ["nested", "snapshots"])
def test_a_printed_run_lists_its_plans_and_a_plan_its_categories(runs, ladder):
    run = runs[ladder]
    first, head, *rows = str(run).splitlines()
    assert first == f"{run.path}: {ladder} levels"
    assert head.split() == ["plan", "MB", "Gaussians", "status"]
    assert [row.split()[:2] for row in rows] == [["SSIM", "0.3"], ["SSIM", "0.4"], ["SSIM", "0.5"]]
    assert repr(run) == f"FinishedRun({str(run.path)!r})"
    plan = run.plans[1]
    first, _, *rows = str(plan).splitlines()
    assert first == "Plan for SSIM 0.4"
    assert len(rows) == len(plan.choices) + 1
    for choice, row in zip(plan.choices, rows, strict=False):
        assert row.startswith(f"{run.titles[choice.label_id]} ")
        assert f"{choice.count:,}" in row
    assert rows[-1].startswith("all ")
    assert "nan" not in str(plan)
    assert repr(plan).startswith("<Plan for SSIM 0.4: ")
    assert "category 3" in str(replace(plan, titles={}, choices=(replace(plan.choices[0], label_id=3),)))


def test_a_plan_of_a_camera_knows_the_names_too_and_files_hold_none(runs):
    run = runs["nested"]
    assert run.plan_camera(run.scene.views[0].camera).titles == run.titles
    scene_plans, _ = read_plans(run.job.run.plan)
    assert scene_plans[0].titles == {}
    assert "titles" not in run.job.run.plan.read_text()


def test_a_notebook_shows_the_single_page_of_the_run(runs, tmp_path):
    run = runs["nested"]
    shown = run.show(height=300)
    html = shown._repr_html_()
    (page,) = re.findall(
        r'<iframe [^>]*style="width:100%;height:300px;[^>]* srcdoc="([^"]*)"></iframe>', html
    )
    run.bundle(tmp_path / "scene.html", single_file=True)
    assert unescape(page) == (tmp_path / "scene.html").read_text(encoding="utf-8")
    assert str(run.path) in repr(shown)
    assert len(repr(shown)) < 300
    with pytest.raises(ValueError, match="a height of 9 px cannot be used"):
        run.show(height=9)


@pytest.mark.slow
@pytest.mark.skipif(chromium.missing() is not None, reason=str(chromium.missing()))
def test_the_viewer_in_a_notebook_draws(runs, tmp_path):
    cell = runs["nested"].show()._repr_html_()
    (tmp_path / "notebook.html").write_text(f"<!doctype html><title>cell</title>{cell}", encoding="utf-8")
    with chromium.open_page((tmp_path / "notebook.html").as_uri(), (480, 500)) as opened:
        frame = opened.page.frames[-1]
        drawn = "document.querySelector('canvas') && window.sagesplat.state().bytesShown > 0"
        wait_for(lambda: frame.evaluate(f"window.sagesplat?.state ? {drawn} : false"))
        ours = [said for said in opened.complaints if "xr-spatial-tracking" not in said]  # of file: alone
        assert ours == []
