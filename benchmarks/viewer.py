"""A bundle over slow networks: bytes and seconds to the first picture, to a target, and in all."""

import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro

from benchmarks.common import finish
from sagesplat.stages.view import show
from tests.browser import Opened, launch, open_page

NETWORKS = (1.6, 10.0, 50.0)  # Mbit/s
LATENCY = 100.0  # ms
TARGETS = (0.8, 0.9, 0.95)  # of fidelity
_QUIET = 1.5  # seconds without a change after which nothing more comes
_STATE = """() => {
  const view = window.sagesplat
  if (!view?.state?.()) return null
  const { count, pending, status, bytesLoaded, labels } = view.state()
  return {
    count, pending, status, bytesLoaded,
    cells: labels.flatMap(({ cells, visible, expected, error }) =>
      cells.map(({ cell, shown, wanted }) => ({ shown, wanted, visible, error,
        expected: Number.isFinite(expected) ? expected : null, last: cell.levels.length }))),
  }
}"""


def measure(bundle: Path, networks: Sequence[float] = NETWORKS, seconds: float = 180.0) -> dict[str, Any]:
    """Loads of a bundle with empty caches, by network: one for each target and one of everything."""
    with show(bundle, print, port=0) as view:
        thread = threading.Thread(target=view.run, args=(False,))
        thread.start()
        try:
            with launch() as browser:
                rows = [
                    _load(browser, view.urls[0], mbit, target, seconds)
                    for mbit in networks
                    for target in (*TARGETS, None)
                ]
        finally:
            view.stop()
            thread.join()
    return {"bundle": bundle.name, "latency_ms": LATENCY, "loads": rows}


def _load(browser: Any, url: str, mbit: float, target: float | None, seconds: float) -> dict[str, Any]:
    """One load: of what a target needs, or of everything (None)."""
    asked = "" if target is None else f"&target={target}"
    row: dict[str, Any] = {"mbit": mbit, "target": target, "first": None, "done": None}
    with open_page(f"{url}?ui=0{asked}", browser=browser, network=(mbit, LATENCY), wait="commit") as opened:
        received = _count_bytes(opened)
        begin = changed = time.perf_counter()
        if target is None:
            _ask_for_everything(opened, seconds)
        before, curve = None, []
        while (now := time.perf_counter()) - begin < seconds:
            state = opened.page.evaluate(_STATE)
            if state and state != before:
                before, changed = state, now
                mark = [now - begin, sum(received.values())]
                curve.append([*mark, state["bytesLoaded"], _ssim(state)])
                if row["first"] is None and state["count"] and all(s["shown"] for s in state["cells"]):
                    row["first"] = mark
                row["done"] = mark if _complete(state, target) else None
            if row["done"] and now - changed > _QUIET:
                break
            opened.page.wait_for_timeout(50)
        row |= {"status": before and before["status"], "complaints": opened.complaints, "curve": curve}
    return row


def _count_bytes(opened: Opened) -> dict[str, int]:
    """Bytes received over the network so far, by request."""
    by_request: dict[str, int] = {}

    def part(event: dict[str, Any]) -> None:
        by_request[event["requestId"]] = by_request.get(event["requestId"], 0) + event["encodedDataLength"]

    def whole(event: dict[str, Any]) -> None:  # with headers
        by_request[event["requestId"]] = int(event["encodedDataLength"])

    session = opened.cdp()
    session.on("Network.dataReceived", part)
    session.on("Network.loadingFinished", whole)
    session.send("Network.enable")
    return by_request


def _ask_for_everything(opened: Opened, seconds: float) -> None:
    opened.wait_for("Boolean(window.sagesplat)", seconds)
    opened.page.evaluate("window.sagesplat.ready.then(() => window.sagesplat.set({ mode: 'full' }))")


def _complete(state: dict[str, Any], target: float | None) -> bool:
    if state["pending"] or state["status"] == "loading":
        return False
    return all(
        s["error"] or s["shown"] >= (s["last"] if target is None else s["wanted"]) for s in state["cells"]
    )


def _ssim(state: dict[str, Any]) -> float | None:
    """Expected quality of what is shown, mean over the cells of the categories in sight."""
    told = [s["expected"] for s in state["cells"] if s["visible"] and s["expected"] is not None]
    return sum(told) / len(told) if told else None


def table(result: dict[str, Any]) -> str:
    """Markdown: a row for each network and target; bytes are of everything, the viewer included."""
    lines = [
        "| Mbit/s | target | first picture | | complete | | status |",
        "|---:|---:|---:|---:|---:|---:|---|",
    ]
    for row in result["loads"]:
        first, done = (
            f"{mark[0]:.1f} s | {mark[1] / 1e6:.2f} MB" if mark else "– | –"
            for mark in (row["first"], row["done"])
        )
        target = "all" if row["target"] is None else f"{row['target']:g}"
        lines.append(f"| {row['mbit']:g} | {target} | {first} | {done} | {row['status']} |")
    return "\n".join(lines)


def main(bundle: Path, write: bool = False) -> None:
    """A bundle in Chromium at 1.6, 10, 50 Mbit/s: bytes and seconds to the first picture and to targets.

    Args:
        bundle: folder of the bundle.
        write: keep the figures in benchmarks/results/cpu.
    """
    result = measure(bundle)
    print(table(result))
    finish("viewer", result, write)


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.viewer")
