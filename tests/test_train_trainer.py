"""Training on photos of known Gaussians: it learns, it repeats itself, it survives being killed."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import random_gaussians, write_capture
from PIL import Image

from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import OutOfMemory, RunError
from sagesplat.core.gaussians import PARAMETERS, Gaussians
from sagesplat.formats.levels import read_header, read_level
from sagesplat.raster import rasterize
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.segment.lift import IGNORED
from sagesplat.segment.masks import mask_path
from sagesplat.segment.valid import ValidPixels
from sagesplat.train import schedule, stepper, trainer
from sagesplat.train.events import Event, LevelSaved, Resumed, Step, Trained
from sagesplat.train.photo_loader import PhotoLoader
from sagesplat.train.state import from_points, initial_state
from sagesplat.train.trainer import train

LABEL_IDS = np.array([-1, 3, 184], np.int16)[np.arange(60) % 3]
# 8 views, of which 7 train; densification from step 12 to 29, a reset after step 20, levels every 12 steps
BUSY = TrainConfig(max_steps=60, level_every=12, refine_every=7, lr_schedule="published")


@pytest.fixture(scope="module", autouse=True)
def early_resets() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(schedule, "_MIN_RESET_INTERVAL", 20)
        yield


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    truth = random_gaussians(60, seed=12, degree=0, log_scale=-1.6, logit=1.0)
    return write_capture(tmp_path_factory.mktemp("capture") / "cloud", truth)


def run(scene: Scene, config: TrainConfig, **options) -> Iterator[Event]:
    return train(scene, Photos(scene.views), LABEL_IDS, config, **options)


def final(events: list[Event]) -> Gaussians:
    assert isinstance(events[-1], Trained)
    return events[-1].gaussians


def assert_identical(a: Gaussians, b: Gaussians) -> None:
    for name in (*PARAMETERS, "label_ids"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name


@pytest.fixture(scope="module")
def undisturbed(scene, tmp_path_factory) -> tuple[list[Event], Path]:
    folder = tmp_path_factory.mktemp("run")
    return list(run(scene, BUSY, folder=folder, settings="s")), folder


def test_the_loss_falls(scene, monkeypatch):
    monkeypatch.setattr(schedule, "_MIN_RESET_INTERVAL", 1500)
    events = list(run(scene, TrainConfig(max_steps=84, sh_degree=1)))
    losses = [e.loss for e in events if isinstance(e, Step)]
    assert np.mean(losses[-7:]) < 0.65 * np.mean(losses[:7])
    assert not any(e.recovering for e in events if isinstance(e, LevelSaved))  # nothing was reset


def test_events_come_in_order(undisturbed):
    events, folder = undisturbed
    steps = [e for e in events if isinstance(e, Step)]
    assert [e.step for e in steps] == list(range(1, 61))
    levels = [e for e in events if isinstance(e, LevelSaved)]
    assert [e.step for e in levels] == [12, 24, 36, 48, 60]
    for level in levels:
        before = events[events.index(level) - 1]
        assert isinstance(before, Step)
        assert before.step == level.step
        assert before.num_gaussians == sum(level.counts.values())
    assert [e.step for e in levels if e.recovering] == [24]  # the reset came after step 20
    assert len(events) == 60 + 5 + 1
    assert sorted(p.name for p in folder.rglob("*.npz")) == [
        *(f"{step:06d}.npz" for step in (12, 24, 36, 48, 60)),
        "checkpoint.npz",
    ]


def test_levels_hold_what_was_announced(undisturbed):
    events, folder = undisturbed
    for event in (e for e in events if isinstance(e, LevelSaved)):
        path = folder / "levels" / f"{event.step:06d}.npz"
        assert event.path == path
        header = read_header(path)
        assert header.counts == event.counts
        assert (header.step, header.recovering) == (event.step, event.recovering)
        assert header.sh_degree == 3  # raised every second step of such a short run
    last, expected = read_level(folder / "levels" / "000060.npz"), final(events)
    assert last.counts() == expected.counts()
    for label in expected.counts():
        assert torch.equal(last.of_labels([label]).means, expected.of_labels([label]).means)


def test_densification_grows_and_labels_stay(undisturbed):
    events, _ = undisturbed
    counts = [e.num_gaussians for e in events if isinstance(e, Step)]
    assert len(set(counts[:1])) == 1
    assert max(counts) > 65  # it grew
    assert len(set(counts[30:])) == 1  # and only in the first half
    g = final(events)
    assert set(g.counts()) <= {-1, 3, 184}
    assert g.label_ids.dtype == torch.int16
    assert len(g.label_ids) == len(g) == counts[-1]


def test_the_same_seed_gives_the_same_bits_and_another_one_does_not(scene, undisturbed):
    events, _ = undisturbed
    again = list(run(scene, BUSY))
    assert_identical(final(again), final(events))
    assert [e for e in again if isinstance(e, Step)] == [e for e in events if isinstance(e, Step)]
    assert all(e.path is None for e in again if isinstance(e, LevelSaved))  # nothing is written
    other = list(run(scene, replace(BUSY, max_steps=10), seed=1))
    first = [e.loss for e in events if isinstance(e, Step)][:10]
    assert [e.loss for e in other if isinstance(e, Step)] != first


@pytest.mark.parametrize("killed_after", [13, 26, 47])
def test_a_killed_run_ends_where_it_would_have(scene, undisturbed, tmp_path, killed_after):
    events, folder = undisturbed
    killed = run(scene, BUSY, folder=tmp_path, settings="s")
    for event in killed:
        if isinstance(event, Step) and event.step == killed_after:
            break
    killed.close()  # type: ignore
    resumed = list(run(scene, BUSY, folder=tmp_path, settings="s"))
    assert resumed[0] == Resumed(killed_after // 12 * 12)
    assert_identical(final(resumed), final(events))
    for path in sorted((folder / "levels").iterdir()):
        assert_identical(read_level(tmp_path / "levels" / path.name), read_level(path))
    finished = list(run(scene, BUSY, folder=tmp_path, settings="s"))
    assert finished[0] == Resumed(60)
    assert len(finished) == 2
    assert_identical(final(finished), final(events))


def test_large_states_are_saved_less_often(scene, undisturbed, tmp_path, monkeypatch):
    """Every other level here; the end is always saved, and a killed run ends where it would have."""
    events, _ = undisturbed
    monkeypatch.setattr(trainer, "_SMALL", 0)
    monkeypatch.setattr(trainer, "_SAVE_EVERY", 20)
    for event in run(scene, BUSY, folder=tmp_path, settings="s"):
        if isinstance(event, Step) and event.step == 47:
            break
    resumed = list(run(scene, BUSY, folder=tmp_path, settings="s"))
    assert resumed[0] == Resumed(24)
    assert_identical(final(resumed), final(events))
    assert next(run(scene, BUSY, folder=tmp_path, settings="s")) == Resumed(60)


def test_training_begins_with_given_gaussians(scene):
    start = random_gaussians(40, seed=3, degree=3)
    config = replace(BUSY, max_steps=1, strategy="mcmc")
    found = final(list(run(scene, config, start=start)))
    assert len(found) == 40
    near = torch.cdist(found.means, start.means).min(1).values
    assert float(near.max()) < 0.1 < float(torch.pdist(start.means).median())


def test_every_view_is_seen_once_a_round_and_test_views_never(scene):
    class Recorded(Photos):
        def __getitem__(self, index):
            seen.append(index)
            return super().__getitem__(index)

    seen: list[int] = []
    list(train(scene, Recorded(scene.views), LABEL_IDS, TrainConfig(max_steps=21, sh_degree=0)))
    for start in (0, 7, 14):
        assert sorted(seen[start : start + 7]) == [1, 2, 3, 4, 5, 6, 7]
    assert seen[:7] != seen[7:14] or seen[:7] != seen[14:]


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_loss_that_is_not_finite_is_one_line(scene):
    class Broken(Photos):
        def __getitem__(self, index):
            return super().__getitem__(index) + np.float32(np.nan)

    with pytest.raises(RunError, match=r"^the loss became nan at step 1; lower the learning rates"):
        list(train(scene, Broken(scene.views), LABEL_IDS, BUSY))


def test_from_points(scene):
    g = from_points(scene.points, LABEL_IDS, sh_degree=2)
    np.testing.assert_array_equal(g.means.numpy(), scene.points.xyz)
    np.testing.assert_array_equal(g.label_ids.numpy(), LABEL_IDS)
    np.testing.assert_allclose(g.logit_opacities.sigmoid(), 0.1, rtol=1e-6)
    assert g.sh_degree == 2
    assert not g.shN.any()
    shown = g.sh0[:, 0].numpy() * 0.28209479177387814 + 0.5
    np.testing.assert_allclose(shown * 255, scene.points.rgb, atol=1e-3)
    distances = np.linalg.norm(scene.points.xyz - scene.points.xyz[0], axis=1)
    nearest = np.sort(distances)[1:4]
    np.testing.assert_allclose(g.log_scales[0].exp(), np.sqrt(np.square(nearest).mean()), rtol=1e-5)
    assert not np.shares_memory(g.means.numpy(), scene.points.xyz)
    state = initial_state(g, seed=0)
    assert state.step == 0
    assert state.last_reset == -1
    assert not any(p.any() for p in (*state.exp_avg.values(), *state.exp_avg_sq.values()))


@pytest.mark.parametrize(
    "config",
    [replace(BUSY, strategy="mcmc"), replace(BUSY, batch=3)],
    ids=["mcmc", "batch"],
)
def test_other_strategies_learn_and_go_on_where_they_were(scene, tmp_path, config):
    whole = list(run(scene, config))
    losses = [e.loss for e in whole if isinstance(e, Step)]
    assert np.mean(losses[-7:]) < 0.9 * np.mean(losses[:7])
    assert len(final(whole)) > len(LABEL_IDS)
    for event in run(scene, config, folder=tmp_path, settings="s"):
        if isinstance(event, Step) and event.step == 41:
            break
    again = list(run(scene, config, folder=tmp_path, settings="s"))
    assert again[0] == Resumed(36)
    assert_identical(final(again), final(whole))


LESS = "out of memory; lower --train.max-gaussians"


@pytest.mark.parametrize(
    ("failure", "says"),
    [
        (torch.OutOfMemoryError("CUDA out of memory. Tried ..."), LESS),
        (OutOfMemory("the GPU is out of memory"), LESS),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to ..."), LESS),
        (RuntimeError("CUDA error: unspecified launch failure\nmore"), "the GPU failed .CUDA error: un"),
    ],
    ids=["torch", "raster", "cpu", "device"],
)
def test_what_a_machine_cannot_do_is_one_line_and_costs_no_checkpoint(
    scene, tmp_path, monkeypatch, failure, says
):
    calls = 0

    def failing(*args, **options):
        nonlocal calls
        calls += 1
        if calls == 30:
            raise failure
        return rasterize(*args, **options)

    monkeypatch.setattr(stepper, "rasterize", failing)
    with pytest.raises(RunError, match=says) as caught:
        list(run(scene, BUSY, folder=tmp_path, settings="s"))
    message = str(caught.value)
    assert "\n" not in message
    assert "training stopped at step 29" in message
    assert str(tmp_path / "checkpoint.npz") in message
    assert next(run(scene, BUSY, folder=tmp_path, settings="s")) == Resumed(24)


class Painted(Photos):
    """Photos with noise below a mask."""

    def __init__(self, scene: Scene, valid: ValidPixels):
        super().__init__(scene.views)
        self.valid, self.rng = valid, np.random.default_rng(0)

    def __getitem__(self, index: int) -> np.ndarray:
        photo, valid = super().__getitem__(index), self.valid[self.views[index]]
        if valid is None:
            return photo
        return np.where(valid[..., None], photo, self.rng.integers(0, 256, photo.shape, np.uint8))


def test_nothing_is_learnt_from_pixels_that_do_not_count(scene, tmp_path):
    """Not a bit depends on what photos show there; a view of nothing else is never drawn."""
    for row, view in enumerate(scene.views):
        valid = np.ones((view.camera.height, view.camera.width), bool)
        valid[4:20, 9:30] = row % 2
        valid &= row != 3
        Image.fromarray(valid).save(mask_path(tmp_path, view))
    valid = ValidPixels(tmp_path)
    config = replace(BUSY, max_steps=40, batch=2)
    plain, painted = (
        final(list(train(scene, photos, LABEL_IDS, config, valid=valid)))
        for photos in (Photos(scene.views), Painted(scene, valid))
    )
    assert_identical(plain, painted)
    loader = PhotoLoader(scene, Photos(scene.views), torch.device("cpu"), valid)
    assert loader.rows.tolist() == [1, 2, 4, 5, 6, 7]
    half = loader.valid(2, 2)
    assert half is not None
    expected = torch.ones(16, 24, dtype=torch.bool)
    expected[2:10, 4:15] = False
    assert torch.equal(half, expected)


def test_no_gaussian_begins_at_an_ignored_point(scene):
    labels = LABEL_IDS.copy()
    labels[:9] = IGNORED
    g = from_points(scene.points, labels, 1)
    assert len(g) == 51
    assert (g.label_ids.numpy() == LABEL_IDS[9:]).all()
    np.testing.assert_array_equal(g.means.numpy(), scene.points.xyz[9:])
