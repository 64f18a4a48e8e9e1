"""The settings that a run folder knows: defaults of the next command on it."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar, get_args

from sagesplat.core import config
from sagesplat.core.limits import NotNegative, Seed
from sagesplat.io.typed import convert_as, known_json
from sagesplat.run.records import FORMAT
from sagesplat.run.run_dir import RunDir

Config = TypeVar("Config")


def recorded_ladder(path: Path) -> config.LadderKind:
    """The kind of levels that a run has results of: nested ones, unless there are only others."""
    kinds: tuple[config.LadderKind, ...] = get_args(config.LadderKind)
    made = {kind for kind in kinds if (RunDir(path, kind).adapted / "provenance").is_dir()}
    return "snapshots" if made == {"snapshots"} else "nested"


def recorded_settings(run: RunDir, of: str = "run") -> dict[str, Any]:
    """What a run's records hold, by the name of the setting in `RunConfig` (with `scene_config` for `scene`).

    A stage that was never done is left out, and so is what cannot be read: the stage itself says what is
    wrong with it. A training that was begun and killed counts. `of`: the command that asks; the seed is that
    of its stage.
    """
    train = _made(run, "train") or _begun(run)
    nest = _made(run, "nest")
    observed = {**_made(run, "observe"), **_made(run, "fit")}
    adopted = _made(run, "adopt")
    scene, label_images = known_json(run.scene, _Made), known_json(run.segmentation, dict) or {}
    if adopted.get("labelled"):
        label_images = {}  # made by adopt
    seeded = _config(_Seeded, nest if of == "nest" and nest else train)
    known: dict[str, Any] = {
        "adopt": _config(config.AdoptConfig, {**adopted, **_levels_of_adopted(nest)}) if adopted else None,
        "scene_config": _config(config.SceneConfig, scene.settings) if scene else None,
        "poses": _config(config.PosesConfig, _made(run, "poses")),
        "masks": _config(config.MasksConfig, label_images),
        "labels": _config(config.LabelsConfig, _labels(run)),
        "train": _config(config.TrainConfig, train),
        "clean": _config(config.CleanConfig, _made(run, "clean")),
        "blocks": _config(config.BlocksConfig, _made(run, "blocks")),
        "nest": _config(config.NestConfig, nest),
        "sample": _config(config.SampleConfig, _made(run, "sample")),
        "fit": _config(config.FitConfig, observed),
        "plan": _config(config.PlanConfig, _made(run, "plan")),
        "seed": seeded.seed if seeded else None,
        "fuse": True if run.provenance("fuse").exists() else None,
    }
    return {name: value for name, value in known.items() if value is not None}


def _labels(run: RunDir) -> dict[str, Any]:
    """The settings of the categories: those of the label images, then those of the instances."""
    made, later = _made(run, "masks"), _made(run, "instances")
    if not later:
        return made
    merge = ",".join(str(text) for text in (made.get("merge"), later.get("merge")) if text)
    return {**made, "merge": merge, "instances": later.get("instances")}


def _levels_of_adopted(nest: dict[str, Any]) -> dict[str, Any]:
    """The settings of an adopted splat's levels; without training there are no steps to remember."""
    names = ("fit", "shares", "lossless", *(("steps",) if nest.get("fit") == "renders" else ()))
    return {name: nest[name] for name in names if name in nest}


def stage_seconds(run: RunDir) -> dict[str, float]:
    """How long each finished stage of a run took, by its name."""
    folders = dict.fromkeys([run.path / "provenance", run.adapted / "provenance"])
    paths = (path for folder in folders for path in sorted(folder.glob("*.json")))
    return {path.stem: made.seconds for path in paths if (made := known_json(path, _Timed))}


@dataclass(frozen=True)
class _Timed:
    seconds: NotNegative


@dataclass(frozen=True)
class _Made:
    """Of a file with settings those."""

    settings: dict[str, Any]
    format: int = FORMAT


def _made(run: RunDir, stage: str) -> dict[str, Any]:
    """The settings of a finished stage, empty where it is not done or of another format."""
    made = known_json(run.provenance(stage), _Made)
    return made.settings if made and made.format == FORMAT else {}


def _begun(run: RunDir) -> dict[str, Any]:
    """The settings of a training that did not end: of the run, or of its first block."""
    for folder in (run.replacement, run, run.block(0)):
        if made := known_json(folder.cap, _Made):
            return made.settings
    return {}


@dataclass(frozen=True)
class _Seeded:
    seed: Seed


def _config(kind: type[Config], settings: dict[str, Any]) -> Config | None:
    """Settings of a kind from a JSON object; None where it holds none of them, or one of a wrong type."""
    if not settings.keys() & {field.name for field in fields(kind)}:  # type: ignore
        return None
    try:
        return convert_as(settings, kind)
    except ValueError:
        return None
