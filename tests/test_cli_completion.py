"""Shells complete commands, flags and values: each is asked for what it would offer."""

import shutil
import subprocess
from pathlib import Path

import pytest

from sagesplat import cli
from sagesplat.cli.completion import script

cli.commands()
ASKED = {
    "": "observe",
    "run --train.max": "--train.max-steps",
    "run x --dev": "--device",
    "run x --device c": "cuda",
}
BASH = """COMP_WORDS=(sagesplat {words}); COMP_CWORD=$(( ${{#COMP_WORDS[@]}} - 1 ))
_sagesplat; printf '%s\\n' "${{COMPREPLY[@]}}" """


@pytest.mark.parametrize("typed", ASKED)
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_offers_what_there_is(shell: str, typed: str, tmp_path: Path) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"needs {shell}")
    file = tmp_path / "completion"
    file.write_text(script(shell))
    if shell == "fish":
        command = f"source {file}; complete -C 'sagesplat {typed}'"
    else:  # as bashcompinit calls it
        command = f"source {file}; {BASH.format(words=typed or repr(''))}"
    options = ["-f"] if shell == "zsh" else []
    env = {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        [shell, *options, "-c", command], capture_output=True, text=True, check=True, env=env
    )
    assert done.stderr == ""
    offered = [line.split("\t")[0] for line in done.stdout.splitlines()]
    assert ASKED[typed] in offered
    assert len(offered) < 60 or shell == "zsh"  # it leaves out what does not begin so by itself
