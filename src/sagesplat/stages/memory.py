"""Whether nesting and segmentation fit into the memory limit: told before they begin."""

from pathlib import Path
from typing import Any

from sagesplat.core.errors import RunError
from sagesplat.core.events import Noted, Warned
from sagesplat.run.job import Job
from sagesplat.segment.hf import DEFAULT_MODEL
from sagesplat.segment.text import DEFAULT_DETECTOR, DEFAULT_MASK_MODEL
from sagesplat.train import memory
from sagesplat.train.memory import GIB

# Of a CPU, measured (docs/performance.md). Limits are compared with what is needed at least: a run that
# would do is not refused.
_NEST = 250e6  # bytes of nesting besides those of training as many Gaussians
_RUNTIME = 330e6  # the interpreter with torch and onnxruntime
_PIXEL = 22  # bytes of a photo's pixel: the label image and what it is chosen from
_DEFAULT_WEIGHTS = {  # bytes of the default networks', which may not be on this machine yet
    DEFAULT_MODEL: 96e6,
    DEFAULT_DETECTOR: 689e6,
    DEFAULT_MASK_MODEL: 156e6,
}
_ADOPT = 1.4e9, 1050.0  # bytes of adopting a splat: whatever its size, and of each Gaussian
# CPU seconds, the same, half more than on a fast machine; with --fit renders each training step takes more
_ADOPT_TIME = 130.0, 330e-6
_STEP_TIME = 0.25
_ONNX = 50e6  # bytes that a small network computes with
_TEXT = 0.6e9  # bytes that SAM 2 computes with; Grounding DINO takes more
_HF = 12, 1.1e9  # the same of transformers' networks: times the weights, at most


def foretell_adopt(job: Job, count: int, steps: int) -> None:
    """Say how long adopting `count` Gaussians takes, about, with `steps` of training, and how much memory."""
    needed = _ADOPT[0] + _ADOPT[1] * count
    seconds = (_ADOPT_TIME[0] + _ADOPT_TIME[1] * count + _STEP_TIME * steps) / max(job.threads, 1)
    needs = f"{count:,} Gaussians take about {max(round(seconds / 60), 1)} min and {needed / GIB:.1f} GiB"
    limit = job.memory_limit or memory.default_limit()
    if job.backend != "cuda" and needed > limit:
        job.emit(Warned(f"{job.run.path}: {needs}; the limit is {limit / GIB:.1f} GiB"))
    elif job.backend != "cuda":
        job.emit(Noted(needs))


def check_nest(job: Job, count: int, sh_degree: int) -> None:
    """RunError where nesting `count` Gaussians needs more memory than the limit; a warning if it may."""
    if job.backend == "cuda":
        return
    limit = job.memory_limit or memory.default_limit()
    fixed, each = memory.fixed_and_each(job.scene, sh_degree, limit)
    least = fixed + each * count
    if least > limit:
        fits = max(int((limit - fixed) / each) // 1000 * 1000, 1000)
        raise RunError(
            f"{job.run.path}: nesting {count:,} Gaussians needs about {least / GIB:.1f} GiB, the limit is "
            f"{limit / GIB:.1f}; raise --memory-limit of `sagesplat run`, or train fewer: "
            f"--train.max-gaussians {fits} --force"
        )
    if least + _NEST > limit:
        needs = f"nesting needs about {(least + _NEST) / GIB:.1f} GiB, the limit is {limit / GIB:.1f}"
        job.emit(Warned(f"{job.run.path}: {needs}"))


def check_network(job: Job, kind: str, settings: dict[str, Any]) -> None:
    """RunError where a network (of `SEGMENTERS`, with its settings) needs more memory than the limit."""
    model = settings.get("model")
    if job.backend == "cuda" or model is None:  # segmenters of others may have no such file
        return
    limit = job.memory_limit or memory.default_limit()
    largest = max(view.camera.width * view.camera.height for view in job.scene.views)
    needed = network_memory(kind, weights(model), largest)
    if kind == "text":
        needed += _masks_weights(model, settings["mask_model"])
    elif "over_model" in settings:  # both are in memory, and compute one after the other
        needed += weights(settings["over_model"])
        needed += _masks_weights(settings["over_model"], settings["over_mask_model"])
    if needed > limit:
        raise RunError(
            f"{model}: segmenting photos of {largest / 1e6:.1f} megapixels needs at least about "
            f"{needed / GIB:.1f} GiB, the limit is {limit / GIB:.1f}; raise --memory-limit of `sagesplat "
            "run`, take a smaller network, or begin a run with --downscale 2"
        )


def network_memory(kind: str, weights: float, pixels: int) -> float:
    """Bytes that a network needs at least, by those of its weights and the pixels of a photo."""
    computes = {"onnx": _ONNX, "hf": min(_HF[0] * weights, _HF[1]), "text": _TEXT}.get(kind, 0.0)
    # files are read into memory, and become parameters before they are released
    return _RUNTIME + max(2 * weights, weights + computes) + pixels * (_PIXEL + 3)


def _masks_weights(detector: Path | str, masks: Path | str) -> float:
    """Bytes of the network that makes masks of boxes; the usual one is not loaded beside all detectors."""
    certain = masks != DEFAULT_MASK_MODEL or detector == DEFAULT_DETECTOR
    return weights(masks) if certain else 0.0


def weights(model: Path | str) -> float:
    """Bytes of a network's weights; 0 where they are not here and not known."""
    path = Path(model)
    if path.is_dir():
        return float(sum(file.stat().st_size for file in path.glob("model*.safetensors")))
    if path.is_file():
        return float(path.stat().st_size)
    return _DEFAULT_WEIGHTS.get(str(model), 0.0)
