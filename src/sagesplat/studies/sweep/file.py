"""The file of a sweep: scenes, variants of the settings, seeds and targets."""

import os
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

from msgspec import Meta

from sagesplat.core.config import RunConfig
from sagesplat.core.errors import DataError, short
from sagesplat.core.limits import Seed, SomeShare
from sagesplat.io.typed import convert_as, read_toml, refused

MAX_LENGTH = 2**20  # characters of a file
MAX_RUNS = 10_000
BUILT_IN = "demo"  # as a scene's path: the built-in capture
_SET_BY = dict.fromkeys(("target_ssim", "target_fidelity", "other_targets"), "targets") | {"seed": "seeds"}
_NAME = r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,99}"  # also of a folder


@dataclass(frozen=True)
class Cell:
    """One training of a sweep, with all targets planned on it."""

    scene: str
    variant: str  # empty where the file names none
    capture: Path | None  # None: the built-in one
    config: RunConfig  # with seed and targets

    @property
    def name(self) -> str:
        """Name of its run folder."""
        return "-".join(part for part in (self.scene, self.variant, f"seed{self.config.seed}") if part)


Sweep = tuple[Cell, ...]


@dataclass(frozen=True)
class _File:
    """What a sweep file may hold."""

    targets: Annotated[tuple[SomeShare, ...], Meta(min_length=1)]
    seeds: Annotated[tuple[Seed, ...], Meta(min_length=1)]
    scenes: Annotated[dict[str, str], Meta(min_length=1)]
    settings: dict[str, Any] = field(default_factory=dict)
    variants: dict[str, dict[str, Any]] = field(default_factory=dict)


def read_sweep(path: Path) -> Sweep:
    """The cells that a sweep file asks for, by scene, variant and seed. DataError where it is not one."""
    what, cure, folder = "a sweep", "examples/sweep.toml shows one", path.parent
    document = read_toml(path, cure, most=MAX_LENGTH)
    with refused(path, what, cure):
        file = convert_as(_known(document, _File, "", folder), _File)
        _config(file.settings, "settings.")
    targets = sorted(round(target, 6) for target in file.targets)
    for key, values in (("targets", targets), ("seeds", file.seeds)):
        _need(len(set(values)) == len(values), f"{path}: {key}: two are equal; leave one out")
    for name in (*file.scenes, *file.variants):
        fine = re.fullmatch(_NAME, name)
        _need(fine, f"{path}: the name {short(repr(name))} makes no folder; use letters, digits, _ . + and -")
    count = len(file.scenes) * max(1, len(file.variants)) * len(file.seeds)
    _need(count <= MAX_RUNS, f"{path}: {count} runs, at most {MAX_RUNS} are possible; split the sweep")
    main = targets.pop(len(targets) // 2)
    cells = []
    for scene, to in file.scenes.items():
        capture = None if to == BUILT_IN else folder / to
        _need(
            not capture or os.path.isdir(capture),  # false for a name that no disk has, e.g. too long
            f"{path}: scenes.{scene}: no folder {short(capture)}; mend the path",
        )
        for variant, changes in (file.variants or {"": {}}).items():
            with refused(path, what, cure):
                where = f"variants.{variant}."
                config = _config(_merged(file.settings, _known(changes, RunConfig, where, folder)), where)
            plan = replace(config.plan, target_ssim=main, other_targets=tuple(targets))
            cells += [Cell(scene, variant, capture, replace(config, plan=plan, seed=s)) for s in file.seeds]
    names = [cell.name.lower() for cell in cells]  # some disks know no capitals
    for name, times in Counter(names).items():
        _need(times == 1, f"{path}: two runs would be called {name}; rename a scene or a variant")
    return tuple(cells)


def _need(fine: object, message: str) -> None:
    if not fine:
        raise DataError(message)


def _known(table: Any, kind: Any, where: str, folder: Path) -> Any:
    """A table with its paths relative to `folder`; ValueError for a key that there is not."""
    if not isinstance(table, dict):
        return table
    hints, made = get_type_hints(kind), {}
    for name, value in table.items():
        if name in _SET_BY:
            raise ValueError(f"{where}{name}: set by the list {_SET_BY[name]}; leave it out")
        if name not in hints:
            raise ValueError(f"{where}{short(repr(name))}: no such key; there are {', '.join(hints)}")
        inner = RunConfig if (kind, name) == (_File, "settings") else hints[name]
        if is_dataclass(inner):
            made[name] = _known(value, inner, f"{where}{name}.", folder)
        elif Path in get_args(inner) and isinstance(value, str):
            made[name] = str(folder / value)
        else:
            made[name] = value
    return made


def _config(settings: Mapping[str, Any], where: str) -> RunConfig:
    try:
        return convert_as(settings, RunConfig)
    except ValueError as error:
        raise ValueError(f"{where}{error}") from None


def _merged(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with those of a variant in place."""
    merged = {**settings, **changes}
    for name in settings.keys() & changes.keys():
        if isinstance(settings[name], dict) and isinstance(changes[name], dict):
            merged[name] = _merged(settings[name], changes[name])
    return merged
