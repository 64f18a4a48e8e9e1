"""Events as progress bars and tables."""

import shlex
import shutil
import sys
import time
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console as RichConsole
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn
from rich.table import Table
from rich.text import Text

from sagesplat.cli.layout import fitted
from sagesplat.core.durations import duration
from sagesplat.core.events import (
    Event,
    Noted,
    RunDone,
    StageDone,
    StageSkipped,
    StageStarted,
    TableMade,
    Training,
    Warned,
)
from sagesplat.core.events import Progress as ProgressEvent
from sagesplat.core.names import visible

LABELS_SHOWN = 4  # categories whose counts the training bar shows
_REFRESH = 0.2  # seconds between two updates of the bar
_SILENT = 60.0  # seconds at least between two progress lines where there is no terminal
_LATEST = 600.0  # seconds after which there is a line though no mark was passed
_MARKS = (10, 25, 50, 75, 100)  # percent
_SURE = 0.02  # share of a stage after which its remaining time is told


class Remaining:
    """Seconds that are left of a stage, by its mean speed since its first report.

    What came before that report (compiling, loading) is not part of the speed, and a stage that resumes does
    not count what was done before.
    """

    def __init__(self) -> None:
        self._first: tuple[float, int] | None = None

    def __call__(self, now: float, done: int, total: int) -> float | None:
        """The estimate at a time in seconds; None as long as too little is done."""
        if self._first is None or done < self._first[1]:  # some stages report several rounds
            self._first = now, done
        since, before = now - self._first[0], done - self._first[1]
        if before <= 0 or before < _SURE * (total - self._first[1]):
            return None
        return since * (total - done) / before


class Console:
    """Shows a run; used as a context manager and called with each event.

    What events hold is printed as it is: rich's markup and emoji codes mean nothing in names and paths, and
    what a terminal would obey is shown (`names.visible`).
    """

    def __init__(self, output: RichConsole | None = None):
        self.out = output or RichConsole(highlight=False)
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description:9}", markup=False),
            BarColumn(bar_width=24),
            TaskProgressColumn(),
            TextColumn("{task.fields[left]}", markup=False),
            TextColumn("{task.fields[text]}", markup=False),
            console=self.out,
            transient=True,
            disable=not self.out.is_terminal,
        )
        self._task = None
        self._shown = 0.0
        self._mark = 0
        self._remaining = Remaining()
        self._warned = set[str]()

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
                self._task = self._bar.add_task(visible(name), total=None, text="", left="")
                self._shown, self._mark = time.monotonic(), 0
                self._remaining = Remaining()
            case StageSkipped(name):
                self.note(f"{name:9} up to date")
            case ProgressEvent(name, done, total, text):
                self._advance(name, done, total, text)
            case Training(step, total, loss, counts, num):
                largest = sorted(counts.items(), key=lambda c: -c[1])[:LABELS_SHOWN]
                by_label = " ".join(f"{name} {count / 1000:.1f}k" for name, count in largest)
                text = f"step {step} loss {loss:.3f} · {num / 1000:.1f}k Gaussians {by_label}"
                self._advance("train", step, total, text)
            case Warned(text):
                if text not in self._warned:  # stages may find the same
                    self._warned.add(text)
                    self.say(f"! {text}", style="yellow")
            case Noted(text):
                self.note(text)
            case StageDone(name, seconds, lines):
                if self._task is not None:
                    self._bar.remove_task(self._task)
                    self._task = None
                self.say(f" {name:9} {seconds:6.1f} s  {lines[0] if lines else ''}", mark=("✓", "green"))
                for line in lines[1:]:
                    self.say(f"{'':21}{line}")
            case TableMade(title, header, rows):
                self._show_table(title, header, rows)
            case RunDone(report, follows, noticed, outcome):
                if noticed:
                    self.note(f"noticed: {'; '.join(noticed)}")
                if outcome:
                    self.say(f"Result: {outcome}", style="bold")
                self.say(f"Report: {report.resolve()}")
                if follows:
                    self.say(f"Next:   {_program()} {shlex.join(follows)}")

    def say(self, text: str, style: str = "", mark: tuple[str, str] = ("", "")) -> None:
        """Print a line in a style, after a mark (text, style) of another."""
        self.out.print(Text.assemble(mark, (visible(text), style)), soft_wrap=True)

    def note(self, text: str) -> None:
        """Print a line that matters little."""
        self.say(f"· {text}", style="dim")

    def ask(self, question: str) -> bool:
        """Ask on the terminal; anything but yes is no."""
        self._bar.stop()
        try:
            return self.out.input(Text(f"{visible(question)} [y/N] ")).strip().lower() in ("y", "yes")
        except EOFError:
            return False
        finally:
            self._bar.start()

    def _show_table(self, title: str, header: tuple[str, ...], rows: tuple[tuple[str, ...], ...]) -> None:
        """Print a table, in parts if it is wider than the terminal."""
        self.out.print(Text(visible(title), "bold"))
        shown = [[visible(cell) for cell in row] for row in (header, *rows)]
        for heads, cells in fitted(shown[0], shown[1:], self.out.width):
            table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
            for index, column in enumerate(heads):
                table.add_column(Text(column), justify="left" if index == 0 else "right", no_wrap=True)
            for row in cells:
                table.add_row(*map(Text, row))
            self.out.print(table)
            self.out.print()

    def _advance(self, name: str, done: int, total: int, text: str) -> None:
        """Move the bar; without a terminal, a line now and then."""
        now = time.monotonic()
        left = self._remaining(now, done, total)
        if self.out.is_terminal:
            if self._task is not None and (now - self._shown > _REFRESH or done == total):
                self._shown = now
                shown = "" if left is None else f"{duration(left)} left"
                self._bar.update(self._task, completed=done, total=total, text=visible(text), left=shown)
            return
        share = 100 * done // total
        mark = max((m for m in _MARKS if m <= share), default=0)
        silent = now - self._shown
        if done < total and ((mark > self._mark and silent >= _SILENT) or silent >= _LATEST):
            self._shown, self._mark = now, mark
            ahead = "" if left is None else f", {duration(left)} left"
            self.say(f"  {name:9} {share:3d} %{ahead}  {text}")


def _program() -> str:
    """What to type to call this program again: its name where that finds it, else its path."""
    called, found = Path(sys.argv[0]), shutil.which("sagesplat")
    if called.name != "sagesplat" or (found is not None and Path(found).resolve() == called.resolve()):
        return "sagesplat"
    return shlex.quote(str(called.relative_to(Path.cwd()) if called.is_relative_to(Path.cwd()) else called))
