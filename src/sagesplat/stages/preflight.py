"""What a run needs, checked before anything takes hours."""

import importlib.util
import shutil
from pathlib import Path

from sagesplat.core.config import MasksConfig, TrainConfig
from sagesplat.core.errors import BackendUnavailable, RunError
from sagesplat.core.events import Warned
from sagesplat.core.extras import install
from sagesplat.run.executor import Local
from sagesplat.run.job import Job
from sagesplat.scene.detect import detect
from sagesplat.stages.label import segmenter_kind
from sagesplat.stages.prompts import MASKS, load, settings_of
from sagesplat.train import memory
from sagesplat.train.strategy import schedule_of

_GIB = 2**30
_LEVEL_BYTES = 34, 79  # of a Gaussian in a level file, with harmonics of degree 0 and 3
_NETWORK_PACKAGES = {  # by the kind of segmenter: the package that it needs, and the extra that brings it
    "hf": ("transformers", "hf"),
    "text": ("transformers", "hf"),
    "onnx": ("onnxruntime", "onnx"),
}
_STATES = 6  # copies of the Gaussians in the two checkpoints: parameters and two moments each


def check_segmenter(job: Job, path: Path, config: MasksConfig) -> None:
    """Load the network of `--segmenter` before structure from motion, which may take hours.

    SageError for a missing package, file or setting, and for weights that are neither here nor can be
    fetched. Nothing is loaded where label images or poses are there already: then the network is next.
    """
    if detect(path) not in ("photos", "video") or job.run.scene.exists():
        return
    kind = segmenter_kind(job.run.capture / path.resolve().stem, config)
    local = isinstance(job.executor, Local)  # else the nodes load the network
    given = kind == MASKS and not config.prompts
    if not given:
        settings_of(kind, config)
    _check_packages(path, *((kind, bool(config.prompts)) if local else (MASKS, False)))
    if local and not given:
        load(kind, config, job.device, job.threads, lambda text: job.emit(Warned(text)))


def _check_packages(path: Path, kind: str, prompts: bool) -> None:
    """BackendUnavailable with all extras that photos or a video miss, so that one command installs them."""
    needed = [("poses from photos", "pycolmap", "poses")]
    if detect(path) == "video":
        needed.append(("frames of a video", "av", "video"))
    kinds = [kind, "text"] if prompts else [kind]
    needed += dict.fromkeys(("label images", *_NETWORK_PACKAGES[k]) for k in kinds if k in _NETWORK_PACKAGES)
    missing = [one for one in needed if importlib.util.find_spec(one[1]) is None]
    if missing:
        what = " and ".join(f"{purpose} need {package}" for purpose, package, _ in missing)
        extras = ",".join(extra for _, _, extra in missing)
        raise BackendUnavailable(f"{path}: {what}; {install(f'sagesplat[{extras}]')}")


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
