"""The sky on a far shell: where points begin, and that its Gaussians stay there, whatever trains them."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import SMALL_RUN, random_gaussians, write_capture
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from sagesplat.core.config import BlocksConfig, CleanConfig, TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import StageDone
from sagesplat.core.gaussians import PARAMETERS, concat
from sagesplat.formats.levels import read_level
from sagesplat.io.files import write_json
from sagesplat.run.job import Job
from sagesplat.run.records import uses
from sagesplat.run.run_dir import RunDir
from sagesplat.scene.images import Photos
from sagesplat.segment.masks import Masks, Taxonomy, mask_path
from sagesplat.segment.valid import ValidPixels
from sagesplat.stages.block_levels import nest_scene
from sagesplat.stages.blocks import train_scene
from sagesplat.stages.clean import clean_levels
from sagesplat.stages.label import lift_labels, make_masks
from sagesplat.stages.scene import open_scene
from sagesplat.train import densify, sky
from sagesplat.train.events import Trained
from sagesplat.train.lr_schedule import lr_schedule
from sagesplat.train.nested import order, train_capped
from sagesplat.train.sky import Shell, find_sky, read_sky, sky_labels, write_sky
from sagesplat.train.state import from_points, initial_state
from sagesplat.train.stepper import tune
from sagesplat.train.strategy import make_strategy
from sagesplat.train.trainer import train as train_gaussians

SKY, TREE = 187, 184
SHELL = Shell(np.array([0.5, -1.0, 2.0], np.float32), 30.0, 2.0, (SKY,))


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A scene whose photos show sky in their upper third, its photos and label images."""
    folder = tmp_path_factory.mktemp("sky") / "capture"
    scene = write_capture(folder, random_gaussians(120, degree=1, logit=2.0))
    (folder / "masks").mkdir()
    for view in scene.views:
        photo = np.array(Image.open(view.image_path))
        ids = np.full(photo.shape[:2], TREE, np.uint8)
        photo[:10], ids[:10] = (90, 140, 250), SKY
        Image.fromarray(photo).save(view.image_path)
        Image.fromarray(ids).save(folder / "masks" / view.name)
    names = {"labels": {str(SKY): "sky-other-merged", str(TREE): "tree-merged"}}
    write_json(folder / "masks" / "labels.json", names)
    return (
        scene,
        Photos(scene.views),
        Masks(folder / "masks", Taxonomy({SKY: names["labels"][str(SKY)], TREE: "tree"})),
    )


def of(capture) -> tuple[sky.Sky, np.ndarray]:
    scene, photos, masks = capture
    labels = np.full(len(scene.points.xyz), TREE, np.int16)
    labels[:5] = SKY
    found = find_sky(scene, photos, masks, labels)
    assert found is not None
    return found, labels


def off_shell(shell: Shell, means: torch.Tensor) -> float:
    """Largest distance from the sphere, as a share of its radius."""
    away = (means.double() - torch.from_numpy(shell.centre).double()).norm(dim=1)
    return float((away / shell.radius - 1).abs().max())


def test_names_of_the_sky():
    names = {1: "sky", 2: "sky-other-merged", 3: "Sky 2", 4: "skyscraper", 5: "skis", 6: "tree", 7: ""}
    assert sky_labels(Taxonomy(names)) == (1, 2, 3)


