"""A grid of courtyards with one ground and one sky; houses and tall hedges stand around the outside only."""

from typing import NamedTuple

import numpy as np

from sagesplat.demo import world
from sagesplat.demo.foliage import NO_OBJECT, PETALS, POTTED_PLANT, Foliage

SPACING = 11.0  # metres between the tables of neighbours
SIDES = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
GREENS = ([0.07, 0.17, 0.03], [0.12, 0.18, 0.03], [0.05, 0.13, 0.04], [0.17, 0.15, 0.03])
CROWNS = (*GREENS, [0.30, 0.11, 0.03], [0.32, 0.24, 0.04], [0.34, 0.20, 0.22])
FLOWERS = (*PETALS, (0.3, 0.12, 0.6), (0.8, 0.7, 0.05))
TINTS = {  # colour factors by material
    world.WOOD: ([1, 1, 1], [0.5, 0.42, 0.4], [1.5, 1.7, 1.9], [0.75, 1.25, 1.5]),
    world.GLAZE: ([1, 1, 1], [1.1, 0.6, 0.3], [0.45, 0.9, 0.6], [0.35, 0.4, 0.55]),
    world.BRICK: ([1, 1, 1], [1.35, 2.0, 1.8], [0.75, 1.3, 1.7], [1.7, 2.6, 2.9]),
    world.ROOF: ([1, 1, 1], [0.45, 0.8, 1.1], [0.7, 0.9, 0.8], [0.5, 0.6, 0.7]),
}


class Place(NamedTuple):
    """Position and orientation of a courtyard."""

    centre: np.ndarray  # [2]
    turn: np.ndarray  # [2, 2], courtyard to world: a rotation by quarter turns, possibly mirrored
    outward: list[np.ndarray]  # directions [2] without a neighbour
    house: bool  # at the place's own north (+y), which is then outward


def centres_of(places: tuple[int, int]) -> np.ndarray:
    """Centres [nx * ny, 2] of the courtyards of a grid around the origin, x fastest."""
    x, y = ((np.arange(n) - (n - 1) / 2) * SPACING for n in places)
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


def ways_of(places: tuple[int, int]) -> np.ndarray:
    """Pairs [K, 2] of neighbouring courtyards, as rows of `centres_of`."""
    centres = centres_of(places)
    apart = np.abs(centres[:, None] - centres).sum(2)
    return np.argwhere(np.triu(np.isclose(apart, SPACING)))


def build_places(seed: int, places: tuple[int, int]) -> world.World:
    """The world of a grid of courtyards with different plants and colours, without light."""
    leaves, solids, bodies, solid_place, body_place, paths = [], [], [], [], [], []
    layout = _layout(places)
    tints = np.ones((len(layout), 11, 3))
    for i, place in enumerate(layout):
        rng = np.random.default_rng([seed, 3, i])
        foliage, own_solids, own_bodies = _courtyard(rng, place.house)
        leaves += [_moved_leaves(part, place) for part in foliage.parts]
        for row, material in own_solids:
            solids.append(([*(place.centre + place.turn @ row[:2]), *row[2:]], material))
        bodies += [(_moved_body(planes, place), material) for planes, material in own_bodies]
        solid_place += [i] * len(own_solids)
        body_place += [i] * len(own_bodies)
        for material, choice in TINTS.items():
            tints[i, material] = choice[(i + seed) % 4]
        if place.house:
            middle, extent = np.reshape(world.DOOR_PATH, (2, 2))
            paths.append([*(place.centre + place.turn @ middle), *(np.abs(place.turn) @ extent)])
    border, hedges = _surroundings(np.random.default_rng([seed, 4]), layout)
    centres = centres_of(places)
    for a, b in ways_of(places):
        paths.append([*(centres[a] + centres[b]) / 2, *(np.abs(centres[b] - centres[a]) / 2).clip(0.55)])
    return world.assemble(
        leaves + border.parts,
        solids,
        bodies + hedges,
        plot=world.PLOT + SPACING * (max(places) - 1) / 2,
        terraces=centres,
        paths=np.array(paths),
        solid_place=np.array(solid_place),
        body_place=np.array(body_place + [0] * len(hedges)),
        places=np.array([np.column_stack([p.turn.T, -p.turn.T @ p.centre]) for p in layout]),
        tints=tints,
        solid_object=np.full(len(solids), NO_OBJECT, np.int16),
        body_object=np.full(len(bodies) + len(hedges), NO_OBJECT, np.int16),
    )


