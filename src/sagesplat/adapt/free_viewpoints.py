"""Viewpoints of a splat of which nothing else is known: drawn from the Gaussians alone.

1. Rays from points of free space (`free_space.Space`) say whether one can be surrounded there. Where that is
   so in a good share of it, and there is a floor, the splat is a place, else an object. (A closed shell
   with a flat bottom looks the same from within, whether it is a room or not: there `kind` helps.)
2. An object is looked at from orbits: directions spread over a band of the sphere, distances log-uniform
   around the one at which it fills the frame. Nearer ones look at parts of it.
3. In a place the viewer stands in free space at a height over the floor, surrounded, where the Gaussians that
   are seen are fine: a splat is fine where its photos were taken from. The directions with finer Gaussians
   are taken more often.
4. Each viewpoint is rendered small: it has to see enough, and not from inside of something.

Viewpoints are taken in the order of low-discrepancy sequences, so that the first n of them are spread evenly
too, whatever the count.
"""

import math
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float64

from sagesplat.adapt.free_poses import CLEAR, RAYS, Orbits, Standing, sequence
from sagesplat.adapt.free_space import Cloud, Space, cloud_of, in_units, space_of
from sagesplat.adapt.upright import upright
from sagesplat.core.errors import RunError
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.sh import C0
from sagesplat.raster import Backend, Workspace, device_of, rasterize
from sagesplat.raster.render import NEAR
from sagesplat.scene.loading import MAX_SIDE
from sagesplat.scene.scene import Camera

Kind = Literal["auto", "object", "place"]
LARGEST_FOV = 150.0  # degrees
MOST = 10_000  # viewpoints

_PROBES = 1000  # points of the unit ball that the kind is decided by
_SURROUNDED = 0.6  # of all directions show something
_SKY = 20.0  # units; what is farther surrounds nobody
_PLACE = 0.2  # of free space is surrounded

_SMALL = 96  # px, longer side of the renders that viewpoints are checked by
_MANY = 100_000  # Gaussians of these renders; of more, every so many are drawn, each as much larger
_SEEN = {"object": 0.01, "place": 0.5}  # least share of the image that is covered
_MOST_NEAR = 0.3  # of what is seen may be closer than CLEAR
_SMALLEST = 0.02  # world units; here the nearest orbits keep clear of the near plane
_TRIES = 12  # for each viewpoint


@dataclass(frozen=True, eq=False)
class FreeViewpoints:
    """Drawn viewpoints, and what they were drawn by."""

    cameras: tuple[Camera, ...]  # any first part of them is spread evenly, too
    kind: Literal["object", "place"]
    up: Float64[np.ndarray, "3"]  # unit vector, world
    centre: Float64[np.ndarray, "3"]  # of the object, or of the place; world
    radius: float  # of the object; of a place, half of its Gaussians are within; world units
    reason: str  # what was decided, by which figures: one line


def free_cameras(
    g: Gaussians,
    count: int,
    *,
    up: str | Float64[np.ndarray, "3"] = "auto",
    fov: float = 60.0,
    size: tuple[int, int] = (512, 384),
    seed: int = 0,
    kind: Kind = "auto",
    backend: Backend = "cpu",
) -> FreeViewpoints:
    """Draw viewpoints of a splat from its Gaussians alone (the module's text).

    The same arguments give the same viewpoints, and a larger `count` begins with those of a smaller one.
    Moving, turning or scaling the splat does the same to them, up to rounding.

    Args:
        g: N Gaussians.
        count: Viewpoints. There may be fewer, where little of a place can be stood in: the reason says so.
        up: "auto", an axis such as "-y" or a vector (`upright.upright`).
        fov: Field of view of the longer side, degrees.
        size: Width and height of the images, px.
        seed: Of the sequences.
        kind: How to look at it; auto: decided.
        backend: Of the small renders.

    Returns:
        At least one viewpoint, and how they were drawn.

    Raises:
        RunError: If no viewpoint sees anything, or an argument is impossible.
    """
    _check(g, count, fov, size)
    cloud = cloud_of(g)
    space = space_of(cloud, seed)
    share = _surrounded_share(space)
    decided = kind
    if decided == "auto":
        decided = "place" if share > _PLACE and upright(cloud, "place", up).floor else "object"
    upward = upright(cloud, decided, up)
    K = _intrinsics(fov, size)
    if decided == "object":
        drawer = Orbits(cloud, upward, K, size, seed)
    else:
        drawer = Standing(space, upward, K, size, seed)
    check = _Check(g, cloud, K, size, decided, backend)
    poses = islice((pose for pose in islice(drawer.poses(), _TRIES * count + 200) if check(pose)), count)
    cameras = tuple(Camera(_world_pose(w2c, cloud), K, *size) for w2c in poses)
    if not cameras:
        raise RunError(
            f"no viewpoint has any of the {len(g):,} Gaussians in sight ({decided}; {upward.reason}); "
            "give cameras, or --up and another kind"
        )
    wanted = "" if len(cameras) == count else f"; {len(cameras)} of {count} viewpoints see enough"
    how = "as asked" if kind != "auto" else f"it encloses {share:.0%} of the free space within it"
    centre = cloud.world(drawer.centre[None])[0]
    reason = f"{decided}: {how}; {upward.reason}{wanted}"
    return FreeViewpoints(cameras, decided, upward.up, centre, drawer.radius * cloud.unit, reason)


