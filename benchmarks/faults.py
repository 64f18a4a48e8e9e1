"""Nothing is lost: the same result when nodes, drivers and processes are killed.

Every case runs the real command in a process of its own, in the same folder (so that even files with paths in
them are the same), and what it leaves is compared with an undisturbed run, file by file, bit for bit.
"""

import json
import os
import random
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import tyro

from benchmarks.common import RESULTS, origin
from benchmarks.faults_run import (
    AGAIN,
    TIMES,
    Asked,
    Command,
    Outcome,
    differing,
    digests,
    ends,
    finish,
    settings,
    timed,
)
from sagesplat.core.errors import RunError, SageError
from sagesplat.demo.capture import cached_capture
from sagesplat.output.table import Table

NODE = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False}
CASES = ("a", "b", "c", "d", "e")
NODES = 3
_BEFORE = {"train": "blocks", "nest": "train"}  # the stage that ends before another begins


def main(
    scene: tyro.conf.Positional[str],
    *,
    out: Path,
    only: tuple[Literal["a", "b", "c", "d", "e"], ...] = (),
    downscale: int = 1,
    steps: int = 300,
    nest_steps: int = 100,
    levels: int = 4,
    kills: int = 20,
    seed: int = 0,
    write: bool = False,
) -> None:
    """Nodes, drivers and runs killed at random: the same result, and what it costs.

    Args:
        scene: a capture, or demo for the built-in one.
        out: folder for the runs, what they print, faults.json and faults.md.
        only: cases: undisturbed (a), on three nodes (b), nodes killed (c), driver killed (d),
            run killed again and again (e).
        downscale: times smaller photos.
        steps: of the training of each block.
        nest_steps: of its nested ladder, and of the small model that this begins with.
        levels: of the ladder.
        kills: of case e.
        seed: of the random moments.
        write: also put the result into benchmarks/results.
    """
    capture = cached_capture() if scene == "demo" else Path(scene).absolute()
    words = settings(downscale, steps, nest_steps, levels)
    asked = Asked(capture, out.absolute(), words, kills, seed)
    try:
        cases = measure(asked, only or CASES, lambda line: print(line, flush=True))
    except SageError as error:
        raise SystemExit(str(error)) from None
    name = scene if scene == "demo" else capture.name
    text = "\n\n".join(f"**{t.title}**\n\n{t.markdown()}" for t in tables(name, cases))
    (asked.out / "faults.md").write_text(text, encoding="utf-8")
    print(text)
    if write:
        rows = [asdict(found) | {"result": found.result} for found in cases.values()]
        made = {"scene": name, "seed": seed, "settings": words, "not_compared": TIMES, "cases": rows}
        line = json.dumps(made, indent=1).replace(str(asked.out), "OUT")
        (RESULTS / f"faults-{name}.json").write_text(line + "\n", encoding="utf-8")


def measure(asked: Asked, wanted: Sequence[str], tell: Callable[[str], None]) -> dict[str, Outcome]:
    """The cases (of `CASES`), and those that OUT/faults.json has from before.

    Each is told in a line. RunError where there is no undisturbed run to compare with.
    """
    file = asked.out / "faults.json"
    before: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {"cases": [], "digests": {}}
    cases = {row["case"]: Outcome(**row) for row in before["cases"]}
    digest = before["digests"]

    def judge(found: Outcome) -> None:
        found.differing = sorted({*found.differing, *differing(digest, digests(asked.run))})

    def keep(found: Outcome) -> None:
        nonlocal digest
        if found.case == "1 thread":
            digest = digests(asked.run)
        if asked.run.exists():
            judge(found)
            if found.differing or found.problems:
                shutil.move(asked.run, asked.out / f"run-{found.case.replace(' ', '-')}")
        shutil.rmtree(asked.run, ignore_errors=True)
        found.of = origin()
        cases[found.case] = found
        rows = [asdict(case) for case in cases.values()]
        file.write_text(json.dumps({"cases": rows, "digests": digest}, indent=1) + "\n")
        tell(f"{found.case}: {found.seconds:.1f} s, {len(found.disturbances)} disturbances, {found.result}")

    def known(case: str) -> Outcome:
        if case not in cases:
            raise RunError(f"{file}: no case '{case}' yet; run cases a and b first")
        return cases[case]

    asked.out.mkdir(parents=True, exist_ok=True)
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
        keep(killed(asked, known("1 thread"), judge))
    if "a" in wanted:
        keep(undisturbed(asked, 2))
    return cases


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
            with Command(asked, "e", "--threads=1") as command:
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
        with Command(asked, "e", "--threads=1") as command:
            finish(found, command)
    return found


def tables(scene: str, cases: Mapping[str, Outcome]) -> list[Table]:
    """What became of each case, and how much faster three nodes are by stage."""
    header = ("case", "disturbances", "seconds", "lost", "done again", "same result")
    body: list[tuple[str | int | float, ...]] = []
    for case, found in cases.items():
        other = cases.get(found.against)
        lost = found.seconds - found.runs * other.seconds if other and found.disturbances else float("nan")
        hit, again = len(found.disturbances), len(found.again)
        body.append((case, hit, found.seconds, lost, again, found.result))
    made = [Table(f"Disturbed runs of {scene}", header, ("", "d", ".0f", ".0f", "d", ""), body)]
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


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.faults")
