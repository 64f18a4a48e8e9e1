"""The nested ladder: order, training on compositions, prefixes, chunks, and a whole run with it."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import DemoRun, job_of, pinhole, random_gaussians, write_capture
from hypothesis import given
from hypothesis import strategies as st

from sagesplat import FinishedRun
from sagesplat.adapt.coverage import PREDICTORS
from sagesplat.adapt.evaluate import read_evaluation
from sagesplat.adapt.ladder import PrefixLadder, read_prefixes
from sagesplat.adapt.observe import TOTAL, read_observations
from sagesplat.adapt.plan_files import read_budget_plan, read_plans
from sagesplat.core.config import NestConfig, PlanConfig, SceneConfig, TrainConfig
from sagesplat.core.errors import DataError, RunError
from sagesplat.formats.increments import read_increments, read_index, totals, write_increments
from sagesplat.formats.levels import write_set
from sagesplat.formats.ply import read_ply
from sagesplat.formats.quantisation import in_buckets
from sagesplat.formats.splats import num_lods, read_splat
from sagesplat.output.tables import bytes_of
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Points, Scene, View
from sagesplat.segment.masks import Taxonomy
from sagesplat.stages.compose import compose_plan
from sagesplat.stages.evaluate import evaluate_plans
from sagesplat.stages.export import export_scene
from sagesplat.stages.methods import NestedLevels
from sagesplat.stages.pipeline import run_all
from sagesplat.stages.plan import make_plan
from sagesplat.stages.report import _outcome, make_report
from sagesplat.stages.results import budget_plan_of, evaluation_of
from sagesplat.stages.shared import observed
from sagesplat.studies.paper.cross_view import read_cross_view
from sagesplat.studies.paper.run import cross_views
from sagesplat.train import nested
from sagesplat.train.importance import importance
from sagesplat.train.nested import Nested, NestStep, draw_shares, level_sizes, nest, order

QUICK = NestConfig(steps=12, levels=4, smallest=0.1)


@given(st.integers(0, 5000), st.integers(1, 20), st.floats(0.01, 1))
def test_level_sizes_rise_to_everything(count: int, levels: int, smallest: float) -> None:
    sizes = level_sizes(count, NestConfig(levels=levels, smallest=smallest))
    assert len(sizes) == levels
    assert sizes[-1] == count
    assert list(sizes) == sorted(sizes)
    if count:
        assert sizes[0] >= 1


def test_sizes_are_geometric() -> None:
    sizes = np.array(level_sizes(10_000, NestConfig(levels=5, smallest=0.01)))
    np.testing.assert_allclose(sizes[1:] / sizes[:-1], 100**0.25, rtol=1e-2)


def test_everything_is_drawn_more_often_in_the_end() -> None:
    config, rng = NestConfig(), np.random.default_rng(0)
    for done, share in ((0.0, 0.1), (0.5, 0.425), (1.0, 0.75)):
        drawn = np.stack([draw_shares(rng, np.arange(3), config, done) for _ in range(2000)])
        assert (drawn == 1).all(1).mean() == pytest.approx(0.8 * share, abs=0.04)
        assert ((drawn >= 0.4).all(1) & (drawn < 1).all(1)).mean() > 0.15 * share
        assert drawn.min() >= 0.03 - 1e-6
        parts = np.log(drawn[(drawn < 1).any(1)])
        nearly = 0.2 * share / (1 - 0.8 * share)
        mean = (1 - nearly) * np.log(0.03) / 2 + nearly * np.log(0.7)
        assert parts.mean() == pytest.approx(mean, abs=0.15)  # log-uniform, but for these
        low = np.log(drawn[(drawn < 0.4).any(1)])
        assert abs(np.corrcoef(low.T)[0, 1]) < 0.2  # each category by itself


def test_a_prefix_of_a_category_or_one_of_each_cell() -> None:
    rng, of_cells = np.random.default_rng(0), np.array([0, 0, 1, 1, 1])
    drawn = np.stack([draw_shares(rng, of_cells, NestConfig(), 0.0) for _ in range(1000)])
    drawn = drawn[(drawn < 1).all(1)]
    together = (drawn[:, 0] == drawn[:, 1]) & (drawn[:, 2:] == drawn[:, 2:3]).all(1)
    assert together.mean() == pytest.approx(0.5, abs=0.06)
    assert (drawn[together, 0] != drawn[together, 2]).all()


@pytest.fixture
def seen() -> Scene:
    """Two views and nothing else."""
    none, no_views = np.zeros((0, 3), np.float32), np.zeros(0, np.int32)
    points = Points(none, none.astype(np.uint8), np.zeros(0, np.int64), no_views, none[:, :2])
    views = tuple(View(f"{i}", pinhole(angle=0.1 * i), Path("none")) for i in range(2))
    return Scene("two", Path("none"), views, points, test_every=0)


@pytest.mark.parametrize("criterion", ["weight", "weight-volume", "sensitivity"])
def test_importance_ranks_what_shows_above_what_does_not(seen, criterion) -> None:
    g = random_gaussians(40, logit=2.0)
    means = g.means.clone()
    means[0] = torch.tensor([0.0, 0.0, -5.0])  # behind the camera
    g = replace(g, means=means)
    worth = importance(g, seen, [0, 1], criterion)
    assert worth.shape == (40,)
    assert worth.dtype == np.float32
    assert (worth >= 0).all()
    assert worth[0] == 0
    assert (worth > 0).sum() > 20


def test_sensitivity_is_the_change_when_a_gaussian_fades(seen) -> None:
    """One Gaussian alone: its picture is proportional to its opacity, so fading removes all of it."""
    from sagesplat.raster import rasterize

    g = random_gaussians(40, logit=-3.0).select(torch.tensor([5]))
    with torch.no_grad():
        energy = sum(float((rasterize(g, v.camera).rgb ** 2).sum()) for v in seen.views)
    found = np.mean([importance(g, seen, [0, 1], "sensitivity", seed=s)[0] for s in range(200)])
    assert found == pytest.approx(energy, rel=0.2)


def ordered(count: int = 60) -> Nested:
    g = random_gaussians(count, degree=1)
    labels = torch.sort(torch.arange(count) % 3).values.to(torch.int16)
    of_base = np.isin(np.arange(count), [20, 21])  # the first two of category 1
    return Nested(replace(g, label_ids=labels), of_base)


def trained(scene: Scene, start: Nested, config: NestConfig, **options) -> Nested:
    *steps, last = nest(start, scene, Photos(scene.views), TrainConfig(), config, **options)
    assert [s.step for s in steps if isinstance(s, NestStep)][-1] == config.steps
    assert isinstance(last, Nested)
    return last


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return write_capture(tmp_path / "capture", random_gaussians(60, seed=3))


def test_training_lowers_the_loss_of_prefixes_and_keeps_the_order(scene: Scene, monkeypatch) -> None:
    monkeypatch.setattr(nested, "SORT_AT", ())
    start = ordered()
    config = NestConfig(steps=40, levels=3)
    events = list(nest(start, scene, Photos(scene.views), TrainConfig(), config))
    result = events[-1]
    assert isinstance(result, Nested)
    assert torch.equal(result.gaussians.label_ids, start.gaussians.label_ids)
    moved = (result.gaussians.means - start.gaussians.means).norm(dim=1)
    spread = (start.gaussians.means[None] - start.gaussians.means[:, None]).norm(dim=2)
    assert moved.max() < spread[spread > 0].median()  # every row is still the Gaussian that it was
    losses = [e.loss for e in events if isinstance(e, NestStep)]
    assert np.mean(losses[-10:]) < np.mean(losses[:10])


def test_they_are_sorted_again_by_what_they_have_become_worth(scene: Scene, monkeypatch) -> None:
    monkeypatch.setattr(nested, "SORT_AT", (0,))
    start, config = ordered(), replace(QUICK, steps=1)
    result = trained(scene, start, config)
    worth = importance(
        start.gaussians,
        scene,
        scene.train_ids.tolist(),
        "sensitivity",
        antialiased=TrainConfig().antialiased,
    )
    rows = np.lexsort((-worth, ~start.of_base, start.gaussians.label_ids.numpy()))
    assert (rows != np.arange(60)).any()
    assert (result.of_base == start.of_base[rows]).all()
    assert torch.allclose(result.gaussians.means, start.gaussians.means[torch.from_numpy(rows)], atol=1e-2)


def test_what_is_not_drawn_stays_as_it_is(scene: Scene, monkeypatch) -> None:
    """With the smallest prefix drawn only (a share that rounds to one Gaussian), no other row moves."""
    monkeypatch.setattr(nested, "SORT_AT", ())
    start = ordered()
    monkeypatch.setattr(nested, "_DRAWN_FROM", 1e-9)
    for share in ("_FULL_SHARE_SHORT", "_FULL_SHARE_END"):
        monkeypatch.setattr(nested, share, 0.0)
    config = replace(QUICK, steps=3)
    result = trained(scene, start, config, seed=1)
    moved = (result.gaussians.means != start.gaussians.means).any(1).numpy()
    first = np.isin(np.arange(60), [0, 20, 40])
    assert moved[first].any()
    few = moved.nonzero()[0] % 20
    assert len(few) < 40


@pytest.mark.parametrize("full", [True, False])
def test_the_full_model_trains_second_opacities_and_low_levels_the_first(scene, monkeypatch, full) -> None:
    monkeypatch.setattr(nested, "SORT_AT", ())
    monkeypatch.setattr(nested, "weight_at", lambda shares: np.float32(shares == 1))
    given = torch.linspace(-1, 1, 60)
    start = replace(ordered(), second_opacities=given)
    for share in ("_FULL_SHARE_SHORT", "_FULL_SHARE_END"):
        monkeypatch.setattr(nested, share, float(full))
    config = replace(QUICK, steps=2)
    result = trained(scene, start, config)
    first = result.gaussians.logit_opacities != start.gaussians.logit_opacities
    assert result.second_opacities is not None
    second = result.second_opacities != given
    assert (second.any(), first.any()) == ((True, False) if full else (False, True))


def test_a_killed_training_goes_on_bit_for_bit(scene: Scene, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(nested, "_SAVE_EVERY", 4)
    whole = trained(scene, ordered(), QUICK)
    file = tmp_path / "state.npz"
    events = nest(ordered(), scene, Photos(scene.views), TrainConfig(), QUICK, checkpoint=file, settings="a")
    for event in events:
        if isinstance(event, NestStep) and event.step == 6:
            break
    resumed = trained(scene, ordered(), QUICK, checkpoint=file, settings="a")
    for name, value in whole.gaussians.parameters().items():
        assert torch.equal(value, resumed.gaussians.parameters()[name]), name
    assert whole.second_opacities is not None
    assert resumed.second_opacities is not None
    assert torch.equal(whole.second_opacities, resumed.second_opacities)
    assert not torch.equal(whole.second_opacities, whole.gaussians.logit_opacities)
    with pytest.raises(RunError, match="other settings"):
        next(iter(nest(ordered(), scene, Photos(scene.views), TrainConfig(), QUICK, checkpoint=file)))


def test_the_end_of_a_training_is_averaged(scene: Scene, monkeypatch) -> None:
    """The last step's values are the mean of those of the 9th, 10th, 11th and 12th step."""
    monkeypatch.setattr(nested, "tail_start", lambda steps: 8)
    monkeypatch.setattr(nested, "_AVERAGE_EVERY", 1)
    seen: list[np.ndarray] = []
    real = nested.TailAverage.add

    def watched(self, state) -> None:
        seen.append(torch.cat([state.gaussians.means, state.second_opacities[:, None]], 1).detach().numpy())
        seen[-1] = seen[-1].copy()
        real(self, state)
        seen.append(torch.cat([state.gaussians.means, state.second_opacities[:, None]], 1).detach().numpy())

    monkeypatch.setattr(nested.TailAverage, "add", watched)
    trained(scene, ordered(), QUICK)
    before, after = seen[::2], seen[1::2]
    for step in range(11):
        np.testing.assert_array_equal(after[step], before[step])
    assert not np.array_equal(before[11], before[10])
    np.testing.assert_allclose(after[11], np.mean(before[8:12], axis=0), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("steps", "start"), [(0, 0), (12, 9), (500, 400), (3000, 2500), (3001, 3000)])
