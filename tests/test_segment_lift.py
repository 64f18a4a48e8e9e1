from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from sagesplat.core.errors import LabelError
from sagesplat.scene import load_scene
from sagesplat.scene.scene import Camera, Points, Scene, View
from sagesplat.segment.lift import IGNORED, LiftedLabels, agreement_in, lift
from sagesplat.segment.masks import Masks, Taxonomy, mask_path, write_mask
from sagesplat.segment.valid import ValidPixels

SCENES = Path(__file__).resolve().parents[2] / "shared" / "scenes"
CAR, TREE, WALL = 3, 184, 199
TAXONOMY = Taxonomy({CAR: "car", TREE: "tree-merged", WALL: "wall"})


def scene_of(xyz, cameras, observations):
    views = tuple(View(f"{i}.jpg", camera, Path(f"{i}.jpg")) for i, camera in enumerate(cameras))
    rows, in_views, uv = zip(*observations, strict=True) if observations else ((), (), np.zeros((0, 2)))
    points = Points(
        np.array(xyz, np.float32),
        np.zeros((len(xyz), 3), np.uint8),
        np.array(rows, np.int64),
        np.array(in_views, np.int32),
        np.array(uv, np.float32).reshape(-1, 2),
    )
    return Scene("s", Path(), views, points)


def camera_at(x=0.0, width=4, height=2):
    w2c = np.eye(4, dtype=np.float32)
    w2c[0, 3] = -x
    K = np.array([[2, 0, width / 2], [0, 2, height / 2], [0, 0, 1]], np.float32)
    return Camera(w2c, K, width, height)


def masks_of(folder, scene, images):
    for view, image in zip(scene.views, images, strict=True):
        write_mask(mask_path(folder, view), np.array(image, np.int16), TAXONOMY)
    return Masks(folder, TAXONOMY)


def test_majority_of_the_track(tmp_path):
    images = [[[CAR, CAR, CAR, TREE], [-1, TREE, TREE, TREE]], [[CAR, TREE, TREE, TREE], [CAR] * 4]]
    observations = [
        (0, 0, (0.99, 0.0)),  # car
        (0, 0, (2.5, 0.99)),  # car, the same view again
        (0, 1, (1.0, 0.0)),  # tree
        (1, 0, (0.5, 1.5)),  # unlabelled: no vote
        (1, 1, (3.5, 1.999)),  # car
        (2, 0, (0.5, 1.5)),  # unlabelled only
        (3, 0, (4.0, 0.5)),  # beyond the right edge
        (3, 1, (-0.01, 0.5)),
    ]
    scene = scene_of(np.zeros((5, 3)), [camera_at(), camera_at()], observations)
    lifted = lift(scene, masks_of(tmp_path, scene, images))
    assert lifted.label_ids.dtype == np.int16
    assert lifted.label_ids.tolist() == [CAR, CAR, -1, -1, -1]
    assert lifted.num_votes.tolist() == [3, 1, 0, 0, 0]
    assert lifted.num_agreeing.tolist() == [2, 1, 0, 0, 0]
    assert lifted.agreement == 0.75


@pytest.mark.parametrize(("rest", "winner"), [(CAR, CAR), (TREE, TREE), (WALL, CAR)])
def test_ties_go_to_the_larger_share_of_the_images(tmp_path, rest, winner):
    """With shares equal, the smaller id wins."""
    observations = [(0, 0, (0.5, 0.5)), (0, 0, (1.5, 0.5))]
    scene = scene_of([[0, 0, 1]], [camera_at()], observations)
    lifted = lift(scene, masks_of(tmp_path, scene, [[[TREE, CAR, rest, rest], [rest] * 4]]))
    assert lifted.label_ids.tolist() == [winner]
    assert lifted.agreement == 0.5


