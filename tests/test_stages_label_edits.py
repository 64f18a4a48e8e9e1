"""Edits of labels applied to a finished run."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import SMALL_RUN, job_of

import sagesplat
from sagesplat.adapt.ladder import NestedLadder
from sagesplat.adapt.observe import TOTAL, Observations, distances_in_views, observe
from sagesplat.core.config import FitConfig, LabelsConfig, RunConfig, TrainConfig
from sagesplat.core.errors import LabelError, RunError
from sagesplat.core.events import Event, StageSkipped, StageStarted
from sagesplat.demo.capture import make_capture
from sagesplat.formats.label_edits import (
    Full,
    Hide,
    LabelEdits,
    Merge,
    Operation,
    Rename,
    Split,
    Weigh,
    dump_edits,
    ladder_hash,
)
from sagesplat.run.run_dir import RunDir
from sagesplat.segment.masks import Taxonomy
from sagesplat.segment.relabel import relabelled
from sagesplat.stages import block_levels, pipeline
from sagesplat.stages.label_edits import LabelsApplied, apply_labels
from sagesplat.stages.observe import observed_views
from sagesplat.stages.results import fidelity_of, increments_of, observations_of, sampled_of, viewpoints_of
from sagesplat.stages.sample import measured_levels

CAR, TREE = "car", "tree-merged"


def edited(run: Path, viewer: Path, *operations: Operation) -> LabelsApplied:
    job = job_of(run)
    edits = LabelEdits(ladder_hash(increments_of(job), job.names()), operations)
    (run / "labels.edit.json").write_bytes(dump_edits(edits))
    return apply_labels(job, viewer=viewer)


def ladder_of(path: Path) -> NestedLadder:
    ladder = job_of(path).ladder
    assert isinstance(ladder, NestedLadder)
    return ladder


def labels_of(path: Path) -> set[int]:
    return {label for label, _ in ladder_of(path).counts}


def sizes_of(ladder: NestedLadder, label: int) -> tuple[int, ...]:
    return tuple(ladder.counts[label, level] for level in ladder.levels)


@pytest.fixture(scope="module")
def in_cells(finished_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run whose categories have several cells."""
    path = tmp_path_factory.mktemp("cells") / "run"
    shutil.copytree(finished_run, path)
    (path.parent / "capture").symlink_to((finished_run.parent / "capture").resolve())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sagesplat.train.cells.FEWEST", 12)
        config = replace(SMALL_RUN, nest=replace(SMALL_RUN.nest, cells=6))
        pipeline.run_all(replace(job_of(path), force=True), finished_run.parent / "capture", config)
    assert len(job_of(path).cells.ids) > 4
    return path


def manifest_of(made: LabelsApplied) -> dict:
    return json.loads((made.bundle.path / "manifest.json").read_text())


def later_commands(path: Path) -> list[tuple[str, str]]:
    """What the commands from observe on do with a run: the stage, and whether it is skipped or begun."""
    told: list[Event] = []
    pipeline.measure_and_plan(job_of(path, told.append), recorded(path))
    return [(type(e).__name__, e.name) for e in told if isinstance(e, StageStarted | StageSkipped)]


def recorded(path: Path) -> RunConfig:
    from sagesplat.run.recorded import recorded_settings

    known = recorded_settings(RunDir(path))
    return replace(RunConfig(), **{name: known[name] for name in ("fit", "sample", "plan")})


def test_names_and_settings_move_no_gaussian(run: Path, viewer: Path) -> None:
    made = edited(
        run, viewer, Rename(CAR, "Ma voiture"), Hide("Ma voiture", True), Weigh(TREE, 3), Full(TREE, True)
    )
    assert not made.trained
    assert set(made.categories) == {"Ma voiture", TREE}
    for name in ("ladder.npz", "fidelity.json", "promises.json", "observations.csv", "plan.json"):
        assert (made.path / "nested" / name).read_bytes() == (run / "nested" / name).read_bytes()
    labels = {one["name"]: one for one in manifest_of(made)["labels"]}
    assert labels["Ma voiture"]["hidden"]
    assert "hidden" not in labels[TREE]
    assert labels[TREE]["weight"] == 3
    assert labels[TREE]["always"]


def test_later_commands_find_the_edited_run_done(run: Path, viewer: Path) -> None:
    made = edited(run, viewer, Rename(CAR, "auto"), Merge(TREE, "auto"))
    done = later_commands(made.path)
    assert [("StageSkipped", stage) for stage in ("observe", "sample", "fit", "plan")] == done[:4]
    with pytest.raises(RunError, match="made by editing"):
        block_levels.nest_scene(job_of(made.path), RunConfig().nest, 0)


