"""Procedural textures of the garden's materials in world coordinates, metres. Colours are linear."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from sagesplat.demo.noise import dice, fbm
from sagesplat.demo.world import BARK, BRICK, CLAY, CORE, GLAZE, GRASS, PAVING, ROOF, WOOD, World


class Hits(NamedTuple):
    """Ray hits, in columns."""

    at: Float64[np.ndarray, "n 3"]
    normal: Float64[np.ndarray, "n 3"]  # unit, outward
    footprint: Float64[np.ndarray, " n"]  # width of a pixel on the surface
    part: Int64[np.ndarray, " n"]  # as returned by `raycast.trace`


def leaf_colours(world: World, h: Hits) -> np.ndarray:
    """Linear RGB [n, 3] of leaves: their own colour with a light midrib and a mottled blade."""
    frame, out = world.leaves[h.part], h.at - world.leaves[h.part, :3]
    along, across = np.einsum("ij,ij->i", out, frame[:, 6:9]), np.einsum("ij,ij->i", out, frame[:, 9:])
    footprint = h.footprint * np.linalg.norm(frame[:, 9:], axis=1)
    tone = (1 + 0.9 * fbm(along + h.part, across, 0.9, 3, footprint)) * (
        0.85 + 0.5 * _joint(np.abs(across), 0.09, footprint)
    )
    return world.leaf_rgb[h.part] * tone[:, None]


def _joint(edge: np.ndarray, width: float, footprint: np.ndarray) -> np.ndarray:
    """Antialiased coverage, 0 to 1, of a joint of half `width` at distance `edge` from its middle."""
    shown = ((width - edge) / (0.5 * footprint + 0.3 * width) + 0.5).clip(0, 1)
    return shown * (2 * width / footprint).clip(0, 1)


def _bricks(u: np.ndarray, v: np.ndarray, length: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Running bond: distance to the joint [n], index of the brick [n]."""
    row = np.floor(v / height).astype(int)
    u = u + 0.5 * length * (row % 2)
    column = np.floor(u / length).astype(int)
    du, dv = u - column * length, v - row * height
    return np.minimum(np.minimum(du, length - du), np.minimum(dv, height - dv)), row * 1009 + column


def _stones(x: np.ndarray, y: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Irregular flagstones (Worley noise): distance to the joint [n], index of the stone [n]."""
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


TEXTURES = {  # material -> texture
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
