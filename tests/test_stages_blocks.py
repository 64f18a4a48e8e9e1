"""Large scenes: the partition, the scene of a block, merging, and a full run in blocks."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import job_of, random_gaussians
from hypothesis import given, settings
from hypothesis import strategies as st
from test_run_executor import Shuffled

from sagesplat.adapt.cells import read_cells
from sagesplat.adapt.ladder import read_ladder, read_prefixes
from sagesplat.core.config import (
    BlocksConfig,
    FitConfig,
    LabelsConfig,
    MasksConfig,
    NestConfig,
    PlanConfig,
    RunConfig,
    SampleConfig,
    SceneConfig,
    TrainConfig,
)
from sagesplat.core.errors import DataError, RunError, SceneError
from sagesplat.core.events import Event, StageDone, StageSkipped
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.demo.capture import make_capture
from sagesplat.formats.label_edits import Hide, LabelEdits, Merge, dump_edits, ladder_hash
from sagesplat.formats.levels import write_set
from sagesplat.io.files import read_json
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.scene import load_scene
from sagesplat.scene.blocks import (
    assigned_views,
    graph_colouring,
    read_blocks,
    split,
    training_scene,
    visible_shares,
    write_blocks,
)
from sagesplat.scene.scene import Camera, Lens, Points, Scene, View
from sagesplat.scene.stored import read_scene, write_scene
from sagesplat.segment.masks import Taxonomy
from sagesplat.stages.block_levels import nest_scene
from sagesplat.stages.bundle_contents import bundle_contents
from sagesplat.stages.instances import make_instances
from sagesplat.stages.label_edits import apply_labels
from sagesplat.stages.live_bundle import live_bundle
from sagesplat.stages.pipeline import run_all
from sagesplat.stages.results import increments_of
from sagesplat.stages.shared import labels_named
from sagesplat.train import boundaries


def street(places: int = 4, points: int = 200, views: int = 12, seed: int = 0, tracks: bool = True) -> Scene:
    """Clouds of points 10 apart along a slanted line, each with cameras around it that look at it."""
    rng = np.random.default_rng(seed)
    along = np.array([0.8, 0.1, 0.6]) / np.linalg.norm([0.8, 0.1, 0.6])
    up = np.array([0.0, -1.0, 0.0])
    centres = 10 * np.arange(places)[:, None] * along
    xyz = np.concatenate([c + rng.normal(size=(points, 3)) * [1.5, 0.4, 1.5] for c in centres])
    K = np.array([[60, 0, 32], [0, 60, 24], [0, 0, 1]], np.float32)
    found = []
    for place, centre in enumerate(centres):
        for i, angle in enumerate(2 * np.pi * np.arange(views) / views):
            position = centre + 4 * np.array([np.cos(angle), -0.3, np.sin(angle)])
            z = (centre - position) / np.linalg.norm(centre - position)
            x = np.cross(-up, z)
            x /= np.linalg.norm(x)
            w2c = np.eye(4)
            w2c[:3, :3] = [x, np.cross(z, x), z]
            w2c[:3, 3] = -w2c[:3, :3] @ position
            camera = Camera(w2c.astype(np.float32), K, 64, 48)
            found.append(View(f"p{place}/v{i:02d}.png", camera, Path(f"/photos/p{place}/v{i:02d}.png")))
    of_point = np.repeat(np.arange(places), points)
    seen = rng.integers(0, views, (len(xyz), 3)) + views * of_point[:, None]
    rows = np.repeat(np.arange(len(xyz)), 3) if tracks else np.zeros(0, int)
    columns = seen.ravel() if tracks else np.zeros(0, int)
    uv = rng.uniform(0, 48, (len(rows), 2)).astype(np.float32)
    rgb = rng.integers(0, 255, (len(xyz), 3)).astype(np.uint8)
    tracked = Points(xyz.astype(np.float32), rgb, rows.astype(np.int64), columns.astype(np.int32), uv)
    return Scene("street", Path("/photos"), tuple(found), tracked, 8, 4)


@settings(max_examples=25)
@given(count=st.integers(2, 7), seed=st.integers(0, 9))
def test_blocks_tile_the_plane_and_share_the_work(count: int, seed: int) -> None:
    scene = street(seed=seed)
    blocks = split(scene, count)
    far = np.random.default_rng(seed).normal(size=(500, 3)) * 100
    for xyz in (scene.points.xyz, far):
        inside = np.stack([blocks.within(xyz, b, 0.0) for b in range(count)])
        np.testing.assert_array_equal(inside.sum(0), 1)  # no gap, no overlap
        np.testing.assert_array_equal(inside.argmax(0), blocks.of(xyz))
    share = np.bincount(blocks.of(scene.points.xyz), minlength=count) / len(scene.points.xyz)
    positions = np.stack([scene.views[i].camera.position for i in scene.train_ids])
    of_views = np.bincount(blocks.of(positions), minlength=count) / len(positions)
    assert (share + of_views).max() < 2 * (share + of_views).min() + 0.2
    assert (blocks.to_border(far) >= 0).all()
    near = blocks.neighbours()
    assert (near == near.T).all()
    assert not near.diagonal().any()
    shades = graph_colouring(near)
    assert all(shades[a] != shades[b] for a, b in zip(*near.nonzero(), strict=True))


def test_cuts_go_between_places() -> None:
    scene = street(places=4)
    blocks = split(scene, 4)
    of_place = blocks.of(scene.points.xyz).reshape(4, -1)
    assert {tuple(set(row.tolist())) for row in of_place} == {(b,) for b in of_place[:, 0].tolist()}
    assert len(set(of_place[:, 0].tolist())) == 4
    normal = np.cross(*blocks.axes)
    assert abs(normal[1]) > 0.95  # up in the photos, though all places are on one line


def test_views_are_for_the_blocks_that_they_see() -> None:
    scene = street(places=2, views=10)
    blocks = split(scene, 2)
    of_points = blocks.of(scene.points.xyz)
    shares = visible_shares(scene, of_points, 2)
    np.testing.assert_allclose(shares.sum(1), 1)
    assigned = assigned_views(scene, blocks, shares)
    assert assigned.any(1).all()
    own = np.array([of_points[0] if v.name.startswith("p0") else of_points[-1] for v in scene.views])
    assert assigned[np.arange(20), own].all()
    blind = visible_shares(street(places=2, views=10, tracks=False), of_points, 2)
    assert (blind[np.arange(20), own] > 0.3).all()  # by the frusta, that reach into the other place
    assert blind[np.arange(20), own].mean() > 0.8


def test_a_part_keeps_its_points_and_some_of_the_background(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sagesplat.scene.blocks._FAR_SHARE", 0.1)
    scene = street(places=2, views=10)
    wide = replace(scene.views[0], camera=scene.views[15].camera)  # one camera looks at the other place
    seen = np.zeros(50, np.int32)
    far = np.flatnonzero(np.arange(400) >= 200)[:50]
    points = replace(
        scene.points,
        track_points=np.concatenate([scene.points.track_points, far]),
        track_views=np.concatenate([scene.points.track_views, seen]),
        track_uv=np.concatenate([scene.points.track_uv, np.zeros((50, 2), np.float32)]),
    )
    scene = replace(scene, points=points, views=(wide, *scene.views[1:]))
    blocks = split(scene, 2)
    mine = int(blocks.of(scene.points.xyz[:1])[0])
    views = [0, 1, 2, 3, 9]
    part, kept = training_scene(scene, blocks, mine, views, seed=0)
    near = blocks.within(scene.points.xyz, mine, blocks.margin)
    assert near[kept].sum() == near.sum()
    assert 0 < (~near[kept]).sum() <= 0.1 * near.sum()
    np.testing.assert_array_equal(part.points.xyz, scene.points.xyz[kept])
    assert [v.name for v in part.views] == [scene.views[i].name for i in views]
    assert part.train_ids.tolist() == [0, 1, 2, 3, 4]  # tests and calibration stay with the whole
    for point, view, uv in zip(
        part.points.track_points[:40], part.points.track_views[:40], part.points.track_uv[:40], strict=True
    ):
        was = (scene.points.track_points == kept[point]) & (scene.points.track_views == views[view])
        assert (scene.points.track_uv[was] == uv).all(1).any()
    same, _ = training_scene(scene, blocks, mine, views, seed=0)
    np.testing.assert_array_equal(same.points.xyz, part.points.xyz)
    with pytest.raises(RunError, match="has 0 views and"):
        training_scene(scene, blocks, mine, [], seed=0)


def test_partition_reads_back(tmp_path: Path) -> None:
    blocks = split(street(), 5)
    write_blocks(tmp_path / "blocks.json", blocks, views=[1, 2])
    back = read_blocks(tmp_path / "blocks.json")
    for name in ("axes", "low", "high", "margin"):
        np.testing.assert_array_equal(getattr(back, name), getattr(blocks, name))
    assert read_json(tmp_path / "blocks.json")["views"] == [1, 2]


def test_stored_scenes_read_back(tmp_path: Path) -> None:
    scene = street(places=2)
    lens = Lens("OPENCV", (60.0, 60.0, 32.0, 24.0, 0.1, 0.0, 0.0, 0.0), 128, 96)
    first = replace(scene.views[0], lens=lens, camera=replace(scene.views[0].camera, background=(9, 8, 7)))
    scene = replace(scene, views=(first, *scene.views[1:]))
    write_scene(tmp_path / "part.npz", scene)
    back = load_scene(tmp_path / "part.npz", test_every=3)  # the splits are those that it was stored with
    for name in ("train_ids", "test_ids", "calibration_ids"):
        np.testing.assert_array_equal(getattr(back, name), getattr(scene, name))
    for a, b in zip(back.views, scene.views, strict=True):
        assert (a.name, a.image_path) == (b.name, b.image_path)
        assert (a.lens and vars(a.lens)) == (b.lens and vars(b.lens))
        assert (a.camera.width, a.camera.height, a.camera.background) == (64, 48, b.camera.background)
        np.testing.assert_array_equal(a.camera.w2c, b.camera.w2c)
        np.testing.assert_array_equal(a.camera.K, b.camera.K)
    for name in ("xyz", "rgb", "track_points", "track_views", "track_uv"):
        np.testing.assert_array_equal(getattr(back.points, name), getattr(scene.points, name))


def test_broken_stored_scenes(tmp_path: Path) -> None:
    path = tmp_path / "part.npz"
    with pytest.raises(SceneError, match="no such file"):
        read_scene(path)
    write_scene(path, street(places=1))
    with np.load(path) as file:
        good = dict(file)
    for changes in (
        {"about": np.array("[]")},
        {"K": good["K"] * np.nan},
        {"rgb": good["rgb"][:-1]},
        {"track_points": good["track_points"] + 10**6},
    ):
        np.savez(path, **{**good, **changes})
        with pytest.raises(SceneError, match="not a stored scene"):
            read_scene(path)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(SceneError, match="not a stored scene"):
        read_scene(path)


def block_levels(count: int, seed: int, label_of: dict[int, int]) -> boundaries.BlockLevels:
    """Levels of as many Gaussians in these cells, with second opacities."""
    cells = torch.tensor(sorted(label_of), dtype=torch.int16).repeat_interleave(count // len(label_of))
    g = replace(random_gaussians(len(cells), seed=seed), label_ids=cells)
    sizes = {cell: (2, 7, n) for cell, n in g.counts().items()}
    second = SecondOpacities.of_levels(g.logit_opacities - 1, sizes)
    return boundaries.BlockLevels(g, sizes, label_of, second)


def test_the_interior_of_a_block_keeps_order_and_levels(tmp_path: Path) -> None:
    whole = block_levels(60, 3, {0: -1, 1: 3, 2: 3, 3: 184})
    inside = np.random.default_rng(0).random(60) < 0.6
    inside[:15] = False  # all of a cell
    boundaries.write_block(tmp_path / "interior.npz", whole.select(inside), 5)
    own = boundaries.read_block(tmp_path / "interior.npz")
    torch.testing.assert_close(own.gaussians.means, whole.gaussians.means[torch.from_numpy(inside)])
    assert own.label_of == {1: 3, 2: 3, 3: 184}
    for cell, (low, middle, last) in own.sizes.items():
        mine = inside[15 * cell : 15 * cell + 15]
        assert (low, middle, last) == (max(1, mine[:2].sum()), max(1, mine[:7].sum()), mine.sum())
    assert own.second is not None
    assert whole.second is not None
    assert own.second.weights == {cell: whole.second.weights[cell] for cell in own.sizes}
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({}, "no labels in it"),
        ({"labels": [3, 184]}, "not the labels of 3"),
        ({"labels": [3, 3, 40_000]}, "not the labels"),
    )
    for more, message in cases:
        write_set(tmp_path / "other.npz", own.gaussians, 5, own.sizes, **more)
        with pytest.raises(DataError, match=message):
            boundaries.read_block(tmp_path / "other.npz")


def test_cells_of_merged_blocks_are_numbered_by_category() -> None:
    parts = block_levels(20, 1, {0: 3, 1: 184}), block_levels(30, 2, {0: -1, 1: 3, 2: 3})
    both = boundaries.merged(parts)
    assert both.label_of == {0: -1, 1: 3, 2: 3, 3: 3, 4: 184}
    assert both.gaussians.label_ids.tolist() == [1] * 10 + [4] * 10 + [0] * 10 + [2] * 10 + [3] * 10
    assert both.sizes == {1: (2, 7, 10), 4: (2, 7, 10), 0: (2, 7, 10), 2: (2, 7, 10), 3: (2, 7, 10)}
    assert both.second is not None
    assert set(both.second.weights) == set(both.label_of)
    torch.testing.assert_close(both.full.logit_opacities, both.gaussians.logit_opacities - 1)
    torch.testing.assert_close(both.gaussians.means[20:], parts[1].gaussians.means)


def test_bands_are_measured_apart() -> None:
    band = np.zeros((4, 4), bool)
    band[0] = True
    error = np.where(band, 0.01, 0.0001)
    found = boundaries.bands([band, band], [error, error], [1 - error, 1 - error])
    assert found.share == 0.25
    assert (found.psnr, found.psnr_inside) == (pytest.approx(20), pytest.approx(40))
    assert (found.ssim, found.ssim_inside) == (pytest.approx(0.99), pytest.approx(0.9999))


CONFIG = RunConfig(
    scene=SceneConfig(calibrate_every=4),
    train=TrainConfig(max_steps=40, level_every=20, sh_degree=1),
    blocks=BlocksConfig(count=2),
    nest=NestConfig(steps=12, levels=4, smallest=0.1, base_steps=12),
    fit=FitConfig(),
    sample=SampleConfig(views=8, calibration_views=8),
    plan=PlanConfig(target_ssim=0.4, other_targets=()),
)


def run_in_blocks(capture: Path, run: Path, config: RunConfig = CONFIG, **options) -> list[Event]:
    events: list[Event] = []
    run_all(Job(RunDir(run, config.ladder), events.append, "cpu", **options), capture, config)
    return events


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "capture"
    make_capture(folder, views=16, width=64, height=48)
    return folder


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("blocks") / "run"
    run_in_blocks(capture, run)
    return run


def blocks_of_cells(run: RunDir) -> dict[int, int]:
    """The block that each cell of a run is of: where most of its Gaussians are."""
    blocks, g = read_blocks(run.division), read_prefixes(run.prefixes).gaussians
    at, found = blocks.of(g.means.numpy()), {}
    for cell in g.counts():
        found[cell] = int(np.bincount(at[g.label_ids.numpy() == cell]).argmax())
    return found


def test_a_run_in_blocks(finished: Path, capture: Path) -> None:
    run = RunDir(finished)
    names = Taxonomy.read(run.masks / "labels.json").names
    ladder, snapshots, cells = read_prefixes(run.prefixes), read_ladder(run.levels), read_cells(run.cells)
    assert snapshots.levels == [20, 40]
    assert {label for label, _ in snapshots.counts} <= {-1, *names}
    assert set(ladder.sizes) == set(cells.label_of)
    assert list(cells.labels) == sorted(cells.labels)
    # each cell is in one block: those that were tuned may have moved a little
    blocks, of_cells = read_blocks(run.division), blocks_of_cells(run)
    assert len({(label, of_cells[cell]) for cell, label in cells.label_of.items()}) > len(set(cells.labels))
    g = ladder.gaussians
    own = np.array([of_cells[cell] for cell in g.label_ids.tolist()])
    beyond = blocks.to_border(g.means.numpy())[blocks.of(g.means.numpy()) != own]
    assert len(beyond) < 0.05 * len(g)
    assert (beyond < blocks.margin / 2).all()
    # a category is one thing: one file, one model, one promise
    chunks = read_json(run.increments / "index.json")["chunks"]
    assert {row["cell"] for row in chunks} == set(ladder.sizes)
    assert len({row["uri"] for row in chunks}) == len(set(cells.labels))
    assert set(Job(run, print).names()) == {-1, *names}
    contents = bundle_contents(Job(run, print), g, cells, False)
    assert len({one.title for one in contents.categories}) == len(contents.categories)
    assert (run.adapted / "borders.csv").read_text().count("\n") == 3
    assert "| block |" in (run.adapted / "blocks.md").read_text()
    assert read_json(run.plan)["scene"]


@pytest.mark.slow
def test_blocks_share_the_cells_that_are_wanted(finished: Path, tmp_path: Path) -> None:
    path = tmp_path / "run"
    shutil.copytree(finished, path)
    few = replace(CONFIG.nest, steps=8, levels=2, base_share=0.0)
    found = []
    for wanted in (0, 24):
        nest_scene(job_of(path, force=True), replace(few, cells=wanted), 0)
        found.append(len(read_cells(RunDir(path).cells).ids))
    pairs, cells = found
    assert pairs < cells <= 24 + pairs


def test_a_run_in_blocks_is_done_once(finished: Path, capture: Path) -> None:
    events = run_in_blocks(capture, finished)
    assert not [e for e in events if isinstance(e, StageDone)]
    assert sum(isinstance(e, StageSkipped) for e in events) == 15


@pytest.mark.slow
def test_blocks_are_the_same_in_any_order_and_process(finished: Path, capture: Path, tmp_path: Path) -> None:
    executor = Shuffled()
    run_in_blocks(capture, tmp_path / "again", executor=executor)
    assert {"block 0", "block 1", "boundaries of block 0", "boundaries of block 1"} <= set(executor.names)
    for name in ("nested/ladder.npz", "nested/observations.csv", "nested/plan.json", "nested/borders.csv"):
        assert (tmp_path / "again" / name).read_bytes() == (finished / name).read_bytes(), name


@pytest.mark.slow
def test_instances_of_blocks(finished: Path, tmp_path: Path, viewer: Path) -> None:
    path = tmp_path / "run"
    shutil.copytree(finished, path)
    before = job_of(path).names()
    make_instances(job_of(path), MasksConfig(), LabelsConfig(instances="potted plant"))
    few = replace(CONFIG.nest, steps=4, levels=2, base_share=0.0)
    nest_scene(job_of(path, force=True), few, 0)
    job = job_of(path)
    names, label_of, blocks = job.names(), job.cells.label_of, blocks_of_cells(job.run)
    found = {(names[label], blocks[cell]) for cell, label in label_of.items()}
    assert {"potted plant 1", "dining table"} <= {name for name, _ in found}
    assert {block for name, block in found if name in job.parents} == {0, 1}
    # pixels keep their category
    view = job.scene.views[0]
    was, now = job.category_masks[view], job.level_masks[view]
    parents = [job.parents.get(names[i], names[i]) for i in now.ravel().tolist()]
    assert parents == [names[i] for i in was.ravel().tolist()]
    # a category means all its instances
    plants = {label for label, name in names.items() if name.startswith("potted plant")}
    assert set(labels_named(job, ["potted plant"])) == plants
    assert [names[i] for i in labels_named(job, ["potted plant 1"])] == ["potted plant 1"]
    assert {job.parents_by_id.get(i) for i in plants} <= {None, "potted plant"}
    # the viewer's tree: category, instance
    contents = bundle_contents(job, job.by_cell.gaussians, job.cells, False)
    tree = {(c.parent, c.name) for c in contents.categories}
    assert {("potted plant", "potted plant 1"), (None, "dining table")} <= tree
    # snapshots have no instances, and they can be folded back
    assert Job(RunDir(path, "snapshots"), print).names() == before
    assert live_bundle(job_of(path), tmp_path / "live", viewer)
    live = read_json(tmp_path / "live" / "manifest.json")["labels"]
    assert {(one["id"], one["name"]) for one in live} <= set(before.items())
    make_instances(job_of(path, force=True), MasksConfig(), LabelsConfig())
    assert job_of(path).names() == before


@pytest.mark.slow
def test_categories_of_blocks_can_be_edited(finished: Path, tmp_path: Path, viewer: Path) -> None:
    job = job_of(finished)
    ids = {name: label for label, name in job.names().items()}
    edits = (Hide("dining table", True), Merge("vase", "potted plant"))
    (tmp_path / "labels.edit.json").write_bytes(
        dump_edits(LabelEdits(ladder_hash(increments_of(job), job.names()), edits))
    )
    made = apply_labels(job, tmp_path / "labels.edit.json", tmp_path / "out", viewer=viewer)
    labels = {one["name"]: one for one in read_json(made.bundle.path / "manifest.json")["labels"]}
    assert labels["dining table"]["hidden"]
    before = [label for label in job.cells.labels if label in (ids["vase"], ids["potted plant"])]
    assert len(labels["potted plant"]["cells"]) == len(before)
    assert "vase" not in labels


def test_a_run_keeps_its_blocks(finished: Path, capture: Path) -> None:
    whole = replace(CONFIG, blocks=BlocksConfig())
    with pytest.raises(RunError, match=r"this run is in blocks; add --blocks\.count"):
        run_in_blocks(capture, finished, whole)
    with pytest.raises(RunError, match=r"made with other count \(2 then, 3 now\)"):
        run_in_blocks(capture, finished, replace(CONFIG, blocks=BlocksConfig(count=3)))


@pytest.mark.slow
def test_snapshots_of_blocks(capture: Path, tmp_path: Path) -> None:
    config = replace(CONFIG, ladder="snapshots", fuse=True)
    events = run_in_blocks(capture, tmp_path / "run", config)
    assert any(isinstance(e, StageDone) and e.name == "report" for e in events)
    assert read_json(RunDir(tmp_path / "run", "snapshots").plan)["scene"]
