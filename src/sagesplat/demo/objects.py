"""Which modelled object each pixel shows: the truth that 3D instances are measured against."""

import numpy as np
from jaxtyping import Float32, Int16

from sagesplat.demo.foliage import NO_OBJECT
from sagesplat.demo.render import FAR, camera_rays, cast_rays, lit_world
from sagesplat.demo.world import BRICK, CORE, LEAF, ROOF, WOOD, World
from sagesplat.scene.scene import Camera


def render_objects(
    camera: Camera, seed: int = 0, places: tuple[int, int] = (1, 1)
) -> tuple[Int16[np.ndarray, "H W"], Float32[np.ndarray, "H W 3"]]:
    """The object of the ray through each pixel's centre, NO_OBJECT where it has none, and where the ray ends.

    Objects are those of `build_world`; a grid of courtyards has none. Points are in world units, those of
    the sky far away.
    """
    world = lit_world(seed, places)
    v, u = (np.indices((camera.height, camera.width)) + 0.5).reshape(2, -1)
    origins, directions, _ = camera_rays(camera, np.stack([u, v], 1))
    t, material, part = cast_rays(world, origins, directions, FAR, float(1 / camera.K[0, 0]))
    shape = camera.height, camera.width
    points = (origins + t[:, None] * directions).astype(np.float32)
    return _objects(world, material, part).reshape(shape), points.reshape(*shape, 3)


def _objects(world: World, material: np.ndarray, part: np.ndarray) -> Int16[np.ndarray, " n"]:
    found = np.full(len(part), NO_OBJECT, np.int16)
    bodies, leaves = np.isin(material, (BRICK, ROOF, CORE)), material == LEAF
    solids = (material >= WOOD) & ~bodies & ~leaves
    found[leaves] = world.leaf_object[part[leaves]]
    found[bodies] = world.body_object[part[bodies] // 8]
    found[solids] = world.solid_object[part[solids]]
    return found
