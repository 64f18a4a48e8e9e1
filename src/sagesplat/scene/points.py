"""Initial points for training without COLMAP: read from a PLY file, or random."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from scipy.spatial import KDTree

from sagesplat.core import geometry
from sagesplat.core.errors import SceneError, short
from sagesplat.core.geometry import Position
from sagesplat.io.ply_header import read_header, read_vertices
from sagesplat.scene.images import load_photo
from sagesplat.scene.scene import Points, View

GREY = 128
FAR = 10.0  # random points reach this many times as far as the volume that the cameras span
NEIGHBOURS = 4  # views, at least one of which must also see a random point
COLOUR_VIEWS, COLOUR_SIDE = 16, 128  # photos that colour random points; their longer side, px
HARMONIC = 0.5 / np.sqrt(np.pi)  # value of the constant spherical harmonic
_OF_SPLATS = ("f_dc_0", "f_dc_1", "f_dc_2")
_COLOURS = (
    ("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"), _OF_SPLATS,
)  # fmt: skip
FULL = {"f4": 255.0, "f8": 255.0, "u2": 1 / 257}  # scale to 0 ... 255 by type of colour property


def untracked(xyz: Float32[np.ndarray, "P 3"], rgb: UInt8[np.ndarray, "P 3"]) -> Points:
    """Points without tracks."""
    return Points(xyz, rgb, np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros((0, 2), np.float32))


def read_points(path: Path, offset: Position = geometry.NO_OFFSET) -> Points:
    """The vertices of a PLY file, ASCII or binary of either byte order: x y z, and red green blue or grey.

    Colours are whole numbers up to 255 (65535 in 16 bits), or floats up to 1, or up to 255 where one is above
    1; they may be named r g b or diffuse_red, and be the f_dc of a splat. Points without colours are grey.
    `offset` is subtracted from the positions before they become float32. Raises SceneError.
    """
    try:
        with path.open("rb") as file:
            header = read_header(file)
            if header.count < 1 or not {"x", "y", "z"} <= {name.lower() for name in header.types}:
                raise ValueError("its header names no vertices or no x, y and z")
            table = {name.lower(): values for name, values in read_vertices(path, file, header).items()}
    except FileNotFoundError:
        raise SceneError(
            f"{path}: no such file; add it, or remove ply_file_path to start from random points"
        ) from None
    except (OSError, ValueError, OverflowError) as error:
        raise SceneError(
            f"{path}: not readable as a PLY file ({short(error)}); export the points again"
        ) from None
    with np.errstate(over="ignore"):  # a double too large for float32 is then reported
        xyz = (np.stack([table[axis] for axis in "xyz"], axis=1) - np.array(offset)).astype(np.float32)
        if bad := int(np.count_nonzero(~np.isfinite(xyz).all(axis=1))):
            raise SceneError(f"{path}: {bad} of {len(xyz)} points are not finite; export the points again")
        rgb = np.full((len(xyz), 3), GREY, np.uint8)
        types = {name.lower(): kind for name, kind in header.types.items()}
        for names in _COLOURS:
            if table.keys() >= set(names):
                values = np.stack([table[name] for name in names], axis=1).astype(float)
                if names[0] == "f_dc_0":
                    values = values * HARMONIC + 0.5
                scale = FULL.get(types[names[0]], 1.0)
                scale = (
                    1.0
                    if scale == 255 and np.nanmax(values, initial=0) > 1 and names != _OF_SPLATS
                    else scale
                )
                rgb[:] = np.nan_to_num(values * scale).round().clip(0, 255)
                break
    return untracked(xyz, rgb)


def seen_or_random(points: Points, views: Sequence[View], of: str) -> tuple[Points, list[str]]:
    """Points of a file for views without tracks; random ones, which a line says, where no view sees any.

    Points and poses are then of different origins or axes: one of both in UTM, or turned.
    """
    with np.errstate(all="ignore"):
        if any(_inside(points.xyz, view)[0].any() for view in views):
            return points, []
    made = random_points(views)
    return made, [
        f"no photo shows any of the {len(points.xyz):,} points of {of}: their origin or axes are not those "
        f"of the poses; training begins with {len(made.xyz):,} random points"
    ]


def random_points(views: Sequence[View], count: int = 100_000, *, cube: float | None = None) -> Points:
    """`count` random initial points, without tracks.

    With `cube` they are uniform in [-cube, cube]^3, as 3DGS initialises NeRF's Blender scenes. Otherwise they
    lie on random rays of the photos. Half of them are uniform in the volume of the frusta, up to the far side
    of the sphere that the cameras span around their `focus`. The other half lie beyond it, up to ten times as
    far, uniform in inverse depth, like the space contraction of mip-NeRF 360 (arXiv:2111.12077). Only points
    that a neighbouring view sees too are kept. This covers objects, rooms and landscapes. The density is
    highest where most cameras look, and low just in front of a lens.

    A point's colour is the mean over some photos at its projections. Raises SceneError.
    """
    rng = np.random.default_rng(0)
    with np.errstate(all="ignore"):  # cameras may be anywhere; points that overflow are in no view
        if cube is None:
            xyz = _in_sight(views, count, rng)
        else:
            xyz = rng.uniform(-cube, cube, (count, 3)).astype(np.float32)
        some = np.linspace(0, len(views) - 1, min(COLOUR_VIEWS, len(views))).round().astype(int)
        return untracked(xyz, _mean_colours(xyz, [views[row] for row in np.unique(some)]))


def focus(views: Sequence[View]) -> tuple[Float64[np.ndarray, "3"], float]:
    """The point nearest to all optical axes (least squares), and the cameras' largest distance from it.

    Parallel axes have no such point. So a small weight pulls it towards a point in front of the cameras, as
    far away as the cameras are spread.
    """
    centres = np.stack([view.camera.position for view in views]).astype(np.float64)
    axes = np.stack([view.camera.direction for view in views]).astype(np.float64)
    middle = centres.mean(axis=0)
    spread = np.linalg.norm(centres - middle, axis=1).max() or 1.0  # any length, if all are in one point
    weight = 1e-3 * len(views)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # projects onto the plane across each axis
    pulled = middle + spread * axes.mean(axis=0)
    right = np.einsum("vij,vj->i", across, centres) + weight * pulled
    point = np.linalg.solve(across.sum(axis=0) + weight * np.eye(3), right)
    return point, float(max(np.linalg.norm(centres - point, axis=1).max(), spread))


def _in_sight(views: Sequence[View], count: int, rng: np.random.Generator) -> Float32[np.ndarray, "P 3"]:
    """Points on rays of the views that a neighbouring view sees too, at most `count` of them."""
    centre, radius = focus(views)
    neighbours = _neighbours(views)
    w2c = np.stack([view.camera.w2c for view in views])
    K = np.stack([view.camera.K for view in views])
    R, t, f, c = w2c[:, :3, :3], w2c[:, :3, 3], K[:, [0, 1], [0, 1]], K[:, :2, 2]
    sizes = np.array([(view.camera.width, view.camera.height) for view in views], np.float32)
    reach = (np.linalg.norm(R @ centre + t, axis=1) + radius).astype(np.float32)
    kept, num_kept = [], 0
    for _ in range(20):
        of = rng.integers(len(views), size=count)
        rays = (rng.random((count, 2), np.float32) * sizes[of] - c[of]) / f[of]
        u = rng.random((count, 1), np.float32)
        near, beyond = np.cbrt(u), 1 / (1 - u * (1 - 1 / FAR))
        depth = reach[of, None] * np.where(rng.random((count, 1)) < 0.5, near, beyond)
        local = np.append(rays, np.ones_like(u), axis=1) * depth
        xyz = np.einsum("pij,pi->pj", R[of], local - t[of]).astype(np.float32)
        seen = np.zeros(count, bool)
        for by in neighbours[of].T:
            x, y, z = (np.einsum("pij,pj->pi", R[by], xyz) + t[by]).T
            uv = np.stack([x, y], axis=1) / z[:, None] * f[by] + c[by]
            seen |= (z > 0) & np.all((uv >= 0) & (uv < sizes[by]), axis=1)
        kept.append(xyz[seen])
        num_kept += len(kept[-1])
        if num_kept >= count:
            break
    if not num_kept:
        raise SceneError(
            f"{views[0].image_path.parent}: no two photos show the same part of the scene; check the poses"
        )
    return np.concatenate(kept)[:count]


def _neighbours(views: Sequence[View]) -> Int64[np.ndarray, "V k"]:
    """Rows of the k nearest views of each view, by position and direction."""
    centres = np.stack([view.camera.position for view in views]).astype(np.float64)
    axes = np.stack([view.camera.direction for view in views])
    spread = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max() or 1.0
    place = np.append(centres / spread, axes, axis=1)
    _, rows = KDTree(place).query(place, k=min(NEIGHBOURS + 1, len(views)))
    return np.reshape(rows, (len(views), -1))[:, 1:]  # the nearest is the view itself


def _mean_colours(xyz: Float32[np.ndarray, "P 3"], views: Sequence[View]) -> UInt8[np.ndarray, "P 3"]:
    """Mean colour over the photos at the points' projections; grey for points in no photo."""
    total, seen = np.zeros((len(xyz), 3), np.float32), np.zeros(len(xyz), np.float32)
    for view in views:
        shrink = min(1.0, COLOUR_SIDE / max(view.camera.width, view.camera.height))
        size = [max(1, round(side * shrink)) for side in (view.camera.width, view.camera.height)]
        small = replace(view, camera=view.camera.resized(*size))
        inside, pixels = _inside(xyz, small)
        x, y = pixels[inside].T
        total[inside] += load_photo(small)[y, x]
        seen += inside
    mean = total / np.maximum(seen, 1)[:, None]
    return np.where(seen[:, None] > 0, mean.round(), GREY).astype(np.uint8)


def _inside(
    xyz: Float32[np.ndarray, "P 3"], view: View
) -> tuple[Bool[np.ndarray, " P"], Int64[np.ndarray, "P 2"]]:
    """Which points project into a view (occluded or not), and their pixels (0, 0 for the others)."""
    camera = view.camera
    uv, _ = geometry.project(xyz, camera.w2c, camera.K)
    inside = np.all((uv >= 0) & (uv < [camera.width, camera.height]), axis=1)
    return inside, np.where(inside[:, None], uv, 0).astype(np.int64)
