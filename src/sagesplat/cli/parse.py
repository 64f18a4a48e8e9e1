"""From words to a command's arguments: the run's own settings, errors in one line."""

import inspect
import io
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import fields, is_dataclass, replace
from difflib import get_close_matches
from functools import wraps
from pathlib import Path
from typing import Any

import tyro

from sagesplat.cli.help import Flag, flag_of, flags_of
from sagesplat.cli.say import say
from sagesplat.core.config import PlanConfig
from sagesplat.core.errors import SageError
from sagesplat.io.typed import impossible, refusal

_PYTHON = {  # what Python says of a text that is no number, and what it is not
    "invalid literal for int() with base 10:": "a whole number",
    "could not convert string to float:": "a number",
}
_DIRECTIONS = {"-x", "-y", "-z"}
_TARGETS = {"--target-fidelity", "--target-ssim"}  # of a plan: one given, the recorded ones are gone
_AS_THEY_ARE = "--downscale", 1  # what most runs record; what they were given is 0, for the run to choose
_SOURCES = {"--segmenter", "--masks", "--model", "--classes"}  # of label images: one given, all are anew


class UsageError(SageError):
    """Words that are no arguments of the command."""


def arguments(name: str, function: Callable[..., None], words: Sequence[str]) -> dict[str, Any]:
    """The arguments of a command: given flags win, else what the run folder records, else the defaults.

    Raises UsageError.
    """
    words = _joined(words)
    values = _parse(name, function, words)
    known = _recorded(name, function, values, words)
    if known:
        values = _with_dicts(_parse(name, _with_defaults(function, known), words), known, words)
    for flag in flags_of(function):
        value = values[flag.setting[0]]
        value = getattr(value, flag.setting[1]) if len(flag.setting) == 2 else value
        if cure := refusal(value, flag.kind):
            raise UsageError(impossible(flag.name, value, cure))
    return values


def _joined(words: Sequence[str]) -> list[str]:
    """Words with `--up -y` as `--up=-y`: a direction is no flag, though it looks like one."""
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] == "--up" and word in _DIRECTIONS:
            joined[-1] = f"--up={word}"
        else:
            joined.append(word)
    return joined


def _say(text: str) -> None:
    say(f"sagesplat: {text}", file=sys.stderr)


def _parse(name: str, function: Callable[..., None], words: Sequence[str]) -> dict[str, Any]:
    """The arguments that words mean; UsageError, one line, where they mean none."""

    @wraps(function)
    def take(*_: Any, **values: Any) -> dict[str, Any]:
        return values

    take.__signature__ = inspect.signature(function)  # type: ignore
    printed, prog = io.StringIO(), f"sagesplat {name}"
    try:
        with redirect_stdout(printed), redirect_stderr(printed):
            values, unknown = tyro.cli(
                take, prog=prog, args=words, return_unknown_args=True, add_help=False, config=()
            )
    except SystemExit as end:
        if not end.code:  # what tyro prints for shells
            print(printed.getvalue(), end="")
            raise
        # an unknown option can make tyro complain of the positional argument beside it
        known = {flag_of(flag.name) for flag in flags_of(function)}
        flags = [word.partition("=")[0] for word in words if word.startswith("--")]
        strange = [flag for flag in flags if flag_of(flag) not in known]
        reason = _unknown(function, strange) if strange else _flat(printed.getvalue())
        raise UsageError(f"{reason}; see `{prog} --help`") from None
    if unknown:
        raise UsageError(f"{_unknown(function, unknown)}; see `{prog} --help`")
    return values


def _unknown(function: Callable[..., None], words: Sequence[str]) -> str:
    """What is wrong with words that are no arguments, with the nearest flag."""
    word = next((word for word in words if word.startswith("-")), words[0])
    flag = word.partition("=")[0]
    if not flag.startswith("-"):
        return f"{word!r} is one argument too many; names with spaces need quotes"
    known = {f.name.strip("-"): f.name for f in flags_of(function) if f.name.startswith("--")}
    for names in (known, {name.rpartition(".")[2]: whole for name, whole in known.items()}):
        if near := get_close_matches(flag.strip("-"), names, n=1):
            return f"no option {flag}; did you mean {names[near[0]]}?"
    return f"no option {flag}"


