"""What training and storage take: plain functions of stated inputs, measured here and by others."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from sagesplat.core.errors import DataError


@dataclass(frozen=True)
class Training:
    """One training whose time is known."""

    what: str
    device: str
    hours: float  # of all devices together
    photos: int
    steps: int  # 0: not told
    gaussians: float  # at the end; 0: not told
    source: str
    ours: bool

    @property
    def hours_per_1000(self) -> float:
        """Device hours for 1000 photos at the same steps a photo."""
        return per_1000_photos(self.hours, self.photos)


_PERFORMANCE = "docs/performance.md, measured"
_GSPLAT = "docs.gsplat.studio, tests/eval"
TRAININGS = (
    Training("garden 256 px, fast pace", "2 CPU cores", 124.1 / 3600, 185, 3000, 92e3, _PERFORMANCE, True),
    Training("dinosaur 256 px, fast pace", "2 CPU cores", 72 / 3600, 116, 2000, 89e3, _PERFORMANCE, True),
    Training("garden 512 px, fast pace", "2 CPU cores", 75.3 / 3600, 185, 1200, 150e3, _PERFORMANCE, True),
    # 232: mean number of photos of its seven scenes of Mip-NeRF 360
    Training("gsplat, mean of 7 scenes", "A100", 19.39 / 60, 232, 30_000, 3.24e6, _GSPLAT, False),
    Training("LiteGS, garden", "RTX 4090", 33 / 3600, 185, 0, 1e6, "LiteGS' authors", False),
    Training("CityGS-X, 5000 photos", "4 x RTX 4090", 4 * 5.0, 5000, 0, 0, "arXiv:2503.23044", False),
)


def per_1000_photos(hours: float, photos: int) -> float:
    """Device hours for 1000 photos, from those for some."""
    if hours < 0 or photos < 1:
        raise DataError(f"{hours} hours for {photos} photos: give a photo at least, and no less than 0 hours")
    return 1000 * hours / photos


def hours_by_steps(photos: float, steps_per_photo: float, ms_per_step: float) -> float:
    """Device hours of a training that looks at every photo so often."""
    return photos * steps_per_photo * ms_per_step / 3.6e6


def per_hectare(photos_per_hectare: float, hours_per_1000: float) -> float:
    """Device hours for a hectare."""
    return photos_per_hectare * hours_per_1000 / 1000


def hull_hectares(positions: Sequence[Sequence[float]], up: Sequence[float], meters_per_unit: float) -> float:
    """Hectares inside the hull of cameras seen from above."""
    points, axis = np.asarray(positions, float), np.asarray(up, float)
    across = np.linalg.svd(axis[None] / np.linalg.norm(axis))[2][1:]
    area = ConvexHull(points @ across.T).volume  # of a hull in the plane this is the area
    return float(area) * meters_per_unit**2 / 1e4


@dataclass(frozen=True)
class Storage:
    """Bytes of one scene at rest."""

    gaussians: float = 92e3
    chunk_bytes: float = 20.7  # per Gaussian: 1,899,917 of 91,972 in garden's bundle
    copies: int = 2  # the increments one by one, and all of them in the pack
    master_bytes: float = 83.3  # per Gaussian: nested/ladder.npz, 7,659,856 for the same
    documents: float = 315_000.0  # manifest and promises, unpacked
    viewer: float = 3_220_000.0  # page, licences, schema; 0 where one page shows all scenes

    @property
    def bundle(self) -> float:
        """Bytes of the folder that a web server has."""
        return self.gaussians * self.chunk_bytes * self.copies + self.documents + self.viewer

    @property
    def master(self) -> float:
        """Bytes of what bundles are made from."""
        return self.gaussians * self.master_bytes
