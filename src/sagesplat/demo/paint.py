"""How hits look: normals, textures anchored in the world, light. Colours are linear, lengths in metres."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from sagesplat.demo.noise import dice, fbm
from sagesplat.demo.world import (
    BARK,
    BRICK,
    CLAY,
    CORE,
    GLAZE,
    GRASS,
    LEAF,
    PAVING,
    ROOF,
    SKY,
    SUN,
    WOOD,
    World,
    radius_at,
)

DOME = 80.0  # radius of the sphere on which the sky is painted
SUN_RGB, SKY_RGB, BOUNCE_RGB = np.array([[2.9, 2.7, 2.3], [0.62, 0.70, 0.88], [0.06, 0.06, 0.05]])


class Hits(NamedTuple):
    """Points where rays ended, in columns."""

    at: Float64[np.ndarray, "n 3"]
    normal: Float64[np.ndarray, "n 3"]  # unit, outward
    footprint: Float64[np.ndarray, " n"]  # width of a pixel on the surface
    part: Int64[np.ndarray, " n"]  # as `raycast.trace` says


def shade(
    world: World,
    origins: Float64[np.ndarray, "n 3"],
    directions: Float64[np.ndarray, "n 3"],
    hit: tuple[np.ndarray, np.ndarray, np.ndarray],
    sun: Float64[np.ndarray, " n"],
    pixel: float,
) -> Float64[np.ndarray, "n 3"]:
    """Colours of rays whose hits (t, material, part) `raycast.cast` found.

    `sun` 0 or 1 says whether a hit sees the sun (used where that is not baked); `pixel` is a pixel's width
    at distance 1.
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
    """Colours [n, 3] of hits of one material; `width` [n] is a pixel's, across the ray."""
    normal = _normals(world, kind, part, at)
    slant, facing = np.einsum("ij,ij->i", normal, directions), normal @ SUN
    hits = Hits(at, normal, width / np.sqrt(np.abs(slant).clip(0.15)), part)
    if kind == LEAF:
        rgb = _leaves(world, hits)
        behind = slant * facing > 0  # lit from behind a leaf glows yellow
        rgb[behind] *= [1.1, 1.0, 0.5]
        facing = np.abs(facing) * np.where(behind, 0.75, 1.0)
        sun, sky = world.leaf_light[part].T
    else:
        local, tint = _in_place(world, kind, hits)
        rgb = np.stack(PAINT[kind](local), 1) * tint
        sky = (0.5 + 0.5 * normal[:, 2]) * (0.4 + 1.5 * at[:, 2]).clip(0, 1)
    if kind in (GRASS, PAVING):
        sun, sky = _baked(world, at).T
    rgb *= SUN_RGB * (sun * facing.clip(0))[:, None] + SKY_RGB * sky[:, None] + BOUNCE_RGB
    if kind == GLAZE:
        mirror = directions - 2 * slant[:, None] * normal
        gleam = 2.5 * sun * (mirror @ SUN).clip(0) ** 60 + 0.10 * mirror[:, 2].clip(0)
        rgb += gleam[:, None]
    return rgb


def _in_place(world: World, kind: int, hits: Hits) -> tuple[Hits, np.ndarray | float]:
    """Hits of one material in the coordinates of their places, and the tints [n, 3] there."""
    if kind in (GRASS, PAVING):
        return hits, 1.0  # one ground for all
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
    """The sky [n, 3]: blue, paler towards the horizon, with clouds."""
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
    solid = world.solids[part]
    height = (at[:, 2] - solid[:, 2]) / solid[:, 3]
    slope = (radius_at(solid.T, height + 0.01) - radius_at(solid.T, height - 0.01)) / (0.02 * solid[:, 3])
    side = (at[:, :2] - solid[:, :2]) / (np.linalg.norm(at[:, :2] - solid[:, :2], axis=1)[:, None] + 1e-9)
    side = np.column_stack([side, -slope]) / np.sqrt(1 + slope**2)[:, None]
    cap = ((height > 0.999).astype(float) - (height < 0.001))[:, None]
    return np.where(cap != 0, cap * [0, 0, 1], side)


def _baked(world: World, at: np.ndarray) -> np.ndarray:
    """Bilinear look-up [n, 2] in the ground's light; its border's values outside of the plot."""
    light, plot = world.ground_light, world.plot
    cells = len(light) - 1
    u, v = ((at[:, :2] + plot) * (cells / (2 * plot))).clip(0, cells - 1e-6).T
    i, j = u.astype(int), v.astype(int)
    u, v, corner = (u - i)[:, None], (v - j)[:, None], i + j * len(light)
    flat = light.reshape(-1, 2)
    low = flat[corner] * (1 - u) + flat[corner + 1] * u
    corner += len(light)
    return low + v * (flat[corner] * (1 - u) + flat[corner + 1] * u - low)


