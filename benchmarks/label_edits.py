"""Ten edits of labels applied to a finished run, promises before and after, and clicks in Chromium."""

import shutil
import statistics
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import promises_fidelity
from sagesplat.core.events import Event
from sagesplat.formats.label_edits import (
    Full,
    Hide,
    LabelEdits,
    Merge,
    Operation,
    Rename,
    Split,
    Weigh,
    dump_edits,
    ladder_hash,
)
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.segment.masks import UNLABELLED
from sagesplat.stages.label_edits import apply_labels
from sagesplat.stages.results import increments_of
from sagesplat.stages.view import show
from tests.browser import Opened, launch, open_page

CLICKS = 40
SIZE = (900, 640)  # px
_TIMES = """() => {
  window.times = [];
  let pressed = 0;
  addEventListener("pointerup", (event) => { pressed = event.timeStamp; }, true);
  new MutationObserver(() => { if (pressed) { times.push(performance.now() - pressed); pressed = 0; } })
    .observe(document.querySelector(".picked"), { childList: true, characterData: true, subtree: true });
}"""


def measure(run: Path, views: int, split: bool, say: Any = print) -> dict[str, Any]:
    """Apply ten edits to a copy of the run's results, score promises at fresh viewpoints, and click."""
    before = Job(RunDir(run), _ignored, "cpu")
    with tempfile.TemporaryDirectory(dir=run.parent) as work:
        edits, out = Path(work) / "labels.edit.json", Path(work) / "edited"
        ladder = ladder_hash(increments_of(before), before.names())
        operations = ten_edits(before, split)
        edits.write_bytes(dump_edits(LabelEdits(ladder, tuple(operations))))
        wall, cpu = time.perf_counter(), time.process_time()
        made = apply_labels(before, edits, out)
        seconds, cpu_seconds = time.perf_counter() - wall, time.process_time() - cpu
        say(f"{len(operations)} edits: {seconds:.1f} s, {cpu_seconds:.1f} s of CPU")
        result = {
            "run": run.name, "edits": len(operations), "split": split, "seconds": seconds,
            "cpu_seconds": cpu_seconds, "categories": len(made.categories),
            "clicks": clicks(made.bundle.path),
        }  # fmt: skip
        for name, path in (("before", run), ("after", out)):
            result[name] = promises(Job(RunDir(path), _ignored, "cpu"), views)
            say(f"{name}: {result[name]}")
        shutil.rmtree(out)
    return result


def ten_edits(job: Job, split: bool) -> list[Operation]:
    """Edits of every kind: of the largest categories names and settings, of the smaller ones a merge."""
    counts = {label: n for (label, level), n in job.ladder.counts.items() if level == job.ladder.levels[-1]}
    order = sorted((label for label in counts if label != UNLABELLED), key=lambda label: -counts[label])
    names = [job.names()[label] for label in order]
    a, b, c, d = names[0], names[1], names[3], names[4]
    operations: list[Operation] = [
        Rename(a, "alpha"), Weigh("alpha", 2), Full(b, True), Weigh(b, 0.5), Merge(d, c), Rename(c, "gamma"),
        Hide(b, True), Hide(b, False), Full(b, False), Rename(b, "βήτα"),
    ]  # fmt: skip
    if split:
        operations[7] = Split("gamma", "part", {c: ((0, counts[order[3]] // 3),)})
    return operations


def promises(job: Job, views: int) -> dict[str, Any]:
    """Share of the promises of fidelity that compositions at fresh viewpoints keep, by target."""
    scored = promises_fidelity.measure(job, views)["targets"]
    wanted = {f"{target:g}": scored[f"{target:g}"] for target in promises_fidelity.TARGETS}
    return {target: {"kept": row["kept"], "decisions": row["decisions"]} for target, row in wanted.items()}


def clicks(bundle: Path, count: int = CLICKS) -> dict[str, float]:
    """Milliseconds from letting the mouse go until the page says what is selected."""
    with show(bundle, print, port=0) as view:
        thread = threading.Thread(target=view.run, args=(False,))
        thread.start()
        try:
            with launch() as browser, open_page(view.urls[0], SIZE, browser=browser) as opened:
                times = _click(opened, count)
        finally:
            view.stop()
            thread.join()
    return {
        "count": len(times), "median_ms": statistics.median(times),
        "p95_ms": float(np.quantile(times, 0.95)), "max_ms": max(times),
    }  # fmt: skip


def _click(opened: Opened, count: int) -> Sequence[float]:
    page = opened.page
    opened.wait_for("window.sagesplat?.state?.().count > 0", 120)
    page.evaluate("sagesplat.set({ mode: 'full' })")
    opened.wait_for("sagesplat.state().pending === 0", 120)
    page.keyboard.press("l")
    page.wait_for_timeout(3000)
    page.evaluate(_TIMES)
    rng = np.random.default_rng(0)
    for x, y in rng.uniform([350, 60], [560, 600], (count, 2)):
        page.mouse.click(float(x), float(y))
        page.wait_for_timeout(500)
        # the next one when the light is on: software takes its time to draw
        opened.wait_for("document.querySelector('.facts').textContent.includes('idle')", 60)
    return page.evaluate("times")


def _ignored(event: Event) -> None:
    pass
