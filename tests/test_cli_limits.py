"""Every numeric option of every command: impossible values are one line, before any work."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, get_args, get_origin

import pytest

from sagesplat import cli
from sagesplat.cli.help import flags_of
from sagesplat.cli.parse import UsageError, arguments
from sagesplat.core.config import RunConfig, TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.io.typed import check_limits, refusal

VALUES = ("-5", "0", "nan", "1e30", str(10**20))


@dataclass(frozen=True)
class Option:
    command: str
    name: str
    kind: Any

    def words(self, value: str) -> list[str]:
        """The option with a value in place of each of its numbers."""
        kind = next((k for k in (self.kind, *get_args(self.kind)) if get_origin(k) in (tuple, dict)), None)
        if get_origin(kind) is dict:
            return [self.name, "tree", value]
        fixed = get_origin(kind) is tuple and Ellipsis not in get_args(kind)
        return [self.name, *[value] * (len(get_args(kind)) if fixed else 1)]


def numbers(kind: Any) -> set[type]:
    """Which of int and float are in an annotation."""
    return {kind} & {int, float} | {t for part in get_args(kind) for t in numbers(part)}


def options() -> Iterator[Option]:
    for command, function in cli.commands().items():
        for flag in flags_of(function):
            if flag.name.startswith("--") and numbers(flag.kind):
                yield Option(command, flag.name, flag.kind)


def positional(command: str) -> list[str]:
    """Words for what a command needs besides options."""
    flags = [flag for flag in flags_of(cli.commands()[command]) if not flag.name.startswith("--")]
    return ["apply" if flag.name == "apply" else "nowhere" for flag in flags if flag.default is None]


def said(command: str, function: Any, words: list[str]) -> str:
    """The line that refuses the words; "" where they are arguments."""
    try:
        arguments(command, function, words)
    except UsageError as error:
        return str(error)
    return ""


def test_all_have_limits():
    """Limits are finite on both sides, so neither NaN nor an overflow can pass."""
    found = list(options())
    assert len({option.command for option in found}) > 15
    for option in found:
        (number,) = numbers(option.kind)
        for wrong in (-5, 10**20) if number is int else (-5.0, math.nan, math.inf):
            value = wrong
            kind = next(
                (k for k in (option.kind, *get_args(option.kind)) if get_origin(k) in (tuple, dict)), 0
            )
            if kind:
                many = len(get_args(kind)) if Ellipsis not in get_args(kind) else 1
                value = {"tree": wrong} if get_origin(kind) is dict else (wrong,) * many
            assert refusal(value, option.kind), (option, wrong)


def test_each_value_is_one_line_or_legal():
    """As typed: once for each setting, whichever commands have it."""
    size = {command: len(list(flags_of(function))) for command, function in cli.commands().items()}
    by_size = sorted(options(), key=lambda option: -size[option.command])  # the last one is parsed fastest
    for option in {(option.name, str(option.kind)): option for option in by_size}.values():
        function = cli.commands()[option.command]
        for value in VALUES:
            words = [*positional(option.command), *option.words(value)]
            line = said(option.command, function, words)
            assert not line or (option.name in line and "\n" not in line)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("run a b --train.max-steps -5", "--train.max-steps -5 is impossible; choose a number from 1 to"),
        (f"run a b --test-every {10**20}", f"--test-every {10**20} is impossible; choose a number from 0 to"),
        ("adopt a b --shares 0.1 2", "--shares 0.1 2.0 is impossible; choose a number above 0 to 1"),
        ("run a b --weights tree -1", "--weights tree -1.0 is impossible; choose a number from 0 to"),
        ("plan a --target-ssim nan", "--target-ssim nan is impossible; choose a number above 0 to 1"),
    ],
)  # fmt: skip
def test_the_line_names_the_option_and_its_range(
    words: str, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("sys.argv", ["sagesplat", *words.split()])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith(f"sagesplat: {line}")
    assert said.count("\n") == 1


def test_settings_of_scripts_are_checked_too():
    check_limits(RunConfig())
    with pytest.raises(RunError, match=r"--train\.max-steps 0 is impossible"):
        check_limits(RunConfig(train=TrainConfig(max_steps=0)))
