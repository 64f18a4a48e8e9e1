"""Ray casting in the garden: numba kernels over scalars."""

from math import sin, sqrt

from sagesplat.demo.noise import fbm_at, jit
from sagesplat.demo.world import BIN, GRASS, LEAF, PAVING, SKY, radius_at

TURF = 0.05  # height of the grass

radius = jit(radius_at)


@jit
def hit_leaves(world, ox, oy, oz, dx, dy, dz, t_max, any_hit):
    """Nearest leaf closer than `t_max`: (t, row), with row -1 for none. The nearer child is visited first.

    The tree is complete, so that traversal needs no stack: one bit per level says which child was visited.
    """
    ix, iy, iz = 1 / (dx or 1e-9), 1 / (dy or 1e-9), 1 / (dz or 1e-9)
    boxes, axes, f = world.boxes, world.axes, world.leaves
    jx, jy, jz = ox * ix, oy * iy, oz * iz
    bins = axes.shape[0]
    node, trail, found = 1, 0, -1
    while True:
        x0, x1 = boxes[node, 0] * ix - jx, boxes[node, 3] * ix - jx
        y0, y1 = boxes[node, 1] * iy - jy, boxes[node, 4] * iy - jy
        z0, z1 = boxes[node, 2] * iz - jz, boxes[node, 5] * iz - jz
        near = max(max(min(x0, x1), min(y0, y1)), max(min(z0, z1), 0.0))
        far = min(min(max(x0, x1), max(y0, y1)), min(max(z0, z1), t_max))
        if near <= far:
            if node < bins:
                axis = axes[node]
                backward = dx < 0 if axis == 0 else (dy < 0 if axis == 1 else dz < 0)
                node = 2 * node + backward
                trail <<= 1
                continue
            for row in range((node - bins) * BIN, (node - bins + 1) * BIN):
                slope = dx * f[row, 3] + dy * f[row, 4] + dz * f[row, 5]
                if abs(slope) < 1e-7:
                    continue
                t = (
                    (f[row, 0] - ox) * f[row, 3] + (f[row, 1] - oy) * f[row, 4] + (f[row, 2] - oz) * f[row, 5]
                ) / slope
                if t < 1e-3 or t >= t_max:
                    continue
                x, y, z = ox + t * dx - f[row, 0], oy + t * dy - f[row, 1], oz + t * dz - f[row, 2]
                a = x * f[row, 6] + y * f[row, 7] + z * f[row, 8]
                if abs(x * f[row, 9] + y * f[row, 10] + z * f[row, 11]) < 1 - a * a:
                    t_max, found = t, row
            if found >= 0 and any_hit:
                return t_max, found
        while trail & 1:
            trail >>= 1
            node >>= 1
        if node == 1:
            return t_max, found
        trail |= 1
        node ^= 1


@jit
def hit_solid(solids, i, ox, oy, oz, dx, dy, dz, t_max):
    """Distance to solid of revolution i, or `t_max`: clips to its cylinder, marches, bisects."""
    x, y, z = ox - solids[i, 0], oy - solids[i, 1], oz - solids[i, 2]
    a, b, c = dx * dx + dy * dy + 1e-12, x * dx + y * dy, x * x + y * y - solids[i, 8] ** 2
    root = b * b - a * c
    if root <= 0 or (b > 0 and c > 0):
        return t_max
    root, height = sqrt(root), solids[i, 3]
    fall = dz if abs(dz) > 1e-9 else 1e-9
    s0, s1 = -z / fall, (height - z) / fall
    near = max(max(min(s0, s1), (-b - root) / a), 1e-4)
    far = min(min(max(s0, s1), (-b + root) / a), t_max)
    if near >= far:
        return t_max
    step, before = (far - near) / 12, near
    for k in range(13):
        t = near + k * step
        if (x + t * dx) ** 2 + (y + t * dy) ** 2 <= radius(solids[i], (z + t * dz) / height) ** 2:
            if k == 0:
                return t
            for _ in range(8):
                middle = 0.5 * (before + t)
                r = radius(solids[i], (z + middle * dz) / height)
                if (x + middle * dx) ** 2 + (y + middle * dy) ** 2 <= r * r:
                    t = middle
                else:
                    before = middle
            return t
        before = t
    return t_max


