"""Categories that stop during training: they stop when they should, and nothing moves them afterwards."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import pinhole
from hypothesis import given, settings
from hypothesis import strategies as st

from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.demo.capture import make_capture
from sagesplat.raster import rasterize
from sagesplat.scene import load_scene
from sagesplat.scene.images import Photos
from sagesplat.segment.lift import lift
from sagesplat.segment.mask_files import import_masks
from sagesplat.segment.masks import Masks, Taxonomy
from sagesplat.train import schedule, stepper, trainer
from sagesplat.train.early_stopping import (
    ActiveTiles,
    active_tiles,
    label_quality,
    measured_views,
    trainable_rows,
)
from sagesplat.train.events import LabelFrozen, Resumed, Step, Trained
from sagesplat.train.lr_schedule import smaller
from sagesplat.train.photo_loader import PhotoLoader
from sagesplat.train.state import initial_state
from sagesplat.train.stepper import Stepper, tune
from sagesplat.train.trainer import train

CPU = torch.device("cpu")
# densification from step 24 to 60 every 6, resets at 40, the SH degree rises every 4 steps
CONFIG = TrainConfig(max_steps=120, level_every=10, refine_every=6, lr_schedule="published")


@pytest.fixture(autouse=True)
def early_resets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedule, "_MIN_RESET_INTERVAL", 40)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "capture"
    make_capture(folder, views=12, width=80, height=60)
    scene = load_scene(folder)
    import_masks(scene, folder / "masks", folder / "run_masks")
    masks = Masks(folder / "run_masks", Taxonomy.read(folder / "run_masks" / "labels.json"))
    return scene, Photos(scene.views), masks, lift(scene, masks).label_ids


@pytest.fixture
def levels(monkeypatch) -> dict[int, Gaussians]:
    """The Gaussians of every level as training has them, before they are encoded."""
    kept: dict[int, Gaussians] = {}

    def keep(folder: Path, step: int, g: Gaussians, **_) -> Path:
        kept[step] = replace(g, **{name: p.clone() for name, p in g.parameters().items()})
        return folder

    monkeypatch.setattr(trainer, "write_level", keep)
    return kept


def measured(g: Gaussians, capture, degree: int) -> dict[int, float]:
    """SSIM by label, as it decides who stops."""
    scene, photos, masks, _ = capture
    work, feed = ActiveTiles(scene, masks), PhotoLoader(scene, photos, CPU)
    return label_quality(g, work, feed, measured_views(scene, masks), CONFIG, degree, backend="cpu")


def rows_of(g: Gaussians, label: int) -> np.ndarray:
    """All parameters of a category's Gaussians, in an order that does not depend on the others."""
    part = g.of_labels([label])
    rows = np.concatenate([p.numpy().reshape(len(part), -1) for p in part.parameters().values()], 1)
    return rows[np.lexsort(rows.T)]


def test_frozen_categories_stay_bit_for_bit(capture, levels, tmp_path):
    scene, photos, masks, labels = capture
    config = replace(CONFIG, freeze_at=0.48)
    events = list(train(scene, photos, labels, config, masks=masks, folder=tmp_path))
    frozen = {e.label_id: e for e in events if isinstance(e, LabelFrozen)}
    assert len({e.step for e in frozen.values()}) > 1  # some stop early, some late
    assert any(e.step < 40 for e in frozen.values())  # one lives through densification and a reset
    moved = 0
    for label, event in frozen.items():
        assert event.ssim >= 0.48
        assert event.count == levels[event.step].counts()[label]
        for step, g in levels.items():
            if step > event.step:
                np.testing.assert_array_equal(rows_of(g, label), rows_of(levels[event.step], label))
                moved += 1
    assert moved
    free = next(label for label in levels[10].counts() if label not in frozen)
    assert not np.array_equal(rows_of(levels[110], free), rows_of(levels[120], free))


def test_training_ends_when_every_category_has_stopped(capture, levels, tmp_path):
    scene, photos, masks, labels = capture
    config = replace(CONFIG, freeze_at=0.02)
    events = list(train(scene, photos, labels, config, masks=masks, folder=tmp_path))
    assert max(e.step for e in events if isinstance(e, Step)) == 10
    end = events[-1]
    assert isinstance(end, Trained)
    assert (end.step, list(levels)) == (10, [10])


