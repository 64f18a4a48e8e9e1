"""The settings that a run folder knows: defaults of the next command on it."""

import json
from collections import ChainMap
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar, get_args

from sagesplat.core import config
from sagesplat.core.limits import NotNegative, Seed
from sagesplat.io.files import write_text
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

    A stage that was never done has what a run that did not end was given for it, or is left out; and so is
    what cannot be read: the stage itself says what is wrong with it. `of`: the command that asks; the seed is
    that of its stage.
    """
    begun = known_json(run.begun, dict[str, dict[str, Any]]) or {}

    def given(name: str, *stages: str) -> dict[str, Any]:
        made = [_made(run, stage) for stage in stages or (name,)]
        return dict(ChainMap(*reversed(made), begun.get(name, {})))

    train = _made(run, "train") or _begun(run) or begun.get("train", {})
    nest, adopted = given("nest"), _made(run, "adopt")
    levels = _levels_of_adopted(_made(run, "nest") or begun.get("adopt", {}))
    scene, label_images = known_json(run.scene, _Made), known_json(run.segmentation, dict) or {}
    if adopted.get("labels_of_file"):
        label_images = {}  # made by adopt
    seeded = _config(_Seeded, nest if of == "nest" and nest else train)
    known: dict[str, Any] = {
        "adopt": _config(config.AdoptConfig, {**adopted, **levels}) if adopted else None,
        "scene_config": _config(config.SceneConfig, scene.settings) if scene else None,
        "poses": _config(config.PosesConfig, _made(run, "poses")),
        "masks": _config(config.MasksConfig, label_images),
        "labels": _config(config.LabelsConfig, _labels(run)),
        "train": _config(config.TrainConfig, train),
        "clean": _config(config.CleanConfig, given("clean")),
        "blocks": _config(config.BlocksConfig, _made(run, "blocks")),
        "nest": _config(config.NestConfig, nest),
        "sample": _config(config.SampleConfig, given("sample")),
        "fit": _config(config.FitConfig, given("fit", "observe", "fit")),
        "plan": _config(config.PlanConfig, given("plan")),
        "seed": seeded.seed if seeded else None,
        "fuse": True if run.provenance("fuse").exists() else None,
    }
    return {name: value for name, value in known.items() if value is not None}


def write_begun(run: RunDir, asked: config.RunConfig, adopt: config.AdoptConfig | None = None) -> None:
    """Write down the settings of a run that begins, for the stages that it may not reach."""
    names = ("train", "clean", "nest", "sample", "fit", "plan")
    settings = {name: asdict(getattr(asked, name)) | {"seed": asked.seed} for name in names}
    settings |= {"adopt": asdict(adopt)} if adopt else {}
    write_text(run.begun, json.dumps(settings, default=str))


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