def _layout(places: tuple[int, int]) -> list[Place]:
    """The courtyards of a grid; outer ones have a house on a side without a neighbour."""
    layout = []
    limits = np.array(places) - 1
    for i, centre in enumerate(centres_of(places)):
        cell = np.array([i % places[0], i // places[0]])
        outward = [side for side in SIDES if (cell + side < 0).any() or (cell + side > limits).any()]
        choice = outward or list(SIDES)
        x, y = choice[int(cell.sum()) % len(choice)] if outward else choice[i % 4]
        mirror = np.diag([1 - 2 * (i % 2), 1])
        layout.append(Place(centre, np.array([[y, x], [-x, y]]) @ mirror, outward, bool(outward)))
    return layout


def _courtyard(rng: np.random.Generator, house: bool) -> tuple[Foliage, list, list]:
    """Foliage, solids and bodies of a courtyard, in its own coordinates."""
    foliage, solids, bodies = Foliage(rng), world.furniture(), world.buildings() if house else []
    foliage.bouquet([0.06, -0.03, 1.13], [FLOWERS[i] for i in rng.permutation(len(FLOWERS))[:2]])
    count = int(rng.integers(3, 6))
    for turn in 2 * np.pi * (np.arange(count) + rng.uniform(0.1, 0.6, count)) / count:
        x, y = rng.uniform(1.7, 2.2) * np.array([np.cos(turn), np.sin(turn)])
        size, height = rng.uniform(0.24, 0.36), rng.uniform(0.24, 0.36)
        rgb = np.array(CROWNS[rng.integers(len(CROWNS))]) * rng.uniform(0.8, 1.3, 3)
        solids.append((world.solid(x, y, 0, height, 0.4 * size, 0.6 * size), world.CLAY))
        foliage.crown([x, y, height + 0.8 * size], size, 650, (0.045, 0.021), list(rgb), POTTED_PLANT)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    for corner in corners[rng.permutation(4)[:2]]:
        x, y = 4.6 * corner + rng.uniform(-0.25, 0.25, 2)
        solids.append((world.solid(x, y, 0, 2.4, 0.11, 0.06), world.BARK))
        height, rgb = rng.uniform(2.7, 3.0), CROWNS[rng.integers(len(CROWNS))]
        foliage.crown([x, y, height], 1.3, 3400, (0.075, 0.04), rgb)
    for along, across in rng.permutation([(a, b) for a in (-2.5, 2.5) for b in (-4.9, 4.9)])[:3]:
        middle = np.array([along, across])[:: rng.choice([-1, 1])]
        half = np.where(np.abs(middle) > 4, 0.2, rng.uniform(0.7, 1.1))
        top = rng.uniform(0.4, 0.55)
        foliage.hedge([*(middle - half), 0.04], [*(middle + half), top], 190)
        bodies.append(
            (world.box([*(middle - half + 0.06), 0], [*(middle + half - 0.06), top - 0.06]), world.CORE)
        )
    return foliage, solids, bodies


def _surroundings(rng: np.random.Generator, layout: list[Place]) -> tuple[Foliage, list]:
    """Tall hedges and trees around the grid, and the bodies of the hedges' dark insides."""
    foliage, bodies = Foliage(rng), []
    for place in layout:
        north = place.turn @ [0, 1]
        for side in place.outward:
            left = np.array([-side[1], side[0]])
            # a hedge ends at the next courtyard's hedge, or goes around the corner
            around = [any((end == side).all() for side in place.outward) for end in (-left, left)]
            ends = [7.2 if corner else SPACING / 2 for corner in around]
            runs = [(-ends[0], ends[1])]
            if place.house and side @ north > 0:
                runs = [(-ends[0], -4.6), (4.6, ends[1])]
            for start, end in runs:
                corners = place.centre + np.array([6.5 * side + start * left, 7.2 * side + end * left])
                low, high, top = corners.min(0), corners.max(0), rng.uniform(1.45, 1.6)
                foliage.hedge([*low, 0.05], [*high, top], 150)
                bodies.append((world.box([*(low + 0.1), 0], [*(high - 0.1), top - 0.1]), world.CORE))
    half = np.abs(np.array([place.centre for place in layout])).max(0)
    ring = 8 + 3 * len(layout)
    for i in range(ring):
        x, y = _around(2 * np.pi * (i + 0.5) / ring, half, rng.uniform(10, 13))
        foliage.crown([x, y, rng.uniform(2.8, 3.8)], 2.4, 1600, (0.17, 0.09), GREENS[rng.integers(3)])
    for i in range(44):  # the far edge of the wood
        x, y = _around(2 * np.pi * i / 44, half, rng.uniform(24, 30))
        foliage.crown([x, y, 2.2], rng.uniform(3.5, 5.0), 130, (0.8, 0.5), [0.07, 0.12, 0.05])
    return foliage, bodies


def _around(turn: float, half: np.ndarray, away: float) -> np.ndarray:
    """A point [2] `away` metres outside the rectangle of half extents `half`, in direction `turn`."""
    out = np.array([np.cos(turn), np.sin(turn)])
    return half * (1.4 * out).clip(-1, 1) + away * out


def _moved_leaves(part: tuple[np.ndarray, ...], place: Place) -> tuple[np.ndarray, ...]:
    frame, reach, *rest = part
    frame, reach = frame.reshape(-1, 4, 3).copy(), reach.copy()
    frame[:, :, :2] = frame[:, :, :2] @ place.turn.T
    frame[:, 0, :2] += place.centre
    reach[:, :2] = reach[:, :2] @ np.abs(place.turn).T
    return frame.reshape(-1, 12), reach, *rest


def _moved_body(planes: np.ndarray, place: Place) -> np.ndarray:
    planes = planes.copy()
    planes[:, :2] = planes[:, :2] @ place.turn.T
    planes[:, 3] += planes[:, :2] @ place.centre
    return planes