def test_points_begin_where_photos_show_sky(capture):
    scene, _, _ = capture
    found, labels = of(capture)
    assert off_shell(found.shell, torch.from_numpy(found.xyz)) < 1e-5
    assert np.linalg.norm(scene.points.xyz - found.shell.centre, axis=1).max() < found.shell.radius
    assert found.shell.scale >= 10
    for row in scene.train_ids:  # from every view its upper part is covered, in the sky's colour
        camera = scene.views[row].camera
        local = found.xyz @ camera.w2c[:3, :3].T + camera.w2c[:3, 3]
        uv = local[:, :2] / local[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
        shown = (local[:, 2] > 0) & (uv > 0).all(1) & (uv < [camera.width, 10]).all(1)
        cells = {(int(u // 8), int(v // 5)) for u, v in uv[shown]}
        assert len(cells) == 12
        assert np.abs(found.rgb[shown].astype(int) - [90, 140, 250]).max() <= 3
    more, ids = found.begin(scene, labels)
    assert (ids[len(labels) :] == SKY).all()
    assert np.array_equal(ids[: len(labels)], labels)
    assert off_shell(found.shell, torch.from_numpy(more.points.xyz[ids == SKY])) < 1e-5
    assert np.array_equal(more.points.xyz[5 : len(labels)], scene.points.xyz[5:])


def test_no_sky_no_shell(capture, tmp_path):
    scene, photos, masks = capture
    labels = np.full(len(scene.points.xyz), TREE, np.int16)
    assert (
        find_sky(scene, photos, Masks(masks.folder, Taxonomy({SKY: "water", TREE: "tree"})), labels) is None
    )
    for view in scene.views:
        Image.fromarray(np.uint8(255 * (np.indices((32, 48))[0] >= 10))).save(mask_path(tmp_path, view))
    assert find_sky(scene, photos, masks, labels, ValidPixels(tmp_path)) is None


def test_opacities_on_the_shell_are_not_reset(capture):
    found, labels = of(capture)
    scene, ids = found.begin(capture[0], labels)
    config = TrainConfig(max_steps=30_000, sh_degree=0, lr_schedule="published")
    strategy = make_strategy(config, scene, lr_schedule(config, 1.0, []), shell=found.shell)
    state = initial_state(from_points(scene.points, ids, 0, opacity=0.9), 0)
    state.step = next(step for step in range(1, 9999) if strategy.schedule.resets(step))
    strategy.step_post(state)
    faint = state.gaussians.logit_opacities.sigmoid() < 0.5
    assert torch.equal(faint, ~found.shell.holds(state.gaussians.means))


@given(st.integers(0, 99))
@settings(max_examples=10)
def test_halves_and_sizes_on_the_shell(seed):
    """Gaussians of the sky split and are pruned as seen from within, and their halves stay on the shell."""
    g = random_gaussians(40, seed=seed, degree=0)
    far = replace(g, means=SHELL.place(g.means), log_scales=g.log_scales + float(np.log(SHELL.scale)))
    state = initial_state(concat([g, far]), seed)
    state.grad_sum[:], state.grad_count[:], state.last_reset = 1.0, 1.0, 1
    densify.refine(state, TrainConfig(), SHELL.extent, 1000, torch.ones(80, dtype=torch.bool), SHELL)
    on = SHELL.holds(state.gaussians.means)
    assert int(on.sum()) == int((~on).sum())  # the same was done to both
    assert off_shell(SHELL, state.gaussians.means[on]) < 1e-5


def test_steps_are_as_large_as_seen_from_within():
    before = SHELL.place(torch.randn(20, 3, generator=torch.Generator().manual_seed(0)))
    means = torch.cat([torch.zeros(3, 3), before])
    rows = torch.arange(3, 23)
    means[rows] += 1e-3 * torch.randn(20, 3, generator=torch.Generator().manual_seed(1))
    moved = means[rows] - before
    SHELL.step(means, before, rows)
    assert off_shell(SHELL, means[rows]) < 1e-5
    assert torch.equal(means[:3], torch.zeros(3, 3))
    outward = (before - torch.from_numpy(SHELL.centre)) / SHELL.radius
    along = moved - (moved * outward).sum(1, keepdim=True) * outward
    assert torch.allclose(means[rows] - before, SHELL.scale * along, atol=1e-3)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_training_keeps_the_sky_on_the_shell(capture, tmp_path, strategy):
    """Through densification, noise, relocation, tuning and a resumed checkpoint; the others stay within."""
    scene, photos, _ = capture
    found, labels = of(capture)
    begun, ids = found.begin(scene, labels)
    config = TrainConfig(
        max_steps=12,
        level_every=6,
        refine_every=3,
        strategy=strategy,
        grow_grad=1e-9,
        sh_degree=1,
    )
    events = list(
        train_gaussians(begun, photos, ids, config, backend="cpu", folder=tmp_path, shell=found.shell)
    )
    g = next(event.gaussians for event in events if isinstance(event, Trained))
    is_sky = g.label_ids == SKY
    assert int(is_sky.sum()) > 20
    assert torch.equal(is_sky, found.shell.holds(g.means))
    assert off_shell(found.shell, g.means[is_sky]) < 1e-5
    for view in scene.views:  # nothing of the sky is between a camera and the scene
        away = (g.means - torch.from_numpy(view.camera.position)).norm(dim=1)
        assert away[is_sky].min() > away[~is_sky].max()
    tuned = tune(g, scene, photos, config, 3, backend="cpu", shell=found.shell)
    assert off_shell(found.shell, tuned.means[tuned.label_ids == SKY]) < 1e-5


def test_the_file(capture, tmp_path):
    found, _ = of(capture)
    path = tmp_path / "sky.npz"
    write_sky(path, found)
    back = read_sky(path)
    assert np.array_equal(back.xyz, found.xyz)
    assert np.array_equal(back.rgb, found.rgb)
    assert back.shell.label_ids == (SKY,)
    assert (back.shell.radius, back.shell.extent) == (found.shell.radius, found.shell.extent)
    shell = found.shell
    for wrong in (
        replace(found, xyz=found.xyz * 0.9),
        replace(found, shell=replace(shell, radius=np.nan)),
        replace(found, shell=replace(shell, label_ids=())),
        replace(found, shell=replace(shell, extent=0.0)),
    ):
        write_sky(path, wrong)
        with pytest.raises(RunError, match=r"sky\.npz: not the sky of a run .*--force"):
            read_sky(path)


def test_a_run_with_sky(capture, tmp_path):
    """The stages write it, use it, and remove it; without it they do what they did."""
    folder, events = tmp_path / "run", []
    job = Job(RunDir(folder), events.append, "cpu", force=True)
    open_scene(job, capture[0].path, SMALL_RUN.scene)
    make_masks(job, SMALL_RUN.masks, SMALL_RUN.labels)
    lift_labels(job)
    train_scene(job, replace(SMALL_RUN.train, max_steps=2), BlocksConfig(), 0)
    trained = job.load_last_level()
    clean_levels(job, CleanConfig(max_loss=9.0))
    nest_scene(job, replace(SMALL_RUN.nest, base_share=0.3, base_steps=1), 0)
    found = job.sky
    assert found is not None
    lines = [line for event in events if isinstance(event, StageDone) for line in event.lines]
    cleaned = read_level(job.run.cleaned)
    assert len(cleaned) < len(trained)
    assert found.shell.holds(cleaned.means).sum() == found.shell.holds(trained.means).sum()
    assert any("on a sphere 10 scene extents away" in line for line in lines)
    for g in (job.load_last_level(), job.ladder.load(job.ladder.levels[-1])):
        on = g.label_ids == SKY
        assert on.any()
        assert off_shell(found.shell, g.means[on]) < 0.03  # rounded in SPZ files
        assert not found.shell.holds(g.means[~on]).any()
    assert uses(job.run, "nest", job.run.sky)
    train_scene(job, replace(SMALL_RUN.train, max_steps=2, sky="off"), BlocksConfig(), 0)
    assert not job.run.sky.exists()


def test_without_sky_nothing_changes(finished_run, tmp_path):
    """A capture without a category of that name gives the same bits with and without it."""
    folder = tmp_path / "run"
    shutil.copytree(finished_run, folder)
    shutil.copytree(finished_run.parent / "capture", tmp_path / "capture")
    job = Job(RunDir(folder), lambda event: None, "cpu", force=True)
    assert job.sky is None
    train_scene(job, replace(SMALL_RUN.train, sky="off"), BlocksConfig(), 0)
    before, after = (read_level(path / "levels" / "000004.npz") for path in (finished_run, folder))
    assert all(torch.equal(getattr(before, name), getattr(after, name)) for name in PARAMETERS)


def test_base_model_and_order(capture):
    """The base model has its share of the sky; what lies on the shell is sky, and nothing else is."""
    scene, photos, masks = capture
    found, labels = of(capture)
    *_, done = train_capped(scene, photos, labels, TrainConfig(sh_degree=1), 60, 4, backend="cpu", sky=found)
    assert isinstance(done, Trained)
    g = done.gaussians
    assert len(g) == 60
    assert off_shell(found.shell, g.means[g.label_ids == SKY]) < 1e-5
    blob = g.select(torch.tensor([0]))  # in front of the sky of all views
    camera = scene.views[scene.train_ids[0]].camera
    place = np.linalg.inv(camera.w2c) @ [0, -0.9, 3, 1]
    blob = replace(
        blob, means=torch.tensor(place[None, :3], dtype=torch.float32), log_scales=torch.full((1, 3), -1.0)
    )
    blob = replace(
        blob, logit_opacities=torch.tensor([4.0]), label_ids=torch.tensor([TREE], dtype=torch.int16)
    )
    ordered = order(concat([g, blob]), scene, masks, shell=found.shell).gaussians
    assert torch.equal(ordered.label_ids == SKY, found.shell.holds(ordered.means))
    plain = order(concat([g, blob]), scene, masks).gaussians
    assert not torch.equal(plain.label_ids == SKY, found.shell.holds(plain.means))
