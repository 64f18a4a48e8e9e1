"""The file of a sweep: scenes, variants of the settings, seeds and targets."""

import re
import tomllib
from collections import Counter
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from sagesplat.core.config import RunConfig
from sagesplat.core.errors import DataError, short

MAX_LENGTH = 2**20  # characters of a file
MAX_DOTS = 64  # in one line of it
MAX_RUNS = 10_000
BUILT_IN = "demo"  # as a scene's path: the built-in capture
_SET_BY = {
    "seed": "seeds",
    "target_ssim": "targets",
    "target_fidelity": "targets",
    "other_targets": "targets",
}
_NEEDED = {
    bool: "true or false", int: "a whole number", float: "a finite number", str: "text in quotes",
    Path: "a path in quotes", tuple: "a list", dict: "a table",
}  # fmt: skip
Config = TypeVar("Config")  # a frozen dataclass of settings


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

    targets: tuple[float, ...] = ()
    seeds: tuple[int, ...] = ()
    settings: RunConfig = field(default_factory=RunConfig)
    scenes: dict[str, str] = field(default_factory=dict)
    variants: dict[str, dict[str, Any]] = field(default_factory=dict)


def read_sweep(path: Path) -> Sweep:
    """The cells that a sweep file asks for, by scene, variant and seed. DataError where it is not one."""
    try:
        text = path.read_text(encoding="utf-8")
        _need(len(text) <= MAX_LENGTH, f"{path}: {len(text)} characters, more than a sweep has; split it")
        # The parser keeps every prefix of a key of many parts.
        dots = max(line.count(".") for line in text.split("\n"))
        _need(dots <= MAX_DOTS, f"{path}: a line with {dots} dots; write lists and tables on several lines")
        document = tomllib.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(
            f"{path}: not readable as TOML ({short(error)}); examples/sweep.toml shows one"
        ) from None
    folder = path.parent
    file = _set(_File(), document, f"{path}: ", folder)
    targets = sorted(round(target, 6) for target in file.targets)
    for key, values in (("scenes", list(file.scenes)), ("targets", targets), ("seeds", file.seeds)):
        _need(values, f"{path}: {key}: missing or empty; give at least one")
        _need(len(set(values)) == len(values), f"{path}: {key}: two are equal; leave one out")
    _need(targets[0] > 0 and targets[-1] <= 1, f"{path}: targets: an SSIM is above 0 and at most 1")
    _need(min(file.seeds) >= 0, f"{path}: seeds: {min(file.seeds)} is negative; take 0 or more")
    for name in (*file.scenes, *file.variants):
        fine = re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,99}", name)
        _need(fine, f"{path}: the name {short(repr(name))} makes no folder; use letters, digits, _ . + and -")
    count = len(file.scenes) * max(1, len(file.variants)) * len(file.seeds)
    _need(count <= MAX_RUNS, f"{path}: {count} runs, at most {MAX_RUNS} are possible; split the sweep")
    main = targets.pop(len(targets) // 2)
    cells = []
    for scene, to in file.scenes.items():
        capture = None if to == BUILT_IN else folder / to
        _need(
            not capture or _is_folder(capture),
            f"{path}: scenes.{scene}: no folder {short(capture)}; mend the path",
        )
        for variant, changes in (file.variants or {"": {}}).items():
            config = _set(file.settings, changes, f"{path}: variants.{variant}.", folder)
            plan = replace(config.plan, target_ssim=main, other_targets=tuple(targets))
            cells += [Cell(scene, variant, capture, replace(config, plan=plan, seed=s)) for s in file.seeds]
    names = [cell.name.lower() for cell in cells]  # some disks know no capitals
    for name, times in Counter(names).items():
        _need(times == 1, f"{path}: two runs would be called {name}; rename a scene or a variant")
    return tuple(cells)


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:  # a name that no disk has, e.g. too long
        return False


def _need(fine: object, message: str) -> None:
    if not fine:
        raise DataError(message)


def _set(config: Config, table: Any, where: str, folder: Path) -> Config:
    """Settings with those of a TOML table in place; `where` is the path and key for errors."""
    _need(isinstance(table, dict), f"{where.rstrip('.')}: {short(repr(table))} given, a table is needed")
    hints = get_type_hints(type(config))
    values = {}
    for name, value in table.items():
        key = f"{where}{name}"
        _need(name not in _SET_BY, f"{key}: set by the list `{_SET_BY.get(name)}`; leave it out here")
        _need(name in hints, f"{where}{short(repr(name))}: no such key; there are {', '.join(hints)}")
        inner = getattr(config, name)
        if is_dataclass(inner):
            values[name] = _set(inner, value, f"{key}.", folder)
        else:
            values[name] = _value(hints[name], value, key, folder)
    return replace(config, **values)  # pyright: ignore[reportArgumentType]


def _value(hint: Any, value: Any, key: str, folder: Path) -> Any:
    """A value of a TOML file as the type that a setting has; paths are relative to `folder`."""
    kind, of = get_origin(hint) or hint, get_args(hint)
    if kind is UnionType:  # X | None, and TOML has no null
        return _value(of[0], value, key, folder)
    if kind is Any or (kind is Literal and value in of):
        return value
    if kind is tuple and isinstance(value, list):
        return tuple(_value(of[0], v, f"{key}[{i}]", folder) for i, v in enumerate(value))
    if kind is dict and isinstance(value, dict):
        return {name: _value(of[1], v, f"{key}.{name}", folder) for name, v in value.items()}
    if kind is Path and isinstance(value, str):
        return folder / value
    if kind is float and type(value) in (int, float) and abs(value) < 1e300:  # neither NaN nor infinite
        return float(value)
    if kind in (bool, int, str) and type(value) is kind:
        return value
    needed = " or ".join(map(repr, of)) if kind is Literal else _NEEDED[kind]
    raise DataError(f"{key}: {short(repr(value))} given, {needed} is needed")
