"""Estimates the vignetting of a capture from the colours that photos show of the same points.

All photos have it alike, so no exposure of single photos explains it: a model trained on them shows dark
rings around what the path looked at as soon as a viewer leaves it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64, Int64

from sagesplat.scene.gains import cross_validated, log_gains
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import STEEPEST, Scene, Vignetting
from sagesplat.scene.track_colours import track_colours
from sagesplat.scene.vignetting import CURVE, OFFSET, powers

_ENOUGH = 30  # observations of a photo, on average
_POINTS = 100  # that photos share, at least
_PASSES = 2  # over the lens and the photos' gains, in turn
_ROUNDS = 10  # of iteratively reweighted least squares
_EXPLAINED = 0.03  # least share by which the lens has to bring colours of the same point together
_LEAST = 0.05  # share of the light that has to be lost at the reach


def estimate_vignetting(scene: Scene, photos: Photos | Sequence[np.ndarray]) -> Vignetting | None:
    """The vignetting of the training photos, taken to have one lens; None where tracks tell none.

    Points that photos show at several distances from the optical axis tell it, by robust least squares
    (Goldman & Chen 2005) along with a gain for each photo. It has to hold for points it was not fitted to.
    """
    rows = scene.train_ids.tolist()
    seen = track_colours(scene, photos, rows)
    if len(seen.points) < _ENOUGH * max(1, len(rows)) or seen.points.max(initial=-1) + 1 < _POINTS:
        return None
    points, views = seen.points, seen.views
    K = np.stack([scene.views[row].camera.K for row in rows]).astype(np.float64)[views]
    log = np.log(seen.colours + OFFSET).mean(1)
    t = (((seen.uv - K[:, :2, 2]) / K[:, [0, 1], [0, 1]]) ** 2).sum(1)  # tan^2 of the angles to the axes
    reach = float(t.max())
    basis, found = powers(t, reach), np.zeros(2)
    plain = full = log - log_gains(points, views, log, len(rows))[views]
    for _ in range(_PASSES):
        found = _lens(points, full, basis)
        full = log - log_gains(points, views, log - basis @ found, len(rows))[views]
    a, b = (CURVE * found).tolist()
    vignetting = Vignetting((a, b), reach)
    if max(abs(a), abs(b)) > STEEPEST or vignetting.lost < _LEAST:
        return None

    def left(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (full[b] - basis[b] @ _lens(points[a], full[a], basis[a]))[:, None]

    # log values less the photos' gains, found without and with the lens
    explained = cross_validated(points, plain[:, None], left)
    return vignetting if explained >= _EXPLAINED else None


def with_vignetting(scene: Scene, vignetting: Vignetting | None) -> Scene:
    """The scene whose photos are read without this vignetting; None: as they are."""
    return replace(scene, views=tuple(replace(view, vignetting=vignetting) for view in scene.views))


def _lens(
    points: Int64[np.ndarray, " T"], log: Float64[np.ndarray, " T"], basis: Float64[np.ndarray, "T 2"]
) -> Float64[np.ndarray, "2"]:
    """Minimise the robust sum of (log - basis @ c - colour of the point)^2; c. Geman-McClure weights."""
    weight = np.ones(len(log))
    found = np.zeros(2)
    for _ in range(_ROUNDS):
        total = np.maximum(np.bincount(points, weight), 1e-9)
        columns = np.column_stack([basis, log])
        means = np.stack([np.bincount(points, weight * column) / total for column in columns.T], 1)
        inner = columns - means[points]
        x, y = inner[:, :2], inner[:, 2]
        normal = (x * weight[:, None]).T @ x + 1e-3 * np.eye(2)
        found = np.linalg.solve(normal, (x * weight[:, None]).T @ y)
        errors = y - x @ found
        scale = 2 * 1.4826 * float(np.median(np.abs(errors))) + 1e-4
        weight = 1 / (1 + (errors / scale) ** 2) ** 2
    return found
