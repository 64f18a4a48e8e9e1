"""What a run needs, checked before anything takes hours."""

import shutil
from pathlib import Path

from sagesplat.core.config import MasksConfig, TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Warned
from sagesplat.run.executor import Local
from sagesplat.run.job import Job
from sagesplat.scene.detect import detect
from sagesplat.stages.label import segmenter_kind
from sagesplat.stages.prompts import MASKS, load, settings_of
from sagesplat.train import memory
from sagesplat.train.strategy import schedule_of

_GIB = 2**30
_LEVEL_BYTES = 34, 79  # of a Gaussian in a level file, with harmonics of degree 0 and 3
_STATES = 6  # copies of the Gaussians in the two checkpoints: parameters and two moments each


def check_segmenter(job: Job, path: Path, config: MasksConfig) -> None:
    """Load the network of `--segmenter` before structure from motion, which may take hours.

    SageError for a missing package, file or setting, and for weights that are neither here nor can be
    fetched. Nothing is loaded where label images or poses are there already: then the network is next.
    """
    if detect(path) not in ("photos", "video") or job.run.scene.exists():
        return
    kind = segmenter_kind(job.run.capture / path.resolve().stem, config)
    if kind == MASKS and not config.prompts:
        return
    settings_of(kind, config)
    if isinstance(job.executor, Local):  # else the nodes load it
        load(kind, config, job.device, job.threads, lambda text: job.emit(Warned(text)))


def check_training(job: Job, config: TrainConfig) -> None:
    """Check memory and disk for a training that is not done yet, before label images take their time.

    RunError where the initial points need more memory than there is, or their levels more disk; a warning
    where the disk may become full.
    """
    run = job.run
    if run.provenance("train").exists() or job.backend == "cuda":
        return
    fitted = memory.fit(job.given_scene, config, job.memory_limit, processes=job.processes)
    points, levels = len(job.given_scene.points.xyz), config.max_steps // schedule_of(config).level_every
    free = shutil.disk_usage(run.path).free
    state = 4 * (11 + 3 * (config.sh_degree + 1) ** 2) * _STATES  # bytes a Gaussian in the checkpoints
    counts = points, fitted.lowered
    least, most = (n * (level * levels + state) for n, level in zip(counts, _LEVEL_BYTES, strict=True))
    needs = f"training writes about {least / _GIB:.1f} to {most / _GIB:.1f} GiB, {free / _GIB:.1f} are free"
    if least > free:
        raise RunError(f"{run.path}: {needs}; free some, or choose another disk")
    if most > free:
        job.emit(Warned(f"{run.path}: {needs}"))
