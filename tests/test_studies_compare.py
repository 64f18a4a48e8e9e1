"""The nested ladder beside its baselines: arithmetic by hand, and everything on a small capture."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sagesplat.core.config import (
    CompareConfig,
    FitConfig,
    MasksConfig,
    NestConfig,
    PlanConfig,
    SampleConfig,
    SceneConfig,
    TrainConfig,
)
from sagesplat.core.errors import DataError, RunError
from sagesplat.core.events import Event, StageSkipped, StageStarted, TableMade, Warned
from sagesplat.formats.increments import read_index
from sagesplat.formats.levels import read_level
from sagesplat.io.files import read_json, write_json
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.stages.fit import fit_ladder
from sagesplat.stages.label import lift_labels, make_masks
from sagesplat.stages.nest import nest_levels
from sagesplat.stages.observe import observe_levels
from sagesplat.stages.plan import make_plan
from sagesplat.stages.sample import sample_levels
from sagesplat.stages.scene import open_scene
from sagesplat.stages.train import train_levels
from sagesplat.studies.compare import report
from sagesplat.studies.compare.report import (
    MCMC,
    PLANNED,
    PRUNED,
    SAGE,
    SAME_SHARE,
    SNAPSHOTS,
    OfLabel,
    Point,
    baselines_table,
    least,
    mcmc_table,
    read_comparison,
    targets_table,
    walk,
    write_comparison,
)
from sagesplat.studies.compare.run import compare
from sagesplat.train.nested import with_at_most

NAN = math.nan
CONFIG = CompareConfig(
    targets=(0.3, 0.5), snapshots=3, shares=(0.3,), tune_steps=5, caps=(0.2, 1.0), budgets=4,
    lpips=Path("nowhere"),
)  # fmt: skip


def point(method: str, count: int, encoded: int, ssim: float, **more) -> Point:
    values = {
        "name": f"{count}", "target": NAN, "budget": NAN, "steps": 10, "ssim_sent": ssim, "psnr": 30 * ssim,
        "lpips_alex": NAN, "lpips_vgg": NAN,
    }  # fmt: skip
    return Point(method=method, count=count, encoded=encoded, ssim=ssim, **{**values, **more})


OURS = [
    point(SAME_SHARE, 100, 1000, 0.4),
    point(PLANNED, 200, 2000, 0.6),
    point(SAME_SHARE, 300, 3000, 0.5),  # larger and worse: no part of the curve
    point(SAME_SHARE, 400, 8000, 0.8),
]


def test_the_curve_interpolates_over_log_bytes_and_never_beyond_its_ends():
    assert least(OURS, 0.6, "encoded") == (2000, "")
    found = least(OURS, 0.7, "encoded")
    assert found.nbytes == pytest.approx(4000)  # half way from 2000 to 8000
    assert found.how == "between"
    assert least(OURS, 0.65, "raw").nbytes == pytest.approx(248 * 200 * 2**0.25)
    assert least(OURS, 0.1, "encoded") == (1000, "smallest")
    assert math.isnan(least(OURS, 0.81, "encoded").nbytes)
    assert math.isnan(least([], 0.5, "raw").nbytes)
    # of equal sizes the better one, of equal ones the smaller
    same = [point(PLANNED, 10, 100, 0.5), point(PLANNED, 10, 100, 0.7), point(PLANNED, 20, 200, 0.7)]
    assert least(same, 0.6, "encoded") == (100, "smallest")
    assert least(same, 0.7, "encoded") == (100, "")


def test_the_tables_by_hand():
    points = [
        *OURS,
        point(SAGE, 1000, 20_000, 0.7, target=0.7),
        point(SAGE, 500, 10_000, 0.6, target=0.6),
        point(PRUNED, 250, 4000, 0.61, ssim_sent=0.6),
        point(PRUNED, 900, 1000, 0.9),
        point(MCMC, 50, 500, 0.5),
        point(MCMC, 200, 1600, 0.6),
    ]
    bar = targets_table(points)
    assert [row[0] for row in bar.rows] == [0.6, 0.7]
    assert bar.rows[0][1:] == pytest.approx((0.6, 0.124, 0.0496, 0.002, 0.4, 2000 / 124_000))
    assert bar.rows[1][4] == pytest.approx(0.004)
    assert bar.marks == {(1, 3): "between", (1, 4): "between"}
    table = baselines_table(points)
    rows = {(row[0], row[2]): row for row in table.rows}
    assert rows[PRUNED, 250][-1] == pytest.approx(2000 / 4000)  # at its SSIM as sent
    assert float(rows[PRUNED, 250][-2]) > 200 / 250  # at its SSIM before that
    assert math.isnan(float(rows[PRUNED, 900][-1]))
    assert rows[MCMC, 50][-1] == pytest.approx(1000 * 2**0.5 / 500)
    assert table.notes[0].startswith("Worst at equal SSIM: 2.828 of the encoded bytes of 3DGS-MCMC (50)")
    assert table.notes[1].endswith("does not reach the SSIM of: 3DGS, pruned and tuned (900).")
    sizes = mcmc_table(points)
    assert [row[1] for row in sizes.rows] == [50, 200]
    assert sizes.marks == {(0, 6): "a tenth"}  # 50 of 400 is nearer to 40 than 200
    assert sizes.rows[0][4:7] == pytest.approx((100, 12, 12 - 15))
    assert math.isnan(float(sizes.rows[0][7]))  # no prefix is as small
    between = 12 + (15 - 12) * math.log(2) / math.log(3)
    assert sizes.rows[1][7] == pytest.approx(between - 18)


def test_a_walk_by_hand():
    nested = {
        (3, 1): {"a1": 10}, (3, 2): {"a1": 10, "a2": 20}, (3, 3): {"a1": 10, "a2": 20, "a3": 40},
        (7, 1): {"b1": 5}, (7, 2): {"b1": 5},  # the second level adds nothing
    }  # fmt: skip
    levels = [{3: 1, 7: 1}, {3: 3, 7: 2}, {3: 1, 7: 1}, {3: 2, 7: 2}]
    found = walk("nested", levels, nested, keeps=True)
    assert (found.first, found.later, found.again, found.replaced) == (15, 60, 0, 0)
    assert (found.changes, found.upgrades) == (3, 2)
    found = walk("nested", levels, nested, keeps=False)
    assert (found.first, found.later, found.again, found.replaced) == (15, 80, 20, 0)
    whole = {key: {f"{key}": sum(files.values())} for key, files in nested.items()}
    found = walk("SAGE", levels, whole, keeps=True)
    assert (found.first, found.later, found.again) == (15, 70 + 5 + 30, 0)
    found = walk("SAGE", levels, whole, keeps=False)
    assert (found.first, found.later, found.again) == (15, 75 + 15 + 35, 15 + 5)
    assert found.replaced == 10 + 5 + 10 + 5  # both upgrades throw away what was there
    assert (found.changes, found.upgrades) == (6, 4)
    assert walk("SAGE", [], whole, keeps=False).first == 0


def test_a_comparison_reads_back_and_damage_is_one_line(tmp_path):
    labels = {-1: OfLabel(3, 40, NAN), 193: OfLabel(7, 60, 0.25)}
    points = [replace(OURS[0], labels=labels, target=0.5), OURS[1]]
    walks = [walk("nested", [{3: 1}], {(3, 1): {"a": 9}}, keeps=True)]
    write_comparison(tmp_path / "c.json", points, walks, scene="plot")
    document = json.loads((tmp_path / "c.json").read_text(), parse_constant=pytest.fail)
    assert document["scene"] == "plot"
    assert document["points"][0]["raw"] == 24_800
    again, same = read_comparison(tmp_path / "c.json")
    assert repr(again) == repr(points)
    assert same == walks
    write_json(tmp_path / "c.json", {"points": [{}], "walks": []})
    with pytest.raises(DataError, match=r"c.json: not a comparison .* compare again"):
        read_comparison(tmp_path / "c.json")


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Job:
    folder = tmp_path_factory.mktemp("compare")
    job = Job(RunDir(folder / "run"), lambda event: None)
    open_scene(job, capture, SceneConfig())
    make_masks(job, MasksConfig())
    lift_labels(job)
    train_levels(job, TrainConfig(max_steps=60, level_every=20, refine_every=5, sh_degree=1), 0)
    nest_levels(job, NestConfig(steps=20, levels=4, base_steps=20), 0)
    observe_levels(job, FitConfig())
    sample_levels(job, SampleConfig(views=8, calibration_views=8), FitConfig())
    fit_ladder(job, FitConfig())
    make_plan(job, PlanConfig(target_ssim=0.4))
    return job


@pytest.fixture(scope="module")
def compared(finished: Job, tmp_path_factory: pytest.TempPathFactory) -> tuple[Job, list[Event], Path]:
    events: list[Event] = []
    copy = tmp_path_factory.mktemp("json") / "points.json"
    job = replace(finished, emit=events.append)
    compare(job, CONFIG, copy)
    return job, events, copy


def test_everything_is_measured(compared):
    job, events, copy = compared
    folder = job.run.path / "compare"
    assert read_json(copy) == read_json(folder / "compare.json")
    points, walks = read_comparison(copy)
    by_method = {m: [p for p in points if p.method == m] for m in (SNAPSHOTS, SAGE, PRUNED, MCMC, SAME_SHARE)}
    assert {len(by_method[m]) for m in (SAGE, MCMC)} == {2}
    assert [p.target for p in by_method[SAGE]] == [0.3, 0.5]
    assert len(by_method[SNAPSHOTS]) in (2, 3)
    assert len(by_method[SAME_SHARE]) == 4
    full = job.recorded.size(60)
    assert by_method[PRUNED][0].count == round(0.3 * full)
    assert by_method[PRUNED][0].steps == 65
    assert by_method[SAME_SHARE][0].steps == 80
    planned = [p for p in points if p.method == PLANNED]
    assert [p.target for p in planned if not math.isnan(p.target)] == pytest.approx([0.3, 0.4, 0.5])
    assert all(p.encoded <= p.budget for p in planned if not math.isnan(p.budget))
    for p in points:
        assert sum(of.count for of in p.labels.values()) == p.count
        assert sum(of.encoded for of in p.labels.values()) == p.encoded > 0
        assert p.raw == 248 * p.count
        assert np.isfinite([p.ssim, p.ssim_sent, p.psnr]).all()
        assert math.isnan(p.lpips_alex)
        assert abs(p.ssim - p.ssim_sent) < 0.05
    assert by_method[SAME_SHARE][-1].encoded == sum(c.nbytes for c in read_index(job.run.increments))
    assert len(walks) == 4
    assert all(w.first > 0 for w in walks)
    assert all(w.replaced == 0 for w in walks if w.method == "nested")
    warned = [e.text for e in events if isinstance(e, Warned)]
    assert len([text for text in warned if "no LPIPS" in text]) == 2
    assert sum(isinstance(e, TableMade) for e in events) >= 4
    page = (folder / "compare.md").read_text()
    for stem in ("curves", "labels"):
        assert f"{stem}.png" in page
        assert (folder / f"{stem}.png").stat().st_size > 1000
    for name in ("table_1_targets", "table_2_baselines", "table_3_mcmc", "table_4_walk", "points"):
        assert (folder / f"{name}.csv").stat().st_size > 50


def test_mcmc_keeps_its_cap_even_below_the_number_of_points(compared):
    job, _, _ = compared
    full = job.recorded.size(60)
    assert len(job.scene.points.xyz) > round(0.2 * full)
    for share in (0.2, 1.0):
        g = read_level(job.run.path / "compare" / f"mcmc-{share:g}.npz")
        assert 0.8 * share * full < len(g) <= round(share * full)


def test_a_second_comparison_trains_nothing_and_a_killed_one_goes_on(compared, monkeypatch):
    job, _, _ = compared
    monkeypatch.setattr(report, "save_figure", lambda *_: b"")
    events: list[Event] = []
    again = replace(job, emit=events.append)
    compare(again, CONFIG)
    assert not [e for e in events if isinstance(e, StageStarted)]
    assert len([e for e in events if isinstance(e, StageSkipped)]) == 2 + 1 + 2 + 2
    folder = job.run.path / "compare"
    before = (folder / "compare.json").read_bytes()
    (folder / "compare.json").unlink()
    (folder / "pruned-0.3-5.npz").unlink()
    events.clear()
    compare(replace(job, emit=events.append), CONFIG)
    assert [e.name for e in events if isinstance(e, StageStarted)] == ["pruned-0.3-5", "compare", "compared"]
    assert (folder / "compare.json").read_bytes() == before
    with pytest.raises(RunError, match=r"compare.json: made with other targets .* --force"):
        compare(job, replace(CONFIG, targets=(0.3,), shares=(0.2,)))
    assert not list(folder.glob("pruned-0.2*"))  # it was refused before anything was trained


def test_a_random_subset_of_the_points_keeps_labels_and_tracks(finished):
    scene, labels = finished.scene, finished.point_labels
    few, mine = with_at_most(scene, labels, 100, 3)
    assert len(few.points.xyz) == len(few.points.rgb) == len(mine) == 100
    rows = [int(np.flatnonzero((scene.points.xyz == xyz).all(1))[0]) for xyz in few.points.xyz]
    np.testing.assert_array_equal(mine, labels[rows])
    kept = np.isin(scene.points.track_points, rows)
    np.testing.assert_array_equal(np.array(rows)[few.points.track_points], scene.points.track_points[kept])
    np.testing.assert_array_equal(few.points.track_uv, scene.points.track_uv[kept])
    np.testing.assert_array_equal(with_at_most(scene, labels, 100, 3)[1], mine)
    assert with_at_most(scene, labels, 10**6, 3)[0] is scene
