"""Fusion of label images: votes are the rasteriser's weights, wrong views are overruled, thin parts stay."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import orbit, random_gaussians
from jaxtyping import Float32, Int16

from sagesplat.core.errors import LabelError
from sagesplat.core.gaussians import Gaussians
from sagesplat.scene.scene import Points, Scene, View
from sagesplat.segment.masks import Masks, Taxonomy, mask_path, write_labels, write_mask
from sagesplat.train.fuse import Votes, draw, fuse, gather, refine, thin_parts
from sagesplat.train.votes import label_weights

CAR, TREE = 3, 184
TAXONOMY = Taxonomy({CAR: "car", TREE: "tree-merged"})
IDS = np.array([-1, CAR, TREE], np.int16)


def _scene(views: int = 4) -> tuple[Gaussians, Scene]:
    """A dense cloud whose left half is a car and whose right half is a tree."""
    g = random_gaussians(400, seed=5, log_scale=-1.6, logit=2.0)
    labels = torch.where(g.means[:, 0] < 0, CAR, TREE).to(torch.int16)
    rows = tuple(View(f"{i}.png", camera, Path(f"{i}.png")) for i, camera in enumerate(orbit(views)))
    empty, none = np.zeros((0, 3), np.float32), np.zeros(0, np.int64)
    points = Points(empty, empty.astype(np.uint8), none, none.astype(np.int32), empty[:, :2])
    return replace(g, label_ids=labels), Scene("x", Path(), rows, points, 0)


def _write(folder: Path, scene: Scene, images: list[Int16[np.ndarray, "H W"]]) -> Masks:
    for view, image in zip(scene.views, images, strict=True):
        write_mask(mask_path(folder, view), image, TAXONOMY)
    write_labels(folder, TAXONOMY, set(TAXONOMY.names))
    return Masks(folder, TAXONOMY)


def _drawn_labels(g: Gaussians, scene: Scene) -> list[Float32[np.ndarray, "C H W"]]:
    shares = np.stack([(g.label_ids.numpy() == i).astype(np.float32) for i in IDS], 1)
    return [draw(g, view.camera, Votes(IDS, shares)) for view in scene.views]


def _truth(g: Gaussians, scene: Scene) -> list[Int16[np.ndarray, "H W"]]:
    """The label that paints most of each pixel; the car where nothing does."""
    return [IDS[drawn.argmax(0).clip(1)] for drawn in _drawn_labels(g, scene)]


def test_hard_votes_are_the_weights_of_the_labels_in_shares(tmp_path: Path) -> None:
    g, scene = _scene()
    masks = _write(tmp_path, scene, _truth(g, scene))
    heard: list[int] = []
    votes = gather(g, scene, masks, [0, 2, 3], on_view=heard.append)
    ids, weights = label_weights(g, scene, masks, [0, 2, 3])
    assert votes.ids.tolist() == [-1, *ids]
    seen = weights.sum(1) > 0
    np.testing.assert_allclose(votes.shares[seen].sum(1), 1, atol=1e-5)
    np.testing.assert_allclose(
        votes.shares[seen, 1:], weights[seen] / weights[seen].sum(1, keepdims=True), atol=1e-5
    )
    assert not votes.shares[~seen].any()
    assert heard == [1, 2, 3]


def _drawn(*shares: float) -> Float32[np.ndarray, "C 1 1"]:
    return np.array(shares, np.float32)[:, None, None]


@pytest.mark.parametrize(
    ("label", "shares", "expected"),
    [
        (CAR, (0.0, 0.3, 0.7), CAR),  # 5.4 to 1 against 9 to 1
        (CAR, (0.0, 0.2, 0.8), TREE),  # 16 to 1
        (CAR, (0.95, 0.0, 0.05), CAR),  # the winner of the votes has no label to give
        (CAR, (0.0, 0.01, 0.48), CAR),  # voters cover less than half
        (CAR, (0.0, 0.01, 0.6), TREE),
        (-1, (0.0, 0.4, 0.6), TREE),
        (-1, (0.6, 0.4, 0.0), -1),
        (-1, (0.0, 0.0, 0.0), -1),
        (TREE, (0.0, 0.0, 0.0), TREE),
    ],
)
def test_when_a_label_is_overruled(label: int, shares: tuple[float, ...], expected: int) -> None:
    assert refine(np.full((1, 1), label, np.int16), _drawn(*shares), IDS).item() == expected


def test_thin_parts_are_overruled_later() -> None:
    label_ids = np.full((40, 40), TREE, np.int16)
    label_ids[:, 20:23] = CAR  # a pole
    label_ids[:15, :15] = CAR  # a block
    thin = thin_parts(label_ids)
    assert thin[:, 20:23].all()
    assert not thin[:12, :12].any()
    assert not thin[25:, 30:].any()
    drawn = np.tile(_drawn(0.0, 0.05, 0.95), (1, 40, 40))
    kept = refine(label_ids, drawn, IDS)
    assert (kept[:, 20:23] == CAR).all()
    assert (kept[:12, :12] == TREE).all()


def test_a_wrong_view_is_put_right_and_the_right_ones_stay(tmp_path: Path) -> None:
    g, scene = _scene(12)
    truth = _truth(g, scene)
    images = [image.copy() for image in truth]
    images[3][8:24, 4:40] = TREE + CAR - truth[3][8:24, 4:40]  # a wrong patch
    images[5][10:20, 10:30] = -1  # a hole
    masks = _write(tmp_path / "in", scene, images)
    voters = [row for row in range(12) if row != 5]
    heard: list[tuple[int, int]] = []
    fused = fuse(
        g, scene, masks, tmp_path / "out", views=voters,
        on_view=lambda *progress: heard.append(progress),
    )  # fmt: skip
    assert heard == [(i, 23) for i in range(1, 24)]
    after = Masks(tmp_path / "out", Taxonomy.read(tmp_path / "out" / "labels.json"))
    covered = [drawn.sum(0) > 0.6 for drawn in _drawn_labels(g, scene)]  # elsewhere labels stay as they are
    wrong = np.array([(i != t)[c].mean() for i, t, c in zip(images, truth, covered, strict=True)])
    left = np.array([(after[v] != t)[c].mean() for v, t, c in zip(scene.views, truth, covered, strict=True)])
    assert wrong[3] > 0.3
    assert left[3] < wrong[3] / 3  # the cloud is translucent: pixels that both paint stay
    assert left[5] < 0.25 * wrong[5]  # though it had no vote
    assert np.delete(left, [3, 5]).max() < 0.02
    assert fused.changed[3] == pytest.approx((after[scene.views[3]] != images[3]).mean())
    assert fused.record["changed"] == pytest.approx(fused.changed.mean())
    assert json.loads(json.dumps(fused.record)) == fused.record
    again = fuse(g, scene, masks, tmp_path / "twice", views=voters)
    np.testing.assert_array_equal(again.changed, fused.changed)  # deterministic


def test_the_folder_of_the_masks_is_refused(tmp_path: Path) -> None:
    g, scene = _scene(1)
    masks = _write(tmp_path, scene, _truth(g, scene))
    with pytest.raises(LabelError, match="these are the masks themselves"):
        fuse(g, scene, masks, tmp_path)


def test_views_without_labels_do_not_vote(tmp_path: Path) -> None:
    g, scene = _scene()
    images = _truth(g, scene)
    images[1:] = [np.full_like(image, -1) for image in images[1:]]
    masks = _write(tmp_path, scene, images)
    np.testing.assert_array_equal(
        gather(g, scene, masks, range(4)).shares, gather(g, scene, masks, [0]).shares
    )
