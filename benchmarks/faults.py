"""Nothing is lost: the same result when nodes, drivers and processes are killed and when the disk is full.

Every case runs the real command in a process of its own, in the same folder (so that even files with paths in
them are the same), and what it leaves is compared with an undisturbed run, file by file, bit for bit.
"""

import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.faults_run import AGAIN, TIMES, Asked, Command, differing, digests, ends, stages, used
from sagesplat.core.errors import RunError
from sagesplat.output.table import Table

RESULTS = Path(__file__).parent / "results"
NODE = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False}
CASES = ("a", "b", "c", "d", "e", "f", "g", "h", "i", "j")
NODES = 3
FULL = re.compile(
    r"sagesplat: [^\n]*no space left, the disk is full; free [\d,]+ MB and run the same command[^\n]*\n"
)
_BEFORE = {"train": "blocks", "nest": "block_categories"}  # the stage that ends before another begins


@dataclass
class Outcome:
    """A case: what was done to it, and what became of it."""

    case: str
    against: str = "1 thread"  # the case whose seconds it is compared with
    disturbances: list[str] = field(default_factory=list)
    runs: int = 1
    seconds: float = 0.0  # of all runs
    load: float | None = None  # of the machine, by the system's count of the last minute
    again: list[str] = field(default_factory=list)  # what the runs said of work that was done again
    stages: dict[str, float] = field(default_factory=dict)  # seconds
    problems: list[str] = field(default_factory=list)  # a run that did not end as it should
    differing: list[str] = field(default_factory=list)  # files
    skipped: str = ""  # why


@contextmanager
def cluster() -> Iterator[Any]:
    """A Ray cluster of three nodes of one CPU each, as processes of this machine."""
    from ray.cluster_utils import Cluster

    # Ray lets everybody else on the machine go first, which one process alone does not
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    with tempfile.TemporaryDirectory(prefix="faults-", ignore_cleanup_errors=True) as folder:
        made: Any = Cluster(initialize_head=True, head_node_args=NODE | {"temp_dir": folder})
        try:
            for _ in range(NODES - 1):
                made.add_node(**NODE)
            yield made
        finally:
            made.shutdown()  # also ends the processes of its nodes


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
    found.seconds, found.load = time.perf_counter() - begin, os.getloadavg()[0]


def undisturbed(asked: Asked, threads: int) -> Outcome:
    """One process, with so many threads."""
    name = f"{threads} thread{'s' * (threads > 1)}"
    with timed(Outcome(name)) as found, Command(asked, f"a{threads}", f"--threads={threads}") as command:
        finish(found, command)
    return found


def on_cluster(asked: Asked) -> Outcome:
    """The same on three nodes."""
    with (
        cluster() as nodes,
        timed(Outcome(f"{NODES} nodes")) as found,
        Command(asked, "b", *_on(nodes)) as command,
    ):
        finish(found, command)
    return found


def _on(nodes: Any) -> tuple[str, ...]:
    return "--threads=1", f"--executor=ray:{nodes.address}"


def node_killed(asked: Asked, known: Outcome, number: int) -> Outcome:
    """A node that is killed during training (1), nesting (2) or either (3), and a fresh one soon after."""
    chance = random.Random(f"{asked.seed} node {number}")
    stage = ("train", "nest")[number - 1] if number < 3 else chance.choice(("train", "nest"))
    found = Outcome(f"node killed, {number} of 3", f"{NODES} nodes")
    with cluster() as nodes, timed(found), Command(asked, f"c{number}", *_on(nodes)) as command:
        command.wait_for(_BEFORE[stage])
        after = chance.uniform(0.05, 0.9) * known.stages[stage]
        if command.end(after) is None:
            nodes.remove_node(chance.choice(sorted(nodes.worker_nodes, key=id)), allow_graceful=False)
            found.disturbances.append(f"a node killed {after:.1f} s into {stage}")
            time.sleep(chance.uniform(3, 8))
            nodes.add_node(**NODE)
        finish(found, command)
    return found


