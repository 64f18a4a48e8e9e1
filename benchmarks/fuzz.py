"""Damaged files for every reader: guided by coverage where atheris is installed, else at random.

Readers take turns in a process each, so that nothing that happens there ends the run: two at a time, and two
turns each. The first is short and says how fast a reader is. The rest of the time goes to the readers that
are fast, and what is slow gets enough for `ENOUGH` executions. The second turn begins with the inputs that
reached something new in the first, and measures the memory that each of them takes.
"""

import json
import mmap
import os
import re
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field
from hashlib import sha256
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from random import Random
from typing import Any

from benchmarks.hostile import Finding, Reader, check, honest_memory, watchdog
from benchmarks.mutate import MOST, mutate

CORPUS = Path(__file__).parents[1] / "tests" / "data" / "hostile"
MEMORY = 16 * 2**30  # bytes of address space; torch takes some of them for itself
ENOUGH = 20_000  # executions of a reader that is slow
SLOW = 1000  # executions per second below which a reader is
MEASURED = 32  # of so many inputs one has its memory measured in Python, which takes time
LARGE = 512  # of so many inputs one is a damaged copy of a large file
STUCK = (
    30.0  # seconds without an execution after which a process is killed: decoders in C cannot be interrupted
)
SHARED = 2**22  # bytes of what a process shares with the one that watches it
# Compiled kernels cannot be measured, and what draws or trains need not be
FOLDERS = (
    "adapt",
    "core",
    "download",
    "formats",
    "io",
    "run",
    "scene",
    "segment",
    "stages",
    "studies",
    "train",
    "viewer",
)


@dataclass
class Turn:
    """What has been done with a reader."""

    reader: Reader
    folder: Path  # what is found, and what is needed meanwhile
    executions: int = 0
    seconds: float = 0.0
    ends: float = 0.0  # of the turn at hand
    pid: int = 0
    begun: float = 0.0
    seen: tuple[int, float] = (0, 0.0)  # executions, and when there were as many
    crashes: dict[str, str] = field(default_factory=dict)

    @property
    def shared(self) -> Path:
        """The count of executions, and the input at hand: what is there after a crash."""
        return self.folder / "shared"

    def progress(self) -> tuple[int, bytes]:
        """Executions of the process at hand, and its last input."""
        with self.shared.open("rb") as file:
            count, length = struct.unpack("<QQ", file.read(16))
            return count, file.read(length)


def run(
    seconds: float, readers: tuple[str, ...], out: Path, seed: int = 0, jobs: int = 2
) -> Iterator[dict[str, Any]]:
    """Fuzz readers (none: all) for a time in `jobs` processes; files that one fails on go to `out`/READER.

    A row for each: reader, executions, seconds, whether coverage guided, branches covered (None without),
    findings by kind.
    """
    command = [
        sys.executable,
        "-m",
        "benchmarks.fuzz",
        str(seconds),
        str(out),
        str(seed),
        str(jobs),
        *readers,
    ]
    out.mkdir(parents=True, exist_ok=True)
    with (
        (out / "log").open("w") as log,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True) as process,
    ):
        assert process.stdout is not None
        for line in process.stdout:
            yield json.loads(line)
    if process.returncode:
        raise SystemExit(f"the fuzzer ended with exit code {process.returncode}; see {out / 'log'}")


