"""`python -m tests.fuzz [READER ...]`: damaged files for every reader, in a process each.

Nothing that happens in the process of a reader ends the run: one that crashes or hangs is a finding, and
another goes on. Inputs are guided by coverage where atheris is installed, else random.
"""

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import nullcontext
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import tyro

from tests.fuzz.fuzz_reader import SHARED, fuzz_reader, guided, keep, progress
from tests.fuzz.hostile import Reader

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results" / "fuzz.json"
# Seconds without an execution after which a process is killed: decoders in C cannot be interrupted.
STUCK = 30.0
# Folders that coverage is measured in. Compiled kernels cannot be measured; what draws or trains need not be.
FOLDERS = (
    "adapt", "core", "download", "formats", "io", "run", "scene", "segment", "stages", "studies", "train",
    "viewer",
)  # fmt: skip


@dataclass
class Turn:
    """A reader, and what has been done with it."""

    reader: Reader
    folder: Path  # of what it needs, its log and its count
    left: float  # seconds that it has
    executions: int = 0
    seconds: float = 0.0
    pid: int = 0
    begun: float = 0.0
    seen: tuple[int, float] = (0, 0.0)  # executions, and when there were as many
    crashes: dict[str, str] = field(default_factory=dict)

    @property
    def log(self) -> str:
        """What its processes printed."""
        path = self.folder / "log"
        return path.read_text(errors="replace") if path.exists() else ""


def main(
    readers: tyro.conf.Positional[tuple[str, ...]] = (),
    *,
    seconds: float = 720,
    out: Path = Path("fuzz-findings"),
    seed: int = 0,
    jobs: int = 2,
    write: bool = False,
) -> None:
    """Damaged files for every reader, guided by coverage where atheris is installed; fails on findings.

    Args:
        readers: names (none: all; tests/fuzz/readers lists them).
        seconds: of all readers together, in `jobs` processes.
        out: folder for the files that a reader fails on.
        seed: of the random numbers.
        jobs: processes.
        write: keep the figures in benchmarks/results/fuzz.json.
    """
    instrumented: Any = nullcontext()
    if guided():
        atheris: Any = import_module("atheris")
        instrumented = atheris.instrument_imports(include=[f"sagesplat.{name}" for name in FOLDERS])
    with instrumented:
        from tests.fuzz.readers import READERS
    if unknown := set(readers) - {reader.name for reader in READERS}:
        raise SystemExit(f"no reader {', '.join(unknown)}; tests/fuzz/readers lists them")
    wanted = [reader for reader in READERS if not readers or reader.name in readers]
    memory = Path("/dev/shm") if Path("/dev/shm").is_dir() else None
    with tempfile.TemporaryDirectory(dir=memory) as folder:
        turns = [Turn(one, Path(folder) / one.name, seconds * jobs / len(wanted)) for one in wanted]
        run(turns, out, seed, jobs)
        rows = [_row(turn, out) for turn in turns]
    found = sum(len(row["findings"]) for row in rows)
    executions = sum(row["executions"] for row in rows)
    result = {"executions": executions, "findings": found, "readers": len(rows), "guided": guided()}
    result |= {"seconds": seconds, "jobs": jobs}
    print(json.dumps(result))
    if write:
        _write(result, rows)
    if found:
        raise SystemExit(f"{found} findings; the files are in {out}")


def run(turns: list[Turn], out: Path, seed: int, jobs: int) -> None:
    """Fuzz each reader for its time, at most `jobs` at once; files that one fails on go to `out`/READER."""
    waiting, running = list(turns), list[Turn]()
    while waiting or running:
        while waiting and len(running) < jobs:
            running.append(waiting.pop(0))
            _start(running[-1], out, seed)
        time.sleep(0.1)
        for turn in list(running):
            code = _ended(turn)
            if code is None:
                continue
            running.remove(turn)
            if code:
                kind = "hang" if code == -signal.SIGKILL else "crash"
                turn.crashes[kind] = f"exit code {code}: {turn.log[-300:]}"
                keep(out, turn.reader, kind, progress(turn.folder)[1])
                if turn.left > 1:
                    seed += 1000
                    waiting.insert(0, turn)


def _start(turn: Turn, out: Path, seed: int) -> None:
    turn.folder.mkdir(exist_ok=True)
    (turn.folder / "shared").write_bytes(bytes(SHARED))
    turn.begun = time.monotonic()
    turn.seen = 0, turn.begun
    turn.pid = os.fork()
    if not turn.pid:
        try:
            fuzz_reader(turn.reader, turn.folder, turn.left, out, seed)
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
    turn.left -= now - turn.begun
    return os.waitstatus_to_exitcode(status)


def _row(turn: Turn, out: Path) -> dict[str, Any]:
    """Figures of a reader, which are printed."""
    found = out / turn.reader.name / "found.json"
    findings = (json.loads(found.read_text()) if found.exists() else {}) | turn.crashes
    covered = re.findall(r"cov: (\d+)", turn.log)
    row = {
        "reader": turn.reader.name, "executions": turn.executions, "seconds": round(turn.seconds, 1),
        "branches": int(covered[-1]) if covered else None, "findings": findings,
    }  # fmt: skip
    print(f"{row['reader']:20} {turn.executions:>10,} in {turn.seconds:>6.1f} s", flush=True)
    for text in findings.values():
        print(f"    {text}")
    return row


def _write(result: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    """Keep a run's figures, a reader on each line, with what they are of."""
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout
    command = " ".join(["python -m tests.fuzz", *sys.argv[1:]])
    origin = {"command": command, "commit": commit.strip(), "date": time.strftime("%Y-%m-%d")}
    lines = ",\n".join(json.dumps(row) for row in rows)
    RESULTS.write_text(f'{json.dumps(origin | result)[:-1]}, "by_reader": [\n{lines}\n]}}\n')


if __name__ == "__main__":
    tyro.cli(main, prog="python -m tests.fuzz")