def check_size(g: Gaussians, name: str) -> None:
    """RunError for a splat in units so large that it would lie before the near plane, or be rounded away.

    `name`: of its file.
    """
    unit = cloud_of(g).unit if len(g) else 1.0
    if unit < _SMALLEST:
        factor = 10 ** math.ceil(-math.log10(max(unit, 1e-30)))
        raise RunError(
            f"{name}: too small, half of its Gaussians are within {unit:.2g} units, and nothing nearer than "
            f"{NEAR} to a camera is drawn; enlarge it: `splat-transform {name} --scale {factor} larger.ply`"
        )


def _check(g: Gaussians, count: int, fov: float, size: tuple[int, int]) -> None:
    if not len(g):
        raise RunError("no Gaussians, so nothing is in sight; give a splat that has some")
    if not 1 <= count <= MOST:
        raise RunError(f"{count} viewpoints cannot be drawn; choose 1 to {MOST:,}")
    if not 1 <= fov <= LARGEST_FOV:
        raise RunError(f"a field of view of {fov:g} degrees cannot be used; choose 1 to {LARGEST_FOV:g}")
    if not all(1 <= side <= MAX_SIDE for side in size):
        raise RunError(f"images of {size[0]} x {size[1]} px cannot be used; choose 512 x 384, say")


def _intrinsics(fov: float, size: tuple[int, int]) -> np.ndarray:
    focal = 0.5 * max(size) / np.tan(np.radians(fov) / 2)
    return np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]], np.float32)


def _surrounded_share(space: Space) -> float:
    """Share of the free space in the unit ball in which most directions show something."""
    points = 2 * sequence(0, 0, 2 * _PROBES)[:, 1:4] - 1
    distance, _ = space.look(points[np.linalg.norm(points, axis=1) < 1], RAYS)
    free = np.quantile(distance, 0.05, axis=1, method="nearest") > CLEAR
    return float(((distance[free] < _SKY).mean(1) > _SURROUNDED).mean()) if free.any() else 0.0


def _world_pose(w2c: np.ndarray, cloud: Cloud) -> np.ndarray:
    """A pose in the scene's units as one in the world."""
    w2c = w2c.copy()
    w2c[:3, 3] = cloud.unit * w2c[:3, 3] - w2c[:3, :3] @ cloud.centre
    return w2c.astype(np.float32)


def _fewer(g: Gaussians) -> Gaussians:
    """At most about `_MANY` Gaussians that cover as much."""
    step = len(g) // _MANY
    if step < 2:
        return g
    some = g.select(torch.arange(0, len(g), step))
    return replace(some, log_scales=some.log_scales + math.log(step) / 2)


class _Check:
    """Whether a pose sees enough, in a small render."""

    def __init__(
        self,
        g: Gaussians,
        cloud: Cloud,
        K: np.ndarray,
        size: tuple[int, int],
        kind: Literal["object", "place"],
        backend: Backend,
    ):
        self.g, self.least, self.backend = (
            _fewer(in_units(g, cloud)).to(device_of(backend)),
            _SEEN[kind],
            backend,
        )
        side = min(1.0, _SMALL / max(size))
        small = max(1, round(size[0] * side)), max(1, round(size[1] * side))
        self.camera = Camera(np.eye(4, dtype=np.float32), K, *size).resized(*small)
        self.workspace = Workspace()

    @torch.no_grad()
    def __call__(self, w2c: np.ndarray) -> bool:
        camera = Camera(w2c.astype(np.float32), self.camera.K, self.camera.width, self.camera.height)
        position = torch.from_numpy(camera.position.copy()).to(self.g.means.device)
        near = ((self.g.means - position).norm(dim=1) < CLEAR).float()
        options: dict[str, Any] = {"sh_degree": 0, "backend": self.backend, "workspace": self.workspace}
        # what is near is white, and the rest black
        sh0 = ((near - 0.5) / C0)[:, None, None].expand_as(self.g.sh0).contiguous()
        render = rasterize(replace(self.g, sh0=sh0), camera, **options)
        seen = float(render.alpha.mean())
        covered, inside = float((render.alpha > 0.5).float().mean()), float(render.rgb.mean())
        return covered >= self.least and inside <= _MOST_NEAR * seen
