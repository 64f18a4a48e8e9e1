"""The program `sagesplat` until its first training step: `start_process.py EPOCH WORD ...`, for start.py.

Prints when its stages began, as JSON: seconds since EPOCH, at which this process was started.
"""

import json
import os
import sys
import time


def main() -> None:
    """Run the command and end at the first step."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as `sagesplat` itself does
    begin = float(sys.argv.pop(1))
    times = {"python": time.time() - begin}
    from sagesplat.cli import console, main
    from sagesplat.core.events import Event, StageDone, StageStarted, Training

    times["console"] = time.time() - begin
    shown = console.Console.__call__

    def show(self: console.Console, event: Event) -> None:
        times.setdefault("job", time.time() - begin)
        shown(self, event)
        if isinstance(event, StageStarted | StageDone):
            what = "begun" if isinstance(event, StageStarted) else "done"
            times[f"{event.name} {what}"] = time.time() - begin
        if isinstance(event, Training):
            times["first step"] = time.time() - begin
            print(json.dumps(times), flush=True)
            os._exit(0)

    console.Console.__call__ = show  # type: ignore[method-assign]
    main()


if __name__ == "__main__":
    main()
