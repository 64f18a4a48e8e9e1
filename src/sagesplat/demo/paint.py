"""Shading of ray hits: normals, light and the sky. Colours are linear, lengths in metres."""

import numpy as np
from jaxtyping import Float64

from sagesplat.demo.noise import fbm
from sagesplat.demo.textures import TEXTURES, Hits, leaf_colours
from sagesplat.demo.world import BRICK, CORE, GLAZE, GRASS, LEAF, PAVING, ROOF, SKY, SUN, World, radius_at

DOME = 80.0  # radius of the sphere on which the sky is painted
SUN_RGB, SKY_RGB, BOUNCE_RGB = np.array([[2.9, 2.7, 2.3], [0.62, 0.70, 0.88], [0.06, 0.06, 0.05]])


def shade(
    world: World,
    origins: Float64[np.ndarray, "n 3"],
    directions: Float64[np.ndarray, "n 3"],
    hit: tuple[np.ndarray, np.ndarray, np.ndarray],
    sun: Float64[np.ndarray, " n"],
    pixel: float,
) -> Float64[np.ndarray, "n 3"]:
    """Linear RGB of rays with the hits (t, material, part) of `raycast.cast`.

    `sun` is 1 for hits that see the sun, else 0 (for materials whose light is not baked). `pixel` is the
    width of a pixel at distance 1.
    """
    t, material, part = hit
    order = material.astype(np.int8).argsort(kind="stable")
    bounds = np.searchsorted(material[order], np.arange(SKY, LEAF + 2))
    rgb = np.empty_like(directions)
    for kind in range(SKY, LEAF + 1):
        rows = order[bounds[kind] : bounds[kind + 1]]
        if len(rows) and kind == SKY:
            rgb[rows] = clouds(origins[rows], directions[rows])
        elif len(rows):
            at = origins[rows] + t[rows, None] * directions[rows]
            rgb[rows] = _lit(world, kind, at, directions[rows], part[rows], sun[rows], pixel * t[rows])
    return rgb


def _lit(world: World, kind: int, at, directions, part, sun, width) -> np.ndarray:
    """Linear RGB [n, 3] of hits of one material; `width` [n]: of a pixel, perpendicular to the ray."""
    normal = _normals(world, kind, part, at)
    slant, facing = np.einsum("ij,ij->i", normal, directions), normal @ SUN
    hits = Hits(at, normal, width / np.sqrt(np.abs(slant).clip(0.15)), part)
    if kind == LEAF:
        rgb = leaf_colours(world, hits)
        behind = slant * facing > 0  # leaves lit from behind look yellow
        rgb[behind] *= [1.1, 1.0, 0.5]
        facing = np.abs(facing) * np.where(behind, 0.75, 1.0)
        sun, sky = world.leaf_light[part].T
    else:
        local, tint = _in_place(world, kind, hits)
        rgb = np.stack(TEXTURES[kind](local), 1) * tint
        sky = (0.5 + 0.5 * normal[:, 2]) * (0.4 + 1.5 * at[:, 2]).clip(0, 1)
    if kind in (GRASS, PAVING):
        sun, sky = _baked(world, at).T
    rgb *= light_on(facing, sun, sky)
    if kind == GLAZE:
        mirror = directions - 2 * slant[:, None] * normal
        gleam = 2.5 * sun * (mirror @ SUN).clip(0) ** 60 + 0.10 * mirror[:, 2].clip(0)
        rgb += gleam[:, None]
    return rgb


def light_on(facing: np.ndarray, sun: np.ndarray, sky: np.ndarray) -> Float64[np.ndarray, "n 3"]:
    """Linear RGB of the light on surfaces: `facing` the sun by this cosine, in this share of sun and sky."""
    return SUN_RGB * (sun * facing.clip(0))[:, None] + SKY_RGB * sky[:, None] + BOUNCE_RGB


def _in_place(world: World, kind: int, hits: Hits) -> tuple[Hits, np.ndarray | float]:
    """Hits of one material in the coordinates of their courtyards, and the tints [n, 3] there."""
    if kind in (GRASS, PAVING):
        return hits, 1.0  # all courtyards share the ground
    place = world.body_place[hits.part // 8] if kind in (BRICK, ROOF, CORE) else world.solid_place[hits.part]
    frame, at, normal = world.places[place], hits.at.copy(), hits.normal.copy()
    at[:, :2] = np.einsum("nij,nj->ni", frame[:, :, :2], at[:, :2]) + frame[:, :, 2]
    normal[:, :2] = np.einsum("nij,nj->ni", frame[:, :, :2], normal[:, :2])
    return hits._replace(at=at, normal=normal), world.tints[place, kind]


def dome_distance(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance [n] from points inside the dome to its surface."""
    b = np.einsum("ij,ij->i", origins, directions)
    return -b + np.sqrt(b * b + DOME**2 - np.einsum("ij,ij->i", origins, origins))


def clouds(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Linear RGB [n, 3] of the sky: blue, paler towards the horizon, with clouds."""
    x, y, z = ((origins + dome_distance(origins, directions)[:, None] * directions) / DOME).T
    z, fine = z.clip(0), np.full(len(z), 0.01)
    u, v = x / (z + 0.22), y / (z + 0.22)
    cover = fbm(u + 3, v, 0.9, 6, fine) + 0.35 * fbm(u, v, 2.2, 2, fine)
    cover = (3.2 * cover + 0.35).clip(0, 1)[:, None]
    blue = [0.20, 0.40, 0.78] + (1 - z[:, None]) ** 3 * [0.42, 0.32, 0.12]
    return blue + cover * (1.02 - 0.25 * fbm(u, v, 0.5, 4, fine)[:, None] - blue)


def _normals(world: World, kind: int, part: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Unit outward normals [n, 3] of hits of one material."""
    if kind == LEAF:
        return world.leaves[part, 3:6]
    if kind in (BRICK, ROOF, CORE):
        return world.bodies[part // 8, part % 8, :3]
    if kind in (GRASS, PAVING):
        return np.tile([0.0, 0.0, 1.0], (len(at), 1))
    return solid_normals(world.solids[part], at)


def solid_normals(
    solid: Float64[np.ndarray, "n 9"], at: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Unit outward normals of points on solids of revolution (rows of `World.solids`)."""
    height = (at[:, 2] - solid[:, 2]) / solid[:, 3]
    slope = (radius_at(solid.T, height + 0.01) - radius_at(solid.T, height - 0.01)) / (0.02 * solid[:, 3])
    side = (at[:, :2] - solid[:, :2]) / (np.linalg.norm(at[:, :2] - solid[:, :2], axis=1)[:, None] + 1e-9)
    side = np.column_stack([side, -slope]) / np.sqrt(1 + slope**2)[:, None]
    cap = ((height > 0.999).astype(float) - (height < 0.001))[:, None]
    return np.where(cap != 0, cap * [0, 0, 1], side)


def _baked(world: World, at: np.ndarray) -> np.ndarray:
    """Baked light [n, 2] on the ground, interpolated bilinearly and clamped to the plot."""
    light, plot = world.ground_light, world.plot
    cells = len(light) - 1
    u, v = ((at[:, :2] + plot) * (cells / (2 * plot))).clip(0, cells - 1e-6).T
    i, j = u.astype(int), v.astype(int)
    u, v, corner = (u - i)[:, None], (v - j)[:, None], i + j * len(light)
    flat = light.reshape(-1, 2)
    low = flat[corner] * (1 - u) + flat[corner + 1] * u
    corner += len(light)
    return low + v * (flat[corner] * (1 - u) + flat[corner + 1] * u - low)
