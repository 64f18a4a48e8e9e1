"""The garden as arrays: leaves in a bounding-volume hierarchy, solids of revolution, convex bodies.

World units are metres and z points up. The table is at the origin, the house to the north (+y).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int16, Int64

from sagesplat.demo.foliage import NO_OBJECT, POTTED_PLANT, Foliage

# Materials. Leaves (LEAF) have a label each; every other material has one label.
SKY, GRASS, PAVING, WOOD, GLAZE, CLAY, BARK, BRICK, ROOF, CORE, LEAF = range(11)
LABELS = {
    64: "potted plant",
    67: "dining table",
    86: "vase",
    184: "tree-merged",
    187: "sky-other-merged",
    191: "pavement-merged",
    193: "grass-merged",
    197: "building-other-merged",
}
LABEL_OF = np.array([187, 193, 191, 67, 86, 64, 184, 197, 197, 184, -1], np.int16)  # by material

# Objects: what a person would count. The hedges and the trees of the garden follow these.
TABLE, VASE, HOUSE, BOUQUET, PLANT, HEDGE = 0, 1, 2, 3, 4, 6
TREE = HEDGE + 5

BIN = 4  # leaves per box at the bottom of the tree
PLOT = 8.0  # half the side of the square of one courtyard
DOOR_PATH = (0.9, 3.1, 0.62, 3.1)  # centre and half extents, from the table to the house
LIGHT_CELLS = 20  # samples of the baked light per metre of ground
SUN = np.array([-0.48, -0.52, 0.71]) / np.linalg.norm([-0.48, -0.52, 0.71])  # towards it


class World(NamedTuple):
    """All geometry of the scene; a NamedTuple, since numba can compile functions of one."""

    boxes: Float64[np.ndarray, "2*bins 6"]  # heap order, root at 1: lowest and highest corner
    axes: Int64[np.ndarray, " bins"]  # axis along which the children of a box differ
    leaves: Float64[np.ndarray, "L 12"]  # centre, unit normal, and two axes divided by their squared length
    leaf_rgb: Float32[np.ndarray, "L 3"]  # linear albedo
    leaf_light: Float32[np.ndarray, "L 2"]  # baked: visible shares of the sun and of the sky
    leaf_label: Int16[np.ndarray, " L"]
    leaf_object: Int16[np.ndarray, " L"]  # NO_OBJECT for the wood
    solids: Float64[np.ndarray, "S 9"]  # x, y, bottom, height, r0, r1, belly, waist; largest radius
    solid_material: Int64[np.ndarray, " S"]
    bodies: Float64[np.ndarray, "B 7 4"]  # planes: outward normal n and c; inside is n.p <= c
    body_material: Int64[np.ndarray, " B"]
    ground_light: Float32[np.ndarray, "G G 2"]  # baked likewise; rows along y, columns along x
    plot: float  # the ground's light is baked on [-plot, plot] squared
    terraces: Float64[np.ndarray, "P 2"]  # centres of round pavements
    paths: Float64[np.ndarray, "K 4"]  # paved rectangles: centre and half extents
    solid_place: Int64[np.ndarray, " S"]
    body_place: Int64[np.ndarray, " B"]
    places: Float64[np.ndarray, "P 2 3"]  # world to courtyard, in the ground plane
    tints: Float64[np.ndarray, "P 11 3"]  # colour factors of a material in a courtyard
    solid_object: Int16[np.ndarray, " S"]
    body_object: Int16[np.ndarray, " B"]


def build_world(seed: int) -> World:
    """The garden of a seed, without light (`render.lit_world` bakes it)."""
    foliage = Foliage(np.random.default_rng(seed))
    solids, bodies = furniture(), buildings()
    solids += [
        (solid(1.75, 1.2, 0.0, 0.34, 0.15, 0.21), CLAY),
        (solid(-1.7, 1.45, 0.0, 0.28, 0.12, 0.18), CLAY),
    ]
    _plant(foliage, solids, bodies)
    return assemble(
        foliage.parts,
        solids,
        bodies,
        plot=PLOT,
        terraces=np.zeros((1, 2)),
        paths=np.array([DOOR_PATH]),
        solid_place=np.zeros(len(solids), np.int64),
        body_place=np.zeros(len(bodies), np.int64),
        places=np.eye(2, 3)[None],
        tints=np.ones((1, 11, 3)),
        solid_object=np.array([TABLE] * 3 + [VASE, PLANT, PLANT + 1, *range(TREE, TREE + 4)], np.int16),
        body_object=np.array([HOUSE] * 3 + [*range(HEDGE, TREE)], np.int16),
    )


def assemble(
    leaves: list[tuple[np.ndarray, ...]],
    solids: list[tuple[list[float], int]],
    bodies: list[tuple[np.ndarray, int]],
    plot: float,
    **rest: np.ndarray,
) -> World:
    """A world without light from `Foliage.parts`, solids and bodies with materials; `rest`: other fields."""
    frame, reach, rgb, label, number = (np.concatenate(c) for c in zip(*leaves, strict=True))
    cells = round(2 * plot * LIGHT_CELLS) + 1
    order, boxes, axes = _box_tree(frame[:, :3], reach)
    return World(
        boxes=boxes,
        axes=axes,
        leaves=frame[order],
        leaf_rgb=rgb[order].astype(np.float32),
        leaf_light=np.zeros((len(order), 2), np.float32),
        leaf_label=label[order].astype(np.int16),
        leaf_object=number[order].astype(np.int16),
        solids=np.array([row for row, _ in solids]),
        solid_material=np.array([m for _, m in solids]),
        bodies=np.array([planes for planes, _ in bodies]),
        body_material=np.array([m for _, m in bodies]),
        ground_light=np.zeros((cells, cells, 2), np.float32),
        plot=plot,
        **rest,
    )


def furniture() -> list[tuple[list[float], int]]:
    """Solids of revolution: the table and the vase on it."""
    return [
        (solid(0, 0, 0.71, 0.04, 0.60, 0.60), WOOD),
        (solid(0, 0, 0.04, 0.67, 0.06, 0.05, 0.015, 0.01), WOOD),
        (solid(0, 0, 0.00, 0.05, 0.30, 0.22), WOOD),
        (solid(0.06, -0.03, 0.75, 0.38, 0.075, 0.075, 0.065, 0.05), GLAZE),
    ]


def solid(
    x: float, y: float, z: float, height: float, r0: float, r1: float, belly: float = 0, waist: float = 0
) -> list[float]:
    """A row of `World.solids` at (x, y, z), with radius r0 at the bottom and r1 at the top."""
    return [x, y, z, height, r0, r1, belly, waist, max(r0, r1) + abs(belly) + abs(waist)]


def buildings() -> list[tuple[np.ndarray, int]]:
    """Convex bodies: the house, its front roof, a chimney."""
    house = box([-4.6, 6.2, 0], [4.6, 8.6, 6])
    slope = np.array([0, -0.66, 0.75])  # normal of the front roof; it passes through the eaves at z = 3
    eaves = slope @ [0, 6.2, 3.0]
    house[5] = [*slope, eaves]
    roof = box([-4.9, 5.85, 0], [4.9, 8.6, 9])
    roof[5] = [*slope, eaves + 0.09]
    roof[2] = [*-slope, -eaves - 0.001]
    return [(house, BRICK), (roof, ROOF), (box([2.2, 7.4, 3], [2.9, 8.1, 5.9]), BRICK)]


def box(low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """A body of seven planes [7, 4]: -x, -y, -z, x, y, z and one that never intersects."""
    planes = np.zeros((7, 4))
    planes[:3, :3], planes[3:6, :3] = -np.eye(3), np.eye(3)
    planes[:, 3] = [*(-np.array(low)), *high, 1]
    return planes


def _plant(foliage: Foliage, solids: list, bodies: list) -> None:
    """Add bouquet, shrubs, hedges and trees."""
    rng = foliage.rng
    foliage.object = BOUQUET
    foliage.bouquet([0.06, -0.03, 1.13])
    foliage.object = PLANT
    foliage.crown([1.75, 1.2, 0.62], 0.34, 700, (0.05, 0.02), [0.05, 0.14, 0.04], POTTED_PLANT)
    foliage.object = PLANT + 1
    foliage.crown([-1.7, 1.45, 0.50], 0.28, 600, (0.04, 0.022), [0.13, 0.17, 0.03], POTTED_PLANT)
    hedges = (
        (-7.2, -7.2, -6.5, 6.4),
        (6.5, -7.2, 7.2, 6.4),
        (-6.5, -7.2, 6.5, -6.5),
        (-7.2, 6.5, -4.6, 7.2),
        (4.6, 6.5, 7.2, 7.2),
    )
    for number, (x0, y0, x1, y1) in enumerate(hedges, HEDGE):
        foliage.object = number
        top = rng.uniform(1.45, 1.6)
        bodies.append((box([x0 + 0.1, y0 + 0.1, 0], [x1 - 0.1, y1 - 0.1, top - 0.1]), CORE))
        foliage.hedge([x0, y0, 0.05], [x1, y1, top], 150)
    greens = ([0.07, 0.17, 0.03], [0.12, 0.18, 0.03], [0.05, 0.13, 0.04], [0.17, 0.15, 0.03])
    trunks = ((-4.9, -4.7), (5.1, -4.3), (5.4, 3.7), (-5.3, 4.3))
    for number, ((x, y), rgb) in enumerate(zip(trunks, greens, strict=True), TREE):
        foliage.object = number
        solids.append((solid(x, y, 0, 2.4, 0.11, 0.06), BARK))
        foliage.crown([x, y, 2.8], 1.35, 3400, (0.075, 0.04), rgb)
    foliage.object = NO_OBJECT
    for i in range(11):  # behind the hedge, which hides the trunks
        angle = -0.5 * np.pi + (i - 5) * 0.43
        x, y = rng.uniform(10, 13) * np.array([np.cos(angle), np.sin(angle)])
        foliage.crown([x, y, rng.uniform(2.8, 3.8)], 2.4, 1600, (0.17, 0.09), greens[rng.integers(3)])
    for i in range(44):  # the far edge of the wood
        angle = i * 2 * np.pi / 44
        x, y = rng.uniform(28, 36) * np.array([np.cos(angle), np.sin(angle)])
        foliage.crown([x, y, 2.2], rng.uniform(3.0, 4.5), 130, (0.8, 0.5), [0.07, 0.12, 0.05])


def radius_at(solid, height):
    """Radius of a solid of revolution at a share of its height: a cone with a belly and a waist.

    `solid` is a row of `World.solids`, or the transposed table for an array of heights.
    """
    bow = 4 * height * (1 - height)
    cone = solid[4] + (solid[5] - solid[4]) * height
    return cone + bow * (solid[6] + solid[7] * 2.6 * (1 - 2 * height))


def _box_tree(centre: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A complete binary tree of bounding boxes over leaves with half extents `reach`.

    Returns the order of the leaves, the boxes and the splitting axes, the latter two in heap order. BIN
    consecutive leaves share a box at the bottom; some leaves occur twice to fill the tree. Level by level,
    each range of leaves is sorted along its longest axis and split in the middle.
    """
    depth = int(np.ceil(np.log2(len(centre) / BIN)))
    order = np.arange(BIN << depth) * len(centre) // (BIN << depth)
    axes = np.zeros(1 << depth, np.int64)
    for level in range(depth):
        runs = centre[order].reshape(1 << level, -1, 3)
        axis = np.ptp(runs, axis=1).argmax(1)
        axes[1 << level : 2 << level] = axis
        key = np.take_along_axis(runs, axis[:, None, None], 2)[..., 0]
        order = np.take_along_axis(order.reshape(1 << level, -1), key.argsort(1, kind="stable"), 1).ravel()
    boxes = np.zeros((2 << depth, 6))
    low = (centre - reach)[order].reshape(-1, BIN, 3).min(1)
    high = (centre + reach)[order].reshape(-1, BIN, 3).max(1)
    for level in range(depth, -1, -1):
        boxes[1 << level : 2 << level] = np.concatenate([low, high], 1)
        if level:
            low, high = low.reshape(-1, 2, 3).min(1), high.reshape(-1, 2, 3).max(1)
    return order, boxes, axes
