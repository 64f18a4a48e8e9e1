"""The settings that a run folder knows: defaults of the next command on it."""

from pathlib import Path
from typing import Any, TypeVar, get_args

from sagesplat.core.config import (
    AdoptConfig,
    BlocksConfig,
    CleanConfig,
    FitConfig,
    LabelsConfig,
    LadderKind,
    LiftConfig,
    MasksConfig,
    NestConfig,
    PlanConfig,
    PosesConfig,
    SampleConfig,
    SceneConfig,
    TrainConfig,
)
from sagesplat.core.typed import check_fields, fits, types_of
from sagesplat.io.files import read_object
from sagesplat.run.records import FORMAT
from sagesplat.run.run_dir import RunDir

Config = TypeVar("Config")


def recorded_ladder(path: Path) -> LadderKind:
    """The kind of levels that a run has results of: nested ones, unless there are only others."""
    kinds: tuple[LadderKind, ...] = get_args(LadderKind)
    made = [kind for kind in kinds if (RunDir(path, kind).adapted / "provenance").is_dir()]
    return made[0] if len(made) == 1 else "nested"


def recorded_settings(run: RunDir, of: str = "run") -> dict[str, Any]:
    """What a run's records hold, by the name of the setting in `RunConfig` (with `scene_config` for `scene`).

    A stage that was never done is left out, and so is what cannot be read: the stage itself says what is
    wrong with it. A training that was begun and killed counts. `of`: the command that asks; the seed is that
    of its stage.
    """
    train = _made(run, "train") or _begun(run)
    nest = _made(run, "nest")
    observed = {**_made(run, "observe"), **_made(run, "fit")}
    tuned = nest.get("boundary_steps")
    boundary = {} if tuned is None else {"boundary_steps": tuned}
    adopted = _made(run, "adopt")
    label_images = {} if adopted.get("labelled") else read_object(run.segmentation)  # else made by adopt
    known: dict[str, Any] = {
        "adopt": _config(AdoptConfig, {**adopted, **_levels_of_adopted(nest)}) if adopted else None,
        "scene_config": _config(SceneConfig, read_object(run.scene).get("settings")),
        "poses": _config(PosesConfig, _made(run, "poses")),
        "masks": _config(MasksConfig, label_images),
        "labels": _config(LabelsConfig, _labels(run)),
        "lift": _config(LiftConfig, _made(run, "lift")),
        "train": _config(TrainConfig, train),
        "clean": _config(CleanConfig, _made(run, "clean")),
        "blocks": _config(BlocksConfig, {**_made(run, "blocks"), **boundary}),
        "nest": _config(NestConfig, nest),
        "sample": _config(SampleConfig, _made(run, "sample")),
        "fit": _config(FitConfig, observed),
        "plan": _config(PlanConfig, _made(run, "plan")),
        "seed": _seed((nest if of == "nest" and nest else train).get("seed")),
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
    found = {}
    for folder in folders:
        for path in sorted(folder.glob("*.json")):
            seconds: Any = read_object(path).get("seconds")
            if fits(seconds, float):
                found[path.stem] = float(seconds)
    return found


def _made(run: RunDir, stage: str) -> dict[str, Any]:
    """The settings of a finished stage, empty where it is not done or of another format."""
    made = read_object(run.provenance(stage))
    settings = made.get("settings")
    return settings if made.get("format") == FORMAT and isinstance(settings, dict) else {}


def _begun(run: RunDir) -> dict[str, Any]:
    """The settings of a training that did not end: of the run, or of its first block."""
    for folder in (run.replacement, run, run.block(0)):
        settings = read_object(folder.cap).get("settings")
        if isinstance(settings, dict):
            return settings
    return {}


def _seed(value: Any) -> int | None:
    return value if fits(value, int) else None


def _config(kind: type[Config], settings: Any) -> Config | None:
    """Settings of a kind from a JSON object; None where it holds none of them, or one of a wrong type."""
    types = types_of(kind)
    try:
        values = {name: settings[name] for name in types if name in settings}
        check_fields(values, types)
    except (TypeError, ValueError):
        return None
    made = {name: _plain(value, types[name]) for name, value in values.items()}
    return kind(**made) if made else None


def _plain(value: Any, kind: Any) -> Any:
    """A value of a JSON file as settings have it: JSON has neither tuples nor paths."""
    if isinstance(value, list):
        return tuple(value)
    return Path(value) if isinstance(value, str) and Path in get_args(kind) else value
