"""Learning-rate and resolution schedule.

`published` is that of 3DGS. `fast` reaches the same quality in a fraction of the steps: higher learning rates
at first, and smaller photos while the model is coarse (as DashGaussian, Chen et al. 2025: the frequency
content of the photos decides for how long).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image

from sagesplat.core.config import TrainConfig
from sagesplat.scene.scene import Camera

# Adam's learning rates of 3DGS (Kerbl et al. 2023); that of the means is times the scene extent.
PUBLISHED_RATES = {
    "means": 1.6e-4,
    "quats": 1e-3,
    "log_scales": 5e-3,
    "logit_opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 1.25e-4,
}
SGLD_NOISE = 5e5  # of 3DGS-MCMC (Kheradmand et al. 2024), times the learning rate of the means
# Of the fast schedule: multiplier of the published learning rates at the start, and the share of the run from
# which on those of all but the means shrink. A run of `_SHORT` steps or fewer has to learn to its end: rates
# shrink to `_SHORT_SHRINK_TO` (means: their own), in longer runs less and less, down to the other pair.
_GAIN, _SHRINK_FROM, _SHORT = 4.0, 0.3, 1000
_SHRINK_TO, _SHORT_SHRINK_TO = 0.1, 0.5
_MEANS_SHRINK_TO, _SHORT_MEANS_SHRINK_TO = 0.01, 0.1  # the first of the published schedule too
_FACTORS = (4, 2)  # how many times smaller photos may be
_SMALLEST = 200  # pixels of the shorter side: below, the Gaussians cost more than the pixels
_LEARNT_BY = 0.5  # share of the run after which all photos have full resolution


@dataclass(frozen=True)
class LrSchedule:
    """Learning rates, SGLD noise and photo resolution of one run, by step."""

    config: TrainConfig
    extent: float
    coarse: tuple[tuple[int, int], ...] = ()  # (last step, how many times smaller), ascending

    def learning_rates(self, step: int) -> dict[str, float]:
        """Adam's learning rate at a step, by parameter name."""
        config, share = self.config, step / self.config.max_steps
        learning_rates = dict(PUBLISHED_RATES)
        if config.lr_schedule == "published":
            learning_rates["means"] *= self.extent * _MEANS_SHRINK_TO**share
            return learning_rates
        short = min(1.0, _SHORT / config.max_steps)
        learning_rates["means"] *= (
            self.extent * max(_MEANS_SHRINK_TO, short * _SHORT_MEANS_SHRINK_TO) ** share
        )
        shrunk = max(0.0, (share - _SHRINK_FROM) / (1 - _SHRINK_FROM))
        gain = _GAIN * max(_SHRINK_TO, short * _SHORT_SHRINK_TO) ** shrunk
        return {name: rate * (_GAIN if name == "means" else gain) for name, rate in learning_rates.items()}

    def sgld_noise(self, step: int) -> float:
        """MCMC's noise at a step, in 1 / world units: the published rate of the means times `SGLD_NOISE`,
        as if the scene were scaled to an extent of 1.
        """
        return (
            SGLD_NOISE
            * PUBLISHED_RATES["means"]
            * _MEANS_SHRINK_TO ** (step / self.config.max_steps)
            / self.extent
        )

    def factor(self, step: int) -> int:
        """How many times smaller the photo of a step is."""
        return next((factor for last, factor in self.coarse if step <= last), 1)


def lr_schedule(config: TrainConfig, extent: float, photos: list[UInt8[np.ndarray, "H W 3"]]) -> LrSchedule:
    """The schedule of a run, from the frequency content of some of its photos.

    Photos `factor` times smaller show the share `detail` of what the photos hold, and are used until
    that share of the first half of the run is over.
    """
    coarse, last = [], 0
    if config.lr_schedule == "fast":
        shortest = min(min(p.shape[:2]) for p in photos)
        for factor in (f for f in _FACTORS if shortest >= f * _SMALLEST):
            until = round(_LEARNT_BY * config.max_steps * float(np.mean([detail(p, factor) for p in photos])))
            if until > last:
                coarse.append((until, factor))
                last = until
    return LrSchedule(config, extent, tuple(coarse))


def detail(photo: UInt8[np.ndarray, "H W 3"], factor: int) -> float:
    """Share of a photo's amplitude spectrum, its mean left out, that one `factor` times smaller keeps."""
    grey = photo.mean(-1)
    spectrum = np.abs(np.fft.fft2(grey - grey.mean()))
    rows, columns = (np.abs(np.fft.fftfreq(n)) * 2 * factor <= 1 for n in grey.shape)
    return float(spectrum[np.ix_(rows, columns)].sum() / max(spectrum.sum(), 1e-12))


def smaller(
    photo: UInt8[np.ndarray, "H W 3"], camera: Camera, factor: int
) -> tuple[UInt8[np.ndarray, "h w 3"], Camera]:
    """A photo and its camera, `factor` times smaller (area-resampled)."""
    if factor == 1:
        return photo, camera
    size = max(1, round(camera.width / factor)), max(1, round(camera.height / factor))
    image = Image.fromarray(photo).resize(size, Image.Resampling.BOX)
    return np.array(image), camera.resized(*size)


def smaller_valid(valid: Bool[np.ndarray, "H W"], factor: int) -> Bool[np.ndarray, "h w"]:
    """Which pixels of a photo `factor` times smaller count: means of pixels that all do."""
    if factor == 1:
        return valid
    height, width = valid.shape
    size = max(1, round(width / factor)), max(1, round(height / factor))
    grey = Image.fromarray(np.where(valid, np.uint8(255), np.uint8(0)))
    return np.asarray(grey.resize(size, Image.Resampling.BOX)) == 255
