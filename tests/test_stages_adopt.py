"""A splat that somebody else trained becomes a run: `sagesplat adopt`."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import random_gaussians, write_capture
from PIL import Image

from sagesplat.core.config import (
    AdoptConfig,
    LabelsConfig,
    MasksConfig,
    PlanConfig,
    RunConfig,
    SampleConfig,
    SceneConfig,
)
from sagesplat.core.errors import RunError
from sagesplat.core.events import Event, StageDone, Warned
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.increments import read_index
from sagesplat.formats.label_edits import FILE, Hide, LabelEdits, Rename, Split, dump_edits, ladder_hash
from sagesplat.formats.labels import sidecar, write_labels
from sagesplat.formats.ply import read_ply, write_ply
from sagesplat.formats.splats import read_splat, write_splat
from sagesplat.metrics.image import ssim_map
from sagesplat.output.contact_sheet import contact_sheet
from sagesplat.raster import rasterize
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.segment.masks import Taxonomy
from sagesplat.segment.registry import SEGMENTERS
from sagesplat.segment.segmenters import Segmented
from sagesplat.stages import adopt_levels, pipeline
from sagesplat.stages.adopt import open_splat
from sagesplat.stages.adopt_levels import make_levels
from sagesplat.stages.api import open_run
from sagesplat.stages.bundle import bundle
from sagesplat.stages.export import export_scene
from sagesplat.stages.label_edits import apply_labels
from sagesplat.stages.methods import method_of
from sagesplat.stages.results import increments_of, promises_of, sampled_of, viewpoints_of
from sagesplat.train.importance import importance

SMALL = AdoptConfig(fit="none", views=14, size=(48, 36), shares=(0.2, 0.4, 0.7, 1.0), kind="object")
REST = RunConfig(
    sample=SampleConfig(views=6, calibration_views=6), plan=PlanConfig(target_fidelity=0.6, other_targets=())
)


def _ball(labels: bool = True) -> Gaussians:
    g = random_gaussians(400, degree=1, logit=2.0)
    return g if labels else replace(g, label_ids=torch.full_like(g.label_ids, -1))


def _adopt(folder: Path, source: Path, config: AdoptConfig) -> tuple[Job, list[Event]]:
    """The whole run."""
    events: list[Event] = []
    job = Job(RunDir(folder / "run"), events.append, "cpu")
    pipeline.adopt(job, source, config, REST)
    return job, events


def _levels(
    folder: Path, source: Path, config: AdoptConfig, masks: MasksConfig = MasksConfig()
) -> tuple[Job, list[Event]]:
    """The run up to its levels."""
    events: list[Event] = []
    job = Job(RunDir(folder / "run"), events.append, "cpu")
    open_splat(job, source, config, SceneConfig(), masks, LabelsConfig())
    make_levels(job, config)
    return job, events


@pytest.fixture(scope="module")
def adopted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of a labelled PLY, without training; the PLY is beside it."""
    folder = tmp_path_factory.mktemp("adopted")
    g = _ball()
    ids = torch.where((g.label_ids == 3) & (g.means[:, 0] > 0), 201, g.label_ids).to(torch.int16)
    names, parents = {3: "car", 184: "tree-merged", 201: "car 1"}, {201: "car"}
    write_ply(folder / "ball.ply", replace(g, label_ids=ids), names, parents=parents)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sagesplat.output.contact_sheet.contact_sheet", contact_sheet)  # draws again
        _adopt(folder, folder / "ball.ply", SMALL)
    return folder / "run"


def test_levels_end_with_what_came_in(adopted: Path) -> None:
    job = Job(RunDir(adopted), lambda event: None, "cpu")
    ladder, before = job.ladder, read_ply(adopted.parent / "ball.ply")
    assert len(ladder.levels) == 4
    assert [ladder.size(level) for level in ladder.levels] == sorted(ladder.size(x) for x in ladder.levels)
    assert ladder.size(4) == len(before)
    top = ladder.load(4)
    for label, count in before.counts().items():
        assert top.counts()[label] == count
        mine, theirs = (np.sort(g.of_labels([label]).means[:, 0].numpy()) for g in (top, before))
        np.testing.assert_allclose(mine, theirs, atol=0.01)  # steps of streams


