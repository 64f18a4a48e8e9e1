"""Labels of trained Gaussians, by the pixels that each contributes to."""

from collections.abc import Collection

import numpy as np
import torch
from jaxtyping import Float32, Int16

from sagesplat.core.gaussians import Gaussians
from sagesplat.raster import Workspace, add_weights
from sagesplat.scene.scene import Scene
from sagesplat.segment.masks import UNLABELLED, Masks


def label_weights(
    gaussians: Gaussians,
    scene: Scene,
    masks: Masks,
    views: Collection[int],
    *,
    antialiased: bool = False,
) -> tuple[Int16[np.ndarray, " L"], Float32[np.ndarray, "N L"]]:
    """Category ids, ascending, and each Gaussian's blending weight on the pixels of each.

    The weights (alpha times transmittance) are summed over the pixels of `views` (rows of `Scene.views`);
    unlabelled pixels do not vote.
    """
    ids = np.array(sorted(masks.taxonomy.names), np.int16)
    column_of = np.full(int(ids.max(initial=0)) + 2, -1, np.int64)  # the last one for unlabelled, -1
    column_of[ids] = np.arange(len(ids))
    weights, workspace = np.zeros((len(gaussians), len(ids)), np.float32), Workspace()
    for row in views:
        view = scene.views[row]
        columns = column_of[masks[view]]
        add_weights(gaussians, view.camera, columns, weights, antialiased=antialiased, workspace=workspace)
    return ids, weights


def winners(
    gaussians: Gaussians, ids: Int16[np.ndarray, " L"], weights: Float32[np.ndarray, "N L"]
) -> torch.Tensor:
    """The category that each Gaussian paints most of, int16 [N]; its old one where no view shows it.

    `ids` and `weights` as of `label_weights`.
    """
    best = ids[weights.argmax(1)] if len(ids) else np.full(len(gaussians), UNLABELLED, np.int16)
    seen, old = torch.from_numpy(weights.sum(1) > 0), gaussians.label_ids
    return torch.where(seen.to(old.device), torch.from_numpy(best).to(old.device), old)