def test_no_checkpoint_lies_among_the_steps_that_are_averaged(steps: int, start: int) -> None:
    assert nested.tail_start(steps) == start


def test_harmonics_in_buckets_are_multiples_and_zero_stays_zero() -> None:
    shN = torch.linspace(-1.2, 1.2, 15 * 3 * 7).reshape(7, 15, 3)
    shN[0] = 0
    found = in_buckets(shN, (5, 4))
    assert torch.equal(found[0], torch.zeros(15, 3))
    assert torch.equal(found[:, :3] * 16, (found[:, :3] * 16).round())
    assert torch.equal(found[:, 3:] * 8, (found[:, 3:] * 8).round())
    assert (found - shN.clamp(-1, 1)).abs().max() <= 0.0625


@pytest.fixture
def ladder(tmp_path: Path) -> PrefixLadder:
    start = ordered()
    sizes = {0: (1, 5, 20), 1: (2, 2, 20), 2: (20, 20, 20)}
    write_set(tmp_path / "ladder.npz", start.gaussians, 12, sizes)
    return read_prefixes(tmp_path / "ladder.npz")


def test_every_level_begins_with_the_one_below(ladder: PrefixLadder) -> None:
    assert ladder.levels == [1, 2, 3]
    assert ladder.counts[1, 2] == 2
    assert ladder.size(2) == 27
    for low, high in ((1, 2), (2, 3)):
        for label in ladder.sizes:
            below, above = (ladder.load(level, [label]).means for level in (low, high))
            assert torch.equal(above[: len(below)], below)
    mixed = ladder.compose({0: 3, 2: 1})
    assert mixed.counts() == {0: 20, 2: 20}
    with pytest.raises(RunError, match="level 4 is not in the ladder"):
        ladder.load(4)