def test_originals_are_ordered_by_what_is_closer_to_what_came_in(adopted: Path) -> None:
    job = Job(RunDir(adopted), lambda event: None, "cpu")
    rows, g = job.scene.train_ids.tolist()[:4], random_gaussians(300, degree=0, logit=3.0)

    def image(some: Gaussians, row: int) -> np.ndarray:
        camera = job.scene.views[row].camera
        drawn = rasterize(some, camera, backend="cpu", antialiased=job.antialiased)
        return drawn.rgb.clamp(0, 1).numpy().copy()

    came_in = [(row, image(g, row)) for row in rows]

    def closeness(order: torch.Tensor) -> float:
        some = g.select(order[:150])
        return float(np.mean([ssim_map(image(some, row), whole).mean() for row, whole in came_in]))

    by = [importance(g, job.scene, rows, "sensitivity", antialiased=job.antialiased), np.arange(300.0)]
    good, poor = (closeness(torch.from_numpy(np.argsort(-one, kind="stable"))) for one in by)
    assert good > poor + 0.01
    for importances in (by, by[::-1]):
        found = adopt_levels._best_order(job, g, importances, (0.5, 1.0), came_in)
        assert closeness(found) == pytest.approx(good, abs=1e-6)


def test_fidelity_is_against_what_came_in(adopted: Path) -> None:
    """The last level is rounded: what it loses is measured, and a target that it misses is out of reach."""
    job = Job(RunDir(adopted), lambda event: None, "cpu")
    drawn, table = viewpoints_of(job), sampled_of(job)
    assert job.came_in is not None
    camera = drawn.cameras[drawn.rows("fit")[0]]
    images = [rasterize(g, camera).rgb.clamp(0, 1).numpy() for g in (job.ladder.load(4), job.came_in)]
    assert table.whole[0, -1] == pytest.approx(ssim_map(*images).mean(), abs=1e-5)
    top = table.fidelity[..., -1][table.pixels > 0]
    assert (top < 1).any()
    assert (top > 0.9).all()
    method = method_of(job)
    assert method.plan_scene(0.5, 0.95, "fidelity").status == "ok"
    assert method.plan_scene(0.999999, 0.95, "fidelity").status == "infeasible"


def test_a_run_without_photos_has_fidelity_and_no_ssim(adopted: Path) -> None:
    run = open_run(adopted)
    assert {run.names[label] for label in run.fidelity} >= {"car", "tree-merged"}
    assert not promises_of(run.job)
    plan = run.plan_camera(run.scene.views[0].camera, target_fidelity=0.6)
    assert len(run.compose(plan)) == plan.count
    job = Job(RunDir(adopted), lambda event: None, "cpu")
    with pytest.raises(RunError, match="without photos"):
        pipeline.make_plan(replace(job, force=True), PlanConfig(target_ssim=0.7))


def test_it_bundles(adopted: Path, tmp_path: Path) -> None:
    made = bundle(Job(RunDir(adopted), lambda event: None, "cpu"), tmp_path / "bundle")
    manifest = json.loads((made.path / "manifest.json").read_text())
    assert list(manifest["promises"]) == ["fidelity"]
    parents = {one["name"]: one.get("parent") for one in manifest["labels"]}
    assert {name: of for name, of in parents.items() if of} == {"car 1": "car"}
    assert "car" in parents
    refine = [
        level.get("refine")
        for label in manifest["labels"]
        for cell in label["cells"]
        for level in cell["levels"]
    ]
    assert "REPLACE" in refine
    with Image.open(adopted / "viewpoints.png") as sheet:
        assert sheet.width > 500


def test_a_second_call_does_nothing(adopted: Path) -> None:
    _, events = _adopt(adopted.parent, adopted.parent / "ball.ply", SMALL)
    assert not [event for event in events if isinstance(event, StageDone)]