def write(path: Path, result: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    """Keep a run's figures, a reader on each line, with what they are of."""
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout
    command = " ".join(["python -m benchmarks", *sys.argv[1:]])
    origin = {"command": command, "commit": commit.strip(), "date": time.strftime("%Y-%m-%d")}
    lines = ",\n".join(json.dumps(row) for row in rows)
    path.write_text(f'{json.dumps(origin | result)[:-1]}, "by_reader": [\n{lines}\n]}}\n')


def _main(seconds: float, out: Path, seed: int, jobs: int, only: list[str]) -> None:
    """Print the rows of `run`. Imports once, then forks for each turn of a reader."""
    with _instrumented() if _guided() else nullcontext():
        from benchmarks.readers import READERS
    if unknown := set(only) - {reader.name for reader in READERS}:
        raise SystemExit(f"no reader {', '.join(unknown)}")
    memory = Path("/dev/shm") if Path("/dev/shm").is_dir() else None
    with tempfile.TemporaryDirectory(dir=memory) as folder:
        turns = [Turn(r, Path(folder) / r.name) for r in READERS if not only or r.name in only]
        share = seconds * jobs / len(turns)
        _take_turns(turns, {t.reader.name: share / 8 for t in turns}, out, seed, jobs)
        _take_turns(turns, _shares(turns, seconds * jobs), out, seed + 1, jobs)
        for turn in turns:
            print(json.dumps(_row(turn, out)), flush=True)


def _shares(turns: list[Turn], seconds: float) -> dict[str, float]:
    """Seconds of the second turns: little for what is slow, and the rest for the others in equal parts."""
    left = max(0.0, seconds - sum(turn.seconds for turn in turns))
    rates = {turn.reader.name: max(turn.executions / max(turn.seconds, 1e-9), 0.1) for turn in turns}
    slow = {n: min(ENOUGH / rate, left / len(turns)) for n, rate in rates.items() if rate < SLOW}
    fast = max(1, len(turns) - len(slow))
    return {n: slow.get(n, (left - sum(slow.values())) / fast) for n in rates}


def _take_turns(turns: list[Turn], shares: dict[str, float], out: Path, seed: int, jobs: int) -> None:
    """A turn for each reader, at most `jobs` at a time; a crash or a hang does not end it."""
    waiting, running = [(turn, shares[turn.reader.name]) for turn in turns], list[Turn]()
    while waiting or running:
        while waiting and len(running) < jobs:
            turn, seconds = waiting.pop(0)
            _start(turn, seconds, out, seed)
            running.append(turn)
        time.sleep(0.1)
        for turn in list(running):
            code = _ended(turn)
            if code is None:
                continue
            running.remove(turn)
            if code:
                content = turn.progress()[1]
                kind = "hang" if code == -signal.SIGKILL else "crash"
                turn.crashes[kind] = f"exit code {code}: {_log(turn)[-300:]}"
                _keep(out, turn.reader, kind, content)
                if (rest := turn.ends - time.monotonic()) > 1:
                    seed += 1000
                    waiting.insert(0, (turn, rest))


def _start(turn: Turn, seconds: float, out: Path, seed: int) -> None:
    turn.folder.mkdir(exist_ok=True)
    turn.shared.write_bytes(bytes(SHARED))
    turn.begun = time.monotonic()
    turn.ends, turn.seen = turn.begun + seconds, (0, turn.begun)
    turn.pid = os.fork()
    if not turn.pid:
        try:
            _child(turn, seconds, out, seed)
        finally:
            os._exit(70)


def _ended(turn: Turn) -> int | None:
    """The exit code of a reader's process, None while it runs; kills one that is stuck."""
    pid, status = os.waitpid(turn.pid, os.WNOHANG)
    now, count = time.monotonic(), turn.progress()[0]
    if not pid:
        if count != turn.seen[0]:
            turn.seen = count, now
        elif now - turn.seen[1] > STUCK:
            os.kill(turn.pid, signal.SIGKILL)
        return None
    turn.executions += count
    turn.seconds += now - turn.begun
    return os.waitstatus_to_exitcode(status)


def _log(turn: Turn) -> str:
    path = turn.folder / "log"
    return path.read_text(errors="replace") if path.exists() else ""


def _row(turn: Turn, out: Path) -> dict[str, Any]:
    found = out / turn.reader.name / "found.json"
    findings = json.loads(found.read_text()) if found.exists() else {}
    covered = re.findall(r"cov: (\d+)", _log(turn))
    return {
        "reader": turn.reader.name, "executions": turn.executions, "seconds": round(turn.seconds, 1),
        "guided": _guided(), "branches": int(covered[-1]) if covered else None,
        "findings": findings | turn.crashes,
    }  # fmt: skip


def _guided() -> bool:
    return find_spec("atheris") is not None


def _instrumented() -> Any:
    atheris: Any = import_module("atheris")
    return atheris.instrument_imports(include=[f"sagesplat.{name}" for name in FOLDERS])


def _keep(out: Path, reader: Reader, kind: str, content: bytes) -> None:
    """Keep an input that a reader fails on."""
    folder = out / reader.name
    folder.mkdir(parents=True, exist_ok=True)
    name = re.sub(r"[^\w]+", "-", kind).strip("-").lower()[:60]
    (folder / f"{name}-{sha256(content).hexdigest()[:6]}{reader.suffix}").write_bytes(content)


def _child(turn: Turn, seconds: float, out: Path, seed: int) -> None:
    """Fuzz one reader, and end the process."""
    with (turn.folder / "log").open("a") as log:  # libFuzzer's, and what a crash leaves
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("error")
    end = time.monotonic() + seconds
    with watchdog():
        target = _Target(turn, out, Random(seed))
        for content in target.seeds:
            target.execute(content, measure=True)
        if _guided():
            _by_coverage(target, turn.folder / "corpus", max(1, round(end - time.monotonic())), seed)
        while time.monotonic() < end:
            target.execute(mutate(target.rng.choice(target.samples), target.seeds, target.rng))
    os._exit(0)


class _Target:
    """A reader that is fed, and what has been found of it."""

    def __init__(self, turn: Turn, out: Path, rng: Random):
        self.reader, self.out, self.rng = turn.reader, out, rng
        self.files, large = turn.folder / "files", turn.folder / "large"
        for folder in (self.files, large):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
        self.samples = self.reader.make(self.files, 1)
        kept = (CORPUS / self.reader.name, turn.folder / "corpus")
        self.seeds = [*self.samples, *(p.read_bytes() for k in kept for p in sorted(k.glob("*")))]
        self.honest, self.large = honest_memory(self.reader, large)
        with turn.shared.open("r+b") as file:
            self._shared = mmap.mmap(file.fileno(), SHARED)
        self._found = out / self.reader.name / "found.json"
        self.findings = json.loads(self._found.read_text()) if self._found.exists() else {}
        self.count = 0

    def execute(self, content: bytes, *, measure: bool = False) -> None:
        """Read an input, and now and then a large one too."""
        self._execute(content, measure or self.count % MEASURED == 0)
        if self.count % LARGE == 0:
            self._execute(mutate(self.large, self.seeds, self.rng, 2 * len(self.large) + MOST), True)

    def _execute(self, content: bytes, measure: bool) -> None:
        self.count += 1
        # first the input, then the count: who reads it between the two sees the former count
        self._shared[8 : 16 + len(content[: SHARED - 16])] = (
            struct.pack("<Q", len(content)) + content[: SHARED - 16]
        )
        self._shared[:8] = struct.pack("<Q", self.count)
        finding = check(self.reader, self.files, content, self.honest, measure=measure)
        if finding and finding.kind not in self.findings and self._again(content, finding.kind):
            content, finding = self._smaller(content, finding)
            self.findings[finding.kind] = finding.text
            _keep(self.out, self.reader, finding.kind, content)
            self._found.write_text(json.dumps(self.findings))

    def _again(self, content: bytes, kind: str) -> Finding | None:
        """The same finding, if there is one again: others on this machine may have made it slow."""
        finding = check(self.reader, self.files, content, self.honest)
        return finding if finding and finding.kind == kind else None

    def _smaller(self, content: bytes, finding: Finding) -> tuple[bytes, Finding]:
        """A smaller input with the same finding: pieces are left out as long as it stays."""
        size, end = len(content) // 2, time.monotonic() + 3.0
        while size and time.monotonic() < end:
            at = 0
            while at < len(content) and time.monotonic() < end:
                shorter = content[:at] + content[at + size :]
                if again := self._again(shorter, finding.kind):
                    content, finding = shorter, again
                else:
                    at += size
            size //= 2
        return content, finding


def _by_coverage(target: _Target, corpus: Path, seconds: int, seed: int) -> None:
    """By libFuzzer, more than half of the time with our mutator and else with its own; ends the process."""
    atheris: Any = import_module("atheris")
    corpus.mkdir(exist_ok=True)
    for number, content in enumerate(target.seeds):
        (corpus / f"seed{number}").write_bytes(content[:MOST])

    def mutated(data: bytes, most: int, number: int) -> bytes:
        rng = Random(number)
        return mutate(data, target.seeds, rng)[:most] if rng.random() < 0.6 else atheris.Mutate(data, most)

    options = [f"-max_total_time={seconds}", f"-seed={seed + 1}", f"-max_len={MOST}", "-rss_limit_mb=0"]
    atheris.Setup(["fuzz", *options, "-timeout=600", str(corpus)], target.execute, custom_mutator=mutated)
    signal.setitimer(signal.ITIMER_REAL, 0.25, 0.25)
    atheris.Fuzz()


if __name__ == "__main__":
    _main(float(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), sys.argv[5:])
