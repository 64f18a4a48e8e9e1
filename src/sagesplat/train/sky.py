"""Sky on a far shell: Gaussians of the sky begin on a sphere around the cameras, and stay on it.

Structure from motion finds no points in a sky. Without any, training paints it with whatever is near, which
hangs in front of cameras that no photo was taken from. The sphere lies beyond everything else.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int16, UInt8
from numba import prange
from scipy.spatial import KDTree
from torch import Tensor

from sagesplat.core.errors import RunError, short
from sagesplat.io.files import atomic_path
from sagesplat.io.npz import Npz
from sagesplat.kernels.jit import njit
from sagesplat.scene.images import Photos
from sagesplat.scene.scene import Camera, Points, Scene
from sagesplat.segment.masks import Masks, Taxonomy
from sagesplat.segment.valid import ALL_VALID, ValidPixels

_FAR_POINTS = 99.0  # percentile of the points' distances that the shell lies beyond
_BEYOND, _LEAST, _MOST = 1.5, 10.0, 100.0  # times that distance; smallest and largest radius, scene extents
_PER_VIEW = 24  # points of the shell along the longer side of a photo
_MARGIN = 8.0  # degrees around the sky in the photos that get points too: other views see more of it
_PIXELS = 20_000  # of a photo's sky that are looked at, at most
_THICKNESS = 0.03  # of the radius: what is closer to the shell lies on it, as SPZ files round positions too
_MOST_POINTS = 10_000_000
_FORMAT = 1


@dataclass(frozen=True, eq=False)
class Shell:
    """The sphere that the Gaussians of the sky lie on; nothing is beyond it."""

    centre: Float32[np.ndarray, "3"]  # world
    radius: float  # world units
    extent: float  # of the scene, world units: sizes and steps on the shell are as large as seen from within
    label_ids: tuple[int, ...]  # the categories that are sky

    @property
    def scale(self) -> float:
        """How many times farther away the shell is than the scene is large."""
        return self.radius / self.extent

    def holds(self, means: Tensor) -> Bool[Tensor, " N"]:
        """Which Gaussians lie on the shell, or beyond it."""
        least = self.radius * (1 - _THICKNESS)
        if means.is_cuda:
            return (means - means.new_tensor(self.centre)).norm(dim=1) >= least
        return torch.from_numpy(_beyond(means.detach().numpy(), self.centre, np.float32(least)))

    def place(self, means: Float32[Tensor, "N 3"]) -> Float32[Tensor, "N 3"]:
        """The means moved to the sphere, along their directions from the centre."""
        centre = means.new_tensor(self.centre)
        offset = means - centre
        return centre + offset * (self.radius / offset.norm(dim=1, keepdim=True).clamp_min(1e-12))

    def step(self, means: Tensor, before: Tensor, rows: Tensor) -> None:
        """Scale a training step of some rows (indices) to the shell's distance, along the shell; in place."""
        if means.is_cuda:  # on a CPU a dozen operations of torch take several times as long as a kernel
            means[rows] = self.place(before + self.scale * (means[rows] - before))
            return
        sizes = np.float32(self.radius), np.float32(self.scale)
        _step(means.numpy(), before.numpy(), rows.numpy(), self.centre, *sizes)


@njit(parallel=True, error_model="numpy", cache=True)
def _beyond(means, centre, radius):
    """Whether each of `means` [N, 3] is at least `radius` away from the centre."""
    found = np.empty(len(means), np.bool_)
    for i in prange(len(means)):
        x, y, z = means[i, 0] - centre[0], means[i, 1] - centre[1], means[i, 2] - centre[2]
        found[i] = x * x + y * y + z * z >= radius * radius
    return found


@njit(parallel=True, error_model="numpy", cache=True)
def _step(means, before, rows, centre, radius, scale):
    """`Shell.step`, in place; `before` has the means of `rows`."""
    for k in prange(len(rows)):
        i, square = rows[k], np.float32(0)
        for axis in range(3):
            moved = before[k, axis] + scale * (means[i, axis] - before[k, axis]) - centre[axis]
            means[i, axis] = moved
            square = np.float32(np.float64(moved) * moved + square)  # as torch rounds it
        far = radius * (np.float32(1) / max(np.sqrt(square), np.float32(1e-12)))
        for axis in range(3):
            means[i, axis] = centre[axis] + means[i, axis] * far