def test_a_ladder_that_does_not_fit_its_gaussians_is_refused(tmp_path: Path) -> None:
    g = ordered().gaussians
    for sizes in ({0: (5, 1, 20)}, {0: (1, 2, 19)}, {0: (1, 20)}):
        whole = {1: (1, 2, 20), 2: (1, 2, 20), **sizes}
        write_set(tmp_path / "ladder.npz", g, 1, whole)
        with pytest.raises(DataError, match=r"ladder\.npz: level sizes"):
            read_prefixes(tmp_path / "ladder.npz")
    with pytest.raises(RunError, match="run `sagesplat nest`"):
        read_prefixes(tmp_path / "nothing.npz")


def test_chunks_hold_what_each_level_adds(tmp_path: Path) -> None:
    sizes = {0: (1, 5, 20), 1: (2, 2, 20), 2: (20, 20, 20)}
    g = ordered().gaussians
    chunks = write_increments(
        tmp_path / "chunks", g, sizes, {0: "a b", 1: "c", 2: "d"}, label_of={0: 0, 1: 1, 2: 2}
    )
    assert [(c.label_id, c.level, c.count) for c in chunks] == [
        (0, 1, 1), (0, 2, 4), (0, 3, 15), (1, 1, 2), (1, 3, 18), (2, 1, 20)
    ]  # fmt: skip
    assert chunks[0].uri.startswith("a-b-01-")
    for chunk in chunks:
        assert (tmp_path / "chunks" / chunk.uri).stat().st_size == chunk.nbytes
    assert read_index(tmp_path / "chunks") == chunks
    sent = read_increments(tmp_path / "chunks", chunks)
    assert torch.equal(sent.label_ids, g.label_ids)
    np.testing.assert_allclose(sent.means, g.means, atol=0.02)
    np.testing.assert_allclose(totals(chunks, [0, 1, 2], 3, "count"), list(sizes.values()))
    again = write_increments(
        tmp_path / "again", g, sizes, {0: "a b", 1: "c", 2: "d"}, label_of={0: 0, 1: 1, 2: 2}
    )
    assert again == chunks  # their names are hashes of their bytes
    plain = write_increments(
        tmp_path / "plys", g, sizes, {0: "a b", 1: "c", 2: "d"}, label_of={0: 0, 1: 1, 2: 2}, kind="ply"
    )
    part = read_ply(tmp_path / "plys" / plain[1].uri)
    np.testing.assert_array_equal(part.means, g.means[1:5])
    (tmp_path / "chunks" / "index.json").write_text('{"chunks": [{"label_id": 0}]}')
    with pytest.raises(DataError, match="not an index of increments"):
        read_index(tmp_path / "chunks")


