"""Ctrl-C in every stage of a run: seconds until a line answers and until the end; what a repeat gives."""

import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.faults_run import differing, digests
from sagesplat.io.files import read_json

# the program, which says on SIGUSR1 where it is
_PROGRAM = (
    "import faulthandler, signal, sys; faulthandler.register(signal.SIGUSR1, all_threads=False)\n"
    "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a shell's background jobs ignore it
    "sys.argv[0] = 'sagesplat'; from sagesplat.__main__ import program; program()"
)
ANSWER = 0.5  # seconds within which Ctrl-C is to be answered
_LONGEST = 60.0  # seconds after which a process that was interrupted counts as hanging
_LINE = re.compile(r"^sagesplat: interrupted; [^\n]+$", re.MULTILINE)
_AT = re.compile(r'^  File "(?:.*/)?([^"/]+/[^"/]+)", line (\d+) in (\w+)$', re.MULTILINE)
_QUIET = (".lock", "photos.json")
_NESTED = ("nested/ladder.npz", "nested/increments", "nested/checkpoint*")


@dataclass(frozen=True)
class Case:
    """A command that makes part of a finished run again, once what it makes is removed."""

    words: tuple[str, ...]  # RUN, SCENE and OUT stand for the folders
    removed: tuple[str, ...]  # patterns below the run folder; provenance/X.json with the stage's name X


@dataclass
class Found:
    """What a case showed."""

    seconds: float = 0.0  # of the command, undisturbed
    answers: list[float] = field(default_factory=list)  # seconds from the signal to the line
    ends: list[float] = field(default_factory=list)  # seconds from the signal to the end of the process
    late: list[str] = field(default_factory=list)  # where the process was when it answered late
    problems: list[str] = field(default_factory=list)


def _stage(name: str, *removed: str, command: str = "") -> Case:
    where = () if name in ("lift", "train", "clean", "masks", "segment") else ("nested/",)
    folder = "".join(where)
    return Case((command or name, "RUN"), (f"{folder}provenance/{name}.json", *removed))


CASES = {
    "help": Case(("run", "--help"), ()),
    "info": Case(("info", "SCENE"), ()),
    "masks": Case(
        ("masks", "SCENE", "RUN"), ("provenance/segment.json", "provenance/masks.json", "masks", "segmented")
    ),
    "lift": _stage("lift", "labels.npz"),
    "train": _stage("train", "levels", "checkpoint*"),
    "clean": _stage("clean", "cleaned.npz"),
    # without the record the settings would be the defaults
    "base": Case(("nest", "RUN"), ("nested/base.npz", *_NESTED)),
    "nest": Case(("nest", "RUN"), _NESTED),
    "observe": _stage("observe", "nested/observations.csv"),
    "sample": _stage("sample", "nested/fidelity.npz"),
    "fit": _stage("fit", "nested/models.json", "nested/promises.json"),
    "plan": _stage("plan", "nested/plan.json"),
    "compose": _stage("compose", "nested/composed.ply"),
    "evaluate": _stage("evaluate", "nested/evaluation.csv"),
    "report": _stage("report", "nested/report"),
    "bundle": Case(("bundle", "RUN", "OUT/bundle"), ()),
    "export": Case(("export", "RUN", "OUT/export.ply"), ()),
    "run": Case(("run", "SCENE", "RUN"), ("*",)),
}  # fmt: skip