@dataclass(frozen=True, eq=False)
class Sky:
    """The shell, and the points on it where Gaussians begin."""

    shell: Shell
    xyz: Float32[np.ndarray, "P 3"]
    rgb: UInt8[np.ndarray, "P 3"]

    def begin(
        self, scene: Scene, label_ids: Int16[np.ndarray, " A"]
    ) -> tuple[Scene, Int16[np.ndarray, " B"]]:
        """The scene with the points of the sky, and the labels of all points.

        Points of the scene that are labelled sky move to the shell, and so does what is beyond it.
        """
        points, shell = scene.points, self.shell
        means = torch.from_numpy(points.xyz)
        to_shell = torch.from_numpy(np.isin(label_ids, shell.label_ids)) | shell.holds(means)
        xyz = torch.where(to_shell[:, None], shell.place(means), means).numpy()
        more: Points = replace(
            points, xyz=np.concatenate([xyz, self.xyz]), rgb=np.concatenate([points.rgb, self.rgb])
        )
        mine = np.full(len(self.xyz), shell.label_ids[0], np.int16)
        return replace(scene, points=more), np.concatenate([label_ids, mine])


def sky_labels(taxonomy: Taxonomy) -> tuple[int, ...]:
    """The ids of the categories that are sky, by name: "sky", "sky-other-merged", "Sky 2" ..."""
    return tuple(
        i for i, name in taxonomy.names.items() if name.replace("-", " ").lower().split()[:1] == ["sky"]
    )


def find_sky(
    scene: Scene,
    photos: Photos,
    masks: Masks,
    label_ids: Int16[np.ndarray, " A"],
    valid: ValidPixels = ALL_VALID,
) -> Sky | None:
    """A far shell with points where training photos show sky; None where they show none.

    The shell is centred between the training cameras, at 1.5 times the distance of all but the farthest
    points (at least 10 scene extents). It gets points in the directions that show sky, and some degrees
    around them: a held-out view sees sky where trees or houses hide it from the others.

    Args:
        scene: The capture.
        photos: Its photos.
        masks: Label images.
        label_ids: Category of each SfM point.
        valid: The pixels that count.
    """
    labels = sky_labels(masks.taxonomy)
    if not labels or not len(scene.train_ids):
        return None
    spacing = _spacing(scene)
    seen, rgb = _seen(scene, photos, masks, labels, valid, spacing)
    if not len(seen):
        return None
    centre = np.median([scene.views[i].camera.position for i in scene.train_ids], axis=0)
    distances = np.linalg.norm(scene.points.xyz[~np.isin(label_ids, labels)] - centre, axis=1)
    far = np.percentile(distances, _FAR_POINTS) if len(distances) else 0.0
    radius = float(np.clip(_BEYOND * far, _LEAST * scene.scale, _MOST * scene.scale))
    shell = Shell(centre.astype(np.float32), radius, scene.scale, labels)
    directions, colors = _with_margin(seen, rgb, spacing)
    return Sky(
        shell, (centre + shell.radius * directions).astype(np.float32), colors.round().astype(np.uint8)
    )


def _spacing(scene: Scene) -> float:
    """Angle between neighbouring points of the shell, radians."""
    cameras = [scene.views[i].camera for i in scene.train_ids]
    fov = np.median([2 * np.arctan(max(c.width / c.K[0, 0], c.height / c.K[1, 1]) / 2) for c in cameras])
    return float(fov / _PER_VIEW)


