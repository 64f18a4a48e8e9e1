"""A sweep on a small procedural capture: cells, resuming, failures, and the sums by hand."""

import csv
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_stages_label import Halves

from sagesplat.adapt.plan_files import read_plans
from sagesplat.core.config import MasksConfig, PlanConfig, RunConfig, SceneConfig, TrainConfig
from sagesplat.core.errors import DataError, RunError
from sagesplat.core.events import Event, StageDone, TableMade, Training, Warned
from sagesplat.io.files import link
from sagesplat.run.records import settings_of
from sagesplat.run.run_dir import RunDir
from sagesplat.segment import hf
from sagesplat.studies.sweep import run
from sagesplat.studies.sweep.file import read_sweep
from sagesplat.studies.sweep.report import MEASURES, Row, readable, summarise
from sagesplat.studies.sweep.run import _share_training, run_sweep

ROOT = Path(__file__).parents[1]
TEXT = """
targets = [0.4, 0.3]
seeds = [0, 5]
settings.ladder = "snapshots"
settings.train = { max_steps = 30, level_every = 10, refine_every = 5, sh_degree = 1 }
scenes.plot = "capture"
variants.track = {}
variants.flat.train.sh_degree = 0
"""
CELLS = ["plot-track-seed0", "plot-track-seed5", "plot-flat-seed0", "plot-flat-seed5"]
TABLES = ("cells.csv", "summary.csv", "summary.md")


def write(folder: Path, text: str) -> Path:
    (folder / "capture").mkdir(exist_ok=True)
    (folder / "sweep.toml").write_text(text)
    return folder / "sweep.toml"


def sweep_in(folder: Path, text: str = TEXT, *, force: bool = False) -> list[Event]:
    events: list[Event] = []
    run_sweep(read_sweep(write(folder, text)), folder / "out", events.append, force=force)
    return events