def test_a_killed_run_keeps_what_was_frozen(capture, tmp_path):
    scene, photos, masks, labels = capture
    config = replace(CONFIG, freeze_at=0.5, max_steps=60)
    whole = list(train(scene, photos, labels, config, masks=masks))
    for event in train(scene, photos, labels, config, masks=masks, folder=tmp_path):
        if isinstance(event, Step) and event.step == 43:
            break
    again = list(train(scene, photos, labels, config, masks=masks, folder=tmp_path))
    assert again[0] == Resumed(40)
    ends = whole[-1], again[-1]
    assert isinstance(ends[0], Trained)
    assert isinstance(ends[1], Trained)
    for name in PARAMETERS:
        assert torch.equal(getattr(ends[0].gaussians, name), getattr(ends[1].gaussians, name))
    late = [e for e in whole if isinstance(e, LabelFrozen) and e.step > 40]
    assert [e for e in again if isinstance(e, LabelFrozen)] == late


def test_a_target_needs_label_images(capture):
    scene, photos, _, labels = capture
    with pytest.raises(RunError, match="needs label images"):
        next(train(scene, photos, labels, replace(CONFIG, freeze_at=0.5)))


def test_tuning_improves_and_keeps_the_set(capture):
    scene, photos, _, labels = capture
    *_, end = train(scene, photos, labels, replace(CONFIG, max_steps=60))
    assert isinstance(end, Trained)
    before = replace(end.gaussians, **{n: p.clone() for n, p in end.gaussians.parameters().items()})
    tuned = tune(end.gaussians, scene, photos, CONFIG, 40)
    assert tuned.counts() == before.counts()
    for name, p in before.parameters().items():  # the input is left alone
        assert torch.equal(p, getattr(end.gaussians, name))
    was, now = (measured(g, capture, 3) for g in (before, tuned))
    assert np.mean(list(now.values())) > np.mean(list(was.values())) + 0.01


