"""Renders the garden: colour, label and depth of every pixel."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import NamedTuple
from zlib import crc32

import numpy as np
from jaxtyping import Float32, Float64, Int16, Int64, UInt8
from numba import get_num_threads

from sagesplat.demo.figures import PERSON, Figures, cast_figures, shade_figures
from sagesplat.demo.paint import shade
from sagesplat.demo.places import build_places
from sagesplat.demo.raycast import cast
from sagesplat.demo.world import LABEL_OF, LEAF, PAVING, SKY, SUN, World, build_world
from sagesplat.scene.scene import Camera

FAR = 1e9
HORIZON = 20.0  # metres; nothing farther away casts a shadow
SENSOR_NOISE = 1.0  # standard deviation, 8-bit steps
FIGURE = LEAF + 1  # material of `figures.Figures`
NEEDS_RAY = 3  # materials from this one on, except leaves, cast a shadow ray


class Lit(NamedTuple):
    """What reaches a camera; all but the colour are those of the ray through the pixel's centre."""

    rgb: Float64[np.ndarray, "H W 3"]  # linear
    label: Int16[np.ndarray, "H W"]
    depth: Float32[np.ndarray, "H W"]  # camera z in metres, inf in the sky
    material: Int64[np.ndarray, "H W"]
    part: Int64[np.ndarray, "H W"]  # of `raycast.trace`


@lru_cache(maxsize=1)
def lit_world(seed: int, places: tuple[int, int]) -> World:
    """The garden of a seed with baked light; `places`: number of courtyards along x and y."""
    world = build_world(seed) if places == (1, 1) else build_places(seed, places)
    axis = np.linspace(-world.plot, world.plot, len(world.ground_light))
    ground = np.stack([*np.meshgrid(axis, axis), np.zeros((len(axis), len(axis)))], -1)
    for points, light in ((ground, world.ground_light), (world.leaves[:, :3], world.leaf_light)):
        for toward, column in ((_sun_directions(), 0), (_sky_directions(), 1)):
            light[..., column] = _open_share(world, points.reshape(-1, 3).astype(float), toward).reshape(
                light.shape[:-1]
            )
    return world


