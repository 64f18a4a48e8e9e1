"""FLIP: how visible a difference is when two pictures alternate (Andersson et al. 2020)."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32
from scipy.ndimage import correlate1d

PIXELS_PER_DEGREE = 67.0  # of visual angle: FLIP's own, a monitor 3840 px and 0.7 m wide seen from 0.7 m

_TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)  # fmt: skip - linear sRGB to CIE XYZ, D65
_WHITE = _TO_XYZ.sum(1)
_OPPONENT = np.array([[0, 116.0, 0], [500, -500, 0], [0, 200, -200]])  # XYZ / white to Y + 16, Cx, Cz
_TO_YCC = (_OPPONENT @ (_TO_XYZ / _WHITE[:, None])).astype(np.float32)
# contrast sensitivity of each channel: sums of a sqrt(pi / b) exp(-pi^2 d^2 / b), d in degrees
_SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
_EXPONENT, _KNEE, _AT_KNEE = 0.7, 0.4, 0.95  # of colour differences: up to the knee's share of the largest
_FEATURE_WIDTH = 0.082  # degrees that the largest weights of the edge detector are apart
_DELTA = 6 / 29  # below its cube CIELAB is linear


def flip_map(
    image: Float32[np.ndarray, "H W 3"],
    reference: Float32[np.ndarray, "H W 3"],
    pixels_per_degree: float = PIXELS_PER_DEGREE,
) -> Float32[np.ndarray, "H W"]:
    """LDR-FLIP at every pixel: 0 = no difference to be seen, 1 = the largest.

    Args:
        image: sRGB in [0, 1].
        reference: What it is compared with, likewise.
        pixels_per_degree: Of visual angle, at which the pictures are looked at.

    Example:
        >>> import numpy as np
        >>> from sagesplat.metrics.flip import flip_map
        >>> photo = np.random.default_rng(0).random((32, 48, 3), np.float32)
        >>> float(flip_map(photo, photo).max())
        0.0
    """
    (colours, edges, points), (colours_of, edges_of, points_of) = (
        _seen(picture, pixels_per_degree) for picture in (image, reference)
    )
    error = _distance(colours, colours_of) ** _EXPONENT
    most = _LARGEST**_EXPONENT
    knee = _KNEE * most
    colour = np.where(
        error < knee, error * (_AT_KNEE / knee), _AT_KNEE + (error - knee) / (most - knee) * (1 - _AT_KNEE)
    )
    feature = np.maximum(np.abs(edges - edges_of), np.abs(points - points_of)) * math.sqrt(0.5)
    return (colour ** (1 - np.sqrt(feature))).astype(np.float32)


def _seen(picture: np.ndarray, pixels_per_degree: float) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """What an eye sees of a picture: Hunt-adjusted CIELAB, [H, W] each, how much of edges, and of points."""
    low = picture / np.float32(12.92)
    linear = np.where(
        picture <= 0.04045, low, ((picture + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    )
    channels = [np.ascontiguousarray(plane) for plane in np.moveaxis(linear @ _TO_YCC.T, -1, 0)]
    filtered = [_blurred(*of, pixels_per_degree) for of in zip(channels, _SENSITIVITY, strict=True)]
    return (_lab(filtered), *_features(channels[0] / np.float32(116), pixels_per_degree))


def _blurred(plane: np.ndarray, terms: Sequence[tuple[float, float]], pixels_per_degree: float) -> np.ndarray:
    """A channel as contrast sensitivity leaves it; pixels beyond the border are those at it."""
    widest = max(b for of in _SENSITIVITY for _, b in of)
    radius = math.ceil(3 * math.sqrt(widest / (2 * math.pi**2)) * pixels_per_degree)
    squares = (np.arange(-radius, radius + 1) / pixels_per_degree) ** 2
    kernels = [np.exp(-(math.pi**2) / b * squares) for _, b in terms]
    volumes = [a * math.sqrt(math.pi / b) * k.sum() ** 2 for (a, b), k in zip(terms, kernels, strict=True)]
    out = np.zeros_like(plane)
    for volume, kernel in zip(volumes, kernels, strict=True):
        out += np.float32(volume / sum(volumes)) * _separable(plane, *2 * (kernel / kernel.sum(),))
    return out


def _separable(plane: np.ndarray, down: np.ndarray, across: np.ndarray) -> np.ndarray:
    return correlate1d(correlate1d(plane, down, 0, mode="nearest"), across, 1, mode="nearest")


def _lab(ycc: Sequence[np.ndarray]) -> list[np.ndarray]:
    """CIELAB of filtered colours, as far as a monitor shows them; in the dark less of a* and b* (Hunt)."""
    to_rgb = np.linalg.inv(_TO_YCC.astype(np.float64)).astype(np.float32)
    rgb = (np.stack(ycc, -1) @ to_rgb.T).clip(0, 1)
    xyz = rgb @ (_TO_XYZ / _WHITE[:, None]).T.astype(np.float32)
    cubic = np.where(xyz > _DELTA**3, np.cbrt(xyz), xyz / np.float32(3 * _DELTA**2) + np.float32(4 / 29))
    x, y, z = np.moveaxis(cubic, -1, 0)
    light = 116 * y - 16
    return [light, 5 * light * (x - y), 2 * light * (y - z)]


def _distance(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> np.ndarray:
    """HyAB: of lightness and of chroma, added."""
    light, a, b = (x - y for x, y in zip(one, other, strict=True))
    return np.abs(light) + np.sqrt(a * a + b * b)


def _features(grey: np.ndarray, pixels_per_degree: float) -> tuple[np.ndarray, np.ndarray]:
    """How much of an edge, and of a point or line, each pixel is: first and second Gaussian derivatives."""
    sigma = 0.5 * _FEATURE_WIDTH * pixels_per_degree
    radius = math.ceil(3 * sigma)
    x = np.arange(-radius, radius + 1)
    flat = np.exp(-(x**2) / (2 * sigma**2))
    even, found = flat / flat.sum(), []
    for kernel in (-x * flat, (x**2 / sigma**2 - 1) * flat):
        kernel = np.where(kernel > 0, kernel / kernel[kernel > 0].sum(), kernel / -kernel[kernel < 0].sum())
        across, down = _separable(grey, even, kernel), _separable(grey, kernel, even)
        found.append(np.sqrt(across * across + down * down))
    return found[0], found[1]


def _largest() -> float:
    """The largest colour difference there is: that of pure green and blue."""
    green, blue = (_lab([np.asarray(_TO_YCC[i, k]) for i in range(3)]) for k in (1, 2))
    return float(_distance(green, blue))


_LARGEST = _largest()