def measure(
    run: Path, names: tuple[str, ...], moments: int, seed: int, say: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """Interrupt the commands that made a run, each at several moments from its start to its end.

    Args:
        run: Finished run; copies of it are worked on.
        names: Of `CASES`.
        moments: Interrupts of each command.
        seed: Of the moments.
        say: Gets a line for each command.
    """
    chance, results = random.Random(seed), {}
    scene = Path(read_json(run / "scene.json")["path"])
    for name in names:
        with tempfile.TemporaryDirectory(dir=run.parent) as folder:
            found = _interrupted(CASES[name], run, scene, Path(folder), moments, chance)
        results[name] = {
            "seconds": found.seconds, "answer_s": max(found.answers, default=None),
            "end_s": max(found.ends, default=None), "late": found.late, "problems": found.problems,
        }  # fmt: skip
        say(
            f"{name:9} {found.seconds:6.1f} s  {len(found.ends)} interrupts, answered within"
            f" {max(found.answers, default=0):.2f} s, ended within {max(found.ends, default=0):.2f} s"
        )
        for line in (*found.late, *found.problems):
            say(f"{'':10}{line}")
    return results


def _interrupted(
    case: Case, finished: Path, scene: Path, folder: Path, moments: int, chance: random.Random
) -> Found:
    found, run = Found(), folder / "run"
    words = [str(scene) if word == "SCENE" else word for word in case.words]
    words = [word.replace("OUT", str(folder)) if word.startswith("OUT") else word for word in words]
    words = [str(run) if word == "RUN" else word for word in words]
    _begin(finished, run, case)
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, *words], capture_output=True, text=True, check=False
    )
    found.seconds = time.perf_counter() - begin
    if done.returncode:
        found.problems.append(f"undisturbed: exit code {done.returncode}: {done.stderr.strip()[-300:]}")
        return found
    expected = _digests(run)
    _begin(finished, run, case)
    for number in range(moments):
        # one in each part of the command, from its imports to its last files; it goes on where it was stopped
        after = (number + chance.random()) / moments * found.seconds
        if number:
            _begin(finished, run, case)
        _interrupt(found, words, max(0.1, after))
    again = subprocess.run(
        [sys.executable, "-c", _PROGRAM, *words], capture_output=True, text=True, check=False
    )
    if again.returncode:
        found.problems.append(f"repeated: exit code {again.returncode}: {again.stderr.strip()[-300:]}")
    found.problems += [f"repeated: {path} differs" for path in differing(expected, _digests(run))]
    found.problems += [f"{path.name} was left" for path in folder.rglob(".*.tmp-*")]
    return found


def _begin(finished: Path, run: Path, case: Case) -> None:
    """A copy of the finished run without what the command makes, and nothing beside it."""
    _remove(run.parent.iterdir())
    shutil.copytree(finished, run)
    for pattern in case.removed:
        _remove(run.glob(pattern))


def _remove(paths: Iterable[Path]) -> None:
    for path in list(paths):
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def _digests(run: Path) -> dict[str, str]:
    return {path: digest for path, digest in digests(run).items() if Path(path).name not in _QUIET}


def _interrupt(found: Found, words: list[str], after: float) -> None:
    """Start the command, send SIGINT after some seconds, and see when it answers and ends."""
    with subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as process:
        try:
            process.wait(after)
        except subprocess.TimeoutExpired:
            pass
        else:
            return  # it was faster this time
        process.send_signal(signal.SIGUSR1)
        time.sleep(0.005)
        begin = time.perf_counter()
        process.send_signal(signal.SIGINT)
        text, answered = "", None
        for text in _errors(process):
            if answered is None and _LINE.search(text):
                answered = time.perf_counter() - begin
        code, took = process.wait(), time.perf_counter() - begin
    where = _place(text)
    rest = [line for line in text.splitlines() if line.startswith(("Traceback", "sagesplat:", "Exception"))]
    rest = [line for line in rest if not line.startswith("sagesplat: settings of ")]  # said at its start
    if code == 0:
        return  # it was about to end
    if code != 2 or answered is None or len(rest) != 1:
        found.problems.append(f"after {after:.1f} s: exit code {code}: {' | '.join(text.splitlines()[-3:])}")
        return
    found.answers.append(answered)
    found.ends.append(took)
    if took > ANSWER:
        found.late.append(f"{answered:.2f} s to answer, {took:.2f} s to end, after {after:.1f} s at {where}")


def _errors(process: "subprocess.Popen[bytes]") -> Iterator[str]:
    """All that the process has printed to standard error, whenever there is more, until it ends."""
    assert process.stderr is not None
    text, deadline = b"", time.perf_counter() + _LONGEST
    while part := process.stderr.read1(4096):  # type: ignore[attr-defined]
        text += part
        yield text.decode(errors="replace")
        if time.perf_counter() > deadline:
            process.kill()


def _place(text: str) -> str:
    """The innermost frames that faulthandler printed, ours among them."""
    frames = [f"{file}:{line} {name}" for file, line, name in _AT.findall(text)]
    return " < ".join(frames[:4])
