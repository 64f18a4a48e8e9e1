"""People who walk through the garden, drawn over a photo as solids of revolution. Metres, colours linear."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sagesplat.demo.noise import fbm, jit
from sagesplat.demo.paint import light_on, solid_normals
from sagesplat.demo.raycast import hit_solid
from sagesplat.demo.world import SUN, solid

PERSON = 1  # COCO's id
NEAREST = 1.4  # metres between a photographer and a figure
CLOTHES = np.array(
    [[0.35, 0.03, 0.03], [0.03, 0.09, 0.35], [0.5, 0.4, 0.05], [0.04, 0.2, 0.1], [0.5, 0.5, 0.48]]
)
TROUSERS = np.array([[0.03, 0.04, 0.09], [0.05, 0.045, 0.04], [0.22, 0.18, 0.12]])
SKIN = np.array([[0.48, 0.27, 0.19], [0.22, 0.11, 0.07], [0.36, 0.2, 0.13]])
HAIR = [0.03, 0.02, 0.015]


class Figures(NamedTuple):
    """The bodies of everybody in a photo."""

    solids: Float64[np.ndarray, "S 9"]  # as `World.solids`
    rgb: Float64[np.ndarray, "S 3"]  # linear albedo
    head: np.ndarray  # [S] bool


def figures_at(photo: int, camera_centre: np.ndarray, count: int, seed: int) -> Figures:
    """Where `count` people are in a photo: each goes around the table at a pace and distance of their own.

    Nobody stands in front of the lens: who would be nearer than `NEAREST` is on the table's other side.
    """
    rows, colours, heads = [], [], []
    for person in range(count):
        rng = np.random.default_rng([seed, 14, person])
        pace, swing = rng.choice([-1, 1]) * rng.uniform(0.35, 0.9), rng.uniform(0.2, 1.5)
        turn = rng.uniform(0, 2 * np.pi) + pace * photo
        away = 2.9 + 1.3 * np.sin(swing * photo + rng.uniform(0, 2 * np.pi))
        place = away * np.array([np.cos(turn), np.sin(turn)])
        if np.linalg.norm(place - camera_centre[:2]) < NEAREST:
            place = -place
        clothes, trousers, skin = (rng.choice(c) for c in (CLOTHES, TROUSERS, SKIN))
        body = _body(place, turn + np.pi / 2, rng.uniform(0.93, 1.06))
        rows += body
        colours += [trousers, trousers, clothes, clothes, clothes, skin, skin]
        heads += [False] * (len(body) - 1) + [True]
    return Figures(np.array(rows).reshape(-1, 9), np.array(colours).reshape(-1, 3), np.array(heads, bool))


def _body(place: np.ndarray, heading: float, size: float) -> list[list[float]]:
    """Rows of `World.solids`: legs, trunk, arms, neck and head of somebody of 1.72 * `size` metres."""
    side, ahead = np.array([-np.sin(heading), np.cos(heading)]), np.array([np.cos(heading), np.sin(heading)])

    def part(across, along, bottom, height, r0, r1, belly=0.0, waist=0.0):
        x, y = place + size * (across * side + along * ahead)
        return solid(x, y, size * bottom, size * height, *(size * r for r in (r0, r1, belly, waist)))

    return [
        part(0.09, 0.12, 0.0, 0.84, 0.055, 0.095),
        part(-0.09, -0.12, 0.0, 0.84, 0.055, 0.095),
        part(0, 0, 0.80, 0.64, 0.15, 0.13, 0.05, 0.02),
        part(0.23, 0.05, 0.80, 0.60, 0.04, 0.06),
        part(-0.23, -0.05, 0.80, 0.60, 0.04, 0.06),
        part(0, 0, 1.40, 0.10, 0.06, 0.055),
        part(0, 0.02, 1.47, 0.25, 0.03, 0.02, 0.08),
    ]


def cast_figures(
    figures: Figures,
    origins: Float64[np.ndarray, "n 3"],
    directions: Float64[np.ndarray, "n 3"],
    t_max: Float64[np.ndarray, " n"],
) -> tuple[Float64[np.ndarray, " n"], np.ndarray]:
    """Distance and row in `figures` of the nearest hit of each ray below `t_max`; row -1 for none."""
    t, part = t_max.copy(), np.full(len(t_max), -1)
    _cast(figures.solids, np.ascontiguousarray(origins), np.ascontiguousarray(directions), t, part)
    return t, part


@jit
def _cast(solids, origins, directions, t, part):
    for i in range(len(t)):
        ox, oy, oz = origins[i, 0], origins[i, 1], origins[i, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        for row in range(solids.shape[0]):
            near = hit_solid(solids, row, ox, oy, oz, dx, dy, dz, t[i])
            if near < t[i]:
                t[i], part[i] = near, row


def shade_figures(
    figures: Figures,
    part: np.ndarray,
    at: Float64[np.ndarray, "n 3"],
    sun: Float64[np.ndarray, " n"],
    footprint: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, "n 3"]:
    """Linear RGB of hits, with folds in the cloth and hair on the heads; `sun`: 1 where it shines."""
    row, normal = figures.solids[part], solid_normals(figures.solids[part], at)
    x, y, z = at.T
    folds = 1 + 0.7 * fbm(x - row[:, 0] + y - row[:, 1], 0.4 * z, 0.09, 3, footprint)
    hair = figures.head[part] & (z > row[:, 2] + 0.62 * row[:, 3])
    rgb = np.where(hair[:, None], HAIR, figures.rgb[part] * folds[:, None])
    sky = (0.5 + 0.5 * normal[:, 2]) * (0.4 + 1.5 * z).clip(0, 1)
    return rgb * light_on(normal @ SUN, sun, sky)
