"""Cross-scene: runs whose truth is known, scores by hand, and two small runs on disk."""

import csv
import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from conftest import LABELS, random_gaussians, write_capture
from hypothesis import given
from hypothesis import strategies as st

from sagesplat.adapt.eq1 import choose_latest, plan_view
from sagesplat.adapt.eq3 import Eq3, SsimModel, write_models
from sagesplat.adapt.observe import Observations
from sagesplat.core.config import SceneConfig
from sagesplat.formats.levels import write_level
from sagesplat.run.job import Job
from sagesplat.run.records import record
from sagesplat.run.run_dir import RunDir
from sagesplat.segment.lift import LiftedLabels
from sagesplat.segment.masks import Taxonomy
from sagesplat.stages.scene import open_scene
from sagesplat.studies.transfer.run import load_fitted
from sagesplat.studies.transfer.run import transfer as transfer_runs
from sagesplat.studies.transfer.score import (
    PREDICTORS,
    FittedRun,
    Transfer,
    point_spacings,
    score,
    shared_categories,
    transfer,
)

VIEWS = 16
LEVELS = (100, 200, 300)
TARGETS = [0.5, 0.7]


def truth(label_id: int, level: int, scale: float) -> SsimModel:
    """SSIM peaks at the last level and falls with distance / scale, fitted to 1 to 5 of those."""
    peak, rate = 0.6 + level / 1000, (0.1 + 0.05 * label_id) / scale
    params = Eq3(peak, rate, 0.0, 1.0, peak, rate, 0.0, 1.0, 5.0 * scale)
    return SsimModel(label_id, level, params, (scale, 5.0 * scale), peak, 0.0, VIEWS, "one regime")


WHOLE: dict[str, type] = dict.fromkeys(
    ("label_id", "level", "view", "num_pixels"), np.int32
)  # columns of whole numbers


def synthetic(
    name: str, names: Mapping[int, str], *, unit: float = 1.0, focal: float = 100.0, levels=LEVELS
) -> FittedRun:
    """A run that its models describe exactly. The first letter of a name decides its truth.

    World units are `unit` times smaller; pixels see distance / focal, whatever the unit.
    """
    of = {i: ord(n[0]) - ord("a") + 1 for i, n in names.items()}
    distance = np.linspace(1.0, 5.0, VIEWS)  # in A's units, at focal 100
    models = {(i, j): replace(truth(of[i], j, unit * focal / 100), label_id=i) for i in names for j in levels}
    rows = [
        (i, j, v, d * unit * focal / 100, models[i, j](d * unit * focal / 100))
        for (i, j) in models
        for v, d in enumerate(distance)
    ]
    columns = dict(
        zip(("label_id", "level", "view", "distance", "ssim"), zip(*rows, strict=True), strict=True)
    )
    others = dict.fromkeys(("ssim_eroded", "psnr", "num_pixels"), (1,) * len(rows))
    return FittedRun(
        name,
        names,
        Observations(**{n: np.array(c, WHOLE.get(n, np.float32)) for n, c in (columns | others).items()}),
        models,
        counts={(i, j): j * i for i in names for j in levels},
        recovering=frozenset(),
        train_views=np.arange(VIEWS)[np.arange(VIEWS) % 8 > 0],
        test_views=np.arange(0, VIEWS, 8),
        extent=4.0 * unit,
        focals=np.full(VIEWS, focal),
        spacings={i: 0.01 * of[i] * unit for i in names},
    )


A = synthetic("a", {1: "apple", 2: "bench"})


def errors(scores: Transfer) -> dict[str, float]:
    return {p: float(scores.ssim_error[scores.predictor == p].max()) for p in PREDICTORS}


def test_other_units_transfer_by_extent_and_by_footprint():
    scores = transfer(A, synthetic("b", A.names, unit=3.0), TARGETS)
    error = errors(scores)
    assert max(error["own"], error["extent"], error["footprint"]) < 1e-6
    assert error["raw"] > 0.05
    exact = scores.select(np.isin(scores.predictor, ["own", "extent", "footprint"]))
    assert not (exact.iteration_error > 0).any()
    assert not exact.missed.any()
    assert set(exact.hit[exact.reachable > 0]) == {1.0}
    assert not exact.outside[exact.split == "test"].any()
    raw = scores.select(scores.predictor == "raw")
    assert raw.outside.min() >= 0.5  # raw distances are 3 to 15 where A knows 1 to 5
    assert raw.bias.max() < 0  # and so look farther than they are