@pytest.fixture(scope="module")
def finished(demo_run: DemoRun) -> Path:
    return demo_run.path


def test_a_run_makes_a_nested_ladder_by_default(finished: Path) -> None:
    job = job_of(finished)
    table = read_observations(job.run.observations)
    assert set(table.level) == {1, 2, 3, 4, 5}
    whole = table.select((table.label_id == TOTAL) & np.isin(table.view, job.scene.train_ids))
    ssim = [whole.ssim[whole.level == level].mean() for level in job.ladder.levels]
    assert ssim[0] == min(ssim)
    assert ssim[-1] > max(ssim) - 0.02  # so few steps teach the base model more than the others
    assert len(job.scene.calibration_ids) == 3
    scene_plans, view_plans = read_plans(job.run.plan)
    assert [p.target for p in scene_plans] == [0.3, 0.4, 0.5]
    assert len(view_plans) == 16
    sent = [p.transfer_bytes for p in scene_plans]
    assert None not in sent
    chunks = read_index(job.run.increments)
    for choice in scene_plans[1].choices:
        mine = [c for c in chunks if c.label_id == choice.label_id and c.level <= choice.level]
        assert choice.transfer_bytes == sum(c.nbytes for c in mine)
        assert choice.count == sum(c.count for c in mine)
    assert len(read_ply(job.run.composed)) == scene_plans[1].count
    evaluation = read_evaluation(job.run.evaluation)
    assert set(evaluation.view) == {0, 8}
    promised = evaluation.select(evaluation.label_id != TOTAL)
    assert np.isfinite(promised.predicted).mean() > 0.75
    assert "grass" in (job.run.report / "index.html").read_text()
    # the full model of nested levels is their top level: 3DGS is what was trained before
    pages = [job.run.report / "index.html", *(job.run.report / "tables").glob("*.csv")]
    assert not [path.name for path in pages if "3DGS" in path.read_text()]