def _flat(message: str) -> str:
    """What tyro says under a title and between rules, as one line."""
    parts: list[list[str]] = [[]]
    for line in message.splitlines():
        text = line.strip("│|╭╮╰╯+ ")
        if text and not text.strip("─-"):
            parts.append([])
        elif text:
            parts[-1].append(text)
    body = parts[0][1:] or [line for part in parts[1:2] for line in part]
    text = " ".join(body).rstrip(".:")
    for words, kind in _PYTHON.items():
        text = text.replace(words, f"not {kind}:")
    return text


def _with_defaults(function: Callable[..., None], values: Mapping[str, Any]) -> Callable[..., None]:
    """The command with other defaults for some of its parameters."""

    @wraps(function)
    def command(*args: Any, **options: Any) -> None:
        function(*args, **options)

    signature = inspect.signature(function)
    values = {name: _without_dicts(value) for name, value in values.items()}
    changed = [p.replace(default=values.get(p.name, p.default)) for p in signature.parameters.values()]
    command.__signature__ = signature.replace(parameters=changed)  # type: ignore
    return command


def _without_dicts(value: Any) -> Any:
    """Settings without the entries of dictionaries: tyro takes a default's keys for the only ones."""
    if not is_dataclass(value) or isinstance(value, type):
        return value
    return replace(value, **{name: {} for name in _dicts(value)})


def _with_dicts(values: dict[str, Any], known: Mapping[str, Any], words: Sequence[str]) -> dict[str, Any]:
    """Parsed values with the recorded dictionaries where their option is not given."""
    found = dict(values)
    given = {word.removeprefix("--").rpartition(".")[2] for word in words if word.startswith("--")}
    for name, value in known.items():
        kept = {key: entries for key, entries in _dicts(value).items() if key not in given}
        found[name] = replace(found[name], **kept) if kept else found[name]
    return found


def _dicts(value: Any) -> dict[str, dict]:
    """The dictionaries of settings, by the name of their field."""
    own = {field.name: getattr(value, field.name) for field in fields(value)} if is_dataclass(value) else {}
    return {name: entries for name, entries in own.items() if isinstance(entries, dict)}


def _recorded(
    name: str, function: Callable[..., None], values: Mapping[str, Any], words: Sequence[str]
) -> dict[str, Any]:
    """Parameters of a command whose values its run folder records; says which are not the defaults."""
    path = values.get("run")
    if not isinstance(path, Path) or not (path / "provenance").is_dir():
        return {}
    from sagesplat.run.recorded import recorded_ladder, recorded_settings
    from sagesplat.run.run_dir import RunDir, check_links

    check_links(path)

    given = {flag_of(word) for word in words}
    ladder = values.get("ladder") if "--ladder" in given else recorded_ladder(path)
    known = recorded_settings(RunDir(path, ladder or "nested"), of=name) | {"ladder": ladder}
    if given & _SOURCES:
        known.pop("masks", None)
    if asked := given & _TARGETS:
        _forget_targets(known, "ssim" if asked == {"--target-ssim"} else "fidelity")
    known = {key: value for key, value in known.items() if key in values}
    changed = [
        _typed(flag, now)
        for flag in flags_of(function)
        if flag.name not in given
        and (now := _now(flag, known, flag.default)) != flag.default
        and (flag.name, now) != _AS_THEY_ARE
    ]
    if changed:
        _say(f"settings of {path}: {' '.join(changed)}")
    return known


def _forget_targets(known: dict[str, Any], leads: str) -> None:
    """Drop recorded targets and budget when a target is given; others too when another quality leads."""
    if isinstance(plan := known.get("plan"), PlanConfig):
        others = plan.other_targets if plan.quality == leads else None
        known["plan"] = replace(
            plan, target_fidelity=None, target_ssim=None, other_targets=others, budget=0.0
        )


def _now(flag: Flag, known: Mapping[str, Any], default: Any) -> Any:
    """The recorded value of a flag."""
    value = known.get(flag.setting[0], default)
    if len(flag.setting) == 2 and is_dataclass(value) and flag.setting[0] in known:
        assert flag.setting[1] in {field.name for field in fields(value)}
        return getattr(value, flag.setting[1])
    return default if len(flag.setting) == 2 else value


def _typed(flag: Flag, value: Any) -> str:
    """A flag with its value, as one types them."""
    if isinstance(value, bool):
        return flag.name if value else flag.off
    parts = [x for pair in value.items() for x in pair] if isinstance(value, dict) else value
    text = " ".join(map(str, parts)) if isinstance(parts, tuple | list) else str(parts)
    return f"{flag.name} {text}"
