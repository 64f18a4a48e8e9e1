"""Leaves of crowns, hedges and bouquets."""

from collections.abc import Sequence

import numpy as np

UP = np.array([0.0, 0.0, 1.0])
POTTED_PLANT, TREE = 64, 184  # labels
NO_OBJECT = -1  # what is modelled as a crowd: grass, the wood, the sky
PETALS = ((0.75, 0.10, 0.28), (0.85, 0.80, 0.75), (0.85, 0.45, 0.05))


class Foliage:
    """Leaves as pointed discs, each with a pose, a colour, a label and the number of its object."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.object = NO_OBJECT  # that the leaves to come belong to
        self.parts: list[tuple[np.ndarray, ...]] = []

    def add(
        self,
        centre: np.ndarray,
        facing: np.ndarray,
        size: tuple[float, float],
        rgb: np.ndarray,
        label: int,
        spread: float = 0.7,
        along: np.ndarray | None = None,
    ) -> None:
        """Add leaves at `centre` [n, 3], with half length and half width `size`, roughly `facing` [n, 3].

        `along` [n, 3] is the direction of the midrib; random by default.
        """
        rng, n = self.rng, len(centre)
        normal = _unit(facing + spread * rng.normal(size=(n, 3)))
        rib = rng.normal(size=(n, 3)) if along is None else along
        u = _unit(rib - normal * (rib * normal).sum(1, keepdims=True))
        v = np.cross(normal, u)
        scale = rng.uniform(0.7, 1.25, (n, 1))
        colour = rgb * rng.lognormal(0.0, 0.22, (n, 1)) * rng.lognormal(0.0, 0.06, (n, 3))
        frame = np.concatenate([centre, normal, u / (size[0] * scale), v / (size[1] * scale)], 1)
        reach = np.sqrt((size[0] * scale * u) ** 2 + (size[1] * scale * v) ** 2)
        self.parts.append((frame, reach, colour, np.full(n, label), np.full(n, self.object)))

    def crown(
        self,
        centre: Sequence[float],
        radius: float,
        count: int,
        size: tuple[float, float],
        rgb: Sequence[float],
        label: int = TREE,
    ) -> None:
        """Add a crown of leaf clusters around `centre`."""
        rng, clusters = self.rng, 26
        at = _unit(rng.normal(size=(clusters, 3))) * rng.uniform(0.25, 0.85, (clusters, 1)) * radius
        at[:, 2] *= 0.85
        tint = np.array(rgb) * rng.lognormal(0, 0.18, (clusters, 1)) * rng.lognormal(0, 0.07, (clusters, 3))
        which = rng.integers(0, clusters, count)
        out = _unit(rng.normal(size=(count, 3)))
        offset = out * rng.uniform(0.5, 1.0, (count, 1)) * 0.4 * radius
        place = np.array(centre) + at[which] + offset
        self.add(place, out + UP / 2, size, tint[which], label)

    def hedge(self, low: Sequence[float], high: Sequence[float], per_metre2: float) -> None:
        """Add leaves on the top and the four sides of a box that stands on the lawn."""
        rng, lo, hi = self.rng, np.array(low), np.array(high)
        for axis, side in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 1)):
            extent = hi - lo
            count = int(per_metre2 * np.prod(np.delete(extent, axis)))
            place = lo + extent * rng.random((count, 3))
            bumps = 0.07 * np.sin(place @ [3.1, 4.3, 5.2]) + rng.normal(0, 0.05, count)
            place[:, axis] = (hi if side else lo)[axis] + (1 if side else -1) * bumps
            facing = np.zeros((count, 3))
            facing[:, axis] = 1 if side else -1
            patch = 1 + 0.25 * np.sin(place @ [1.7, 2.3, 3.9])
            rgb = patch[:, None] * [0.05, 0.12, 0.03]
            self.add(place, facing + 0.4 * UP, (0.09, 0.05), rgb, TREE)

    def bouquet(self, mouth: Sequence[float], petals: Sequence[Sequence[float]] = PETALS) -> None:
        """Add leaves, stems and flowers that grow out of the vase's mouth."""
        rng, base = self.rng, np.array(mouth)
        out = _unit(rng.normal(size=(420, 3)) * [1, 1, 0.55] + [0, 0, 0.75])
        reach = rng.uniform(0.05, 0.30, (420, 1))
        droop = np.array([0, 0, -1.6]) * reach**2
        rgb = np.array([0.07, 0.19, 0.04])
        self.add(
            base + out * reach + droop, [0, 0, 1] - 0.3 * out, (0.062, 0.02), rgb, POTTED_PLANT, 0.35, out
        )
        out = _unit(rng.normal(size=(34, 3)) * [1, 1, 0.5] + [0, 0, 1.1])
        head = base + out * rng.uniform(0.24, 0.36, (34, 1))
        self.add((base + head) / 2, rng.normal(size=(34, 3)), (0.17, 0.004), rgb, POTTED_PLANT, 0.0, out)
        colour = np.array(petals)[rng.integers(0, len(petals), 34)]
        for angle in np.arange(8) * np.pi / 4:
            side = _unit(np.cross(out, [0.3, 0.2, 1.0]))
            petal = side * np.cos(angle) + np.cross(out, side) * np.sin(angle)
            self.add(
                head + 0.024 * petal, out + 0.3 * petal, (0.026, 0.013), colour, POTTED_PLANT, 0.1, petal
            )
        self.add(head + 0.008 * out, out, (0.012, 0.016), np.array([0.7, 0.5, 0.05]), POTTED_PLANT, 0.1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