def test_the_papers_ladder_has_no_budget(finished: Path) -> None:
    job = Job(RunDir(finished, "snapshots"), print)
    assert set(read_observations(job.run.observations).level) == {30, 60, 90}
    with pytest.raises(RunError, match="--budget needs the nested ladder"):
        make_plan(job, PlanConfig(budget=1e5))


def test_budgets_are_kept_and_more_bytes_promise_more(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "run")
    job = job_of(tmp_path / "run", force=True)
    full = NestedLevels(job).costs
    for unit in ("bytes", "gpu-bytes", "count"):
        costs, promised = full.of(unit), []
        for share in (0.3, 0.6, 1.0):
            budget = float(share * costs[:, -1].sum())
            make_plan(job, PlanConfig(target_ssim=0.4, budget=budget, budget_unit=unit))
            plan = read_budget_plan(job.run.plan)
            assert plan is not None
            assert plan.status == "ok"
            rows = {label: i for i, label in enumerate(full.labels)}
            assert sum(costs[rows[c.label_id], c.level - 1] for c in plan.choices) <= budget
            promised.append(sum(c.count for c in plan.choices))
        assert promised == sorted(promised)
    compose_plan(job)
    plan = read_budget_plan(job.run.plan)
    assert plan is not None
    assert len(read_ply(job.run.composed)) == plan.count
    assert FinishedRun(job).plans[0].budget == plan.budget  # the main plan comes first
    nested = NestedLevels(job)
    train = job.scene.train_ids
    quality, shown = nested.qualities["ssim"].mean[train], nested.shown[train]
    best = (quality * shown[..., None]).sum(0) / shown.sum(0)[:, None]
    for row, choice in enumerate(plan.choices):  # all that money can buy
        assert choice.status == "no model" or choice.predicted == pytest.approx(best[row].max())
    evaluate_plans(job)
    assert np.isnan(read_evaluation(job.run.evaluation).target).any()
    make_plan(job, PlanConfig(target_ssim=0.4, budget=10.0))
    plan = read_budget_plan(job.run.plan)
    assert plan is not None
    assert plan.status == "over budget"
    assert {c.level for c in plan.choices} == {1}
    name = job.names()[full.labels[-1]]
    make_plan(job, PlanConfig(target_ssim=0.4, budget=1e5, weights={name: 5.0}))
    with pytest.raises(RunError, match="no category 'nothing'"):
        make_plan(job, PlanConfig(target_ssim=0.4, budget=1e5, weights={"nothing": 5.0}))