def test_what_is_clicked_becomes_a_category_with_levels_and_promises(adopted: Path, viewer: Path) -> None:
    """Splits name Gaussians of the last level; those that came in follow, and levels are made anew."""
    job = Job(RunDir(adopted), lambda event: None, "cpu")
    clicked = np.flatnonzero(job.ladder.load(4).of_labels([3]).means[:, 1] > 0).tolist()
    operations = (Split("car", "roof", {"car": tuple((row, 1) for row in clicked)}), Hide("roof", True))
    edits = LabelEdits(ladder_hash(increments_of(job), job.names()), operations)
    (adopted / FILE).write_bytes(dump_edits(edits))
    made = apply_labels(job, viewer=viewer)
    new = Job(RunDir(made.path), lambda event: None, "cpu")
    roof = next(label for label, name in new.names().items() if name == "roof")
    before, after = (
        {tuple(at): label for at, label in zip(g.means.tolist(), g.label_ids.tolist(), strict=True)}
        for g in (job.came_in, new.came_in)
        if g is not None
    )
    moved = [at for at, label in after.items() if label != before[at]]
    assert len(moved) == len(clicked) == new.ladder.counts[roof, 4]
    assert {(before[at], after[at]) for at in moved} == {(3, roof)}
    assert min(height for _, height, _ in moved) > -0.02  # steps of streams
    assert roof in open_run(made.path).fidelity
    assert new.parents == {"car 1": "car"}
    for one, other in zip(job.scene.views, new.scene.views, strict=True):
        np.testing.assert_allclose(one.camera.w2c, other.camera.w2c, atol=1e-6)
    manifest = json.loads((made.bundle.path / "manifest.json").read_text())
    assert [label["name"] for label in manifest["labels"] if label.get("hidden")] == ["roof"]
    apply_labels(job, viewer=viewer)  # replaces the earlier one, from what is there already


def test_what_is_renamed_has_its_looks_beside_what_came_in(adopted: Path, viewer: Path) -> None:
    job = Job(RunDir(adopted), lambda event: None, "cpu")
    edits = LabelEdits(ladder_hash(increments_of(job), job.names()), (Rename("car", "bus"),))
    (adopted / FILE).write_bytes(dump_edits(edits))
    made = apply_labels(job, out=adopted.with_name("renamed"), viewer=viewer)
    new = Job(RunDir(made.path), lambda event: None, "cpu")
    assert job.came_in is not None
    assert new.came_in is not None
    assert torch.equal(new.came_in.means, job.came_in.means)
    assert not made.trained
    assert "looks" in json.loads((made.bundle.path / "manifest.json").read_text())


def test_levels_are_a_file_of_streams_for_each_category(adopted: Path) -> None:
    listed = read_index(RunDir(adopted).increments)
    assert {one.format for one in listed} == {"stream"}
    assert len({one.uri for one in listed}) == len({one.label_id for one in listed})
    assert any(one.refine == "REPLACE" for one in listed)


def test_categories_have_as_many_cells_as_asked_for(tmp_path: Path) -> None:
    write_ply(tmp_path / "ball.ply", random_gaussians(2400, degree=0, logit=2.0))
    for cells in (0, 8):
        asked = replace(SMALL, cells=cells)
        job, _ = _levels(tmp_path / str(cells), tmp_path / "ball.ply", asked)
        assert (len(job.cells.ids) > len(set(job.cells.labels))) == (cells > 0)


@pytest.mark.parametrize("fit", ["none", pytest.param("renders", marks=pytest.mark.slow)])
def test_lossless_is_identical(tmp_path: Path, fit: Any) -> None:
    before = replace(_ball(labels=False), quats=_ball().quats * 3)  # of any length
    write_ply(tmp_path / "ball.ply", before)
    job, events = _levels(tmp_path, tmp_path / "ball.ply", replace(SMALL, fit=fit, steps=12, lossless=True))
    top = job.ladder.load(job.ladder.levels[-1])
    assert job.names()[0] == "scene"
    assert set(top.counts()) == {0}
    order, other = (np.lexsort(g.means.numpy().T) for g in (top, before))
    for name, value in before.parameters().items():
        mine = top.parameters()[name]
        assert torch.equal(mine[torch.from_numpy(order)], value[torch.from_numpy(other)]), name
    said = [line for e in events if isinstance(e, StageDone) and e.name == "nest" for line in e.lines]
    assert any("as it came in" in line for line in said)
    kinds = {one.level: one.format for one in read_index(job.run.increments)}
    assert (kinds[4], kinds[1]) == ("ply", "stream")