def test_a_merged_category_has_the_levels_of_its_parts(run: Path, viewer: Path) -> None:
    made = edited(run, viewer, Merge(TREE, CAR))
    assert not made.trained
    before, after = ladder_of(run), ladder_of(made.path)
    assert labels_of(made.path) == {3}
    for level in before.levels:
        assert after.counts[3, level] == before.counts[3, level] + before.counts[184, level]
        # a stream of its own rounds positions within half a step: the levels show the same Gaussians
        old = np.sort(before.load(level, [3, 184]).means.numpy(), axis=0)
        new = np.sort(after.load(level, [3]).means.numpy(), axis=0)
        assert np.abs(old - new).max() < 0.1
    assert [one["id"] for one in manifest_of(made)["labels"]] == [3]


def by_key(table: Observations) -> Observations:
    return table.select(np.lexsort((table.label_id, table.view, table.level)))


def test_merged_observations_are_those_that_rendering_measures(run: Path, viewer: Path) -> None:
    made = edited(run, viewer, Merge(TREE, CAR))
    before, job = job_of(run), job_of(made.path)
    told = by_key(observations_of(job))
    far = distances_in_views(job.scene, job.point_labels)
    how = {"valid": job.valid, "antialiased": job.antialiased, "backend": "cpu"}
    # with all categories at one level the Gaussians of the run are those of the merged category
    exact = by_key(observe(job.scene, job.photos, job.level_masks, before.ladder, far, **how))
    # its own stream has another grid, to which positions move by up to half a step (here 0.035)
    coded = by_key(observe(job.scene, job.photos, job.level_masks, job.ladder, far, **how))
    for name in ("label_id", "level", "view", "num_pixels", "distance"):
        np.testing.assert_array_equal(getattr(told, name), getattr(exact, name))
        np.testing.assert_array_equal(getattr(told, name), getattr(coded, name))
    np.testing.assert_allclose(told.ssim, exact.ssim, atol=1e-5)
    np.testing.assert_allclose(told.psnr, exact.psnr, atol=1e-4)
    np.testing.assert_allclose(told.ssim, coded.ssim, atol=5e-3)
    np.testing.assert_allclose(told.psnr, coded.psnr, atol=0.1)
    assert (told.label_id == TOTAL).any()
    assert 184 not in told.label_id


def test_a_split_is_exact(run: Path, viewer: Path) -> None:
    before = ladder_of(run)
    sizes = sizes_of(before, 3)
    chosen = [0, 2, *range(sizes[0], sizes[0] + 3), sizes[-1] - 1]
    runs = ((0, 1), (2, 1), (sizes[0], 3), (sizes[-1] - 1, 1))
    made = edited(run, viewer, Split(CAR, "left car", {CAR: runs}))
    assert made.trained
    after = ladder_of(made.path)
    (new,) = labels_of(made.path) - labels_of(run)
    assert job_of(made.path).names()[new] == "left car"
    old = before.load(before.levels[-1], [3]).means.numpy()
    part = after.load(after.levels[-1], [new]).means.numpy()
    np.testing.assert_allclose(np.sort(part, 0), np.sort(old[chosen], 0), atol=1e-5)
    for level, size in enumerate(sizes, 1):
        assert after.counts[new, level] == sum(rank < size for rank in chosen)
        assert after.counts[new, level] + after.counts[3, level] == size
    assert torch.equal(before.load(1, [184]).means, after.load(1, [184]).means)  # its file is the same
    sampled = sampled_of(job_of(made.path))
    assert sampled.labels == tuple(job_of(made.path).cells.ids.tolist())
    assert new in job_of(made.path).cells.labels


def test_parts_are_measured_as_everything_is(run: Path, viewer: Path) -> None:
    """Only parts of images are rendered for them; the rest is taken from the run."""
    made = edited(run, viewer, Split(CAR, "left car", {CAR: ((20, 30),)}))
    job, config = job_of(made.path), FitConfig()
    told, measured = by_key(observations_of(job)), by_key(observed_views(job, config))
    for name in ("label_id", "level", "view", "num_pixels", "distance"):
        np.testing.assert_array_equal(getattr(told, name), getattr(measured, name))
    parts = np.isin(told.label_id, [3, 201])
    for name, tolerance in (("ssim", 3e-4), ("ssim_eroded", 3e-4), ("psnr", 0.01)):
        one, other = getattr(told, name), getattr(measured, name)
        np.testing.assert_array_equal(one[parts], other[parts])
        # at level 3 the left car is complete, so that it has the opacities of the full model there
        exact = told.level != 3
        np.testing.assert_allclose(one[exact], other[exact], atol=tolerance)  # back within float32
        np.testing.assert_allclose(one, other, atol=60 * tolerance)
    drawn, told = viewpoints_of(job), sampled_of(job)
    measured = measured_levels(job, [drawn.cameras[row] for row in drawn.rows("fit")])
    np.testing.assert_allclose(np.delete(told.whole, 2, -1), np.delete(measured.whole, 2, -1), atol=1e-4)
    np.testing.assert_allclose(told.whole, measured.whole, atol=0.02)
    parts = np.isin(job.cells.labels, [3, 201])
    np.testing.assert_array_equal(told.pixels[:, parts], measured.pixels[:, parts])
    np.testing.assert_array_equal(told.fidelity[:, parts], measured.fidelity[:, parts])


