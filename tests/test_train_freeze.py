"""Categories that stop during training: they stop when they should, and nothing moves them afterwards."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sagesplat.config import TrainConfig
from sagesplat.demo.capture import make_capture
from sagesplat.errors import RunError
from sagesplat.gaussians import PARAMETERS, Gaussians
from sagesplat.raster import Workspace
from sagesplat.scene import load_scene
from sagesplat.scene.images import Photos
from sagesplat.segment.lift import lift
from sagesplat.segment.masks import Masks, Taxonomy, import_masks
from sagesplat.train import trainer
from sagesplat.train.freeze import label_quality, trainable_rows
from sagesplat.train.stepper import tune
from sagesplat.train.trainer import LabelFrozen, LevelSaved, Resumed, Step, Trained, train

# densification from step 24 to 60 every 6, resets at 40, the SH degree rises every 4 steps
CONFIG = TrainConfig(
    max_steps=120, level_every=10, refine_start=24, refine_every=6, reset_every=40, pace="published"
)


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


def rows_of(g: Gaussians, label: int) -> np.ndarray:
    """All parameters of a category's Gaussians, in an order that does not depend on the others."""
    part = g.of_labels([label])
    rows = np.concatenate([p.numpy().reshape(len(part), -1) for p in part.parameters().values()], 1)
    return rows[np.lexsort(rows.T)]


def test_frozen_categories_stay_bit_for_bit(capture, levels, tmp_path):
    scene, photos, masks, labels = capture
    config = replace(CONFIG, freeze_at=0.55)
    events = list(train(scene, photos, labels, config, masks=masks, folder=tmp_path))
    frozen = {e.label_id: e for e in events if isinstance(e, LabelFrozen)}
    assert len({e.step for e in frozen.values()}) > 1  # some stop early, some late
    assert any(e.step < 40 for e in frozen.values())  # one lives through densification and a reset
    moved = 0
    for label, event in frozen.items():
        assert event.ssim >= 0.55
        assert event.count == levels[event.step].counts()[label]
        for step, g in levels.items():
            if step > event.step:
                np.testing.assert_array_equal(rows_of(g, label), rows_of(levels[event.step], label))
                moved += 1
    assert moved
    free = next(label for label in levels[10].counts() if label not in frozen)
    assert not np.array_equal(rows_of(levels[110], free), rows_of(levels[120], free))


def test_a_category_stops_at_the_first_level_that_reaches_the_target(capture, levels, tmp_path):
    scene, photos, masks, labels = capture
    config = replace(CONFIG, freeze_at=0.45, max_steps=40)
    events = list(train(scene, photos, labels, config, masks=masks, folder=tmp_path))
    first = min(e.step for e in events if isinstance(e, LabelFrozen))
    for step in sorted(levels):
        degree = min(3, step // round(1000 * 40 / 30_000))
        quality = label_quality(levels[step], scene, photos, masks, config, degree, "cpu", Workspace())
        reached = {
            label for label, ssim in quality.items() if ssim >= 0.45 and label in levels[step].counts()
        }
        if step < first:
            assert not reached
        if step == first:
            assert reached == {e.label_id for e in events if isinstance(e, LabelFrozen) and e.step == first}
            break


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


def test_levels_right_after_a_reset_are_faint(capture, levels, tmp_path):
    scene, photos, _, labels = capture
    config = replace(CONFIG, max_steps=60, reset_every=30, refine_stop=15_000)
    config = replace(config, refine_stop=30_000)  # densification until the end
    plan = trainer.densify.schedule(config)
    assert plan.refine_stop > 30
    saved: dict[bool, LevelSaved] = {}
    faint = {}
    for late in (False, True):
        events = train(scene, photos, labels, replace(config, levels_after_reset=late), folder=tmp_path)
        at = plan.reset_every
        saved[late] = next(e for e in events if isinstance(e, LevelSaved) and e.step == at)
        faint[late] = float(levels[at].logit_opacities.sigmoid().max())
    assert faint[True] < 0.011 < faint[False]
    assert (saved[False].recovering, saved[True].recovering) == (False, True)


@pytest.mark.parametrize("target", [0.0, -1.0, 1.5, float("nan")])
def test_impossible_targets_are_one_line(capture, target):
    scene, photos, masks, labels = capture
    with pytest.raises(RunError, match=r"--train.freeze-at .* is no SSIM"):
        next(train(scene, photos, labels, replace(CONFIG, freeze_at=target), masks=masks))
    with pytest.raises(RunError, match="needs label images"):
        next(train(scene, photos, labels, replace(CONFIG, freeze_at=0.5)))


def test_rows_that_may_change(capture):
    g = Gaussians(
        *[torch.zeros(4, *shape) for shape in ((3,), (4,), (3,), (), (1, 3), (0, 3))],
        label_ids=torch.tensor([-1, 3, 184, 3], dtype=torch.int16),
    )
    assert trainable_rows(g, {}).tolist() == [True] * 4
    assert trainable_rows(g, {3: 100, 7: 5}).tolist() == [True, False, True, False]
    assert trainable_rows(g, {-1: 1}).tolist() == [False, True, True, True]


def test_tuning_improves_and_keeps_the_set(capture):
    scene, photos, masks, labels = capture
    *_, end = train(scene, photos, labels, replace(CONFIG, max_steps=60))
    assert isinstance(end, Trained)
    before = replace(end.gaussians, **{n: p.clone() for n, p in end.gaussians.parameters().items()})
    tuned = tune(end.gaussians, scene, photos, CONFIG, 40)
    assert tuned.counts() == before.counts()
    for name, p in before.parameters().items():  # the input is left alone
        assert torch.equal(p, getattr(end.gaussians, name))
    was, now = (
        label_quality(g, scene, photos, masks, CONFIG, 3, "cpu", Workspace()) for g in (before, tuned)
    )
    assert np.mean(list(now.values())) > np.mean(list(was.values())) + 0.01