def test_another_lens_transfers_by_footprint_only():
    error = errors(transfer(A, synthetic("b", A.names, focal=200.0), TARGETS))
    assert max(error["own"], error["footprint"]) < 1e-6
    assert min(error["raw"], error["extent"]) > 0.05
    b = synthetic("b", A.names)  # twice as far, half of the views through twice the lens
    focals = np.where(np.arange(VIEWS) % 2, 200.0, 100.0)
    distance = (b.observations.distance * focals[b.observations.view] / 100).astype(np.float32)
    error = errors(
        transfer(A, replace(b, focals=focals, observations=replace(b.observations, distance=distance)), [0.7])
    )
    assert error["footprint"] < 1e-6 < min(error["raw"], error["extent"])


def test_names_decide_not_ids():
    b = synthetic("b", {1: "bench", 2: "apple", 3: "unlabelled", -1: "unlabelled"}, unit=3.0)
    a = synthetic("a", {**A.names, -1: "unlabelled"})
    assert [(s.name, s.label_a, s.label_b) for s in shared_categories(a, b)] == [
        ("bench", 2, 1),
        ("apple", 1, 2),
    ]
    scores = transfer(a, b, TARGETS)
    assert set(scores.category) == {"apple", "bench"}
    assert errors(scores)["extent"] < 1e-6


def test_levels_are_matched_by_their_share_of_the_run():
    b = replace(synthetic("b", A.names, levels=(30, 60, 90, 150)), recovering=frozenset({60}))
    matched = shared_categories(A, b)[0]
    assert (matched.levels, matched.matched) == ((30, 90, 150), (100, 200, 300))
    resetting = replace(A, recovering=frozenset({200}))  # 90 of 150 is nearer to 300 of 300 than to 100
    assert shared_categories(resetting, b)[0].matched == (100, 100, 300)
    assert shared_categories(replace(A, recovering=frozenset(LEVELS)), b)[0].matched == (100, 200, 300)


def test_scores_by_hand():
    """Three levels in four views: kept too dear, missed, kept at best, and out of reach of every level."""
    levels, counts = np.array([100, 200, 300]), np.array([10, 40, 30])
    measured = np.array([[0.75, 0.5, 0.25, 0.25], [0.75, 0.5, 0.75, 0.25], [0.75, 0.75, 0.5, 0.5]])
    predicted = np.array([[0.5, 0.75, 0.25, 0.25], [0.75, 0.5, 0.5, 0.75], [0.5, 0.5, 0.25, 0.5]])
    assert choose_latest(measured.T, counts, 0.75)[0].tolist() == [0, 2, 1, 2]
    assert choose_latest(predicted.T, counts, 0.75)[0].tolist() == [1, 0, 1, 1]
    result = score(predicted, measured, levels, counts, 0.75)
    assert result == {
        "reachable": 3, "hit": pytest.approx(2 / 3), "missed": 1,
        "iteration_error": (100 + 200 + 0) / 3, "regret": (30 + 0) / 2,
    }  # fmt: skip
    hopeless = score(predicted, measured, levels, counts, 1.0)
    assert (hopeless["reachable"], hopeless["missed"]) == (0, 0)
    assert all(math.isnan(hopeless[name]) for name in ("hit", "iteration_error", "regret"))


ssims = st.sampled_from([0.25, 0.5, 0.625, 0.75, 1.0])  # few values, so that ties come up
ladders = st.lists(st.tuples(st.integers(0, 3), ssims, ssims), min_size=1, max_size=5)


