"""Compiles the kernels that many tests need: processes of tests would compile the same ones side by side.

`make test` runs it while the tools for tests are installed: it needs nothing but sagesplat.
"""

import tempfile
from pathlib import Path

from sagesplat.core.config import NestConfig, PlanConfig, RunConfig, TrainConfig
from sagesplat.demo.capture import make_capture
from sagesplat.output import before_after, figures, report
from sagesplat.stages.api import run_scene

CONFIG = RunConfig(
    train=TrainConfig(max_steps=20),
    nest=NestConfig(steps=10, base_steps=10),
    plan=PlanConfig(budget=1e4),
)


def main() -> None:
    """A run of a few steps; figures need no kernels, and take half of its time."""
    report.report_figures = lambda *_: iter(())
    figures.save_figure = lambda figure, path, **_: b""
    before_after.before_after = lambda path, *_, **options: path.touch()
    with tempfile.TemporaryDirectory() as folder:
        make_capture(Path(folder) / "capture", views=12, width=64, height=48)
        run_scene(Path(folder) / "capture", Path(folder) / "run", CONFIG)


if __name__ == "__main__":
    main()