def test_each_view_is_planned_by_its_bound(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "run")
    job = job_of(tmp_path / "run")
    cross_views(job)
    table = read_cross_view(job.run.cross_view)
    parts = table.select((table.label_id != TOTAL) & np.isfinite(table.predicted))
    assert set(parts.level) <= {1, 2, 3, 4, 5}
    feasible = parts.select(parts.predicted >= parts.target)
    assert len(feasible)
    by = {
        row["by"]: row
        for row in csv.DictReader((job.run.adapted / "promises_kept.csv").read_text().splitlines())
    }
    assert list(by) == list(PREDICTORS)
    assert float(by["perfect"]["coverage"]) == 1
    rows = csv.DictReader((job.run.adapted / "promises_by_target.csv").read_text().splitlines())
    whole = [row for row in rows if row["category"] == "all"]
    for column in ("accepted", "violated", "false rejections"):
        assert sum(int(row[column]) for row in whole) == int(by["bound"][column])


def test_coverage_is_tested_on_the_plans_that_are_made_and_costs_are_bytes(finished: Path) -> None:
    job, target = job_of(finished), 0.4
    nested = NestedLevels(job)
    scores = nested.coverage([target])
    assert scores is not None
    bound = scores.by("bound")
    table = observed(job)
    plans = {row: nested.plan_view(row, target) for row in job.scene.test_ids.tolist()}
    for i, (label, row) in enumerate(zip(bound.label_id.tolist(), bound.view.tolist(), strict=True)):
        sent = nested.costs.transfer_bytes[nested.costs.labels.index(label)]
        here = table.select((table.label_id == label) & (table.view == row))
        measured = dict(zip(here.level.tolist(), here.ssim.tolist(), strict=True))
        choice = next(c for c in plans[row].choices if c.label_id == label)
        assert bound.accepted[i] == (choice.status == "ok")
        if bound.accepted[i]:
            assert bound.kept[i] == (measured[choice.level] >= target)
        if bound.kept[i]:
            enough = [sent[level - 1] for level, ssim in measured.items() if ssim >= target]
            assert bound.regret[i] == sent[choice.level - 1] - min(enough)
    assert bound.kept.sum() > 0


@pytest.mark.slow
def test_without_calibration_views_a_run_still_promises(demo_run: DemoRun, tmp_path: Path) -> None:
    config = replace(demo_run.config, scene=SceneConfig(calibrate_every=0), train=TrainConfig(max_steps=20))
    job = job_of(tmp_path / "run")
    run_all(job, demo_run.capture, replace(config, nest=replace(QUICK, steps=2, base_share=0.0)))
    assert read_plans(job.run.plan)[0]


def test_seeds_come_first_and_take_the_place_of_the_least_worthy(scene: Scene) -> None:
    class OneLabel:
        """Every pixel is of category 3."""

        taxonomy = Taxonomy({3: "thing"})

        def __getitem__(self, view: View) -> np.ndarray:
            return np.full((view.camera.height, view.camera.width), 3, np.int16)

    g = random_gaussians(50, seed=3)
    base = random_gaussians(8, seed=4)
    found = order(g, scene, OneLabel(), base=base)  # type: ignore[arg-type]
    assert len(found.gaussians) == 50
    assert sorted(found.gaussians.means[:8].tolist()) == sorted(base.means.tolist())
    worth = importance(g, scene, scene.train_ids.tolist(), "sensitivity")
    worthiest = g.means[torch.from_numpy(np.argsort(-worth, kind="stable")[:42].copy())]
    assert torch.equal(found.gaussians.means[8:], worthiest)


def test_export_writes_what_other_viewers_read(finished: Path, tmp_path: Path) -> None:
    job, options = job_of(finished), {"level": 3, "labels": [], "target": None}
    expected = job.ladder.load(3)
    for name in ("a.ply", "a.compressed.ply", "a.spz", "a.sog", "a.glb", "a.splat"):
        assert export_scene(job, tmp_path / name, **options) == len(expected)
        splat = read_splat(tmp_path / name)
        assert splat.gaussians.counts() == expected.counts()
        assert splat.names.items() <= job.names().items()
    assert export_scene(job, tmp_path / "a.rad", **options) == len(expected)
    with pytest.raises(RunError, match=r"a\.sog: exists; add --force"):
        export_scene(job, tmp_path / "a.sog", **options)
    with pytest.raises(DataError, match=r"a\.ksplat: its name says no format"):
        export_scene(job, tmp_path / "a.ksplat", **options)
    with pytest.raises(RunError, match="levels are for lod-meta"):
        export_scene(job, tmp_path / "b.ply", **options, levels=[1])
    target = {**options, "target": ("fidelity", 0.9)}
    with pytest.raises(RunError, match=r"b\.ply: a level, or the scene planned for a target"):
        export_scene(job, tmp_path / "b.ply", **target)
    for wrong in (options, {**target, "level": None}):
        with pytest.raises(RunError, match="holds several levels"):
            export_scene(job, tmp_path / "b.ssog", **wrong)


