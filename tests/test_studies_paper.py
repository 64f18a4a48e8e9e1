"""The paper's tables and figures, cross-view plans, equal model size, and early stopping."""

import csv
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import pinhole, random_gaussians

from sagesplat.adapt.ladder import read_ladder
from sagesplat.adapt.observe import TOTAL, RenderedLabels, near_border, read_observations
from sagesplat.core.config import (
    PaperConfig,
    PlanConfig,
    RunConfig,
    SampleConfig,
    TrainConfig,
)
from sagesplat.core.errors import RunError
from sagesplat.core.events import Event, StageSkipped, Warned
from sagesplat.formats.levels import write_level
from sagesplat.io.files import read_json
from sagesplat.output import tables
from sagesplat.output.table import Table
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.scene import View
from sagesplat.segment.display_names import titles
from sagesplat.stages.fit import fit_ladder
from sagesplat.stages.label import lift_labels, make_masks
from sagesplat.stages.observe import observe_levels
from sagesplat.stages.plan import make_plan
from sagesplat.stages.scene import open_scene
from sagesplat.stages.train import train_levels
from sagesplat.studies.early_stopping import compare_early_stopping
from sagesplat.studies.paper.cross_view import CrossView, read_cross_view
from sagesplat.studies.paper.report import four_levels
from sagesplat.studies.paper.run import paper_report
from sagesplat.studies.paper.same_size import FULL, METHODS, nearest_snapshot, prune_to, read_same_size
from sagesplat.train.importance import importance

CONFIG = RunConfig(
    train=TrainConfig(max_steps=90, level_every=15),
    plan=PlanConfig(target_ssim=0.4),
    sample=SampleConfig(views=8, calibration_views=8),
)
PAPER = PaperConfig(tune_steps=5)


def work(run: Path, capture: Path, config: RunConfig = CONFIG, **options) -> tuple[Job, list[Event]]:
    events: list[Event] = []
    job = Job(RunDir(run, "snapshots"), events.append, **options)
    open_scene(job, capture, config.scene)
    make_masks(job, config.masks)
    lift_labels(job)
    train_levels(job, config.train, config.seed)
    observe_levels(job, config.fit)
    fit_ladder(job, config.fit)
    make_plan(job, config.plan)
    return job, events


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Job, list[Event]]:
    folder = tmp_path_factory.mktemp("run") / "run"
    work(folder, capture)
    events: list[Event] = []
    no_weights = replace(PAPER, lpips=folder / "nowhere")
    job = Job(RunDir(folder, "snapshots"), events.append)
    paper_report(job, no_weights)
    return job, events


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_every_table_and_figure_is_there(finished):
    job, events = finished
    folder = job.run.paper
    names = "table_1_training table_1_test table_3_view table_4_view table_4_test cross_view equation_3"
    for name in names.split():
        for kind in ("csv", "md", "tex"):
            assert (folder / f"{name}.{kind}").stat().st_size > 100, name
    for name in ("figure_2", "figure_3", "figure_4"):
        for kind in ("png", "svg"):
            assert (folder / f"{name}.{kind}").stat().st_size > 1000, name
    page = (folder / "paper.md").read_text()
    assert "figure_4.png" in page
    assert "Table III" in page
    # LPIPS is missing: two warnings, values with a status, no crash
    warned = [e.text for e in events if isinstance(e, Warned)]
    assert len([w for w in warned if "sagesplat download lpips" in w]) >= 2
    assert "LPIPS not measured" in (folder / "table_4_test.md").read_text()


def test_tables_i_and_ii_repeat_the_observations(finished):
    job, _ = finished
    table = read_observations(job.run.observations)
    row = next(r for r in rows_of(job.run.paper / "table_1_test.csv") if r["category"] == "grass")
    mine = (table.label_id == 193) & (table.level == 45) & np.isin(table.view, job.scene.test_ids)
    assert float(row["45 SSIM"]) == pytest.approx(table.ssim[mine].mean(), abs=1e-6)
    assert int(row["90 Gaussians"]) == job.ladder.counts[193, 90]
    whole = rows_of(job.run.paper / "table_1_training.csv")[-1]
    assert whole["category"] == "whole image"
    assert int(whole["30 Gaussians"]) == sum(n for (_, i), n in job.ladder.counts.items() if i == 30)


