"""Everything that a run can do, on a capture whose categories miss what is usually there."""

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sagesplat.adapt.coverage import PREDICTORS
from sagesplat.adapt.evaluate import read_evaluation
from sagesplat.adapt.observe import read_observations
from sagesplat.adapt.plan_files import read_plans
from sagesplat.adapt.viewpoint import read_promises
from sagesplat.core.config import (
    CompareConfig,
    NestConfig,
    PaperConfig,
    PlanConfig,
    RunConfig,
    SampleConfig,
    SceneConfig,
    TrainConfig,
)
from sagesplat.demo.capture import make_capture
from sagesplat.io.files import read_json, write_json
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.stages.bundle import bundle
from sagesplat.stages.methods import method_of
from sagesplat.stages.pipeline import run_all
from sagesplat.studies.compare.run import compare
from sagesplat.studies.paper.cross_view import read_cross_view
from sagesplat.studies.paper.run import cross_views, paper_report
from sagesplat.studies.transfer.run import transfer

VIEWS, TESTS, CALIBRATION = 12, (0, 8), (3, 7)
TRAINING = tuple(row for row in range(VIEWS) if row not in TESTS + CALIBRATION)
PATCHES = {  # categories painted over others: in which views, where
    200: ((TRAINING[0],), np.s_[20:50, 20:60]),  # in one training view only
    201: ((TRAINING[1],), np.s_[30:31, 30:31]),  # of a single pixel: no SfM point, no Gaussian
    202: (TESTS, np.s_[:20, :40]),  # in test views only: no Gaussian
    203: (CALIBRATION, np.s_[40:, 50:]),  # in calibration views only: no Gaussian, yet a viewpoint model
}
TRAINED_ONLY, SEEN_ONCE = 197, 193  # of the capture's own: in no held-out view; in one training view only
CONFIG = RunConfig(
    scene=SceneConfig(calibrate_every=4),
    train=TrainConfig(max_steps=30, level_every=10, sh_degree=1),
    nest=NestConfig(steps=4, levels=3, smallest=0.2, base_share=0.0),
    sample=SampleConfig(views=8, calibration_views=8),
    plan=PlanConfig(target_ssim=0.3),
)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The painted categories, and real ones that are labelled in training views only or in one view only."""
    folder = tmp_path_factory.mktemp("sparse") / "capture"
    make_capture(folder, views=VIEWS, width=80, height=60)
    masks = [np.array(Image.open(folder / "masks" / f"view_{row:03d}.png")) for row in range(VIEWS)]
    unlabelled_in = {TRAINED_ONLY: TESTS + CALIBRATION, SEEN_ONCE: tuple(set(range(VIEWS)) - {TRAINING[2]})}
    for row, mask in enumerate(masks):
        for label, views in unlabelled_in.items():
            mask[(mask == label) & (row in views)] = 255
        for label, (views, where) in PATCHES.items():
            if row in views:
                mask[where] = label
        Image.fromarray(mask).save(folder / "masks" / f"view_{row:03d}.png")
    names = read_json(folder / "masks" / "labels.json")
    names["labels"] |= {str(label): f"patch {label}" for label in PATCHES}
    write_json(folder / "masks" / "labels.json", names)
    return folder


@pytest.fixture(scope="module")
def trained(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("trained") / "run"
    run_all(Job(RunDir(run), lambda event: None), capture, CONFIG)
    return run


@pytest.mark.slow
@pytest.mark.parametrize("ladder", ["nested", pytest.param("snapshots", marks=pytest.mark.slow)])
def test_every_stage_and_study_takes_them(ladder, capture, trained, tmp_path):
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    job = Job(RunDir(run, ladder), lambda event: None)
    run_all(job, capture, CONFIG)
    _check_what_is_missing(job)
    if ladder == "nested":
        assert 203 in read_promises(job.run.promises)
        cross_views(job)
        rows = csv.DictReader((job.run.adapted / "promises_kept.csv").read_text().splitlines())
        assert [row["by"] for row in rows] == list(PREDICTORS)
        sets = CompareConfig(snapshots=2, shares=(0.3,), tune_steps=2, caps=(0.5,), budgets=2, lpips=tmp_path)
        assert compare(job, sets)
        (tmp_path / "viewer").mkdir()
        (tmp_path / "viewer" / "index.html").write_text("<!doctype html><body><!-- poster --></body>")
        assert bundle(job, tmp_path / "bundle", viewer=tmp_path / "viewer").labels
    else:
        paper_report(job, PaperConfig(tune_steps=2, lpips=tmp_path))
        transfer(job, job, tmp_path / "transfer", lpips=tmp_path)
    table = read_cross_view(job.run.cross_view)
    assert set(table.view) == set(TESTS)
    assert not {201, 202, 203} & set(table.label_id)


def _check_what_is_missing(job: Job) -> None:
    """The capture is what it is meant to be, and plans have the categories that have Gaussians."""
    assert tuple(job.scene.test_ids) == TESTS
    assert tuple(job.scene.calibration_ids) == CALIBRATION
    table = read_observations(job.run.observations)
    views = {label: set(table.view[table.label_id == label]) for label in np.unique(table.label_id).tolist()}
    assert {label: views[label] for label in PATCHES} == {i: set(rows) for i, (rows, _) in PATCHES.items()}
    assert views[TRAINED_ONLY] <= set(TRAINING)
    assert views[SEEN_ONCE] == {TRAINING[2]}
    drawn = {label for label, _ in job.ladder.counts}
    assert {TRAINED_ONLY, SEEN_ONCE, 200} <= drawn
    assert not {201, 202, 203} & drawn
    scene_plans, view_plans = read_plans(job.run.plan)
    assert all(set(plan.levels) == drawn for plan in (*scene_plans, *view_plans))
    method = method_of(job)
    for plan in view_plans:  # what is evaluated is what was planned with, without SfM points as well
        assert plan.view is not None
        for c in plan.choices:
            found = method.predicted(plan, c.label_id, plan.view)
            assert found == pytest.approx(c.predicted, nan_ok=True)
    evaluation = read_evaluation(job.run.evaluation)
    assert set(evaluation.view) == set(TESTS)
    assert np.isnan(evaluation.predicted[evaluation.label_id == 202]).all()