@settings(max_examples=50, derandomize=True)
@given(st.integers(1, 70), st.integers(1, 70), st.sampled_from([1, 2, 4]), st.integers(0, 99))
def test_masks_of_tiles_fit_photos_of_any_size(height, width, factor, seed):
    labels = np.random.default_rng(seed).integers(-1, 2, (height, width)).astype(np.int16)
    photo, camera = smaller(np.zeros((height, width, 3), np.uint8), pinhole(width, height), factor)
    tiles = active_tiles(labels, {1}, factor)
    assert tiles.shape == (-(-camera.height // 16), -(-camera.width // 16))
    assert tiles.shape == (-(-photo.shape[0] // 16), -(-photo.shape[1] // 16))
    if factor == 1:
        for (row, column), active in np.ndenumerate(tiles):
            part = labels[16 * row : 16 * row + 16, 16 * column : 16 * column + 16]
            assert active == (part != 1).any()


def test_finished_views_are_drawn_in_one_round_of_eight(capture):
    scene, photos, masks, _ = capture
    everything = frozenset({-1, *masks.taxonomy.names})
    one = next(iter(sorted(masks.taxonomy.names)))
    state = initial_state(three(one), 0)
    shown = {row: set(np.unique(masks[scene.views[row]]).tolist()) for row in scene.train_ids.tolist()}
    seen = {label: sum(label in labels for labels in shown.values()) for label in everything}
    rare = min((label for label in seen if seen[label]), key=lambda label: seen[label])
    assert seen[rare] < len(shown)
    some = everything - {rare}
    work = ActiveTiles(scene, masks, some)
    unfinished = {row for row in shown if shown[row] - some}
    picked = Stepper(PhotoLoader(scene, photos, CPU), CONFIG, work)
    views = [picked._next_view(state) for _ in range(2000)]
    assert unfinished
    assert {row for row in shown if not work.finished(row)} == unfinished
    counts = {row: views.count(row) for row in shown}
    busy = np.mean([counts[row] for row in unfinished])
    for row in set(shown) - unfinished:
        assert counts[row] < 0.4 * busy
    done = ActiveTiles(scene, masks, everything)
    assert all(done.finished(row) for row in shown)
    assert done.tiles(int(scene.train_ids[0])) is not None


def three(label: int) -> Gaussians:
    zeros = torch.zeros(3)
    return Gaussians(
        torch.rand(3, 3), torch.eye(4)[:1].repeat(3, 1), torch.zeros(3, 3), zeros, torch.zeros(3, 1, 3),
        torch.zeros(3, 0, 3), torch.full((3,), label, dtype=torch.int16),
    )  # fmt: skip


def test_rare_categories_are_measured_where_they_show(capture):
    scene = capture[0]
    views = tuple(replace(scene.views[0], name=str(i)) for i in range(120))
    many = replace(scene, views=views, test_every=8)

    class Rare:
        """7 everywhere but in three views, of which one is a test view, and 9 in most."""

        def __getitem__(self, view):
            label = 5 if view.name in ("8", "33", "77") else 7
            return np.array([[label, 9 if int(view.name) > 30 else label]], np.int16)

    picked = measured_views(many, Rare())  # type: ignore[arg-type]
    assert picked[5] == [33, 77]
    assert len(picked[7]) in (14, 15, 16)
    assert len(picked[9]) >= 8
    assert min(picked[9]) > 30
    assert all(set(rows) <= set(many.train_ids.tolist()) for rows in picked.values())


def test_a_category_stops_at_the_first_level_that_reaches_the_target(capture, levels, tmp_path):
    scene, photos, masks, labels = capture
    config = replace(CONFIG, freeze_at=0.45, max_steps=40)
    events = list(train(scene, photos, labels, config, masks=masks, folder=tmp_path))
    first = min(e.step for e in events if isinstance(e, LabelFrozen))
    for step in sorted(levels):
        degree = min(3, step // round(1000 * 40 / 30_000))
        quality = measured(levels[step], capture, degree)
        reached = {
            label for label, ssim in quality.items() if ssim >= 0.45 and label in levels[step].counts()
        }
        if step < first:
            assert not reached
        if step == first:
            assert reached == {e.label_id for e in events if isinstance(e, LabelFrozen) and e.step == first}
            break


def test_rows_that_may_change(capture):
    g = Gaussians(
        *[torch.zeros(4, *shape) for shape in ((3,), (4,), (3,), (), (1, 3), (0, 3))],
        label_ids=torch.tensor([-1, 3, 184, 3], dtype=torch.int16),
    )
    assert trainable_rows(g, {}).tolist() == [True] * 4
    assert trainable_rows(g, {3: 100, 7: 5}).tolist() == [True, False, True, False]
    assert trainable_rows(g, {-1: 1}).tolist() == [False, True, True, True]


def test_tiles_with_only_stopped_categories_are_done():
    labels = np.zeros((40, 50), np.int16)
    labels[:, 30:] = 3
    labels[39, 49] = -1
    left, both = [True, True, False, False], [True, True, False, True]
    assert active_tiles(labels, {3}).tolist() == [left, left, both]
    assert active_tiles(labels, {3, -1}).tolist() == [left] * 3
    assert active_tiles(labels, {0, 3}).tolist() == [[False] * 4] * 2 + [[False, False, False, True]]
    assert not active_tiles(labels, {-1, 0, 3}).any()
    assert active_tiles(labels, ()).all()
    # the image 20 x 25 has 2 x 2 tiles, the right ones from column 32 on
    assert active_tiles(labels, {3}, 2).tolist() == [[True, False], [True, True]]
    assert active_tiles(labels, {3}, 4).tolist() == [[True]]


def test_stopped_categories_stop_costing(capture, monkeypatch):
    """What is drawn shrinks with every category that stops, and frozen rows take no gradient."""
    scene, photos, masks, labels = capture
    drawn: list[tuple[int, float]] = []

    def watched(*args, **options):
        tiles = options["tile_mask"]
        drawn.append((int(options["trainable"] is not None), 1.0 if tiles is None else float(tiles.mean())))
        return rasterize(*args, **options)

    monkeypatch.setattr(stepper, "rasterize", watched)
    frozen_at: list[int] = []
    config = replace(CONFIG, freeze_at=0.44)
    for event in train(scene, photos, labels, config, masks=masks):
        if isinstance(event, LabelFrozen):
            frozen_at.append(event.step)
    first, last = min(frozen_at), max(step for step in frozen_at if step < config.max_steps)
    assert set(drawn[:first]) == {(0, 1.0)}
    before = np.mean([share for _, share in drawn[first:last]])
    after = np.mean([share for _, share in drawn[last:]])
    assert after < before < 1
    assert all(asked for asked, _ in drawn[first:])  # for no gradients of frozen rows
