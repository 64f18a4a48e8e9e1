"""Scripts that complete commands, flags and their values in a shell."""

import re
import shlex

from sagesplat.cli.base import COMMANDS
from sagesplat.cli.help import Flag, flags_of
from sagesplat.cli.overview import summaries


def script(shell: str) -> str:
    """What a shell reads to complete `sagesplat`: every command and flag of this version."""
    flags = {
        name: [flag for flag in flags_of(function) if flag.name.startswith("--")]
        for name, function in COMMANDS.items()
    }
    return _fish(flags) if shell == "fish" else _bash(flags, zsh=shell == "zsh")


def _typed(flag: Flag) -> str:
    """A flag as one types it: what is on already can only be turned off."""
    return flag.off if flag.default is True else flag.name


def _choices(flag: Flag) -> list[str]:
    """The values of a flag that has a few."""
    found = re.fullmatch(r"\{(.+)\}", flag.values)
    return found[1].split(",") if found else []


def _bash(flags: dict[str, list[Flag]], zsh: bool) -> str:
    """For bash, and for zsh through its own bashcompinit. Slices count from 0 in both, indices do not."""
    of_command = [
        f"    {name}) words={shlex.quote(' '.join(['--help', *map(_typed, options)]))} ;;"
        for name, options in flags.items()
    ]
    values = {flag.name: _choices(flag) for options in flags.values() for flag in options if _choices(flag)}
    of_flag = [f"    {name}) words={shlex.quote(' '.join(values[name]))} ;;" for name in sorted(values)]
    begin = ["autoload -Uz compinit bashcompinit && compinit && bashcompinit"] if zsh else []
    return "\n".join([
        *begin,
        "_sagesplat() {",
        '  local current="${COMP_WORDS[@]:$COMP_CWORD:1}" words=',
        '  local before="${COMP_WORDS[@]:$((COMP_CWORD - 1)):1}"',
        '  case "$before" in',
        *of_flag,
        "  esac",
        f'  if [ "$COMP_CWORD" = 1 ]; then words={shlex.quote(" ".join([*flags, "--help", "--version"]))}',
        '  elif [ "${current#-}" != "$current" ]; then case "${COMP_WORDS[@]:1:1}" in',
        *of_command,
        "  esac; fi",
        '  COMPREPLY=($(compgen -W "$words" -- "$current"))',
        "}",
        "complete -o default -F _sagesplat sagesplat",
    ])  # fmt: skip


def _fish(flags: dict[str, list[Flag]]) -> str:
    lines, about = [], dict(summaries())
    for name, options in flags.items():
        summary = shlex.quote(about[name])
        lines.append(f"complete -c sagesplat -n __fish_use_subcommand -a {name} -d {summary}")
        for flag in options:
            values = f" -x -a {shlex.quote(' '.join(_choices(flag)))}" if _choices(flag) else ""
            needed = " -r" if flag.values and not values else ""
            lines.append(
                f"complete -c sagesplat -n '__fish_seen_subcommand_from {name}' "
                f"-l {_typed(flag)[2:]}{needed}{values}"
            )
    return "\n".join(lines)
