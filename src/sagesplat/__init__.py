"""sagesplat: semantic-driven adaptive Gaussian splatting.

Everything that a script needs is here, and is loaded when it is first used: `import sagesplat` itself loads
neither torch nor numba. The examples in `examples/` import from here alone.

    run_scene, open_run, FinishedRun           the whole pipeline; a finished run
    adopt_splat, measure_levels, Measured      a splat that is trained already; levels against their scene
    apply_labels                               categories of a finished run, edited in the viewer
    RunConfig, SceneConfig, TrainConfig, NestConfig, PlanConfig    settings
    AdoptConfig, MeasureConfig                 settings of adopt_splat and measure_levels
    Event, StageDone, StageSkipped, Warned     what these functions tell their callers; see `Event` for all
    load_scene, Scene, View, Camera            captures
    make_demo_capture                          the built-in capture, of any size
    Gaussians, read_ply, write_ply, read_spz, write_spz    splat files
    rasterize, Render, set_threads             rendering, with gradients
    ssim_map                                   SSIM at every pixel, as everything here measures it
    train_gaussians                            the training loop, as a generator of events
    Plan, ViewModel, read_plans, read_promises    plans and the SSIM models behind them
    Taxonomy, HfSegmenter, OnnxSegmenter, label_image      label images
    select, select_mask                        Gaussians by the names of categories and instances
    read_splat, write_splat, Splat             splat files of any tool, with their names
    SageError                                  what a user can cause

No name here is that of a subpackage. `sagesplat.run` and `sagesplat.train` are folders of modules: a function
of that name would be hidden as soon as somebody imports the folder. So the functions are called `run_scene`
and `train_gaussians`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from sagesplat.adapt.plan import Plan
    from sagesplat.adapt.plan_files import read_plans
    from sagesplat.adapt.viewpoint import ViewModel, read_promises
    from sagesplat.core.config import (
        AdoptConfig,
        MeasureConfig,
        NestConfig,
        PlanConfig,
        RunConfig,
        SceneConfig,
        TrainConfig,
    )
    from sagesplat.core.errors import SageError
    from sagesplat.core.events import Event, StageDone, StageSkipped, Warned
    from sagesplat.core.gaussians import Gaussians
    from sagesplat.demo.capture import make_capture as make_demo_capture
    from sagesplat.formats.ply import read_ply, write_ply
    from sagesplat.formats.splat import Splat
    from sagesplat.formats.splats import read_splat, write_splat
    from sagesplat.formats.spz import read_spz, write_spz
    from sagesplat.metrics.image import ssim_map
    from sagesplat.output.figures import label_image
    from sagesplat.raster import Render, rasterize, set_threads
    from sagesplat.scene import load_scene
    from sagesplat.scene.scene import Camera, Scene, View
    from sagesplat.segment.hf import HfSegmenter
    from sagesplat.segment.masks import Taxonomy
    from sagesplat.segment.onnx import OnnxSegmenter
    from sagesplat.segment.select import select, select_mask
    from sagesplat.stages.api import FinishedRun, adopt_splat, apply_labels, open_run, run_scene
    from sagesplat.studies.measure.report import Measured
    from sagesplat.studies.measure.run import measure_levels
    from sagesplat.train.trainer import train as train_gaussians

__all__ = [
    "AdoptConfig", "Camera", "Event", "FinishedRun", "Gaussians", "HfSegmenter", "MeasureConfig",
    "Measured", "NestConfig", "OnnxSegmenter", "Plan", "PlanConfig", "Render", "RunConfig", "SageError",
    "Scene", "SceneConfig", "Splat", "StageDone", "StageSkipped", "Taxonomy", "TrainConfig", "View",
    "ViewModel", "Warned", "adopt_splat", "apply_labels", "label_image", "load_scene",
    "make_demo_capture", "measure_levels", "open_run", "rasterize", "read_plans", "read_ply",
    "read_promises", "read_splat", "read_spz", "run_scene", "select", "select_mask", "set_threads",
    "ssim_map", "train_gaussians", "write_ply", "write_splat", "write_spz",
]  # fmt: skip

# by module, below sagesplat
_EXPORTS = {
    "adapt.plan": "Plan",
    "adapt.plan_files": "read_plans",
    "adapt.viewpoint": "ViewModel read_promises",
    "core.config": "AdoptConfig MeasureConfig NestConfig PlanConfig RunConfig SceneConfig TrainConfig",
    "core.errors": "SageError",
    "core.events": "Event StageDone StageSkipped Warned",
    "core.gaussians": "Gaussians",
    "demo.capture": "make_demo_capture",
    "formats.ply": "read_ply write_ply",
    "formats.splat": "Splat",
    "formats.splats": "read_splat write_splat",
    "formats.spz": "read_spz write_spz",
    "metrics.image": "ssim_map",
    "output.figures": "label_image",
    "raster": "Render rasterize set_threads",
    "scene": "load_scene",
    "scene.scene": "Camera Scene View",
    "segment.hf": "HfSegmenter",
    "segment.masks": "Taxonomy",
    "segment.onnx": "OnnxSegmenter",
    "segment.select": "select select_mask",
    "stages.api": "FinishedRun adopt_splat apply_labels open_run run_scene",
    "studies.measure.report": "Measured",
    "studies.measure.run": "measure_levels",
    "train.trainer": "train_gaussians",
}
_MODULE_OF = {name: module for module, names in _EXPORTS.items() for name in names.split()}
_NAME_THERE = {"make_demo_capture": "make_capture", "train_gaussians": "train"}


def __getattr__(name: str) -> Any:
    """An exported name, loaded on its first use."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'sagesplat' has no attribute {name!r}")
    value = getattr(import_module(f"sagesplat.{_MODULE_OF[name]}"), _NAME_THERE.get(name, name))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
