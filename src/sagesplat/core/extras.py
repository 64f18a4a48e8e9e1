"""The command that installs what is missing, for the environment that this sagesplat is in."""

import os
import shlex
import shutil
import sys
from importlib.metadata import distributions
from pathlib import Path


def install(*words: str) -> str:
    """The command that installs something beside this sagesplat, as one types it.

    No index has to hold sagesplat: the one that is installed satisfies `sagesplat[hf]`, and only the packages
    of the extra are fetched.

    Args:
        words: packages, extras such as "sagesplat[hf]", options of pip

    Returns:
        `pip install ...` where that reaches this environment, else with its Python in full; with pipx
        where that made it, and with uv where there is no pip (`uv tool install`, `uv venv`).
    """
    quoted = " ".join(f'"{word}"' if os.name == "nt" else shlex.quote(word) for word in words)
    python = Path(sys.executable)
    if (Path(sys.prefix) / "pipx_metadata.json").exists():
        return f"pipx runpip sagesplat install {quoted}"
    if not any(distributions(name="pip")):  # finding the module may import setuptools
        return f"uv pip install --python {_typed(python)} {quoted}"
    pip = shutil.which("pip")
    if pip is not None and Path(pip).parent == python.parent:
        return f"pip install {quoted}"
    return f"{_typed(python)} -m pip install {quoted}"


def _typed(path: Path) -> str:
    """A path as short as it can be typed here."""
    here = str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)
    return f'"{here}"' if os.name == "nt" else shlex.quote(here)
