"""Events as progress bars and tables."""

import sys
import time
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console as RichConsole
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from sagesplat.core.events import (
    Event,
    RunDone,
    StageDone,
    StageSkipped,
    StageStarted,
    TableMade,
    Training,
    Warned,
)
from sagesplat.core.events import Progress as ProgressEvent

LABELS_SHOWN = 4  # categories whose counts the training bar shows
_REFRESH = 0.2  # seconds between two updates of the bar
_LINES = 10  # progress lines a stage prints where there is no terminal


class Console:
    """Shows a run; used as a context manager and called with each event."""

    def __init__(self, output: RichConsole | None = None):
        self.out = output or RichConsole(highlight=False)
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description:9}"),
            BarColumn(bar_width=24),
            TaskProgressColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[text]}"),
            console=self.out,
            transient=True,
            disable=not self.out.is_terminal,
        )
        self._task = None
        self._shown = 0.0
        self._began = 0.0
        self._tenth = 0

    def __enter__(self) -> "Console":
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def __call__(self, event: Event) -> None:
        """Show one event."""
        match event:
            case StageStarted(name):
                if self._task is not None:  # of a stage that failed
                    self._bar.remove_task(self._task)
                self._task = self._bar.add_task(name, total=None, text="")
                self._began, self._shown, self._tenth = time.monotonic(), 0.0, 0
            case StageSkipped(name):
                self.out.print(f"[dim]· {name:9} up to date[/]")
            case ProgressEvent(name, done, total, text):
                self._advance(name, done, total, text)
            case Training(step, total, loss, counts, num):
                largest = sorted(counts.items(), key=lambda c: -c[1])[:LABELS_SHOWN]
                by_label = " ".join(f"{name} {count / 1000:.1f}k" for name, count in largest)
                text = f"step {step} loss {loss:.3f} · {num / 1000:.1f}k Gaussians {by_label}"
                self._advance("train", step, total, text)
            case Warned(text):
                self.out.print(f"[yellow]! {text}[/]", soft_wrap=True)
            case StageDone(name, seconds, lines):
                if self._task is not None:
                    self._bar.remove_task(self._task)
                    self._task = None
                self.out.print(
                    f"[green]✓[/] {name:9} {seconds:6.1f} s  {lines[0] if lines else ''}", soft_wrap=True
                )
                for line in lines[1:]:
                    self.out.print(f"{'':21}{line}", soft_wrap=True)
            case TableMade(title, header, rows):
                table = Table(
                    title=title,
                    title_justify="left",
                    title_style="bold",
                    box=SIMPLE_HEAD,
                    padding=(0, 1, 0, 0),
                )
                for index, column in enumerate(header):
                    table.add_column(column, justify="left" if index == 0 else "right", no_wrap=True)
                for row in rows:
                    table.add_row(*row)
                self.out.print(table)
            case RunDone(report, run):
                self.out.print(f"Report: {report.resolve()}", soft_wrap=True)
                if run:
                    self.out.print(f"Walk through it: {_program()} view {run}", soft_wrap=True)

    def _advance(self, name: str, done: int, total: int, text: str) -> None:
        """Move the bar; without a terminal, a line at every tenth."""
        now = time.monotonic()
        if self.out.is_terminal:
            if self._task is not None and (now - self._shown > _REFRESH or done == total):
                self._shown = now
                self._bar.update(self._task, completed=done, total=total, text=text)
        elif done * _LINES // total > self._tenth:
            self._tenth = done * _LINES // total
            left = (now - self._began) * (total - done) / done
            self.out.print(
                f"  {name:9} {100 * done // total:3d} %  {left:5.0f} s left  {text}", soft_wrap=True
            )


def _program() -> str:
    """How this program was called, to be typed again."""
    called = Path(sys.argv[0])
    return str(called) if called.name == "sagesplat" else "sagesplat"