def test_ranks_stay_those_of_the_run_after_a_merge(run: Path, viewer: Path) -> None:
    operations: Sequence[Operation] = (
        Merge(CAR, TREE), Split(TREE, "both", {CAR: ((0, 40),), TREE: ((1, 2),)}), Rename("both", "mixed"),
    )  # fmt: skip
    made = edited(run, viewer, *operations)
    after = ladder_of(made.path)
    (new,) = labels_of(made.path) - {184}
    assert sizes_of(after, new)[-1] == 42
    assert job_of(made.path).names()[new] == "mixed"
    assert fidelity_of(job_of(made.path))


def test_levels_of_merged_and_split_cells_are_those_of_before(in_cells: Path, viewer: Path) -> None:
    before, old = ladder_of(in_cells), job_of(in_cells)
    first, *_, last = before.cells_of(3)
    count = before.cells.sizes[last][-1]
    start = sizes_of(before, 3)[-1] - count  # ranks go through the cells, one after the other
    operations = Split(CAR, "part", {CAR: ((start + 1, count - 1),)}), Merge(TREE, CAR)
    made = edited(in_cells, viewer, *operations)
    after, job = ladder_of(made.path), job_of(made.path)
    (new,) = labels_of(made.path) - {3, -1}
    assert sizes_of(after, new)[-1] == count - 1
    assert sorted(job.cells.ids.tolist()) == list(range(len(old.cells.ids) + 1))
    assert len(after.cells_of(3)) == len(before.cells_of(3)) + len(before.cells_of(184))
    # grids stay those of the old cells, so nothing moves
    for level in before.levels:
        one, other = (np.sort(ladder.load(level).means.numpy(), 0) for ladder in (before, after))
        np.testing.assert_allclose(one, other, atol=1e-6)
    # whole cells keep what was measured, and where they are
    theirs, mine = sampled_of(old), sampled_of(job)
    a, b = theirs.labels.index(first), mine.labels.index(after.cells_of(3)[0])
    np.testing.assert_array_equal(theirs.fidelity[:, a], mine.fidelity[:, b])
    np.testing.assert_array_equal(old.cells.points()[a], job.cells.points()[b])
    models = fidelity_of(job)
    assert {cell.cell for cell in models[3].cells} == set(after.cells_of(3))
    assert increments_of(job)


def test_models_of_other_categories_follow_their_cells(in_cells: Path, viewer: Path) -> None:
    made = edited(in_cells, viewer, Merge(TREE, "unlabelled"))  # whose cells are now numbered first
    before, after = (job_of(path) for path in (in_cells, made.path))
    moved = ladder_of(made.path).cells_of(3)
    assert [cell - len(ladder_of(made.path).cells_of(-1)) for cell in moved] == before.cells.ids.tolist()[:-1]
    pairs = zip(fidelity_of(before)[3].cells, fidelity_of(after)[3].cells, strict=True)
    for cell, (one, other) in zip(moved, pairs, strict=True):
        assert other.cell == cell
        np.testing.assert_array_equal(one.offsets, other.offsets)
    files = [{one.uri for one in increments_of(job) if one.label_id == 3} for job in (before, after)]
    assert files[0] == files[1]


def test_scripts_apply_edits(run: Path, tmp_path: Path) -> None:
    job = job_of(run)
    ladder = ladder_hash(increments_of(job), job.names())
    (tmp_path / "mine.json").write_bytes(dump_edits(LabelEdits(ladder, (Rename(CAR, "auto"),))))
    told: list[Event] = []
    made = sagesplat.apply_labels(
        str(run), tmp_path / "mine.json", tmp_path / "out", on_event=told.append, backend="cpu", threads=1
    )
    assert made.names[3] == "auto"
    assert (made.job.run.path / "bundle" / "manifest.json").exists()
    assert told
    with pytest.raises(LabelError, match=r"none\.json: cannot be read"):
        sagesplat.apply_labels(run, tmp_path / "none.json")


def test_an_edited_run_is_edited_again(run: Path, viewer: Path) -> None:
    first = edited(run, viewer, Rename(CAR, "auto"), Weigh("auto", 2))
    second = edited(first.path, viewer, Merge("auto", TREE), Weigh(TREE, 4))
    assert second.path.name == "run-edited-edited"
    assert {one["name"]: one["weight"] for one in manifest_of(second)["labels"]}[TREE] == 4


