"""Multi-view label fusion: all views vote on the Gaussians, whose votes are rendered into each view."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int16
from scipy.ndimage import binary_opening

from sagesplat.core.errors import LabelError
from sagesplat.core.gaussians import Gaussians
from sagesplat.raster import Backend, Workspace, add_weights, device_of, rasterize
from sagesplat.scene.scene import Camera, Scene
from sagesplat.segment.masks import UNLABELLED, Masks, prepare_folder, write_labels, write_mask
from sagesplat.segment.valid import ALL_VALID, ValidPixels

# when the other views overrule a view
_WEIGHT = 2.0  # exponent of the fused probabilities beside the view's own
_CONFIDENCE = 0.9  # probability of a hard label; the other categories share what remains
_MIN_SHARE = 0.5  # of a pixel: what the voters have to cover of it, and the winner of their votes
_KEEP_THIN = 3.0  # exponent of the view's own probabilities at thin parts
_THIN_RADIUS = 3  # px; what an opening by a disc of this radius removes is thin


@dataclass(frozen=True, eq=False)
class Votes:
    """Category votes of each Gaussian, over all views that it contributes to."""

    ids: Int16[np.ndarray, " C"]  # category ids in rising order, the first one -1
    shares: Float32[np.ndarray, "N C"]  # of each category in the votes; rows sum to 1, or 0 without a vote


@dataclass(frozen=True, eq=False)
class Fused:
    """What fusion did to a folder of masks."""

    changed: Float32[np.ndarray, " V"]  # share of each view's pixels that have another label
    record: dict[str, Any]  # options and result as plain values, for provenance


def gather(
    gaussians: Gaussians,
    scene: Scene,
    masks: Masks,
    views: Collection[int],
    *,
    valid: ValidPixels = ALL_VALID,
    antialiased: bool = False,
    on_view: Callable[[int], None] | None = None,
) -> Votes:
    """Let the pixels of `views` (rows of `Scene.views`) vote on the Gaussians that contribute to them.

    A pixel's vote is its category in `masks`, times the blending weight (alpha times transmittance) of the
    Gaussian. Unlabelled is a candidate too, but views without any label do not vote, and no pixel that is not
    `valid`. `on_view(done)` is called after each view.
    """
    ids = np.array([UNLABELLED, *sorted(masks.taxonomy.names)], np.int16)
    votes, workspace = np.zeros((len(gaussians), len(ids)), np.float32), Workspace()
    for done, row in enumerate(views):
        camera, label_ids = scene.views[row].camera, masks[scene.views[row]]
        counts = valid[scene.views[row]]
        if (label_ids != UNLABELLED).any():
            columns = np.searchsorted(ids, label_ids)
            if counts is not None:
                columns[~counts] = -1
            add_weights(gaussians, camera, columns, votes, antialiased=antialiased, workspace=workspace)
        if on_view:
            on_view(done + 1)
    total = votes.sum(1, keepdims=True)
    return Votes(ids, np.divide(votes, total, out=np.zeros_like(votes), where=total > 0))


def draw(
    gaussians: Gaussians,
    camera: Camera,
    votes: Votes,
    *,
    antialiased: bool = False,
    backend: Backend = "auto",
    workspace: Workspace | None = None,
) -> Float32[np.ndarray, "C H W"]:
    """The votes on the Gaussians alpha-blended into a camera; the sum over C is what voters cover."""
    g = gaussians.to(device_of(backend))
    features = torch.from_numpy(votes.shares).to(g.means.device)
    with torch.no_grad():
        render = rasterize(
            g, camera, sh_degree=0, features=features, antialiased=antialiased, backend=backend,
            workspace=workspace,
        )  # fmt: skip
    assert render.features is not None
    return np.moveaxis(render.features.float().cpu().numpy(), 2, 0)


def refine(
    label_ids: Int16[np.ndarray, "H W"],
    drawn: Float32[np.ndarray, "C H W"],
    ids: Int16[np.ndarray, " C"],
) -> Int16[np.ndarray, "H W"]:
    """A view's label image with the votes of all views (`drawn`, see `draw`) taken into account.

    A product of experts: the category with the largest log p_view + 2 log p_fused wins. p_view comes from the
    label. A pixel keeps its label where voters cover less than half of it or where the winner has less than
    that of their votes. An unlabelled pixel prefers no category; no label is taken away.
    """
    covered = drawn.sum(0)
    fused = drawn / np.maximum(covered, 1e-6)
    tiny = 1 - _CONFIDENCE
    own = np.where(label_ids == ids[:, None, None], _CONFIDENCE, tiny).astype(np.float32)
    trust = np.where(thin_parts(label_ids), _KEEP_THIN, 1).astype(np.float32)
    trust[label_ids == UNLABELLED] = 0
    score = trust * np.log(np.maximum(own[1:], tiny / len(ids)))
    score += _WEIGHT * np.log(np.maximum(fused[1:], tiny / len(ids)))
    best = score.argmax(0) + 1
    share = np.take_along_axis(fused, best[None], 0)[0]
    clear = (covered >= _MIN_SHARE) & (share >= _MIN_SHARE)
    return np.where(clear, ids[best], label_ids)


def thin_parts(label_ids: Int16[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Pixels that an opening of their category by a disc removes: poles, legs, twigs."""
    radius = _THIN_RADIUS
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    disc = x**2 + y**2 <= radius**2
    thin = np.zeros(label_ids.shape, bool)
    for label_id in np.unique(label_ids[label_ids != UNLABELLED]):
        mask = np.pad(label_ids == label_id, 2 * radius, mode="edge")  # nothing is thin by the image's border
        inner = (slice(2 * radius, -2 * radius),) * 2
        thin |= (mask & np.logical_not(binary_opening(mask, disc)))[inner]
    return thin