def render_view(
    camera: Camera, seed: int = 0
) -> tuple[UInt8[np.ndarray, "H W 3"], Int16[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
    """A photo (sRGB) with its ground-truth label ids and depths (camera z in metres, inf in the sky).

    Label and depth are those of the ray through the pixel's centre. The clouds are on a dome of 80 m radius.
    The sensor noise depends on seed and pose, so a view always gives the same photo.
    """
    lit = render_light(camera, seed)
    return take_photo(lit.rgb, camera, seed), lit.label, lit.depth


def render_light(
    camera: Camera, seed: int = 0, places: tuple[int, int] = (1, 1), figures: Figures | None = None
) -> Lit:
    """What reaches a camera. `figures` stand in the scene, without shadows."""
    world, shape = lit_world(seed, places), (camera.height, camera.width)
    pixel = float(1 / camera.K[0, 0])
    v, u = (np.indices(shape) + 0.5).reshape(2, -1)
    uv = np.stack([u, v], 1)
    hit, rgb, z_share = _sample(world, camera, uv, pixel, 0, figures)
    t, material, part = hit
    label = np.select(
        [material == LEAF, material == FIGURE], [world.leaf_label[part], PERSON], LABEL_OF[material % FIGURE]
    ).astype(np.int16)
    depth = np.where(material == SKY, np.inf, t * z_share).astype(np.float32)
    tone = _develop(rgb.mean(1))
    rough = _edges(material.reshape(shape), part.reshape(shape), tone.reshape(shape)).ravel()
    for k in range(1, 4):  # three more rays per pixel where the image is not smooth
        offset = 0.38 * np.array([np.cos(2.1 * k), np.sin(2.1 * k)])
        rgb[rough] += _sample(world, camera, uv[rough] + offset, pixel, k, figures)[1]
    rgb[rough] /= 4
    return Lit(rgb.reshape(*shape, 3), *(of.reshape(shape) for of in (label, depth, material, part)))


def take_photo(light: Float64[np.ndarray, "H W 3"], camera: Camera, seed: int) -> UInt8[np.ndarray, "H W 3"]:
    """The photo (sRGB) of linear RGB: tone curve, sensor noise, 8 bits."""
    rng = np.random.default_rng([seed, crc32(camera.w2c.tobytes())])
    photo = 255 * _develop(light) + rng.normal(0, SENSOR_NOISE, light.shape)
    return photo.round().clip(0, 255).astype(np.uint8)


def cast_rays(
    world: World,
    origins: Float64[np.ndarray, "n 3"],
    directions: Float64[np.ndarray, "n 3"],
    t_max: float | np.ndarray,
    pixel: float,
    any_hit: bool = False,
) -> tuple[Float64[np.ndarray, " n"], Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    """Distance, material and part of the nearest hit of each ray (see `raycast.trace`)."""
    n = len(directions)
    hit = np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64)
    limits = np.broadcast_to(np.asarray(t_max, float), n).copy()
    cast(world, np.ascontiguousarray(origins), np.ascontiguousarray(directions), limits, pixel, any_hit, *hit)
    return hit


def camera_rays(camera: Camera, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins, unit directions [n, 3] and camera z per unit of distance [n] of pixels uv [n, 2]."""
    focal, middle = camera.K[[0, 1], [0, 1]], camera.K[:2, 2]
    inward = np.concatenate([(uv - middle) / focal, np.ones((len(uv), 1))], 1)
    length = np.linalg.norm(inward, axis=1)
    directions = inward @ camera.w2c[:3, :3].astype(float) / length[:, None]
    return np.tile(camera.position.astype(float), (len(uv), 1)), directions, 1 / length


def _sample(world: World, camera: Camera, uv: np.ndarray, pixel: float, k: int, figures: Figures | None):
    """Hits, linear RGB and camera z per distance of rays through uv; shadow rays aim at sun point k."""
    origins, directions, z_share = camera_rays(camera, uv)
    hit = cast_rays(world, origins, directions, FAR, pixel)
    t, material = hit[:2]
    sun = np.zeros(len(t))
    ask = (material >= NEEDS_RAY) & (material != LEAF)
    at = origins[ask] + (t[ask, None] - 2e-3) * directions[ask]
    toward = np.tile(_sun_directions()[k], (len(at), 1))
    sun[ask] = cast_rays(world, at, toward, HORIZON, pixel, True)[1] == SKY
    rgb = shade(world, origins, directions, hit, sun, pixel)
    if figures:
        _draw_figures(world, figures, origins, directions, hit, rgb, k, pixel)
    return hit, rgb, z_share


def _draw_figures(world: World, figures: Figures, origins, directions, hit, rgb, k: int, pixel: float):
    """Change hits and colours of the rays that figures stop."""
    t, row = cast_figures(figures, origins, directions, hit[0])
    rows = np.flatnonzero(row >= 0)
    t, row = t[rows], row[rows]
    at = origins[rows] + (t - 2e-3)[:, None] * directions[rows]
    toward = np.tile(_sun_directions()[k], (len(at), 1))
    sun = (cast_rays(world, at, toward, HORIZON, pixel, True)[1] == SKY).astype(float)
    rgb[rows] = shade_figures(figures, row, at, sun, pixel * t)
    for values, new in zip(hit, (t, FIGURE, row), strict=True):
        values[rows] = new


def _edges(material: np.ndarray, part: np.ndarray, tone: np.ndarray) -> np.ndarray:
    """Pixels [H, W] that need more than one ray: borders of parts, and high contrast (`tone` is sRGB).

    Paving and sky have no hard edges: their textures fade out below a pixel's width.
    """
    rough = np.zeros(tone.shape, bool)
    plain = (material == PAVING) | (material == SKY)
    key = material * (1 << 20) + np.where(material == LEAF, 0, part)
    for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        step = (key[a] != key[b]) | (~plain[a] & (np.abs(tone[a] - tone[b]) > 0.06))
        rough[a] |= step
        rough[b] |= step
    return rough


def _develop(rgb: np.ndarray) -> np.ndarray:
    """Linear RGB to sRGB in [0, 1], tone-mapped by Reinhard's curve with white at 3."""
    light = 1.15 * rgb.clip(0)
    light = (light * (1 + light / 9) / (1 + light)).clip(0, 1)
    return np.where(light < 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def _sun_directions() -> np.ndarray:
    """Directions [4, 3] to four points of the sun's disc."""
    turn = 2.4 * np.arange(4)
    offset = 0.012 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    return (SUN + offset) / np.linalg.norm(SUN + offset, axis=1, keepdims=True)


def _sky_directions() -> np.ndarray:
    """Eight directions [8, 3], cosine-weighted around the zenith."""
    turn, rise = 2.39996 * np.arange(8), np.sqrt((np.arange(8) + 0.5) / 8)
    side = np.sqrt(1 - rise**2)
    return np.stack([side * np.cos(turn), side * np.sin(turn), rise], 1)


def _open_share(world: World, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Share [n] of the directions [k, 3] in which points [n, 3] see the sky."""

    def one(direction: np.ndarray) -> np.ndarray:
        rays = np.tile(direction, (len(points), 1))
        return cast_rays(world, points + 0.02 * rays, rays, HORIZON, 0.003, True)[1] == SKY

    return np.mean(list(threads_map(one, directions)), axis=0)


def threads_map(function, items) -> Iterator:
    """`map` on as many threads as numba may use; the kernels release the GIL."""
    with ThreadPoolExecutor(get_num_threads()) as pool:
        yield from pool.map(function, items)