def _seen(
    scene: Scene, photos: Photos, masks: Masks, labels: tuple[int, ...], valid: ValidPixels, spacing: float
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3"]]:
    """Directions in which training photos show sky, one per cell of a grid, and their mean colours."""
    found = [np.zeros((0, 7))]
    for row in scene.train_ids.tolist():
        view = scene.views[row]
        sky, counts = np.isin(masks[view], labels), valid[view]
        v, u = np.nonzero(sky if counts is None else sky & counts)
        if not len(v):
            continue
        step = -(-len(v) // _PIXELS)
        v, u = v[::step], u[::step]
        directions = _directions(view.camera, np.stack([u + 0.5, v + 0.5], 1))
        rows = np.concatenate([directions, photos[row][v, u], np.ones((len(v), 1))], 1)
        found.append(_summed(rows, spacing))
    table = _summed(np.concatenate(found), spacing)
    lengths = np.linalg.norm(table[:, :3], axis=1, keepdims=True)
    return table[:, :3] / lengths, table[:, 3:6] / table[:, 6:]


def _summed(rows: Float[np.ndarray, "R 7"], spacing: float) -> Float[np.ndarray, "C 7"]:
    """Sums of the rows (direction, colour, count) in each cell of directions."""
    mean = rows[:, :3] / rows[:, 6:]
    cells, cell = np.unique(np.floor(mean / spacing).astype(np.int64), axis=0, return_inverse=True)
    total = np.zeros((len(cells), 7))
    np.add.at(total, cell.ravel(), rows)
    return total


def _directions(camera: Camera, uv: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """Unit vectors in the world towards pixels."""
    inward = np.concatenate([(uv - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]], np.ones((len(uv), 1))], 1)
    directions = inward @ camera.w2c[:3, :3]
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _with_margin(
    seen: Float[np.ndarray, "S 3"], rgb: Float[np.ndarray, "S 3"], spacing: float
) -> tuple[Float[np.ndarray, "D 3"], Float[np.ndarray, "D 3"]]:
    """The directions that were seen, and a margin around them in the colours of the nearest."""
    n = int(4 * np.pi / spacing**2)
    z, turn = 1 - (2 * np.arange(n) + 1) / n, np.pi * (1 + 5**0.5) * (np.arange(n) + 0.5)  # Fibonacci's
    across = np.sqrt(1 - z * z)
    grid = np.stack([across * np.cos(turn), across * np.sin(turn), z], 1)
    offset, nearest = map(np.asarray, KDTree(seen).query(grid))
    margin = (offset > 0.7 * spacing) & (offset < 2 * np.sin(np.radians(_MARGIN) / 2))
    return np.concatenate([seen, grid[margin]]), np.concatenate([rgb, rgb[nearest[margin]]])


def write_sky(path: Path, sky: Sky) -> None:
    """Write a sky to a .npz file."""
    shell = sky.shell
    with atomic_path(path) as temporary:
        np.savez(
            temporary, format=np.array(_FORMAT), centre=shell.centre, radius=np.array(shell.radius),
            extent=np.array(shell.extent), label_ids=np.array(shell.label_ids, np.int16), xyz=sky.xyz,
            rgb=sky.rgb,
        )  # fmt: skip


def read_sky(path: Path) -> Sky:
    """The sky that `write_sky` wrote; RunError for anything else."""
    try:
        with Npz(path) as file:
            if int(file["format"]) != _FORMAT:
                raise ValueError("another format")
            centre, radius, extent = file["centre"], float(file["radius"]), float(file["extent"])
            label_ids, xyz, rgb = file["label_ids"], file["xyz"], file["rgb"]
        _check(centre, radius, extent, label_ids, xyz, rgb)
    except (OSError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise RunError(
            f"{path}: not the sky of a run ({short(error)}); run `sagesplat train` again with --force"
        ) from None
    return Sky(Shell(centre, radius, extent, tuple(label_ids.tolist())), xyz, rgb)


def _check(
    centre: np.ndarray, radius: float, extent: float, label_ids: np.ndarray, xyz: np.ndarray, rgb: np.ndarray
) -> None:
    """ValueError for wrong shapes and types, or what is no sky."""
    if not (0 < extent < radius < 1e9 and radius <= 1.001 * _MOST * extent):
        raise ValueError("no shell beyond the scene")
    if centre.shape != (3,) or centre.dtype != np.float32 or not (np.abs(centre) < 1e9).all():
        raise ValueError("no centre")
    if label_ids.ndim != 1 or label_ids.dtype != np.int16 or not len(label_ids):
        raise ValueError("no categories")
    if (label_ids < 0).any():
        raise ValueError("categories out of range")
    kinds = (xyz, np.float32), (rgb, np.uint8)
    if any(a.dtype != kind or a.shape != (len(xyz), 3) for a, kind in kinds) or len(xyz) > _MOST_POINTS:
        raise ValueError("no points with colours")
    off = np.linalg.norm(xyz.astype(np.float64) - centre, axis=1) / radius - 1
    if not (np.abs(off) < 1e-3).all():
        raise ValueError("points that are not on the shell")
