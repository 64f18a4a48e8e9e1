"""Known disturbances of the built-in capture: what photos of people differ in from a clean capture."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from sagesplat.core.errors import SceneError
from sagesplat.scene.scene import Camera

FACING = np.pi  # where a half circle begins: its photos see the front of the house


@dataclass(frozen=True)
class Wild:
    """Disturbances of a capture, each off by default. All follow the capture's seed."""

    exposure: float = 0.0
    """Exposure of a photo: uniform within this many EV of the right one."""
    white_balance: float = 0.0
    """Drift of white balance along the path: up to this many EV more red and less blue, or the reverse."""
    vignetting: float = 0.0
    """Share of the light that the lens loses in the corners."""
    figures: int = 0
    """People who walk around: at another place in each photo."""
    figure_masks: bool = True
    """Label images show the figures as "person"; else what is behind them."""
    pose_degrees: float = 0.0
    """Root mean square angle of the noise of rotations, degrees."""
    pose_shift: float = 0.0
    """Root mean square distance of the noise of camera centres, as a share of the scene's extent."""
    keep: float = 1.0
    """Share of the photos that is kept, drawn at random."""
    half_circle: bool = False
    """The path goes around the table half way only."""
    off_path: int = 0
    """Photos of the truth from viewpoints off the path, for measuring."""

    def __post_init__(self) -> None:
        """SceneError for what cannot be drawn."""
        amounts = self.exposure, self.white_balance, self.pose_degrees, self.pose_shift
        if not all(np.isfinite(amounts)) or min(*amounts, self.figures, self.off_path) < 0:
            raise SceneError(f"{self}: a disturbance is below 0 or not a number; give 0 for none")
        if not 0 <= self.vignetting < 1 or not 0 < self.keep <= 1:
            raise SceneError(f"{self}: vignetting is a share from 0 to below 1, keep one above 0")

    @property
    def quiet(self) -> bool:
        """Whether nothing is disturbed and nothing is measured."""
        return replace(self, figure_masks=True) == Wild()


NOTHING = Wild()
EVERYTHING = Wild(0.7, 0.15, 0.4, 3, True, 0.5, 0.005, off_path=40)  # what `sagesplat demo --wild` draws


def kept_views(wild: Wild, views: int, seed: int) -> np.ndarray:
    """Rows of the photos that are kept, in order; at least 3."""
    count = max(min(3, views), round(wild.keep * views))
    if count >= views:
        return np.arange(views)
    return np.sort(np.random.default_rng([seed, 11]).choice(views, count, replace=False))


def camera_gains(wild: Wild, views: int, seed: int) -> Float64[np.ndarray, "V 3"]:
    """Factors of linear RGB by photo: exposure is drawn photo by photo, white balance drifts along the path.

    The mean of exposures over all photos is 0 EV, so that an undisturbed photo shows the mean exposure.
    """
    rng = np.random.default_rng([seed, 12])
    exposure = rng.uniform(-1, 1, views)
    exposure = wild.exposure * (exposure - exposure.mean()).clip(-1, 1)
    walk = rng.normal(size=views).cumsum()
    walk -= walk.mean()
    walk *= wild.white_balance / max(np.abs(walk).max(), 1e-9)
    return 2.0 ** np.stack([exposure + walk, exposure, exposure - walk], 1)


def lens_falloff(wild: Wild, camera: Camera) -> Float64[np.ndarray, "H W 1"]:
    """Share of the light that the lens lets through: as cos^4 of an angle, which follows from the corners."""
    v, u = np.indices((camera.height, camera.width)) + 0.5
    middle = np.array([camera.width, camera.height]) / 2
    r2 = ((u - middle[0]) ** 2 + (v - middle[1]) ** 2) / (middle @ middle)
    return (1 + ((1 - wild.vignetting) ** -0.5 - 1) * r2[..., None]) ** -2


def noisy_cameras(wild: Wild, cameras: list[Camera], seed: int) -> list[Camera]:
    """The cameras with poses that are a little off."""
    if not (wild.pose_degrees or wild.pose_shift):
        return cameras
    rng, centres = np.random.default_rng([seed, 13]), np.stack([c.position for c in cameras]).astype(float)
    extent = 1.1 * np.linalg.norm(centres - centres.mean(0), axis=1).max()
    turns = np.radians(wild.pose_degrees) / np.sqrt(3) * rng.normal(size=centres.shape)
    centres += wild.pose_shift * extent / np.sqrt(3) * rng.normal(size=centres.shape)
    return [
        replace(camera, w2c=_posed(Rotation.from_rotvec(turn).as_matrix() @ camera.w2c[:3, :3], centre))
        for camera, turn, centre in zip(cameras, turns, centres, strict=True)
    ]


def _posed(rotation: np.ndarray, centre: np.ndarray) -> np.ndarray:
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = rotation, -rotation @ centre
    return w2c.astype(np.float32)
