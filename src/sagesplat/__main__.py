"""The program `sagesplat`, also as `python -m sagesplat`."""

import os
import sys

from sagesplat.core import signals


def program() -> None:
    """Run the command line. Signals end it in order from the first moment on, imports included."""
    # idle threads of numba's and torch's pools sleep instead of spinning in the way of other programs and of
    # each other; read when the libraries are loaded
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if os.path.basename(sys.argv[0]) == "__main__.py":
        sys.argv[0] = "sagesplat"  # in messages and in locks
    with signals.handled():
        try:
            from sagesplat.cli import main

            main()
        except (KeyboardInterrupt, SystemError) as error:
            signals.leave(error)


if __name__ == "__main__":
    program()
