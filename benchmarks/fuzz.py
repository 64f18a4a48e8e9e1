"""Damaged files for every reader: guided by coverage where atheris is installed, else at random.

Readers take turns in a process each, so that nothing that happens there ends the run: two at a time, and two
turns each. The first is short and says how fast a reader is. The rest of the time goes to the readers that
are fast, and what is slow gets enough for `ENOUGH` executions. The second turn begins with the inputs that
reached something new in the first, and measures the memory that each of them takes.
"""

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks.fuzz_reader import SHARED, fuzz_reader, guided, keep, progress
from benchmarks.hostile import Reader

ENOUGH = 20_000  # executions of a reader that is slow
SLOW = 1000  # executions per second below which a reader is
# seconds without an execution after which a process is killed: decoders in C cannot be interrupted
STUCK = 30.0
# Compiled kernels cannot be measured, and what draws or trains need not be
FOLDERS = (
    "adapt", "core", "download", "formats", "io", "run", "scene", "segment", "stages", "studies", "train",
    "viewer",
)  # fmt: skip


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


def run(
    seconds: float, readers: tuple[str, ...], out: Path, seed: int = 0, jobs: int = 2
) -> Iterator[dict[str, Any]]:
    """Fuzz readers (none: all) for a time in `jobs` processes; files that one fails on go to `out`/READER.

    A row for each: reader, executions, seconds, whether coverage guided, branches covered (None without),
    findings by kind.
    """
    words = [str(seconds), str(out), str(seed), str(jobs), *readers]
    command = [sys.executable, "-m", "benchmarks.fuzz", *words]
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
    with _instrumented() if guided() else nullcontext():
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
                content = progress(turn.folder)[1]
                kind = "hang" if code == -signal.SIGKILL else "crash"
                turn.crashes[kind] = f"exit code {code}: {_log(turn)[-300:]}"
                keep(out, turn.reader, kind, content)
                if (rest := turn.ends - time.monotonic()) > 1:
                    seed += 1000
                    waiting.insert(0, (turn, rest))


def _start(turn: Turn, seconds: float, out: Path, seed: int) -> None:
    turn.folder.mkdir(exist_ok=True)
    (turn.folder / "shared").write_bytes(bytes(SHARED))
    turn.begun = time.monotonic()
    turn.ends, turn.seen = turn.begun + seconds, (0, turn.begun)
    turn.pid = os.fork()
    if not turn.pid:
        try:
            fuzz_reader(turn.reader, turn.folder, seconds, out, seed)
        finally:
            os._exit(70)


def _ended(turn: Turn) -> int | None:
    """The exit code of a reader's process, None while it runs; kills one that is stuck."""
    pid, status = os.waitpid(turn.pid, os.WNOHANG)
    now, count = time.monotonic(), progress(turn.folder)[0]
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
        "guided": guided(), "branches": int(covered[-1]) if covered else None,
        "findings": findings | turn.crashes,
    }  # fmt: skip


def _instrumented() -> Any:
    atheris: Any = import_module("atheris")
    return atheris.instrument_imports(include=[f"sagesplat.{name}" for name in FOLDERS])


if __name__ == "__main__":
    _main(float(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), sys.argv[5:])
