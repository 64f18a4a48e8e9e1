"""`python -m benchmarks NAME ...` is `python -m benchmarks.NAME ...`, whose --help says what it does."""

import runpy
import sys
from pathlib import Path


def names() -> list[str]:
    """The benchmarks: files and folders with a `main()`."""
    here = Path(__file__).parent
    paths = [*here.glob("[a-z]*.py"), *here.glob("*/__main__.py")]
    runnable = [path for path in paths if "\ndef main(" in path.read_text(encoding="utf-8")]
    return sorted(path.parent.name if path.stem == "__main__" else path.stem for path in runnable)


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in names():
        raise SystemExit(f"python -m benchmarks NAME --help, where NAME is one of {', '.join(names())}")
    runpy.run_module(f"benchmarks.{sys.argv.pop(1)}", run_name="__main__", alter_sys=True)
