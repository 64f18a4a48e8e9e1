"""What the base model of nested levels begins with: the trained model, merged to as few Gaussians."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from sagesplat.core.gaussians import Gaussians
from sagesplat.scene.scene import Scene
from sagesplat.train.early_stopping import spread
from sagesplat.train.importance import importance
from sagesplat.train.merging import merge
from sagesplat.train.refit import refit_coverage
from sagesplat.train.sky import Shell

_VIEWS = 24  # that blending weights are found in


def merged_start(
    g: Gaussians,
    scene: Scene,
    views: Sequence[int],
    count: int,
    *,
    antialiased: bool = False,
    shell: Shell | None = None,
) -> Gaussians:
    """About `count` Gaussians that paint what `g` paints, from neighbours of a category that merged.

    A training that begins with these is where one that begins with points is after several times the steps.
    Those of the sky, on the `shell`, stay on it.
    """
    some = spread(list(views), _VIEWS)
    weights = importance(g, scene, some, "weight", antialiased=antialiased)
    *_, merged = merge(g, weights, [count])
    found = merged.gaussians
    wanted = np.bincount(merged.into, weights=weights, minlength=len(found)).astype(np.float32)
    found = refit_coverage(found, wanted, scene, some, antialiased=antialiased)
    if shell is None:
        return found
    sky = torch.isin(found.label_ids, found.label_ids.new_tensor(shell.label_ids))  # merged, it lies within
    return replace(found, means=torch.where(sky[:, None], shell.place(found.means), found.means))
