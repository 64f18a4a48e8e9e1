"""The step numbers of a training: the published ones of 3DGS, scaled to the length of the run."""

import math
from dataclasses import dataclass

from sagesplat.core.config import TrainConfig

_REFERENCE_STEPS = 30_000
# Steps between two opacity resets, and between two increases of the SH degree (Kerbl et al. 2023).
RESET_EVERY, RAISE_SH_EVERY = 3000, 1000
_REFINE_START = 500  # not scaled, as refinements are not: the gradient statistics need the views
_MIN_REFINEMENTS, _LATEST_STOP = 8, 0.7  # refinements of a short fast run; share of the run
_MIN_RESET_INTERVAL = 1500  # steps that a model needs between two resets, however short the run


@dataclass(frozen=True)
class Schedule:
    """Steps and intervals of one training, in steps."""

    level_every: int
    refine_start: int
    refine_stop: int
    reset_every: int  # steps between two opacity resets; 0: none
    raise_sh_every: int
    recovery: int  # steps after a reset during which a level counts as recovering

    def refines(self, step: int) -> bool:
        """Whether densification is active at a step."""
        return self.refine_start < step < self.refine_stop

    def resets(self, step: int) -> bool:
        """Whether 3DGS resets opacities at a step."""
        return self.reset_every > 0 and self.refines(step) and step % self.reset_every == 0


def scaled_schedule(config: TrainConfig, refine_stop: int) -> Schedule:
    """The published step numbers scaled to `max_steps`; `refine_stop` is that of a run of 30,000 steps."""
    share = config.max_steps / _REFERENCE_STEPS

    def scaled(step: int) -> int:
        return max(1, round(step * share))

    reset_every = 0
    start, stop = min(_REFINE_START, config.max_steps // 5), scaled(refine_stop)
    if config.lr_schedule == "published":
        reset_every = max(scaled(RESET_EVERY), _MIN_RESET_INTERVAL)
    else:  # short runs need time to grow too
        enough = start + _MIN_REFINEMENTS * config.refine_every
        stop = max(stop, min(enough, int(_LATEST_STOP * config.max_steps)))
    return Schedule(
        level_every=config.level_every or math.ceil(config.max_steps / 30),
        refine_start=start,
        refine_stop=stop,
        reset_every=reset_every,
        raise_sh_every=scaled(RAISE_SH_EVERY),
        recovery=min(1000, reset_every // 2),
    )