def test_projection_asks_every_view_that_the_point_lies_in(tmp_path):
    xyz = [[0.0, 0, 1], [0, 0, -1], [9, 0, 1], [0.9, 0, 1]]  # seen, behind, outside, right edge
    scene = scene_of(xyz, [camera_at(), camera_at(0.5), camera_at(-0.5)], [])
    images = [[[TREE] * 4] * 2, [[CAR] * 4] * 2, [[CAR] * 4] * 2]
    masks = masks_of(tmp_path, scene, images)
    lifted = lift(scene, masks)  # it has no tracks
    assert lifted.label_ids.tolist() == [CAR, -1, -1, CAR]  # the last by its tie
    assert lifted.num_votes.tolist() == [3, 0, 0, 2]
    assert np.isnan(lift(scene, masks, views=[]).agreement)
    assert agreement_in(scene, masks, lifted.label_ids, {1, 2}) == 1
    assert agreement_in(scene, masks, lifted.label_ids, {0}) == 0
    assert np.isnan(agreement_in(scene, masks, lifted.label_ids, set()))


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_against_a_loop(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    images = rng.choice([-1, CAR, TREE, WALL], (3, 2, 4), p=[0.1, 0.4, 0.3, 0.2])
    observations = [(rng.integers(6), rng.integers(3), rng.uniform(0, (4, 2))) for _ in range(30)]
    scene = scene_of(np.zeros((6, 3)), [camera_at()] * 3, observations)
    lifted = lift(scene, masks_of(tmp_path_factory.mktemp("masks"), scene, images))
    share = {label: (images == label).sum() for label in (CAR, TREE, WALL)}
    points = scene.points
    for p in range(6):
        seen = [
            images[v, int(y), int(x)]
            for q, v, (x, y) in zip(points.track_points, points.track_views, points.track_uv, strict=True)
            if p == q
        ]
        votes = {label: seen.count(label) for label in (CAR, TREE, WALL)}
        best = max(votes, key=lambda label: (votes[label], share[label], -label))
        assert lifted.label_ids[p] == (best if sum(votes.values()) else -1)
        assert (lifted.num_votes[p], lifted.num_agreeing[p]) == (sum(votes.values()), votes[best])


def test_points_on_pixels_that_do_not_count_are_ignored(tmp_path):
    """A point that most of its pixels show on what is ignored; a tie, or no pixel at all, is no reason."""
    images = [[[CAR] * 4] * 2, [[CAR] * 4] * 2]
    at, left = [(0.5, 0.5), (3.5, 0.5)], np.array([[True, True, True, False]] * 2)
    observations = [(0, 0, at[1]), (1, 0, at[1]), (1, 1, at[1]), (2, 0, at[0]), (2, 1, at[1])]
    scene = scene_of(np.zeros((4, 3)), [camera_at(), camera_at()], observations)
    masks = masks_of(tmp_path / "masks", scene, images)
    assert lift(scene, masks).ignored is None
    path = mask_path(tmp_path / "valid", scene.views[0])
    path.parent.mkdir()
    Image.fromarray(left).save(path)
    lifted = lift(scene, masks, valid=ValidPixels(tmp_path / "valid"))
    assert lifted.ignored is not None
    assert lifted.ignored.tolist() == [True, False, False, False]
    assert lifted.initial_ids.tolist() == [IGNORED, CAR, CAR, -1]
    lifted.write(tmp_path / "labels.npz")
    again = LiftedLabels.read(tmp_path / "labels.npz", 4).select(np.array([0, 3]))
    assert again.initial_ids.tolist() == [IGNORED, -1]


def test_labels_npz(tmp_path):
    path = tmp_path / "labels.npz"
    labels = LiftedLabels(np.array([3, -1], np.int16), np.array([4, 0], np.int32), np.array([3, 0], np.int32))
    labels.write(path)
    again = LiftedLabels.read(path, 2)
    assert again.ignored is None
    for name in ("label_ids", "num_votes", "num_agreeing"):
        column = getattr(labels, name)
        np.testing.assert_array_equal(getattr(again, name), column)
        assert getattr(again, name).dtype == column.dtype
    with pytest.raises(LabelError, match=r"\(2,\)\} where the scene has 3 points"):
        LiftedLabels.read(path, 3)
    np.savez(path, label_ids=np.array([0.5, 1]), num_votes=labels.num_votes, num_agreeing=labels.num_agreeing)
    with pytest.raises(LabelError, match="not the labels of points"):
        LiftedLabels.read(path, 2)


@pytest.mark.parametrize(("name", "agreement"), [("garden", 0.978), ("dinosaur", 0.981)])
def test_real_scenes_agree_as_their_notes_say(name, agreement):
    if not (SCENES / name).exists():
        pytest.skip("needs the real scenes beside the checkout")
    scene, folder = load_scene(SCENES / name), SCENES / name / "masks"
    lifted = lift(scene, Masks(folder, Taxonomy.read(folder / "labels.json")))
    assert lifted.agreement == pytest.approx(agreement, abs=1e-3)
    assert (lifted.label_ids >= 0).mean() > 0.95