@jit
def hit_body(bodies, i, ox, oy, oz, dx, dy, dz, t_max):
    """Distance to convex body i, and the plane through which the ray enters; (t_max, -1) for a miss."""
    near, far, face = 1e-4, t_max, -1
    for k in range(bodies.shape[1]):
        slope = bodies[i, k, 0] * dx + bodies[i, k, 1] * dy + bodies[i, k, 2] * dz
        room = bodies[i, k, 3] - bodies[i, k, 0] * ox - bodies[i, k, 1] * oy - bodies[i, k, 2] * oz
        if room < 0 and slope >= 0:
            return t_max, -1  # outside of this plane and not coming closer
        if slope < 0 and room < near * slope:
            near, face = room / slope, k
        elif slope > 0 and room < far * slope:
            far = room / slope
        if near >= far:
            return t_max, -1
    return (near, face) if face >= 0 else (t_max, -1)


@jit
def paved(world, x, y):
    """Whether the ground at (x, y) is terrace or path."""
    terraces, paths = world.terraces, world.paths
    wobble = 0.10 * sin(3 * x + 1.3 * y) + 0.07 * sin(5.1 * y - 2.2 * x)
    for i in range(terraces.shape[0]):
        if (x - terraces[i, 0]) ** 2 + (y - terraces[i, 1]) ** 2 < (2.35 + wobble) ** 2:
            return True
    edge = 0.5 * wobble
    for i in range(paths.shape[0]):
        u, v, half_u, half_v = x - paths[i, 0], y - paths[i, 1], paths[i, 2], paths[i, 3]
        if half_u > half_v:  # the long sides are uneven, the ends are straight
            u, v, half_u, half_v = v, u, half_v, half_u
        if abs(v) < half_v and abs(u) < half_u + edge:
            return True
    return False


@jit
def hit_ground(world, ox, oy, oz, dx, dy, dz, floor, pixel):
    """(t, material) of a ray that reaches z = 0 at distance `floor`.

    The turf is a stack of layers with holes, so that a low viewpoint does not see its roots.
    """
    if paved(world, ox + floor * dx, oy + floor * dy):
        return floor, PAVING
    for layer in range(4):
        t = floor + TURF * (1 - 0.25 * layer) / dz
        if t > 0 and blades(ox + t * dx, oy + t * dy, pixel * t) > 0.75 - 0.2 * layer:
            return t, GRASS
    return floor, GRASS


@jit
def blades(x, y, footprint):
    """Height of the grass at (x, y), 0 to 1: tufts and, at close range, single blades."""
    lean = 0.02 * sin(7 * x + 3 * y)
    return 0.5 + 1.3 * fbm_at(x + lean, y - lean, 0.09, 3, footprint)


@jit
def trace(world, ox, oy, oz, dx, dy, dz, t_max, pixel, any_hit):
    """Nearest hit of a ray with unit direction: (t, material, part); material SKY for none below `t_max`.

    `part` is the row of the leaf or solid, or 8 * body + plane. With `any_hit`, the first hit found.
    """
    material, part = SKY, -1
    floor = -oz / dz if dz < -1e-6 and oz > 0 else t_max
    grounded = floor < t_max
    t_max = min(t_max, floor)
    for i in range(world.solids.shape[0]):
        t = hit_solid(world.solids, i, ox, oy, oz, dx, dy, dz, t_max)
        if t < t_max:
            t_max, material, part = t, world.solid_material[i], i
    for i in range(world.bodies.shape[0]):
        t, face = hit_body(world.bodies, i, ox, oy, oz, dx, dy, dz, t_max)
        if face >= 0:
            t_max, material, part = t, world.body_material[i], 8 * i + face
    if any_hit and material != SKY:
        return t_max, material, part
    t, row = hit_leaves(world, ox, oy, oz, dx, dy, dz, t_max, any_hit)
    if row >= 0:
        t_max, material, part = t, LEAF, row
    if grounded and t_max > floor + 1.01 * TURF / dz:
        t, ground = hit_ground(world, ox, oy, oz, dx, dy, dz, floor, pixel)
        if t <= t_max:
            return t, ground, -1
    return t_max, material, part


@jit
def cast(world, origins, directions, t_max, pixel, any_hit, t, material, part):
    """Cast rays [n, 3] with unit directions; fills t, material and part [n] (see `trace`).

    `t_max` [n] limits each ray; `pixel` is the width of a pixel at distance 1.
    """
    for i in range(len(t)):
        ox, oy, oz = origins[i, 0], origins[i, 1], origins[i, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        t[i], material[i], part[i] = trace(world, ox, oy, oz, dx, dy, dz, t_max[i], pixel, any_hit)