def done(events: list[Event]) -> list[str]:
    return [event.name for event in events if isinstance(event, StageDone)]


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the capture, the file and the finished sweep."""
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "capture").symlink_to(capture)
    events = sweep_in(folder)
    assert [name for name in done(events) if "/" not in name] == CELLS
    assert done(events).count("plot-track-seed5/train") == 1
    assert isinstance(events[-1], TableMade)
    return folder


@pytest.fixture
def copy(finished: Path, tmp_path: Path) -> Path:
    """The finished sweep, to be spoilt; the link keeps the capture where it was."""
    shutil.copytree(finished / "out", tmp_path / "out")
    (tmp_path / "capture").symlink_to(finished / "capture")
    return tmp_path


def test_every_cell_and_target_is_a_row_that_agrees_with_its_run(finished: Path) -> None:
    rows = rows_of(finished / "out" / "cells.csv")
    assert [(r["variant"], r["seed"], r["target"]) for r in rows] == [
        (variant, seed, target)
        for variant in ("track", "flat")
        for seed in ("0", "5")
        for target in ("0.3", "0.4")
    ]
    for row in rows:
        run = RunDir(finished / "out" / "runs" / f"plot-{row['variant']}-seed{row['seed']}", "snapshots")
        plan = next(p for p in read_plans(run.plan)[0] if p.target == float(row["target"]))
        assert int(row["Gaussians"]) == plan.count
        assert row["status"] == plan.status
        assert 0 < float(row["of full model"]) <= 1
        assert float(row["share kept"]) == pytest.approx(int(row["kept"]) / int(row["promised"]))
        assert 0 < float(row["SSIM"]) <= float(row["full SSIM"]) + 0.1
        assert 5 < float(row["PSNR"]) < 40
    assert min(float(row["of full model"]) for row in rows) < 0.95
    assert len({row["full PSNR"] for row in rows}) == 4  # every seed and variant was a training of its own
    summary = rows_of(finished / "out" / "summary.csv")
    assert [(r["variant"], r["target"], r["n"]) for r in summary] == [
        (variant, target, "2") for variant in ("track", "flat") for target in ("0.3", "0.4")
    ]
    pair = [float(r["SSIM"]) for r in rows if (r["variant"], r["target"]) == ("flat", "0.4")]
    assert float(summary[3]["SSIM"]) == pytest.approx(sum(pair) / 2)
    assert float(summary[3]["SSIM sd"]) == pytest.approx(abs(pair[0] - pair[1]) / math.sqrt(2))
    lines = (finished / "out" / "summary.md").read_text().splitlines()
    assert len(lines) == 4 + len(summary)
    assert {line.count("|") for line in lines[2:]} == {len(MEASURES) + 6}
    assert f"{float(summary[3]['SSIM']):.3f}±{float(summary[3]['SSIM sd']):.3f}" in lines[-1]


def test_a_second_sweep_has_nothing_to_do_and_says_the_same(finished: Path) -> None:
    before = [(finished / "out" / name).read_bytes() for name in TABLES]
    assert done(sweep_in(finished)) == CELLS
    assert [(finished / "out" / name).read_bytes() for name in TABLES] == before


def test_what_is_trained_alike_is_trained_once(copy: Path) -> None:
    text = TEXT + "variants.minimum.fit.distance = 'minimum'\n"
    events = sweep_in(copy, text)
    stages_of = [name.split("/")[1] for name in done(events) if name.startswith("plot-minimum-seed5/")]
    assert stages_of == ["observe", "fit", "plan", "compose", "evaluate", "report"]
    rows = {(r["variant"], r["seed"], r["target"]): r for r in rows_of(copy / "out" / "cells.csv")}
    for target in ("0.3", "0.4"):
        like, minimum = (rows[variant, "5", target] for variant in ("track", "minimum"))
        assert like["full PSNR"] == minimum["full PSNR"]
    assert done(sweep_in(copy, text)) == [*CELLS, "plot-minimum-seed0", "plot-minimum-seed5"]


def test_cells_that_share_a_training_share_what_later_stages_read(finished, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(hf, "HfSegmenter", Halves)
    (tmp_path / "capture").symlink_to(finished / "capture")
    text = """
        targets = [0.4]
        seeds = [0]
        [settings]
        ladder = "snapshots"
        fuse = true
        masks = { segmenter = "hf", model = "some/network" }
        labels = { ignore = "sky-other-merged" }
        train = { max_steps = 20, level_every = 20 }
        [scenes]
        plot = "capture"
        [variants]
        first = {}
        second.fit.distance = "minimum"
    """
    events = sweep_in(tmp_path, text)
    assert [name for name in done(events) if name.endswith("/train")] == ["plot-first-seed0/train"]
    first, second = (RunDir(tmp_path / "out" / "runs" / f"plot-{name}-seed0") for name in ("first", "second"))
    assert settings_of(first, "fuse") == settings_of(second, "fuse") == {}
    for path in sorted(p for p in first.fused.rglob("*") if p.is_file()):
        assert (second.path / path.relative_to(first.path)).read_bytes() == path.read_bytes(), path.name
    assert first.valid.exists()
    # all that was there after training is there again
    later = {"fused", "snapshots", ".lock"}
    assert {p.name for p in first.path.iterdir()} - later == {p.name for p in second.path.iterdir()} - later


def test_a_shared_training_is_there_as_a_whole_or_not_at_all(copy: Path, monkeypatch) -> None:
    text = TEXT + "variants.minimum.fit.distance = 'minimum'\n"
    cells = read_sweep(write(copy, text))
    like, new = cells[0], cells[-1]
    runs, times = copy / "out" / "runs", 0
    RunDir(runs / like.name).cameras.write_bytes(b"refined")

    def fails(path: Path, target: Path) -> None:
        nonlocal times
        times += 1
        if times == 20:
            raise KeyboardInterrupt
        link(path, target)

    monkeypatch.setattr(run, "link", fails)
    with pytest.raises(KeyboardInterrupt):
        _share_training(runs, like, new)
    assert not (runs / new.name).exists()
    _share_training(runs, like, new)
    assert RunDir(runs / new.name).provenance("train").exists()
    assert RunDir(runs / new.name).cameras.read_bytes() == b"refined"


def test_a_cell_that_fails_is_recorded_and_the_others_go_on(copy: Path) -> None:
    (copy / "empty").mkdir()
    sweep = read_sweep(write(copy, TEXT.replace("scenes", 'scenes.bad = "empty"\nscenes')))
    events: list[Event] = []
    with pytest.raises(RunError, match=r"out: 4 of 8 runs failed \(bad-track-seed0, .*cells\.csv"):
        run_sweep(sweep, copy / "out", events.append)
    assert done(events) == CELLS
    warnings = [event.text for event in events if isinstance(event, Warned)]
    assert len(warnings) == 4
    assert warnings[0].startswith("bad-track-seed0: ")
    assert isinstance(events[-1], TableMade)
    rows = rows_of(copy / "out" / "cells.csv")
    assert len(rows) == 16
    assert rows[0]["status"].startswith("failed: ")
    assert rows[0]["SSIM"] == ""
    summary = rows_of(copy / "out" / "summary.csv")
    assert [row["n"] for row in summary] == ["0"] * 4 + ["2"] * 4
    assert (summary[0]["SSIM"], summary[0]["SSIM sd"]) == ("", "")


def test_an_interrupted_sweep_keeps_what_is_done(copy: Path) -> None:
    def interrupt(event: Event) -> None:
        if isinstance(event, Training):
            raise KeyboardInterrupt

    sweep = read_sweep(write(copy, TEXT.replace("5]", "1]")))
    with pytest.raises(KeyboardInterrupt):
        run_sweep(sweep, copy / "out", interrupt)
    assert {row["seed"] for row in rows_of(copy / "out" / "cells.csv")} == {"0"}


def test_settings_and_variants_become_the_configuration_of_each_cell(tmp_path: Path) -> None:
    text = """
        targets = [0.9, 0.5, 1]
        seeds = [3]
        [settings]
        scene.downscale = 2
        masks.masks = "labels"
        train = { sh_degree = 1, antialiased = true, grow_grad = 1 }
        plan.share = 0.5
        [scenes]
        plot = "capture"
        garden = "demo"
        [variants.a]
        train.sh_degree = 2
    """
    plot, garden = read_sweep(write(tmp_path, text))
    assert (plot.name, plot.capture) == ("plot-a-seed3", tmp_path / "capture")
    assert (garden.name, garden.capture) == ("garden-a-seed3", None)
    assert (
        plot.config
        == garden.config
        == RunConfig(
            SceneConfig(downscale=2),
            masks=MasksConfig(masks=tmp_path / "labels"),
            train=TrainConfig(sh_degree=2, antialiased=True, grow_grad=1.0),
            plan=PlanConfig(target_ssim=0.9, share=0.5, other_targets=(0.5, 1.0)),
            seed=3,
        )
    )
    assert isinstance(plot.config.train.grow_grad, float)
    assert plot.config.plan.targets == [0.5, 0.9, 1.0]


def test_the_example_is_a_sweep() -> None:
    sweep = read_sweep(ROOT / "examples" / "sweep.toml")
    assert {cell.capture for cell in sweep} == {None}


HEAD = 'targets = [0.8]\nseeds = [0]\nscenes.plot = "capture"\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("targets = [", "not readable as TOML"),
        (HEAD + '"a\\nb" = 1', r"'a\\nb': no such key; there are targets, seeds"),
        (HEAD + "settings.train.steps = 1", r"settings\.train\.'steps': no such key; there are max_steps"),
        (HEAD + "settings.train.max_steps = -5", r"settings\.train\.max_steps: expected int >= 1"),
        (HEAD + "settings.masks.masks = 3", r"masks\.masks: 3 is no path"),
        (HEAD + "settings.seed = 1", r"settings\.seed: set by the list seeds"),
        (HEAD + "variants.a.plan.other_targets = [1]", r"variants\.a\.plan\.other_targets: set by the list"),
        (HEAD + "variants.'a/b' = {}", "the name 'a/b' makes no folder; use letters"),
        (HEAD + "scenes.'..' = 'capture'", r"the name '\.\.' makes no folder"),
        (HEAD + "variants.a.train.max_steps = 0.5", r"variants\.a\.train\.max_steps: expected int"),
        (HEAD + "scenes.Plot = 'capture'", "two runs would be called plot-seed0"),
        (HEAD + "scenes.other = 'nowhere'", r"scenes\.other: no folder .*nowhere"),
        (HEAD.replace("scenes.plot", "#"), "missing required field scenes"),
        (HEAD.replace("[0]", "[1, 2, 1]"), "seeds: two are equal"),
        (HEAD.replace("0.8", "0.8, 0.80000001"), "targets: two are equal"),
        (HEAD.replace("0.8", "1.1"), r"targets\[0\]: expected float <= 1"),
    ],
)
def test_what_is_wrong_with_a_file_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(DataError, match=rf"sweep\.toml: .*({message})"):
        read_sweep(path)


def row(seed: int, ssim: float, *, scene: str = "a", status: str = "ok") -> Row:
    values = dict.fromkeys(MEASURES, math.nan) | {"Gaussians": 100 * (seed + 1), "SSIM": ssim}
    return (scene, "", seed, 0.8, *values.values(), status)


def test_sums_by_hand() -> None:
    failed = ("a", "", 3, 0.8, *[math.nan] * len(MEASURES), "failed: why")
    rows = [row(0, 0.7), row(1, 0.8, status="infeasible"), row(2, 0.9), failed, row(0, math.nan, scene="b")]
    table = summarise(rows)
    a, b = (dict(zip(table.header, values, strict=True)) for values in table.rows)
    assert (a["scene"], a["target"], a["n"], a["ok"]) == ("a", 0.8, 3, 2)
    assert (a["Gaussians"], a["Gaussians sd"]) == (200, 100)
    assert a["SSIM"] == pytest.approx(0.8)
    assert a["SSIM sd"] == pytest.approx(0.1)
    assert (b["n"], b["Gaussians"]) == (1, 100)
    assert all(math.isnan(float(b[name])) for name in ("Gaussians sd", "SSIM", "SSIM sd"))
    shown = readable(table, ("Gaussians", "SSIM"))
    assert shown.header == ("scene", "variant", "target", "n", "ok", "Gaussians", "SSIM")
    assert shown.rows == [
        ("a", "", "0.8", "3", "2", "200±100", "0.800±0.100"),
        ("b", "", "0.8", "1", "1", "100", "–"),
    ]


@given(st.lists(st.floats(0, 1) | st.just(math.nan), min_size=1, max_size=8))
def test_spread_is_that_of_the_known_values(values: list[float]) -> None:
    table = summarise([row(seed, value) for seed, value in enumerate(values)])
    (sums,) = (dict(zip(table.header, r, strict=True)) for r in table.rows)
    known = np.array([v for v in values if not math.isnan(v)])
    assert sums["n"] == len(values)
    expected = known.mean() if len(known) else math.nan
    assert sums["SSIM"] == pytest.approx(expected, nan_ok=True)
    expected = known.std(ddof=1) if len(known) > 1 else math.nan
    assert sums["SSIM sd"] == pytest.approx(expected, nan_ok=True)