@given(ladders, st.sampled_from([0.5, 0.7, 0.75, 1.0]))
def test_the_choice_is_the_planners(ladder, target):
    levels = np.arange(1, len(ladder) + 1)
    counts, *columns = map(np.array, zip(*ladder, strict=True))
    chosen = levels[choose_latest(np.stack(columns), counts, target)[0]]
    for view, ssim in enumerate(columns):
        models = {
            (1, i): SsimModel(1, i, Eq3(*[0.0] * 9), (0.0, 0.0), float(q), 0.0, 1, "constant")
            for i, q in zip(levels.tolist(), ssim, strict=True)
        }
        plan = plan_view(models, dict(zip(models, counts.tolist(), strict=True)), {}, target, 0)
        assert plan.levels == {1: chosen[view]}


@given(st.lists(ladders, min_size=1, max_size=4).filter(lambda x: len({len(i) for i in x}) == 1), ssims)
def test_regret_is_never_negative_and_hit_is_a_share(views, target):
    counts = np.array([count for count, _, _ in views[0]])
    predicted, measured = (np.array([[row[k] for row in view] for view in views]).T for k in (1, 2))
    result = score(predicted, measured, np.arange(len(counts)), counts, target)
    assert not result["regret"] < 0  # or NaN
    assert not result["hit"] < 0
    assert not result["hit"] > 1
    assert 0 <= result["missed"] <= result["reachable"] <= len(views)
    perfect = score(measured, measured, np.arange(len(counts)), counts, target)
    assert perfect["missed"] == 0
    assert not perfect["regret"] > 0
    assert not perfect["iteration_error"] > 0


def test_spacing_is_to_the_nearest_point_of_the_same_label():
    xyz = np.array([[0, 0, 0], [0, 0, 1], [0, 0, 3], [0, 0, 0.5], [9, 9, 9]], np.float32)
    assert point_spacings(xyz, np.array([1, 1, 1, 2, 3])) == {1: 1.0}
    assert point_spacings(xyz, np.array([1, 1, 1, 2, 2]))[1] == 1.0


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    """A run folder that says of a small capture what a synthetic run does."""
    folder = tmp_path_factory.mktemp("transfer")
    g = random_gaussians(60, degree=0)
    write_capture(folder / "capture", g, views=VIEWS)
    job = Job(RunDir(folder / "run", "snapshots"), lambda event: None)
    run, made = job.run, synthetic("b", {3: "apple", 184: "bench"})
    open_scene(job, folder / "capture", SceneConfig())
    Taxonomy(dict(made.names)).write(run.masks / "labels.json")
    votes = np.ones(len(g), np.int32)
    LiftedLabels(g.label_ids.numpy(), votes, votes).write(run.labels)
    for level in LEVELS:
        write_level(run.levels, level, g, recovering=False, sh_degree=0)
    made.observations.write_csv(run.observations)
    write_models(run.models, dict(made.models))
    for stage, values in (
        ("train", {"antialiased": False}), ("observe", {"distance": "percentile"}),
        ("fit", {"min_share": 0.0}), ("plan", {"targets": TARGETS})
    ):  # fmt: skip
        record(run, stage, values, [], 0.0)
    return job


def test_a_run_predicts_itself_like_its_own_models(job, tmp_path):
    summary, line = transfer_runs(job, job, tmp_path)
    assert line.startswith("SSIM error on test views: raw 0.000, extent 0.000, footprint 0.000; without")
    assert line.endswith("own models 0.000")
    with (tmp_path / "summary.csv").open() as file:
        assert next(csv.reader(file)) == list(summary.header)
    with (tmp_path / "transfer.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["target"] for row in rows} == {str(target) for target in TARGETS}
    assert {row["missed"] for row in rows} == {"0"}
    files = {"transfer.png", "transfer.svg", "panel.png", "panel.svg"}
    files |= {f"{name}.{kind}" for name in ("transfer", "summary") for kind in ("csv", "md", "tex")}
    assert {p.name for p in tmp_path.rglob("*.*")} == files
    fitted = load_fitted(job)
    assert fitted.focals == pytest.approx([40.0] * VIEWS)
    assert set(fitted.spacings) == set(LABELS)
    assert len(load_fitted(job).observations) == len(LEVELS) * 2 * VIEWS