def test_table_iii_marks_what_was_selected(finished):
    job, _ = finished
    rows = rows_of(job.run.paper / "table_3_view.csv")
    view = job.scene.test_ids[len(job.scene.test_ids) // 2]
    table = read_observations(job.run.observations)
    for row in rows[:-1]:
        label = next(i for i, name in titles(job.names()).items() if name == row["category"])
        chosen = [part.rpartition(": ")[2] for part in row["marks"].split("; ")]
        assert ", ".join(chosen).count(",") == 2  # every target chose one of the four iterations
        distances = [row[f"distance {which}"] for which in ("min", "5 %", "mean")]
        if any(distances):  # else nothing of the category is in the view: the sky may be behind the camera
            assert sorted(map(float, distances)) == [float(value) for value in distances]
        counts = [job.ladder.counts[label, level] for level in (15, 30, 45, 90)]
        assert int(row["Gaussians t=0.4"]) in counts
        assert float(row["MB t=0.4"]) == pytest.approx(int(row["Gaussians t=0.4"]) * 248 / 1e6)
        seen = table.ssim[(table.label_id == label) & (table.level == 30) & (table.view == view)]
        assert float(row["SSIM at 30"] or "nan") == pytest.approx(
            float(seen[0]) if len(seen) else np.nan, nan_ok=True
        )


def test_cross_view_rows_hold_together(finished):
    job, _ = finished
    table = read_cross_view(job.run.cross_view)
    assert set(table.view) == set(job.scene.test_ids)
    assert {round(float(t), 3) for t in table.target} == {0.3, 0.4, 0.5}
    whole = table.select(table.label_id == TOTAL)
    assert np.isnan(whole.predicted).all()
    assert len(whole) == 3 * len(job.scene.test_ids)
    parts = table.select(table.label_id != TOTAL)
    masks = RenderedLabels(job.ladder.load(90), antialiased=job.antialiased)
    for row in range(len(parts)):
        pixels = masks[job.scene.views[parts.view[row]]] == parts.label_id[row]
        assert parts.num_pixels[row] == pixels.sum() > 0
    known = parts.select(parts.oracle_level != -1)
    for row in range(len(known)):
        label, count = int(known.label_id[row]), int(known.oracle_count[row])
        assert job.ladder.counts[label, int(known.oracle_level[row])] == count
        if known.level_ssim[row] >= known.target[row]:  # the chosen level would have done: it is no cheaper
            assert known.regret[row] == known.count[row] - count >= 0
        else:
            assert np.isnan(known.regret[row])


def test_regret_by_hand():
    whole = {"view", "label_id", "level", "count", "oracle_level", "oracle_count", "num_pixels"}
    fields = CrossView.__dataclass_fields__
    columns = {f: np.zeros(4, np.int32 if f in whole else np.float32) for f in fields}
    columns |= {
        "target": np.full(4, 0.5, np.float32),
        "level_ssim": np.array([0.6, 0.4, 0.6, 0.5], np.float32),
        "count": np.array([30, 10, 30, 20], np.int32),
        "oracle_level": np.array([100, 200, -1, 100], np.int32),
        "oracle_count": np.array([20, 20, -1, 20], np.int32),
    }
    np.testing.assert_array_equal(CrossView(**columns).regret, [10, np.nan, np.nan, 0])


def test_equal_model_size_means_equal_counts(finished):
    job, _ = finished
    rows = read_same_size(job.run.same_size)
    full = job.ladder.size(job.ladder.levels[-1])
    for of_view in np.unique(rows.of_view):
        for target in (0.3, 0.4, 0.5):
            at = (rows.of_view == of_view) & (rows.target == np.float32(target))
            counts = {METHODS[m]: set(rows.count[at & (rows.method == m)]) for m in range(FULL)}
            assert counts["SAGE"] == counts["SAGE, tuned"] == counts["3DGS, pruned and tuned"]
            level = nearest_snapshot(job.ladder, counts["SAGE"].pop())
            assert counts["3DGS, snapshot"] == {
                sum(n for (_, i), n in job.ladder.counts.items() if i == level)
            }
    assert set(rows.count[rows.method == FULL]) == {full}
    assert np.isnan(rows.lpips_alex).all()  # no weights were there
    assert np.isfinite(rows.ssim + rows.psnr).all()


def test_a_second_report_has_nothing_to_do_and_another_view_needs_force(finished):
    job, _ = finished
    events: list[Event] = []
    again = Job(job.run, events.append)
    paper_report(again, replace(PAPER, lpips=job.run.path / "nowhere"))
    assert [e.name for e in events if isinstance(e, StageSkipped)] == ["crossview", "same_size", "paper"]
    with pytest.raises(RunError, match=r"no photo 'nothing'; there are view_000"):
        paper_report(again, replace(PAPER, view="nothing"))
    with pytest.raises(RunError, match=r"same_size\.csv: made with other .*--force"):
        paper_report(again, replace(PAPER, lpips=job.run.path / "nowhere", view=job.scene.views[3].name))


def test_early_stopping_beside_a_composition(capture, finished, tmp_path):
    full, _ = finished
    config = replace(CONFIG, train=replace(CONFIG.train, freeze_at=0.45))
    online, events = work(tmp_path / "online", capture, config)
    stops = read_json(online.run.frozen)
    assert stops
    assert sum(isinstance(e, Warned) and "stops at step" in e.text for e in events) == len(stops)
    methods, categories = compare_early_stopping(online, full, tmp_path / "out")
    assert [row[0] for row in methods.rows] == ["early stopping", "composed", "full run"]
    assert np.isfinite([value for row in methods.rows for value in row[1:]]).all()
    for row in categories.rows:
        label = next(i for i, name in titles(full.names()).items() if name == row[0])
        assert row[1] == stops.get(str(label), 90)
        assert row[2] == online.ladder.counts[label, online.ladder.levels[-1]]
        assert row[5] == full.ladder.counts[label, row[4]]
    # until the first one stops both runs are the same, so the first to stop agree
    first = min(stops.values())
    chosen = {row[0]: row[4] for row in categories.rows}
    for label, step in stops.items():
        if step == first:
            assert chosen[titles(full.names())[int(label)]] == first
    with pytest.raises(RunError, match=r"this run needs --train.freeze-at .* must not have it"):
        compare_early_stopping(full, online, tmp_path)
    other = Job(RunDir(tmp_path / "other", "snapshots"), lambda event: None)
    shutil.copytree(full.run.path, other.run.path)
    made = other.run.provenance("train")
    made.write_text(made.read_text().replace('"seed": 0', '"seed": 5'))
    with pytest.raises(RunError, match=r"other settings \(seed\)"):
        compare_early_stopping(online, other, tmp_path)


def test_rendered_labels_take_what_paints_most():
    g = random_gaussians(60, seed=4, log_scale=-1.0, logit=3.0)
    camera = pinhole()
    view = View("a", camera, Path("a.png"))
    labels = RenderedLabels(g)[view]
    assert labels.shape == (50, 70)
    assert set(np.unique(labels)) <= {-1, 3, 184}
    only = replace(g, label_ids=torch.full_like(g.label_ids, 3))
    alone = RenderedLabels(only)[view]
    assert set(np.unique(alone)) <= {-1, 3}
    from sagesplat.raster import rasterize

    alpha = rasterize(only, camera).alpha.numpy()
    np.testing.assert_array_equal(alone == 3, alpha > 0.5)
    nothing = RenderedLabels(g.select(torch.zeros(60, dtype=torch.bool)))[view]
    assert (nothing == -1).all()


def test_near_border_by_hand():
    label_ids = np.zeros((9, 9), np.int16)
    label_ids[:, 5:] = 7
    band = near_border(label_ids, 2)
    np.testing.assert_array_equal(np.flatnonzero(band[4]), [3, 4, 5, 6])
    assert not near_border(np.zeros((4, 4), np.int16), 3).any()


def test_pruning_keeps_what_paints(finished):
    job, _ = finished
    g = job.ladder.load(90)
    weights = importance(g, job.scene, [1, 2, 3])
    assert weights.shape == (len(g),)
    total = sum(float(pipeline_alpha(g, job, row)) for row in (1, 2, 3))
    assert weights.sum() == pytest.approx(total, rel=1e-3)
    few = prune_to(g, 100, weights)
    assert len(few) == 100
    assert importance(few, job.scene, [1, 2, 3]).min() > 0
    assert len(prune_to(g, 0, weights)) == 0
    assert len(prune_to(g, 10**9, weights)) == len(g)


def pipeline_alpha(g, job, row):
    from sagesplat.raster import rasterize

    return rasterize(g, job.scene.views[row].camera).alpha.sum()


def test_a_category_that_was_pruned_away_counts_nothing(tmp_path):
    g = random_gaussians(30)
    write_level(tmp_path, 100, g, recovering=False, sh_degree=3)
    write_level(tmp_path, 200, g.of_labels([-1, 3]), recovering=False, sh_degree=3)
    ladder = read_ladder(tmp_path)
    assert ladder.counts == {(-1, 100): 10, (3, 100): 10, (184, 100): 10} | {
        (-1, 200): 10, (3, 200): 10, (184, 200): 0
    }  # fmt: skip
    assert len(ladder.compose({-1: 100, 3: 200, 184: 200})) == 20
    assert tables.last_counts(ladder.counts) == {-1: 10, 3: 10, 184: 0}


def test_four_levels_are_the_papers():
    assert four_levels(range(1000, 31_000, 1000)) == [5000, 10_000, 15_000, 30_000]
    assert four_levels([7, 14]) == [7, 14]
    assert four_levels([90]) == [90]


def test_tables_in_markdown_and_latex(tmp_path):
    table = Table(
        "SSIM & more", ("category", "SSIM", "count", "rest"), ("", ".2f", "k", ""),
        [("a_b|c", 0.5, 1_412_000, "50 %"), ("d", float("nan"), 9_400, "")],
        groups=(("t=5", 2),), marks={(0, 1): "t=0.5"}, notes=("A note.",),
    )  # fmt: skip
    assert table.markdown().splitlines() == [
        "| category | t=5 SSIM | t=5 count | rest |",
        "|---|---:|---:|---|",
        "| a_b\\|c | **0.50** (t=0.5) | 1.4M | 50 % |",
        "| d | – | 9,400 |  |",
        "",
        "A note.",
    ]
    tex = table.latex()
    assert r"\caption{SSIM \& more}" in tex
    assert r"\multicolumn{2}{c}{t=5}" in tex
    assert r"\cmidrule(lr){2-3}" in tex
    assert r"a\_b$|$c & \cellcolor{black!10}0.50\textsuperscript{t=0.5} & 1.4M & 50 \% \\" in tex
    assert tex.count(r"\\") == 4 + 0
    assert table.only("count", "category").cells() == [["1.4M", "a_b|c"], ["9,400", "d"]]
    table.write(tmp_path / "t")
    assert (tmp_path / "t.csv").read_text().splitlines() == [
        "category,t=5 SSIM,t=5 count,rest,marks",
        "a_b|c,0.5,1412000,50 %,t=5 SSIM: t=0.5",
        "d,,9400,,",
    ]