def fuse(
    gaussians: Gaussians,
    scene: Scene,
    masks: Masks,
    target: Path,
    *,
    views: Collection[int] | None = None,
    valid: ValidPixels = ALL_VALID,
    antialiased: bool = False,
    backend: Backend = "auto",
    on_view: Callable[[int, int], None] | None = None,
) -> Fused:
    """Fuse the label images of all views by way of the trained Gaussians, and write the result.

    Every Gaussian collects the labels of the pixels that it contributes to, weighted by alpha x
    transmittance. The labelled Gaussians are then rendered into each view and combined with its own label
    image.

    Args:
        gaussians: The trained model.
        scene: The capture.
        masks: Label images to start from.
        target: Folder to write, in the format of `import_masks`.
        views: Rows of `Scene.views` that vote; None: the training views. All views are written.
        valid: The pixels that vote; the others get labels as unlabelled ones do.
        antialiased: How the model was trained.
        backend: Rasteriser; decides the device.
        on_view: Called with (views done, views in all); a view votes once and is written once.

    Returns:
        The share of changed pixels in each view, and a record of the options.

    Raises:
        LabelError: If `target` is the folder of `masks`.
    """
    voters: Collection[int] = scene.train_ids.tolist() if views is None else views
    if target.resolve() == masks.folder.resolve():
        raise LabelError(f"{target}: these are the masks themselves; name another folder for the fused ones")
    total = len(voters) + len(scene.views)

    def report(done: int) -> None:
        if on_view:
            on_view(done, total)

    g = gaussians.detach().to(device_of(backend))
    votes = gather(g, scene, masks, voters, valid=valid, antialiased=antialiased, on_view=report)
    paths, workspace = prepare_folder(target, scene.views), Workspace()
    occurring: set[int] = set()
    changed: list[float] = []
    for row, (view, path) in enumerate(zip(scene.views, paths, strict=True)):
        before = masks[view]
        drawn = draw(g, view.camera, votes, antialiased=antialiased, backend=backend, workspace=workspace)
        after = refine(before, drawn, votes.ids)
        write_mask(path, after, masks.taxonomy)
        occurring.update(np.unique(after).tolist())
        changed.append(float((after != before).mean()))
        report(len(voters) + row + 1)
    write_labels(target, masks.taxonomy, occurring)
    record = {
        "weight": _WEIGHT,
        "confidence": _CONFIDENCE,
        "min_share": _MIN_SHARE,
        "keep_thin": _KEEP_THIN,
        "changed": float(np.mean(changed)),
    }
    return Fused(np.array(changed, np.float32), record)
