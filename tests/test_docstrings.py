"""Examples in docstrings run as written, and what everybody calls says what it takes and returns."""

import doctest
import importlib
import inspect
from pathlib import Path
from typing import Any

import pytest

import sagesplat

# modules whose examples run here; those that need a capture or a run are marked +SKIP
MODULES = (
    "adapt.allocate", "adapt.eq1", "adapt.fill", "adapt.observe", "adapt.photo_models",
    "adapt.viewpoint",
    "formats.levels", "formats.ply", "formats.splats", "formats.spz", "formats.stream",
    "metrics.color_correct", "metrics.image", "raster", "scene", "segment.masks", "segment.relabel",
    "segment.select", "stages.api", "stages.label_edits", "train.trainer",
)  # fmt: skip
CALLED_BY_MANY = (
    "adapt.allocate:best_within", "adapt.allocate:cheapest", "adapt.scene_plans:plan_for_scene",
    "adapt.bound_plans:plan_for_view", "adapt.bound_plans:plan_within", "adapt.bound_plans:quality_at",
    "adapt.eq3:fit_models", "adapt.evaluate:evaluate", "adapt.fill:fill", "adapt.observe:observe",
    "adapt.eq1:plan_scene", "adapt.eq1:plan_view", "adapt.photo_models:fit_photo_models",
    "adapt.viewpoint:ViewModel.predict",
    "demo.capture:cached_capture", "demo.capture:make_capture", "formats.levels:read_level",
    "formats.ply:read_ply", "formats.ply:write_ply", "formats.spz:decode_spz", "formats.spz:encode_spz",
    "metrics.image:photometric_loss", "metrics.image:ssim_map", "raster:rasterize", "run.stage:run_stage",
    "scene:load_scene", "segment.lift:lift", "segment.mask_files:import_masks",
    "segment.segmenters:segment_views", "stages.api:FinishedRun.bundle", "stages.api:FinishedRun.compose",
    "stages.api:FinishedRun.plan_camera", "stages.api:open_run", "stages.api:run_scene",
    "stages.pipeline:run_all", "train.fuse:fuse", "train.nested:nest", "train.trainer:train",
)  # fmt: skip


def named(name: str) -> Any:
    module, _, path = name.partition(":")
    found: Any = importlib.import_module(f"sagesplat.{module}")
    for part in path.split("."):
        found = getattr(found, part)
    return found


@pytest.mark.parametrize("name", MODULES)
def test_examples_run_as_written(name):
    module = importlib.import_module(f"sagesplat.{name}")
    found = [test for test in doctest.DocTestFinder().find(module) if test.examples]
    assert found
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    for test in found:
        report: list[str] = []
        runner.run(test, out=report.append)
        assert not report, "".join(report)


def test_no_example_is_left_out():
    package = Path(sagesplat.__file__).parent
    found = {path for path in package.rglob("*.py") if ">>> " in path.read_text()}
    names = {".".join(path.relative_to(package).with_suffix("").parts) for path in found}
    assert {name.removesuffix(".__init__") for name in names} == set(MODULES)


@pytest.mark.parametrize("name", CALLED_BY_MANY)
def test_every_argument_is_described(name):
    function = named(name)
    text = inspect.getdoc(function) or ""
    arguments = [each for each in inspect.signature(function).parameters if each != "self"]
    assert [each for each in arguments if f"\n    {each}: " not in text] == []
    sections = [line for line in text.splitlines() if line in ("Args:", "Returns:", "Yields:", "Raises:")]
    assert sections[0] == "Args:"
    assert len(sections) == len(set(sections))
