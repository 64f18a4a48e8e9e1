"""The stage `sample`, and the fidelity models that are fitted to it, on a run made in two seconds."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import job_of

from sagesplat.adapt import fidelity
from sagesplat.adapt.cell_models import expect, promised
from sagesplat.adapt.fidelity import measure_compositions, measure_levels
from sagesplat.adapt.observe import RenderedLabels, observe
from sagesplat.adapt.viewpoints import Rule, draw, read_viewpoints
from sagesplat.core.config import FitConfig, SampleConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import StageDone, StageSkipped
from sagesplat.metrics.image import ssim_map
from sagesplat.raster import rasterize
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.stages import sample
from sagesplat.stages.fit import fit_ladder
from sagesplat.stages.results import fidelity_of, sampled_of, viewpoints_of
from sagesplat.stages.sample import sample_levels

FEW = SampleConfig(views=6, calibration_views=4)


@pytest.fixture
def job(run: Path) -> Job:
    return job_of(run, force=True)


def again(job: Job, config: SampleConfig = FEW) -> list:
    events: list = []
    sample_levels(replace(job, emit=events.append), config, FitConfig())
    return events


def test_a_finished_run_has_what_was_asked(finished_run: Path):
    job = Job(RunDir(finished_run), lambda event: None, "cpu")
    drawn, table = viewpoints_of(job), sampled_of(job)
    assert table.fidelity.shape == (len(drawn.rows("fit")), 2, 4)
    assert {name: len(drawn.rows(name)) for name in ("fit", "bias", "calibration")} == sample._FEWEST
    seen = table.pixels > 0
    assert (table.fidelity[..., -1][seen] == 1).all()
    assert np.isnan(table.fidelity[~seen]).all()
    assert (table.whole[:, -1] == 1).all()
    models = fidelity_of(job)
    shown = np.flatnonzero(table.shown().any(axis=0))
    assert set(models) == {table.labels[i] for i in shown}
    assert all(model.status == "calibrated" for model in models.values())


def test_the_levels_are_compared_with_the_full_model(job: Job):
    cameras = viewpoints_of(job).cameras[:2]
    found, pixels, whole = measure_levels(job.ladder, cameras, backend="cpu")
    full, low = (job.ladder.load(level) for level in (4, 1))
    for row, camera in enumerate(cameras):
        images = [rasterize(g, camera).rgb.clamp(0, 1).numpy() for g in (low, full)]
        quality = ssim_map(*images)
        assert whole[row, 0] == pytest.approx(quality.mean(), abs=1e-6)
        ids = RenderedLabels(full, "cpu").render(camera)
        for column, label in enumerate((3, 184)):
            assert pixels[row, column] == (ids == label).sum()
            wanted = quality[ids == label].mean() if pixels[row, column] else np.nan
            assert found[row, column, 0] == pytest.approx(wanted, abs=1e-6, nan_ok=True)
    planned = np.array([[[1, 1], [4, 4], [1, 4], [4, 4]]] * 2)
    composed, same = measure_compositions(job.ladder, cameras, planned, backend="cpu")
    assert (same == pixels).all()
    # float32 of the same Gaussians in another order: one machine in many is 1.07e-6 away
    np.testing.assert_allclose(composed[:, 0, :-1], found[..., 0], atol=4e-6)
    np.testing.assert_allclose(composed[:, 1, -1], 1, atol=4e-6)
    np.testing.assert_array_equal(composed[:, 1], composed[:, 3])


@pytest.mark.parametrize("keep_levels", [0, 10**8])
def test_kept_pictures_are_compared_like_new_ones(
    job: Job, monkeypatch: pytest.MonkeyPatch, keep_levels: int
):
    monkeypatch.setattr(fidelity, "_KEEP_LEVELS", keep_levels)
    cameras = viewpoints_of(job).cameras[:2]
    planned = np.array([[[1, 1], [1, 4]]] * 2)
    expected, pixels = measure_compositions(job.by_cell, cameras, planned, backend="cpu")
    references = fidelity.References(job.by_cell, "cpu", False)
    for _ in range(2):
        found, same = measure_compositions(
            job.by_cell, cameras, planned, backend="cpu", references=references
        )
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(same, pixels)
    assert [bool(one.levels) for one in references._kept.values()] == [keep_levels > 0] * 2


def test_some_views_are_observed_at_the_last_level_alone(job: Job):
    given = job.scene, job.photos, job.level_masks, job.ladder, job.distances("percentile")
    every = observe(*given, views=[0, 1], backend="cpu")
    fewer = observe(*given, views=[0, 1], last_only={1}, backend="cpu")
    assert set(fewer.level[fewer.view == 1].tolist()) == {4}
    expected = every.select((every.view == 0) | (every.level == 4))
    for name, column in vars(expected).items():
        np.testing.assert_array_equal(getattr(fewer, name), column)


def test_done_once_and_again_with_other_settings(job: Job):
    first = again(job)
    assert [e.name for e in first if isinstance(e, StageDone)] == ["sample"]
    drawn = job.run.viewpoints.read_bytes()
    assert [e.name for e in again(job) if isinstance(e, StageSkipped)] == ["sample"]
    again(job, replace(FEW, shift=0.2))
    assert job.run.viewpoints.read_bytes() != drawn
    again(job, FEW)
    assert job.run.viewpoints.read_bytes() == drawn
    assert len(viewpoints_of(job).rows("fit")) == 6


def test_few_calibration_viewpoints_promise_the_full_model_only(job: Job):
    again(job)
    fit_ladder(job, FitConfig())
    models = fidelity_of(job)
    assert {model.status for model in models.values()} == {"uncalibrated"}
    cameras = [viewpoints_of(job).cameras[0]]
    expected = expect(models, job.cells, cameras, len(job.ladder.levels))
    for level in job.ladder.levels:
        composed = expected.of_composition(np.full(expected.share.shape, level))
        bound = promised(models, expected, composed)
        known = np.isfinite(bound)
        assert (bound[known] == 1).all() if level == job.ladder.levels[-1] else (bound[known] < 0.5).all()


def test_own_viewpoints(job: Job, tmp_path: Path):
    camera = job.scene.views[0].camera
    c2w = np.linalg.inv(camera.w2c.astype(np.float64)) * [1, -1, -1, 1]
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"frames": [{"transform_matrix": c2w.tolist()}]}))
    again(job, replace(FEW, viewpoints=path, shift=0, places=(0, 0, 1)))
    drawn = read_viewpoints(job.run.viewpoints)
    assert drawn.source == "path.json"
    assert all(np.abs(c.w2c[:3, :3] - camera.w2c[:3, :3]).max() < 1e-6 for c in drawn.cameras)


def test_viewpoints_that_see_nothing_are_one_line(job: Job, tmp_path: Path):
    away = np.eye(4)
    away[:3, 3] = [0, 0, 1000]
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"frames": [{"transform_matrix": (away * [1, -1, -1, 1]).tolist()}]}))
    before = job.run.sampled.read_bytes()
    with pytest.raises(RunError, match=r"none of 6 viewpoints shows anything of the scene.*--sample\.shift"):
        again(job, replace(FEW, viewpoints=path))
    assert job.run.sampled.read_bytes() == before


def test_numbers_follow_the_length_of_the_training(job: Job, monkeypatch: pytest.MonkeyPatch):
    def counts(steps: int) -> dict[str, int]:
        monkeypatch.setattr(
            sample,
            "settings_of",
            lambda run, stage: {"max_steps": steps, "steps": steps, "base_steps": 9**9, "base_share": 0},
        )
        return sample._counts(job, SampleConfig(), 1.35)

    assert counts(1) == sample._FEWEST
    assert counts(100_000) == sample.MOST
    between = counts(1500)
    assert all(sample._FEWEST[name] < between[name] <= sample.MOST[name] for name in between)


def test_the_error_decides_how_many_viewpoints_are_measured(job: Job, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sample, "VIEWS", (4, 8, 16))
    drawn = draw(job.scene, [job.scene.views[1].camera], Rule(), {"fit": 16, "bias": 1, "calibration": 1})
    for errors, wanted in (((1.0, 0.96), 8), ((1.0, 0.5), 16)):
        models = iter([{3: SimpleNamespace(rmse=error)} for error in errors])
        monkeypatch.setattr(sample, "fit_fidelity", lambda *_, models=models: next(models))
        table, used = sample._until_it_stops_shrinking(job, drawn, FitConfig(), False)
        assert used == len(table.fidelity) == wanted