@pytest.mark.slow
def test_cameras_with_photos_promise_ssim_too(tmp_path: Path) -> None:
    truth = random_gaussians(150, degree=1, logit=2.0)
    write_capture(tmp_path / "capture", truth, noise=0.02)
    write_ply(
        tmp_path / "ball.ply", replace(truth, label_ids=torch.full_like(truth.label_ids, 3)), {3: "car"}
    )
    config = replace(SMALL, cameras=tmp_path / "capture", shares=(0.4, 1.0))
    job, _ = _adopt(tmp_path, tmp_path / "ball.ply", config)
    assert promises_of(job)
    assert job.scene.path == tmp_path / "capture"


def test_label_images_vote(tmp_path: Path) -> None:
    """Labels that the file has not: given for the cameras, as pictures."""
    truth = random_gaussians(150, degree=1, logit=2.0)
    scene = write_capture(tmp_path / "capture", truth, noise=0.0)
    masks = tmp_path / "masks"
    masks.mkdir()
    for view in scene.views:
        ids = np.full((view.camera.height, view.camera.width), 3, np.uint8)
        ids[:, view.camera.width // 2 :] = 184
        Image.fromarray(ids).save((masks / view.name).with_suffix(".png"))
    (masks / "labels.json").write_text('{"labels": {"3": "car", "184": "tree-merged"}}')
    write_ply(tmp_path / "ball.ply", replace(truth, label_ids=torch.full_like(truth.label_ids, -1)))
    config = replace(SMALL, cameras=tmp_path / "capture", shares=(0.4, 1.0))
    job, _ = _levels(tmp_path, tmp_path / "ball.ply", config, MasksConfig(masks=masks))
    counts = job.ladder.load(job.ladder.levels[-1]).counts()
    assert min(counts[3], counts[184]) > 30


@pytest.mark.parametrize(
    ("labels", "left"),
    [
        (LabelsConfig(merge="car=tree-merged"), {184}),
        (LabelsConfig(keep="car"), {3, -1}),
        (LabelsConfig(merge="car=thing"), {184, 201}),
    ],
)
def test_labels_of_the_file_are_merged_and_left_out(
    tmp_path: Path, labels: LabelsConfig, left: set[int]
) -> None:
    g = _ball()
    g = replace(g, label_ids=torch.where(g.label_ids < 0, 3, g.label_ids))
    write_ply(tmp_path / "ball.ply", g, {3: "car", 184: "tree-merged"})
    job = Job(RunDir(tmp_path / "run"), lambda event: None, "cpu")
    open_splat(job, tmp_path / "ball.ply", SMALL, SceneConfig(), MasksConfig(), labels)
    counts = job.load_last_level().counts()
    assert set(counts) == left
    assert sum(counts.values()) == len(g)
    assert set(job.point_labels.tolist()) <= left


@pytest.mark.parametrize("name", ["ball.ply", pytest.param("ball.sog", marks=pytest.mark.slow)])
def test_instances_come_in_and_go_out_with_their_category(tmp_path: Path, name: str) -> None:
    ids = torch.tensor([62, 201, 202, 202], dtype=torch.int16).repeat(100)
    names, parents = {62: "chair", 201: "chair 1", 202: "chair 2"}, {201: "chair", 202: "chair"}
    write_splat(tmp_path / name, replace(_ball(), label_ids=ids), names, parents=parents)
    job, _ = _levels(tmp_path, tmp_path / name, SMALL)
    assert job.names() == {**names, -1: "unlabelled"}
    assert job.parents == {"chair 1": "chair", "chair 2": "chair"}
    export_scene(job, tmp_path / "out" / name, level=4, labels=(), target=None)
    out = read_splat(tmp_path / "out" / name)
    assert (out.names, out.parents) == (names, parents)
    assert out.gaussians.counts() == {62: 100, 201: 100, 202: 200}
    export_scene(job, tmp_path / name.replace("ball", "chairs"), level=4, labels=["chair 2"], target=None)
    assert len(read_splat(tmp_path / name.replace("ball", "chairs")).gaussians) == 200


def test_labels_beside_the_file_that_changed_are_read_again(tmp_path: Path) -> None:
    """They are a part of the splat as it is read, like an offset beside it."""
    g = _ball()
    write_ply(tmp_path / "ball.ply", g, {3: "car", 184: "tree-merged"})
    job = Job(RunDir(tmp_path / "run"), lambda event: None, "cpu")
    words = tmp_path / "ball.ply", SMALL, SceneConfig(), MasksConfig(), LabelsConfig()
    open_splat(job, *words)
    write_labels(tmp_path / "ball.ply", torch.full_like(g.label_ids, 1), {1: "person"})
    with pytest.raises(RunError, match=r"ball\.ply\.labels\.json"):
        open_splat(replace(job), *words)
    again = replace(job, force=True)
    open_splat(again, *words)
    assert again.names()[1] == "person"
    assert set(again.load_last_level().counts()) == {1}
    sidecar(tmp_path / "ball.ply").unlink()
    with pytest.raises(RunError, match=r"ball\.ply\.labels\.json"):
        open_splat(replace(job), *words)


class _Halves:
    """A network that sees a car on the left of every picture, and trees on the right."""

    taxonomy = Taxonomy({3: "car", 184: "tree-merged"})

    def __call__(self, photos: Sequence[np.ndarray], /) -> list[Segmented]:
        found = []
        for photo in photos:
            ids = np.full(photo.shape[:2], 184, np.int16)
            ids[:, : photo.shape[1] // 2] = 3
            found.append(Segmented(ids))
        return found


@pytest.mark.parametrize("kind", ["hf", "onnx", "text"])
def test_networks_segment_the_renders_and_their_label_images_vote(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: Any
) -> None:
    """A splat alone: no photos, no labels; its renders are segmented."""
    factory = replace(SEGMENTERS[kind], load=lambda *_: _Halves(), settings=lambda config: {})
    monkeypatch.setitem(SEGMENTERS, kind, factory)
    write_ply(tmp_path / "ball.ply", _ball(labels=False))
    masks = MasksConfig(segmenter=kind, prompts="car" if kind == "text" else "")
    job = Job(RunDir(tmp_path / "run"), lambda event: None, "cpu")
    open_splat(job, tmp_path / "ball.ply", SMALL, SceneConfig(), masks, LabelsConfig())
    assert job.load_last_level().counts().keys() >= {3, 184}
    view = job.scene.views[job.scene.train_ids[0]]
    assert view.image_path.is_relative_to(tmp_path / "run" / "capture")


def test_merged_categories_take_their_instances_along(tmp_path: Path) -> None:
    ids = torch.tensor([62, 201, 202, 202], dtype=torch.int16).repeat(100)
    names, parents = {62: "chair", 201: "chair 1", 202: "chair 2"}, {201: "chair", 202: "chair"}
    write_splat(tmp_path / "ball.ply", replace(_ball(), label_ids=ids), names, parents=parents)
    job = Job(RunDir(tmp_path / "run"), lambda event: None, "cpu")
    labels = LabelsConfig(merge="chair=seat,chair 1=seat")
    open_splat(job, tmp_path / "ball.ply", SMALL, SceneConfig(), MasksConfig(), labels)
    assert job.parents == {"chair 2": "seat"}


def test_a_category_that_nothing_shows_is_unlabelled_and_said(tmp_path: Path) -> None:
    g = _ball()
    labels = torch.full_like(g.label_ids, 3)
    labels[:5] = 200
    means, faint = g.means.clone(), g.logit_opacities.clone()
    means[:5], faint[:5] = 0, -6  # too faint to be seen within the others
    write_ply(
        tmp_path / "ball.ply",
        replace(g, means=means, logit_opacities=faint, label_ids=labels),
        {3: "car", 200: "inside"},
    )
    job, events = _levels(tmp_path, tmp_path / "ball.ply", SMALL)
    counts = job.ladder.load(job.ladder.levels[-1]).counts()
    assert counts[3] == len(g) - 5
    assert counts[-1] == 1  # what nothing shows of the others is not sent
    assert any("5 Gaussians" in str(event) for event in events if isinstance(event, Warned))


def test_one_gaussian(tmp_path: Path) -> None:
    g = random_gaussians(1, degree=0, log_scale=-0.5, logit=3.0)
    write_ply(tmp_path / "few.ply", replace(g, label_ids=torch.full_like(g.label_ids, -1)))
    job, _ = _levels(tmp_path, tmp_path / "few.ply", SMALL)
    assert job.ladder.size(job.ladder.levels[-1]) == 1