def _leaves(world: World, h: Hits) -> np.ndarray:
    """The leaf's own colour, a light midrib, a mottled blade."""
    frame, out = world.leaves[h.part], h.at - world.leaves[h.part, :3]
    along, across = np.einsum("ij,ij->i", out, frame[:, 6:9]), np.einsum("ij,ij->i", out, frame[:, 9:])
    footprint = h.footprint * np.linalg.norm(frame[:, 9:], axis=1)
    tone = (1 + 0.9 * fbm(along + h.part, across, 0.9, 3, footprint)) * (
        0.85 + 0.5 * _joint(np.abs(across), 0.09, footprint)
    )
    return world.leaf_rgb[h.part] * tone[:, None]


def _joint(edge: np.ndarray, width: float, footprint: np.ndarray) -> np.ndarray:
    """How much of a joint of half `width` shows at a distance from its middle, 0 to 1, antialiased."""
    shown = ((width - edge) / (0.5 * footprint + 0.3 * width) + 0.5).clip(0, 1)
    return shown * (2 * width / footprint).clip(0, 1)


def _bricks(u: np.ndarray, v: np.ndarray, length: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Running bond: distance to the joint, number of the brick."""
    row = np.floor(v / height).astype(int)
    u = u + 0.5 * length * (row % 2)
    column = np.floor(u / length).astype(int)
    du, dv = u - column * length, v - row * height
    return np.minimum(np.minimum(du, length - du), np.minimum(dv, height - dv)), row * 1009 + column


def _stones(x: np.ndarray, y: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Irregular flagstones (Worley's cells): distance to the joint, number of the stone."""
    u, v = x / size, y / size
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    p, q = (
        np.array([(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)]).T[:, :, None] + np.stack([i, j])[:, None]
    )
    d = np.hypot(p + 0.15 + 0.7 * dice(p, q) - u, q + 0.15 + 0.7 * dice(q + 57, p) - v)
    nearest = d.argmin(0)[None]
    name = np.take_along_axis(p * 131 + q, nearest, 0)[0]
    first, second = np.partition(d, 1, axis=0)[:2]
    return size * (second - first), name


def _grass(h: Hits):
    """Tufts: dark at the root, yellow at the tip, with patches and daisies."""
    x, y, z = h.at.T
    tone = (0.35 + 15 * z) * (1 + 1.3 * fbm(x, y, 0.06, 4, h.footprint))
    dry = (0.25 + 1.4 * fbm(x, y, 1.6, 5, h.footprint)).clip(0)
    i, j = np.floor(x / 0.21).astype(int), np.floor(y / 0.21).astype(int)
    off = np.hypot(x / 0.21 - i - 0.2 - 0.6 * dice(j, i), y / 0.21 - j - 0.2 - 0.6 * dice(i + 9, j))
    daisy = (z > 0.01) & (dice(i, j) > 0.8) & (off < 0.11)
    colour = tone * (0.10 + 0.12 * dry), tone * (0.20 + 0.06 * dry), tone * (0.035 + 0.02 * dry)
    return [np.where(daisy, white, c) for white, c in zip((0.8, 0.8, 0.72), colour, strict=True)]


def _paving(h: Hits):
    """Flagstones with mossy joints."""
    x, y, _ = h.at.T
    bend = 0.05 * fbm(x, y, 0.4, 3, h.footprint)
    edge, name = _stones(x + bend, y - bend, 0.42)
    grey = 0.26 + 0.22 * dice(name, 3) + 0.30 * fbm(x, y, 0.5, 7, h.footprint)
    grey *= 1 + 0.5 * fbm(x, y, 0.018, 2, h.footprint)
    warm, joint = 0.06 * dice(name, 8), _joint(edge, 0.02, h.footprint)
    moss = 0.12 + 0.10 * fbm(x, y, 0.05, 3, h.footprint)
    stone = grey + warm, grey, 0.86 * grey - 0.4 * warm
    return [c + joint * (m * moss - c) for c, m in zip(stone, (0.8, 1.0, 0.4), strict=True)]


def _wood(h: Hits):
    """Planks along x with grain; turned wood below the top."""
    x, y, z = h.at.T
    top = h.normal[:, 2] > 0.5
    plank = np.where(top, np.floor(y / 0.095), 0).astype(int)
    x, y = np.where(top, x, 3 * (x + y)), np.where(top, y, z)
    bend = 0.01 * fbm(x, y, 0.3, 2, h.footprint)
    tone = 0.75 + 0.35 * dice(plank, 5) + 0.9 * fbm(0.12 * x + 3.0 * plank, y + bend, 0.022, 4, h.footprint)
    tone += 0.7 * fbm(0.25 * x + 7.0 * plank, y, 0.10, 3, h.footprint)
    within = y - 0.095 * plank
    gap = _joint(np.minimum(within, 0.095 - within), 0.0035, h.footprint)
    tone *= 1 - np.where(top, 0.85 * gap, 0)
    return 0.36 * tone, 0.19 * tone, 0.085 * tone


def _glaze(h: Hits):
    """White ceramic with blue bands and tendrils; soil in the mouth."""
    x, y, z = h.at.T
    turn, height = 0.12 * np.arctan2(y + 0.03, x - 0.06), (z - 0.75) / 0.38
    vine = (np.abs(fbm(turn, z, 0.06, 3, h.footprint)) < 0.028) & (height > 0.16) & (height < 0.68)
    blue = vine | (np.abs(height - 0.12) < 0.025) | (np.abs(height - 0.72) < 0.02) | (height > 0.96)
    speck = 1 + 0.25 * fbm(turn, z, 0.01, 2, h.footprint)
    speck *= np.where(h.normal[:, 2] > 0.9, 0.03, 1)
    return [speck * np.where(blue, b, w) for b, w in ((0.03, 0.62), (0.08, 0.64), (0.34, 0.62))]


def _house(h: Hits):
    """Bricks; on the front two windows with white bars and a door."""
    x, y, z = h.at.T
    u = np.where(np.abs(h.normal[:, 1]) > 0.5, x, y)
    edge, name = _bricks(u, z, 0.24, 0.085)
    tone = 0.7 + 0.55 * dice(name, 1) + 0.6 * fbm(u, z, 0.06, 3, h.footprint)
    tone *= 1 + 0.8 * fbm(u, z, 1.8, 4, h.footprint)
    joint, mortar = _joint(edge, 0.006, h.footprint), 0.42 + 0.2 * fbm(u, z, 0.1, 3, h.footprint)
    rgb = np.stack([0.36 * tone, 0.155 * tone, 0.10 * tone], 1)
    rgb += joint[:, None] * (mortar[:, None] * [1, 0.93, 0.82] - rgb)
    front, frame = (h.normal[:, 1] < -0.5) & (y < 6.3), [0.62, 0.60, 0.55]
    for middle, half, low, high in ((-2.6, 0.75, 0.95, 2.25), (3.0, 0.75, 0.95, 2.25), (0.9, 0.5, 0.0, 2.15)):
        a = np.abs(x - middle)
        around = front & (a < half + 0.09) & (z > low - 0.09) & (z < high + 0.09)
        inside = around & (a < half) & (z > low) & (z < high)
        rgb[around] = frame
        a, b, fine = a[inside], z[inside], h.footprint[inside]
        if half < 0.6:
            panel = np.where((np.abs(a - 0.25) < 0.16) & (b % 0.7 > 0.14), 0.07, 0.11)
            rgb[inside] = (panel * (1 + 0.5 * fbm(0.2 * b, a, 0.03, 3, fine)))[:, None] * [0.4, 1, 0.9]
        else:
            dark = 0.05 + 0.25 * fbm(x[inside], b, 0.8, 4, fine).clip(0) + 0.04 * (b - low)
            bars = (a < 0.03) | (np.abs(b - 1.75) < 0.025)
            rgb[inside] = np.where(bars[:, None], frame, dark[:, None] * [1, 1.2, 1.5])
    return rgb.T


def _roof(h: Hits):
    """Rows of clay tiles, a shadow under each row."""
    x, _, z = h.at.T
    up = 1.35 * (z - 2.7)
    edge, name = _bricks(x, up, 0.2, 0.22)
    tone = (0.65 + 0.35 * (up / 0.22 % 1)) * (
        0.7 + 0.5 * dice(name, 2) + 0.7 * fbm(x, up, 0.3, 5, h.footprint)
    )
    tone *= 1 - 0.6 * _joint(edge, 0.012, h.footprint)
    return 0.34 * tone, 0.14 * tone, 0.09 * tone


def _clay(h: Hits):
    """Terracotta, soil on top."""
    x, y, z = h.at.T
    tone = 1 + 0.8 * fbm(3 * x + 4 * y, z, 0.06, 4, h.footprint)
    tone *= np.where(h.normal[:, 2] > 0.9, 0.08, 1)
    return 0.42 * tone, 0.17 * tone, 0.085 * tone


def _bark(h: Hits):
    """Grey brown with upright furrows."""
    x, y, z = h.at.T
    tone = 1 + 0.8 * fbm(3 * x + 4 * y, 0.25 * z, 0.06, 4, h.footprint)
    return 0.10 * tone, 0.075 * tone, 0.05 * tone


def _core(h: Hits):
    """The dark inside of a hedge."""
    return [np.full(len(h.part), c) for c in (0.012, 0.022, 0.008)]


PAINT = {
    GRASS: _grass,
    PAVING: _paving,
    WOOD: _wood,
    GLAZE: _glaze,
    CLAY: _clay,
    BARK: _bark,
    BRICK: _house,
    ROOF: _roof,
    CORE: _core,
}
