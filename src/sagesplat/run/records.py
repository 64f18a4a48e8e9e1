"""Records of what each result of a run folder was made from."""

import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sagesplat import __version__
from sagesplat.core.errors import RunError, short
from sagesplat.core.limits import NotNegative, Number, Seed
from sagesplat.io.files import read_json, write_json
from sagesplat.io.typed import convert_as, refused
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage_table import STAGES, command_of

FORMAT = 3  # of the run folder; raised when older folders can no longer be read


@dataclass(frozen=True)
class _More:
    """Settings of stages beside those of their kind."""

    seed: Seed = 0
    targets: list[Number] = field(default_factory=list)


@dataclass(frozen=True)
class _Record:
    """What every record holds."""

    settings: dict[str, Any]
    inputs: dict[str, str]
    seconds: NotNegative = 0.0


class Settings(dict[str, Any]):
    """The settings in a record; RunError for one that is not there."""

    def __init__(self, values: Mapping[str, Any], path: Path) -> None:
        super().__init__(values)
        self._path = path

    def __missing__(self, name: str) -> Any:
        raise RunError(f"{self._path}: no setting {name} in it; run that stage again with --force")


def file_hash(path: Path) -> str:
    """SHA-256 of a file, or of all files of a folder with their names."""
    digest = hashlib.sha256()
    for file in sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]:
        if path.is_dir():
            digest.update(os.fsencode(file.relative_to(path)))
        with file.open("rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


def input_hashes(run: RunDir, inputs: Sequence[Path]) -> dict[str, str]:
    """SHA-256 of each input, by its path relative to the run folder: a run may be moved as a whole.

    Of a stage's record all but its seconds counts: they differ each time that a stage is done.
    """
    return {Path(os.path.relpath(path, run.path)).as_posix(): _input_hash(path) for path in inputs}


def _input_hash(path: Path) -> str:
    if path.parent.name != "provenance":
        return file_hash(path)
    kept = {key: value for key, value in read_record(path).items() if key != "seconds"}
    return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()


def checkpoint_key(run: RunDir, settings: Mapping[str, Any], inputs: Sequence[Path]) -> str:
    """What a stage's checkpoint is kept with: training resumes only with these settings and inputs."""
    return json.dumps({"settings": dict(settings), "inputs": input_hashes(run, inputs)})


class _NoRecord(RunError):
    """A file that is not the record of a stage."""


def read_record(path: Path) -> dict[str, Any]:
    """The record that `record` wrote; its "settings" are `Settings`.

    RunError for anything else, for settings of a wrong type, and for a run folder of another format.
    """
    cure = "run that stage again with --force"
    made = read_json(path, cure, _NoRecord)
    if isinstance(made, dict):
        check_format(path, made)
    with refused(path, "the record of a stage", cure, _NoRecord):
        settings = convert_as(made, _Record).settings
        convert_as(settings, _More)
        if path.stem in STAGES and (kind := STAGES[path.stem].settings):
            convert_as(settings, kind)
    return made | {"settings": Settings(settings, path)}


def check_format(path: Path, made: Mapping[str, Any]) -> None:
    """RunError unless a record, which was read from `path`, is of the format that is read here."""
    if made.get("format") != FORMAT:
        raise RunError(
            f"{path}: from a run folder of format {short(made.get('format'))}, this sagesplat "
            f"({__version__}) reads {FORMAT}; run again into a new folder"
        )


def is_done(
    run: RunDir,
    stage: str,
    settings: Mapping[str, Any],
    inputs: Sequence[Path] | None,
    outputs: Sequence[Path],
    force: bool,
) -> bool:
    """Whether a stage's result is there, made with exactly these settings from exactly these inputs.

    Without `inputs` only the settings are compared: for a look ahead, before the inputs are made. A result
    made otherwise is never overwritten without `force`: RunError says what differs.
    """
    if not run.provenance(stage).exists():
        return False
    try:
        made = read_record(run.provenance(stage))
    except _NoRecord:
        if force:
            return False
        raise
    if not all(p.exists() for p in outputs):
        return False
    differs = _differences(made, settings, made["inputs"] if inputs is None else input_hashes(run, inputs))
    if not differs:
        return True
    if not force:
        raise RunError(
            f"{outputs[0]}: made with other {differs}; choose another run folder, or add --force to redo it"
        )
    return False


def settings_of(run: RunDir, stage: str) -> Settings:
    """The settings that a finished stage was made with; RunError where it is not done, or they are no use."""
    return _record_of(run, stage)["settings"]


def seconds_of(run: RunDir, stage: str) -> float:
    """How long a finished stage took; NaN where its record does not say."""
    return float(_record_of(run, stage).get("seconds", math.nan))


def is_made_from(run: RunDir, stage: str, path: Path) -> bool:
    """Whether a finished stage's result was made from a file as it is now."""
    name, digest = next(iter(input_hashes(run, [path]).items()))
    return _record_of(run, stage)["inputs"].get(name) == digest


def uses(run: RunDir, stage: str, path: Path) -> bool:
    """Whether a finished stage's result was made from a file, whatever is in it now."""
    return Path(os.path.relpath(path, run.path)).as_posix() in _record_of(run, stage)["inputs"]


def _record_of(run: RunDir, stage: str) -> dict[str, Any]:
    if not run.provenance(stage).exists():
        raise RunError(f"{run.path}: stage {stage} is not done; run `{command_of(stage)}` or `sagesplat run`")
    return read_record(run.provenance(stage))


def _typed(settings: Mapping[str, Any], name: str) -> str:
    """A setting as one would type it."""
    value = settings.get(name, "not set")
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else short(value)


def _differences(made: Mapping[str, Any], settings: Mapping[str, Any], inputs: Mapping[str, str]) -> str:
    """A few words on what changed since a result was made; empty = nothing."""
    old, new = made["settings"], settings
    changed = [
        f"{short(k).replace('_', '-')} ({_typed(old, k)} then, {_typed(new, k)} now)"
        for k in [*new, *(k for k in old if k not in new)]
        if k not in old or k not in new or old[k] != new[k]
    ]
    old, new = made["inputs"], inputs
    changed += [
        f"{short(name)} (its content changed)" for name in new if name in old and old[name] != new[name]
    ]
    changed += [f"{short(name)} (not used then)" for name in new if name not in old]
    changed += [f"{short(name)} (not used any more)" for name in old if name not in new]
    return ", ".join(changed[:3])


def record(
    run: RunDir, stage: str, settings: Mapping[str, Any], inputs: Sequence[Path], seconds: float
) -> None:
    """Write down what a finished stage's result was made from."""
    write_json(
        run.provenance(stage),
        {
            "format": FORMAT,
            "stage": stage,
            "version": __version__,
            "seconds": round(seconds, 2),
            "settings": dict(settings),
            "inputs": input_hashes(run, inputs),
        },
    )