def driver_killed(asked: Asked, known: Outcome) -> Outcome:
    """The process that runs the tasks, killed while the blocks are trained, and started again at once."""
    chance = random.Random(f"{asked.seed} driver")
    found = Outcome("driver killed", f"{NODES} nodes")
    with cluster() as nodes, timed(found):
        with Command(asked, "d", *_on(nodes)) as command:
            command.wait_for(_BEFORE["train"])
            after = chance.uniform(0.2, 0.9) * known.stages["train"]
            command.end(after)
            if command.kill():
                found.disturbances.append(f"killed {after:.1f} s into train")
        with Command(asked, "d", *_on(nodes)) as command:
            finish(found, command)
    return found


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Callable[[int], None]]:
    """A tmpfs of so many bytes; yields what makes it larger. RunError where that is not allowed."""
    folder.mkdir(parents=True, exist_ok=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if not shutil.which("mount") or subprocess.run(mount, capture_output=True).returncode:
        raise RunError(f"{folder}: mounting a tmpfs takes root; run as root, or leave out case e")

    def grow(size: int) -> None:
        subprocess.run(["mount", "-o", f"remount,size={size}", str(folder)], check=True)

    try:
        yield grow
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def disk_full(asked: Asked, nbytes: int, judge: Callable[[Outcome], None], ray: bool) -> Outcome:
    """A disk for a part of `nbytes`, made larger each time that it is full."""
    chance = random.Random(f"{asked.seed} disk {ray}")
    size = int(chance.uniform(0.1, 0.3) * nbytes)
    name, against = ("disk full, 3 nodes", f"{NODES} nodes") if ray else ("disk full", "1 thread")
    found = Outcome(name, against)
    try:
        with small_disk(asked.disk, size) as grow:
            if ray:
                with cluster() as nodes, timed(found):
                    _until_it_fits(asked, found, size, grow, chance, "e-ray", _on(nodes))
            else:
                with timed(found):
                    _until_it_fits(asked, found, size, grow, chance, "e", ("--threads=1",))
            judge(found)
    except RunError as error:
        found.skipped = str(error)
    return found


def _until_it_fits(
    asked: Asked, found: Outcome, size: int, grow: Callable[[int], None], chance: random.Random, name: str,
    words: tuple[str, ...],
) -> None:  # fmt: skip
    while True:
        with Command(asked, name, *words) as command:
            if command.end() != 2:
                finish(found, command)
                return
            found.again += AGAIN.findall(command.said)
            said = command.errors
        found.disturbances.append(f"full at {size:,} bytes: {said.strip()}")
        if not FULL.fullmatch(said):
            found.problems.append(f"not the line of a full disk: {said.strip()}")
            return
        size = int(size * chance.uniform(1.3, 1.8))
        grow(size)


def killed(asked: Asked, known: Outcome, judge: Callable[[Outcome], None]) -> Outcome:
    """`kill -9` again and again, at random times that spread over the whole run.

    A run that ends before all kills were used is compared, and another begins.
    """
    chance = random.Random(f"{asked.seed} kills")
    found, reached = Outcome("kill -9 at random times"), ends(known.stages)
    total = max(reached.values())
    start, done = max(0.0, known.seconds - total), 0.0  # seconds until a run begins to work; of work done
    with timed(found):
        while left := asked.kills - len(found.disturbances):
            after = chance.uniform(0, 2 * (start + (total - done) / (left + 1)))
            with Command(asked, "f", "--threads=1") as command:
                if command.end(after) is not None:
                    finish(found, command)
                    judge(found)
                    if found.problems:
                        return found
                    shutil.rmtree(asked.run)
                    found.runs, done = found.runs + 1, 0.0
                    continue
                command.kill()
                last = (["the start", *command.done])[-1]
                done = max([done, *(reached.get(name, 0.0) for name in command.done)])
                found.disturbances.append(f"after {after:.1f} s, past {last}")
                found.again += AGAIN.findall(command.said)
        with Command(asked, "f", "--threads=1") as command:
            finish(found, command)
    return found


# all of them


def measure(asked: Asked, only: tuple[str, ...], tell: Callable[[str], None]) -> dict[str, Outcome]:
    """The cases (`CASES`; none named: all), and those that OUT/faults.json has from before.

    Each is told in a line. RunError where there is no undisturbed run to compare with.
    """
    file = asked.out / "faults.json"
    before = json.loads(file.read_text()) if file.exists() else {"cases": [], "digests": {}, "bytes": 0}
    cases = {row["case"]: Outcome(**row) for row in before["cases"]}
    digest, nbytes = before["digests"], before["bytes"]

    def judge(found: Outcome) -> None:
        found.differing = sorted({*found.differing, *differing(digest, digests(asked.run))})

    def keep(found: Outcome) -> None:
        nonlocal digest, nbytes
        if found.case == "1 thread":
            digest, nbytes = digests(asked.run), used(asked.run)
            shutil.copytree(asked.run, asked.out / "undisturbed", dirs_exist_ok=True)
        if asked.run.exists():
            judge(found)
            if found.differing or found.problems:
                shutil.move(asked.run, asked.out / f"run-{found.case.replace(' ', '-')}")
        shutil.rmtree(asked.disk, ignore_errors=True)
        cases[found.case] = found
        rows = [asdict(case) for case in cases.values()]
        file.write_text(json.dumps({"cases": rows, "digests": digest, "bytes": nbytes}, indent=1) + "\n")
        tell(f"{found.case}: {found.seconds:.1f} s, {len(found.disturbances)} disturbances, {result(found)}")

    def known(case: str) -> Outcome:
        if case not in cases:
            raise RunError(f"{file}: no case '{case}' yet; run cases a and b first")
        return cases[case]

    asked.out.mkdir(parents=True, exist_ok=True)
    wanted = only or CASES
    if "a" in wanted:
        keep(undisturbed(asked, 1))
    known("1 thread")
    if "b" in wanted:
        keep(on_cluster(asked))
    if "c" in wanted:
        for number in (1, 2, 3):
            keep(node_killed(asked, known(f"{NODES} nodes"), number))
    if "d" in wanted:
        keep(driver_killed(asked, known(f"{NODES} nodes")))
    if "e" in wanted:
        for ray in (False, True):
            keep(disk_full(asked, nbytes, judge, ray))
    if "f" in wanted:
        keep(killed(asked, known("1 thread"), judge))
    from benchmarks import faults_process as process  # which takes its types from here

    if "g" in wanted:
        keep(process.signalled(asked, known("1 thread"), max(2, asked.kills // 2)))
    if "h" in wanted:
        keep(process.without_memory(asked))
    if "i" in wanted:
        keep(process.capture_changed(asked))
    if "j" in wanted:
        keep(process.bundlers(asked, asked.out / "undisturbed"))
    if "a" in wanted:
        keep(undisturbed(asked, 2))
    return cases


def _origin(asked: Asked) -> dict[str, Any]:
    """What a case was measured with and when."""
    git = ["git", "-C", str(RESULTS), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True).stdout.strip()
    command = " ".join(["python -m benchmarks", *sys.argv[1:]])
    return {
        "command": command, "commit": commit, "date": time.strftime("%Y-%m-%d"), "settings": asked.words,
    }  # fmt: skip


def _kept(file: Path, cases: Mapping[str, Outcome]) -> list[dict[str, Any]]:
    """What an earlier run measured of other cases."""
    before = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {"cases": []}
    of = {"settings": before.get("settings")}
    return [{"of": of} | row for row in before["cases"] if row["case"] not in cases]


def result(found: Outcome) -> str:
    """Whether a case ended as the undisturbed run, in words."""
    if found.skipped:
        return f"skipped: {found.skipped}"
    if found.problems:
        return found.problems[0]
    return f"no: {', '.join(found.differing[:3])}" if found.differing else "same"


def tables(scene: str, cases: Mapping[str, Outcome]) -> list[Table]:
    """What became of each case, and how much faster three nodes are by stage."""
    header = ("case", "disturbances", "seconds", "lost", "load", "done again", "same result")
    body: list[tuple[str | int | float, ...]] = []
    for case, found in cases.items():
        other = cases.get(found.against)
        lost = found.seconds - found.runs * other.seconds if other and found.disturbances else float("nan")
        load = float("nan") if found.load is None else found.load
        hit, again = len(found.disturbances), len(found.again)
        body.append((case, hit, found.seconds, lost, load, again, result(found)))
    made = [Table(f"Disturbed runs of {scene}", header, ("", "d", ".0f", ".0f", ".1f", "d", ""), body)]
    if "1 thread" in cases and f"{NODES} nodes" in cases:
        made.append(speed(cases["1 thread"], cases[f"{NODES} nodes"]))
    return made


def speed(local: Outcome, spread: Outcome) -> Table:
    """Seconds of each stage in one process and on three nodes."""
    header = ("stage", "1 thread", f"{NODES} nodes", "times faster")
    body: list[tuple[str | int | float, ...]] = []
    for name, seconds in local.stages.items():
        if name in spread.stages and "/" not in name and seconds >= 1:
            body.append((name, seconds, spread.stages[name], seconds / max(spread.stages[name], 0.05)))
    body.append(("all", local.seconds, spread.seconds, local.seconds / spread.seconds))
    return Table("Seconds by stage", header, ("", ".1f", ".1f", ".2f"), body)


def report(scene: str, asked: Asked, cases: Mapping[str, Outcome], write: bool) -> str:
    """The tables in Markdown, also as OUT/faults.md; with `write`, all as JSON in benchmarks/results."""
    text = "\n\n".join(f"**{t.title}**\n\n{t.markdown()}" for t in tables(scene, cases))
    (asked.out / "faults.md").write_text(text, encoding="utf-8")
    if write:
        file = RESULTS / f"faults-{scene}.json"
        made = {"scene": scene, "seed": asked.seed, "not_compared": TIMES}
        made["cases"] = _kept(file, cases) + [
            asdict(found) | {"result": result(found), "of": _origin(asked)} for found in cases.values()
        ]
        line = json.dumps(made, indent=1).replace(str(asked.out), "OUT")
        file.write_text(line + "\n", encoding="utf-8")
    return text
