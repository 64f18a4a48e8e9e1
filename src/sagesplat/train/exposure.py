"""Learns a colour transform for each training photo, and fits those of held-out views to their photos."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from sagesplat.core.config import TrainConfig
from sagesplat.raster.exposure import SATURATED
from sagesplat.scene.gains import Gains, photo_gains
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Scene
from sagesplat.train.view_parameters import ViewParameters

SIZE = 12  # parameters of a view: the transform [3, 4], less the identity
_LR, _LR_END = 1e-2, 1e-3  # of Adam, decaying exponentially
_PIXELS = 60_000  # that a fit takes, evenly spread
_ROUNDS = 5  # of iteratively reweighted least squares
_PRIOR = 1e-4  # weight of the identity in a fit, as a fraction of the pixels


@dataclass(eq=False)
class ExposureUpdate:
    """Adam on the transforms of the training photos, whose mean stays the identity: exports need none."""

    train_ids: Tensor  # rows of the training views
    max_steps: int
    start: Float32[Tensor, "V 12"]  # of all views; of held-out ones zeros
    gains: Gains
    first_step: int = 1
    size: ClassVar[int] = SIZE

    def __call__(self, parameters: ViewParameters, views: Sequence[int], grad: Tensor, step: int) -> None:
        """Update the transforms of some views, then shift all so that their mean is the identity."""
        lr = _LR * (_LR_END / _LR) ** (step / self.max_steps)
        parameters.adam_step(views, grad, lr)
        rows = self.train_ids.to(parameters.values.device)
        parameters.values[rows] -= parameters.values[rows].mean(0)


def exposure_update(scene: Scene, photos: Photos, config: TrainConfig) -> tuple[ExposureUpdate | None, str]:
    """What refines the exposure of a training, or None, and in words what was found.

    `auto`: where the photos differ. Cameras that have an exposure already keep it.
    """
    if config.exposure == "off" or any(view.camera.exposure is not None for view in scene.views):
        return None, ""
    rows = scene.train_ids
    gains = photo_gains(scene, photos, rows.tolist())
    if config.exposure == "auto" and not gains.differ:
        if gains.source == "nothing":
            return None, (
                "exposure is not looked at: no tracks and no EXIF tell it;"
                " add --train.exposure affine where photos differ"
            )
        if gains.follow_direction:
            return None, (
                f"exposure varies by {gains.range_ev:.1f} EV with the viewing direction,"
                " learned as view-dependent colour; --train.exposure affine takes it out"
            )
        return None, ""
    found = f"exposure varies by {gains.range_ev:.1f} EV: a colour transform per photo"
    if not gains.differ:
        found = "a colour transform per photo, as asked for"
    start = torch.zeros(len(scene.views), SIZE)
    if gains.differ:
        offsets = gains.transforms() - np.eye(3, 4, dtype=np.float32)
        start[torch.from_numpy(rows)] = torch.from_numpy(offsets.reshape(-1, SIZE))
    return ExposureUpdate(torch.from_numpy(rows), config.max_steps, start, gains), found


def transform(offsets: Tensor) -> Float32[Tensor, "3 4"]:
    """The colour transform of a view's parameters [12]."""
    return torch.eye(3, 4, device=offsets.device) + offsets.view(3, 4)


def transforms(parameters: ViewParameters) -> Float32[np.ndarray, "V 3 4"]:
    """The colour transforms of all views."""
    return np.eye(3, 4, dtype=np.float32) + parameters.values.cpu().numpy().reshape(-1, 3, 4)


def fit_exposure(
    image: Float32[np.ndarray, "H W 3"],
    photo: Float32[np.ndarray, "H W 3"],
    valid: Bool[np.ndarray, "H W"] | None = None,
) -> Float32[np.ndarray, "3 4"]:
    """The colour transform [3, 4] that brings a rendering to a photo, by robust least squares.

    Of the `valid` pixels those count for a channel where the photo is neither black nor saturated there;
    Cauchy weights give little to what differs in content.
    """
    x, y = (image.reshape(-1, 3), photo.reshape(-1, 3)) if valid is None else (image[valid], photo[valid])
    some = slice(None, None, 1 + len(x) // _PIXELS)
    colours, y, found = x[some], y[some], np.eye(3, 4)
    x = np.concatenate([colours, np.ones_like(colours[:, :1])], 1)
    for c in range(3):
        within = (y[:, c] > 1 - SATURATED) & (y[:, c] < SATURATED)
        a, b = x[within].astype(np.float64), y[within, c].astype(np.float64)
        weight = np.ones(len(b))
        for _ in range(_ROUNDS):
            weighted = a * weight[:, None]
            prior = (_PRIOR * weight.sum() + 1e-6) * np.eye(4)
            found[c] = np.linalg.solve(weighted.T @ a + prior, weighted.T @ b + prior @ np.eye(3, 4)[c])
            errors = np.abs(a @ found[c] - b)
            weight = 1 / (1 + (errors / (2 * np.median(errors) + 1e-4)) ** 2) if len(b) else weight
    return found.astype(np.float32)
