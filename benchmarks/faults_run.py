"""A run that is to be disturbed: its command, what it prints, and what it leaves, bit for bit."""

import hashlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

PROGRAM = (sys.executable, "-m", "sagesplat")
AGAIN = re.compile(r"^! (.*(?:; done again |resuming from step ).*)$", re.MULTILINE)
_DONE = re.compile(r"^✓ (.+?) +(\d+\.\d) s  ", re.MULTILINE)
_SKIPPED = re.compile(r"^· (.+?) +up to date$", re.MULTILINE)
_POLL = 0.1  # seconds between two looks at what a run printed
# What tells seconds, and so differs between any two runs. All else has to be the same
TIMES = {
    "provenance/*.json": "seconds, and so the hashes of records among the inputs; all else is compared",
    "blocks.csv": "seconds of each block: their columns; all else is compared",
    "blocks.md": "the same table for people",
    "report/tables/timings.csv": "seconds of each stage",
    "report/index.html": "a page with those tables",
    ".lock": "who had the folder last",
}
_LEFT_OUT = (".lock", "blocks.md", "timings.csv", "index.html")


@dataclass(frozen=True)
class Asked:
    """What is run, and how often it is disturbed."""

    scene: Path
    out: Path
    words: tuple[str, ...]  # further settings of `sagesplat run`
    kills: int = 20
    seed: int = 0

    @property
    def run(self) -> Path:
        """The run folder of every case."""
        return self.out / "run"


def settings(downscale: int, steps: int, nest_steps: int, levels: int) -> tuple[str, ...]:
    """Options of a run in three blocks that takes a minute or two."""
    return (
        f"--downscale={downscale}", f"--train.max-steps={steps}", f"--train.level-every={max(1, steps // 5)}",
        "--blocks.count=3",
        f"--nest.steps={nest_steps}", f"--nest.base-steps={nest_steps}", f"--nest.levels={levels}",
        "--target-ssim=0.6",
    )  # fmt: skip


def digests(run: Path) -> dict[str, str]:
    """SHA-256 of what every file of a run says but for times (`TIMES`), by path."""
    files = sorted(p for p in run.rglob("*") if p.is_file() and p.name not in _LEFT_OUT)
    return {str(p.relative_to(run)): hashlib.sha256(_content(p)).hexdigest() for p in files}


def _content(path: Path) -> bytes:
    if path.parent.name == "provenance":
        record = json.loads(path.read_text(encoding="utf-8"))
        return json.dumps(record | {"seconds": 0}).encode()
    if path.name == "blocks.csv":
        rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
        kept = [i for i, name in enumerate(rows[0]) if not name.endswith(" s")]
        return "\n".join(",".join(row[i] for i in kept) for row in rows).encode()
    return path.read_bytes()


def differing(first: Mapping[str, str], second: Mapping[str, str]) -> list[str]:
    """Files that only one of two runs has, or that differ."""
    found = []
    for name in sorted(first.keys() | second.keys()):
        if name not in second:
            found.append(f"{name} (missing)")
        elif name not in first:
            found.append(f"{name} (left over)")
        elif first[name] != second[name]:
            found.append(name)
    return found


class Command:
    """`sagesplat run` in a process of its own; killed at the end of the block if it is still there."""

    def __init__(self, asked: Asked, name: str, *more: str):
        logs = asked.out / "logs"
        logs.mkdir(parents=True, exist_ok=True)
        number = len(list(logs.glob(f"{name}-*.txt")))
        self.log, self._errors = logs / f"{name}-{number:02d}.txt", logs / f"{name}-{number:02d}.err"
        words = [*PROGRAM, "run", asked.scene, asked.run, *asked.words, *more]
        environment = os.environ | {"RAY_USAGE_STATS_ENABLED": "0", "PYTHONUNBUFFERED": "1"}
        with self.log.open("wb") as out, self._errors.open("wb") as errors:
            self._process = subprocess.Popen(
                [*map(str, words)], stdout=out, stderr=errors, stdin=subprocess.DEVNULL, env=environment
            )

    def __enter__(self) -> "Command":
        return self

    def __exit__(self, *exception: object) -> None:
        self.kill()

    def kill(self) -> bool:
        """End it as `kill -9` does; whether it was still at work."""
        working = self._process.poll() is None
        self._process.kill()
        self._process.wait()
        return working

    def end(self, seconds: float | None = None) -> int | None:
        """Its exit code; None where it still works after so many seconds."""
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None

    def wait_for(self, stage: str) -> None:
        """Until a stage has ended, or the command has."""
        while stage not in self.done and self._process.poll() is None:
            time.sleep(_POLL)

    @property
    def said(self) -> str:
        """What it printed so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    @property
    def errors(self) -> str:
        """The same, as errors."""
        return self._errors.read_text(encoding="utf-8", errors="replace")

    @property
    def done(self) -> list[str]:
        """Stages that have ended, skipped ones included."""
        return _SKIPPED.findall(self.said) + list(stages(self.said))


def stages(said: str) -> dict[str, float]:
    """Seconds of the stages that a run said it has done, in their order."""
    return {name: float(seconds) for name, seconds in _DONE.findall(said)}


def ends(of: Mapping[str, float]) -> dict[str, float]:
    """Seconds of work after which each stage had ended, of a run by one process."""
    found, before, within = {}, 0.0, 0.0
    for name, seconds in of.items():
        if "/" in name:  # a part of the stage that ends next
            within += seconds
            found[name] = before + within
        else:
            before, within = before + seconds, 0.0
            found[name] = before
    return found


@dataclass
class Outcome:
    """A case: what was done to it, and what became of it."""

    case: str
    against: str = "1 thread"  # the case whose seconds it is compared with
    disturbances: list[str] = field(default_factory=list)
    runs: int = 1
    seconds: float = 0.0  # of all runs
    again: list[str] = field(default_factory=list)  # what the runs said of work that was done again
    stages: dict[str, float] = field(default_factory=dict)  # seconds
    problems: list[str] = field(default_factory=list)  # a run that did not end as it should
    differing: list[str] = field(default_factory=list)  # files
    of: dict[str, str] = field(default_factory=dict)  # command, commit and date

    @property
    def result(self) -> str:
        """Whether a case ended as the undisturbed run, in words."""
        if self.problems:
            return self.problems[0]
        return f"no: {', '.join(self.differing[:3])}" if self.differing else "same"


def finish(found: Outcome, command: Command) -> None:
    """Wait for a command that is to end well."""
    code = command.end()
    found.stages = stages(command.said)
    if code or command.errors:
        found.problems.append(f"exit code {code}: {command.errors.strip()}")
    found.again += AGAIN.findall(command.said)


@contextmanager
def timed(found: Outcome) -> Iterator[Outcome]:
    """Measures what a case takes, without the start of its cluster."""
    begin = time.perf_counter()
    yield found
    found.seconds = time.perf_counter() - begin
