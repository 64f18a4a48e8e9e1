"""What happens to a process: signals, memory that runs out, a capture that changes, others at its side."""

import random
import re
import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

from benchmarks.faults import Outcome, finish, timed
from benchmarks.faults_run import PROGRAM, Asked, Command, differing, digests

LINE = re.compile(r"sagesplat: [^\n]+\n")
SIGNALS = ((signal.SIGTERM, 1, 143), (signal.SIGINT, 5, 2))  # how often, and the exit code
STAGES = ("lift", "blocks", "train", "block_categories")  # after which something happens
_MORE = 3 * 2**20, 40 * 2**20  # bytes that a process may still take
_BUNDLERS = 3


def signalled(asked: Asked, known: Outcome, times: int) -> Outcome:
    """SIGTERM and five quick Ctrl-C in turn, at random times; the same command each time."""
    chance = random.Random(f"{asked.seed} signals")
    found = Outcome("SIGTERM, five Ctrl-C")
    with timed(found):
        for turn in range(times):
            number, often, code = SIGNALS[turn % 2]
            after = chance.uniform(0.1, 1.5 * known.seconds / times)
            with Command(asked, "g", "--threads=1") as command:
                if command.end(after) is None and command.signal(number, often):
                    found.disturbances.append(f"{signal.Signals(number).name} x {often} after {after:.1f} s")
                    _refused(found, command, code)
                    _left_over(found, asked.run)
        with Command(asked, "g", "--threads=1") as command:
            finish(found, command)
    return found


def without_memory(asked: Asked) -> Outcome:
    """After several stages, hardly any more memory for the process."""
    chance = random.Random(f"{asked.seed} memory")
    found = Outcome("no memory left")
    with timed(found):
        for stage in STAGES:
            more = int(chance.uniform(*_MORE))
            _disturbed(asked, found, "h", stage, lambda c, more=more: c.limit_memory(more), f"{more:,} bytes")
        with Command(asked, "h", "--threads=1") as command:
            finish(found, command)
    return found


def capture_changed(asked: Asked) -> Outcome:
    """The capture is moved away, then a photo replaced, while the run works; both are undone afterwards."""
    found, away = Outcome("capture moved, photo changed"), asked.scene.with_name("away")
    photos = sorted((asked.scene / "images").iterdir())
    kept = asked.scene.with_name("kept")
    shutil.copytree(asked.scene / "images", kept, dirs_exist_ok=True)

    def move(command: Command) -> bool:
        asked.scene.rename(away)
        return True

    def change(command: Command) -> bool:
        for path in photos:
            shutil.copy(photos[0] if path != photos[0] else photos[1], path)
        return True

    with timed(found):
        for stage, act, what in (("scene", move, "moved"), ("lift", change, "photos changed")):
            _disturbed(asked, found, "i", stage, act, what)
            if away.exists():
                away.rename(asked.scene)
            for path in photos:
                shutil.copy2(kept / path.name, path)
        with Command(asked, "i", "--threads=1") as command:
            finish(found, command)
    shutil.rmtree(kept)
    return found


def _disturbed(
    asked: Asked, found: Outcome, name: str, stage: str, act: Callable[[Command], bool], what: str
) -> None:
    """Do something to a run after a stage; where it does not end well it is to say why in a line."""
    with Command(asked, name, "--threads=1") as command:
        command.wait_for(stage)
        if command.end(0.01) is None and act(command):
            _refused(found, command, 2)
            said = command.errors.strip() or "not noticed"
            found.disturbances.append(f"{what} after {stage}: {said}")


def _refused(found: Outcome, command: Command, code: int) -> None:
    """A command that was disturbed ends by itself: well, or with this code and one line."""
    ended = command.end()
    if ended not in (0, code) or (ended and not LINE.fullmatch(command.errors)):
        found.problems.append(f"exit code {ended}: {command.errors.strip()}")


def _left_over(found: Outcome, run: Path) -> None:
    found.problems += [
        f"{path.name} was left" for path in run.rglob(".*.tmp-*") if "cluster" not in path.name
    ]


def bundlers(asked: Asked, finished: Path) -> Outcome:
    """Several processes that write one bundle at once: it is whole, and as one alone makes it."""
    found, alone, out = Outcome(f"{_BUNDLERS} bundlers"), asked.out / "alone", asked.out / "together"
    for folder in (alone, out):
        shutil.rmtree(folder, ignore_errors=True)
    with timed(found):
        for target, count in ((alone, 1), (out, _BUNDLERS)):
            ends = _bundle(finished, target, count)
            told = [said for code, said in ends if code]
            found.disturbances += [said.strip() for said in told]
            if len(told) == count or not all(LINE.fullmatch(s) and "writes there" in s for s in told):
                found.problems += [f"bundling: {said.strip()}" for said in told]
    first, second = digests(alone), digests(out)
    found.differing = differing(first, second)
    return found


def _bundle(run: Path, out: Path, count: int) -> list[tuple[int, str]]:
    words = [*PROGRAM, "bundle", str(run), str(out), "--threads=1"]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    started = [subprocess.Popen(words, **pipes) for _ in range(count)]  # pyright: ignore
    return [(process.wait(), errors) for process in started for errors in [process.communicate()[1]]]