@pytest.mark.parametrize(
    ("operations", "why"),
    [
        ([Rename("cart", "auto")], "no category 'cart'; did you mean car?"),
        ([Rename(CAR, TREE)], "is taken"),
        ([Merge(CAR, "unlabelled"), Merge(TREE, "unlabelled")], "leave no category"),
        ([Split(CAR, "all", {CAR: ((0, 10**6),)})], "has .* Gaussians"),
    ],
)
def test_impossible_edits_are_one_line(
    run: Path, viewer: Path, operations: list[Operation], why: str
) -> None:
    with pytest.raises(LabelError, match=why):
        edited(run, viewer, *operations)
    assert not (run.parent / "run-edited").exists()


def test_a_name_that_only_label_images_have_is_taken(run: Path, viewer: Path) -> None:
    path = run / "masks" / "labels.json"
    Taxonomy({**Taxonomy.read(path).names, 9: "boat"}).write(path)
    with pytest.raises(LabelError, match=r"labels\.edit\.json: the name 'boat' is that of a category that"):
        edited(run, viewer, Rename(CAR, "boat"))
    assert not (run.parent / "run-edited").exists()


def test_edits_of_another_run(run: Path, viewer: Path) -> None:
    (run / "labels.edit.json").write_bytes(dump_edits(LabelEdits("0" * 64, (Rename(CAR, "auto"),))))
    with pytest.raises(LabelError, match="edits of another run"):
        apply_labels(job_of(run), viewer=viewer)


def test_other_folders_are_left_alone(run: Path, viewer: Path, tmp_path: Path) -> None:
    (tmp_path / "run-edited").mkdir()
    (tmp_path / "run-edited" / "mine.txt").write_text("mine")
    with pytest.raises(RunError, match="neither empty nor an edited run"):
        edited(run, viewer, Rename(CAR, "auto"))
    with pytest.raises(RunError, match="the run itself"):
        apply_labels(job_of(run), out=run, viewer=viewer)
    with pytest.raises(RunError, match="not a run folder"):
        apply_labels(job_of(tmp_path / "run-edited"), viewer=viewer)


@pytest.mark.slow
def test_instances_keep_their_category_through_edits(tmp_path: Path, viewer: Path) -> None:
    make_capture(tmp_path / "capture", views=16, width=80, height=60)
    config = replace(
        SMALL_RUN,
        labels=LabelsConfig(instances="potted plant,vase"),
        train=TrainConfig(max_steps=60, level_every=60),
    )
    run = tmp_path / "run"
    pipeline.run_all(job_of(run), tmp_path / "capture", config)
    before = job_of(run)
    plants = sorted(name for name, parent in before.parents.items() if parent == "potted plant")
    made = edited(run, viewer, Rename("vase 1", "urn"), Hide("urn", True), Merge(plants[1], plants[0]))
    after = job_of(made.path)
    assert not after.run.has_instances  # its label images are those of the instances
    assert after.parents["urn"] == "vase"
    assert after.parents[plants[0]] == "potted plant"
    assert plants[1] not in {*after.parents, *after.names().values()}
    labels = {one["name"]: one.get("parent") for one in manifest_of(made)["labels"]}
    assert (labels["urn"], labels[plants[0]]) == ("vase", "potted plant")
    ids = {name: i for i, name in after.names().items()}
    view = before.scene.views[0]
    old = {name: i for i, name in before.names().items()}
    mine = np.isin(before.level_masks[view], [old[name] for name in plants[:2]])
    assert np.array_equal(after.level_masks[view] == ids[plants[0]], mine)
    assert [("StageSkipped", stage) for stage in ("observe", "sample", "fit", "plan")] == later_commands(
        made.path
    )[:4]


def test_the_parents_of_edited_names() -> None:
    names = {1: "chair", 2: "chair 1", 3: "chair 2", 4: "table 1"}
    before = {"chair 1": "chair", "chair 2": "chair", "table 1": "table"}
    counts = dict.fromkeys(names, 4)

    def parents(*operations: Operation) -> dict[str, str]:
        return relabelled(names, counts, operations).parents(before, names)

    assert parents(Rename("chair 1", "throne")) == {"throne": "chair", "chair 2": "chair", "table 1": "table"}
    assert parents(Rename("chair", "seat"))["chair 1"] == "seat"
    assert parents(Merge("chair 2", "chair 1")) == {"chair 1": "chair", "table 1": "table"}
    assert parents(Merge("table 1", "chair 1")) == {"chair 2": "chair"}
    assert parents(Merge("chair 1", "chair")) == {"chair 2": "chair", "table 1": "table"}