def test_export_writes_levels_of_detail(finished: Path, tmp_path: Path) -> None:
    job, options = job_of(finished), {"level": None, "labels": [], "target": None}
    path = tmp_path / "lods" / "lod-meta.json"
    assert export_scene(job, path, **options) == len(job.ladder.load(5))
    counts = [len(read_splat(path, lod).gaussians) for lod in range(num_lods(path))]
    assert counts == [len(job.ladder.load(level)) for level in range(5, 0, -1)]
    categories = json.loads(path.read_text())["tree"]["children"]
    assert [leaf["lods"]["0"]["count"] for node in categories for leaf in node["children"]] == [
        job.by_cell.counts[cell, 5] for cell in sorted(job.cells.ids.tolist())
    ]
    assert {node["name"] for node in categories} == {job.names()[i] for i in job.cells.labels.tolist()}
    with pytest.raises(RunError, match="lods: not empty"):
        export_scene(job, path, **options)
    again = replace(job, force=True)
    export_scene(again, path, **options, levels=[2, 4])
    assert num_lods(path) == 2
    ssog = path.with_name("a.ssog")
    export_scene(job, ssog, **options, levels=[2, 4])
    assert [len(read_splat(ssog, lod).gaussians) for lod in (0, 1)] == [
        len(read_splat(path, lod).gaussians) for lod in (0, 1)
    ]
    with pytest.raises(RunError, match=r"a\.ssog: exists; add --force"):
        export_scene(job, ssog, **options)
    ssog.unlink()
    (path.parent / "letter.txt").write_text("dear")
    with pytest.raises(RunError, match="lods: not empty"):
        export_scene(again, path, **options)
    assert (path.parent / "letter.txt").exists()


def test_one_gaussian_is_a_category_too(tmp_path: Path) -> None:
    g = ordered().gaussians.select(torch.tensor([0, 20, 21]))
    sizes = {label: level_sizes(n, QUICK) for label, n in g.counts().items()}
    assert sizes[0] == (1, 1, 1, 1)
    chunks = write_increments(tmp_path / "chunks", g, sizes, {0: "a", 1: "b"}, label_of={0: 0, 1: 1})
    assert [(c.label_id, c.level) for c in chunks] == [(0, 1), (1, 1), (1, 4)]
    assert totals(chunks, [0, 1], 4, "count").tolist() == [[1, 1, 1, 1], [1, 1, 1, 2]]


def test_an_unknown_category_is_told_before_a_plan_is_given_up(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "run")
    job = job_of(tmp_path / "run", force=True)
    before = job.run.provenance("plan").read_bytes()
    with pytest.raises(RunError, match="no category 'foo'; there are"):
        make_plan(job, PlanConfig(budget=1e5, weights={"foo": 2.0}))
    assert job.run.provenance("plan").read_bytes() == before


def test_a_report_is_of_what_was_composed_and_measured(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "run")
    job = job_of(tmp_path / "run", force=True)
    make_plan(job, PlanConfig(budget=2000.0, budget_unit="count"))
    with pytest.raises(RunError, match=r"planned anew; run `sagesplat compose .*run` before the report"):
        make_report(job)
    compose_plan(job)
    with pytest.raises(RunError, match=r"planned anew; run `sagesplat evaluate .*run` before the report"):
        make_report(job)
    evaluate_plans(job)
    plan = budget_plan_of(job)
    assert plan is not None
    size = f"{sum(map(bytes_of, plan.choices)) / 1e6:.2f} MB of"
    rows = evaluation_of(job).of(plan)
    measured = f"SSIM {rows.ssim[rows.label_id == TOTAL].mean():.3f}"
    assert _outcome(job).startswith(size)
    assert measured in _outcome(job)
