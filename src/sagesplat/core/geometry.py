"""Geometry on plain arrays: offsets, projection, nearest neighbours, Morton order."""

import numpy as np
from jaxtyping import Float, Float32, Int64
from scipy.spatial import KDTree

Position = tuple[float, float, float]  # world units
NO_OFFSET: Position = (0.0, 0.0, 0.0)
_FARTHEST = 1e9  # world units; float64 is too coarse beyond
_LARGE = 1e5  # world units; float32 has steps of 0.01 there, too coarse for what is near a camera
_FAR = 100.0  # times the size of a scene: from there, float32 costs 0.01 px and more in photos of 4000 px


def offset_of(middles: Float[np.ndarray, "N 3"], others: Float[np.ndarray, "M 3"] | None = None) -> Position:
    """What to subtract, in float64, from all positions of a scene before float32 rounds them.

    Zeros, unless the scene is far from its origin for its size, or farther than 10^5 units and its size, as
    those in UTM are. Medians decide, so that a few outliers do not. The offset is a round number of about the
    scene's size.

    Args:
        middles: Positions whose median is the middle of the scene: of its cameras, or of its Gaussians.
        others: Positions that count for the size only: points.
    """
    middles = middles[np.isfinite(middles).all(axis=1)].astype(np.float64)
    if not len(middles):
        return NO_OFFSET
    with np.errstate(all="ignore"):  # what overflows is not near enough to be moved
        middle = np.median(middles, axis=0)
        distance = float(np.linalg.norm(middle))
        parts = [middles] if others is None or not len(others) else [middles, others]
        size = max(float(np.median(np.linalg.norm(part - middle, axis=1))) for part in parts)
    size = size if size > 1e-12 * distance else 1.0  # all in one place, as far as float64 tells
    least = size if distance > _LARGE else _FAR * size
    if not least < distance < _FARTHEST:
        return NO_OFFSET
    step = 10.0 ** np.floor(np.log10(size))
    x, y, z = (np.round(middle / step) * step).tolist()
    return x, y, z


def less_offset(w2c: Float[np.ndarray, "*V 4 4"], offset: Position) -> Float[np.ndarray, "*V 4 4"]:
    """Poses, world to camera, after `offset` was subtracted from all positions of the world."""
    moved = w2c.copy()
    moved[..., :3, 3] += w2c[..., :3, :3] @ np.array(offset)
    return moved


def offset_text(offset: Position) -> str:
    """An offset for people and files: "412346 5312346 188"."""
    return " ".join(f"{value:.10g}" for value in offset)


def mean_neighbour_distance(xyz: Float32[np.ndarray, "P 3"], k: int = 3) -> Float32[np.ndarray, " P"]:
    """Root mean square distance to the k nearest other points (or as many as there are), at least 1e-7."""
    k = min(k, len(xyz) - 1)
    if k < 1:
        return np.full(len(xyz), 1e-2, np.float32)
    distances = KDTree(xyz).query(xyz, k=k + 1)[0][:, 1:]
    return np.sqrt(np.maximum(np.square(distances).mean(1), 1e-14)).astype(np.float32)


def to_camera(xyz: Float[np.ndarray, "P 3"], w2c: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "P 3"]:
    """World points in camera coordinates."""
    return xyz @ w2c[:3, :3].T + w2c[:3, 3]


def project(
    xyz: Float[np.ndarray, "P 3"], w2c: Float[np.ndarray, "4 4"], K: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "P 2"], Float[np.ndarray, " P"]]:
    """Pixels and depths (camera z, world units) of world points; pixels behind the camera are NaN."""
    points = to_camera(xyz, w2c)
    depths = points[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = points[:, :2] / np.where(depths > 0, depths, np.nan)[:, None]
    return pixels * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]], depths


def morton_order(points: Float32[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Rows of the points along Morton's space-filling curve, 10 bits per axis."""
    if not len(points):
        return np.zeros(0, np.int64)
    low, high = np.percentile(points, [1, 99], axis=0)  # floaters would squeeze the rest
    cells = ((points - low) / np.maximum(high - low, 1e-12) * 1024).clip(0, 1023).astype(np.int64)
    codes = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            codes |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(codes, kind="stable")


def weighted_quantile(
    values: Float[np.ndarray, " N"], weights: Float[np.ndarray, " N"], share: float
) -> float:
    """The value below which this share of the weight is."""
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(sums, share * sums[-1])), len(order) - 1)]])
