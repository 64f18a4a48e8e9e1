"""Recorded visits of bundles (web/test/visitors.report.mjs) as flat arrays."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sagesplat.core.errors import DataError
from sagesplat.io.files import read_json

KINDS = ("viewer", "manifest", "promises", "pack", "chunk")


@dataclass(frozen=True, eq=False)
class Library:
    """Visits of some bundles: row b V + v of the visit tables is visit v of bundle b.

    Every bundle has the same V visits, of the same profiles; files are padded to the longest list.
    """

    names: tuple[str, ...]  # of the bundles
    profiles: tuple[str, ...]
    kinds: np.ndarray  # [B, F] index into KINDS, -1: padding
    sizes: np.ndarray  # [B, F] bytes over the network
    hashed: np.ndarray  # [B, F] name changes with the content: kept without asking again
    profile: np.ndarray  # [V] of each visit
    seconds: np.ndarray  # [V] that it lasts
    start: np.ndarray  # [B V + 1] first request of each visit
    at: np.ndarray  # [R] seconds since the visitor came
    file: np.ndarray  # [R]
    body: np.ndarray  # [R] bytes that a server sent
    kept: np.ndarray  # [B V, F] came whole, so that the browser has it afterwards

    @property
    def visits(self) -> int:
        """V, of each bundle."""
        return len(self.profile)

    @property
    def grows(self) -> np.ndarray:
        """[B, F] files whose bytes go with the number of Gaussians."""
        return self.kinds >= KINDS.index("pack")

    def per_visit(self) -> np.ndarray:
        """Bytes [B, V, kind] that each visit with an empty cache takes, by kind of file."""
        table = np.zeros((len(self.names), self.visits, len(KINDS)))
        row = np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))
        bundle, visit = np.divmod(row, self.visits)
        np.add.at(table, (bundle, visit, self.kinds[bundle, self.file]), self.body)
        return table


def read(paths: Sequence[Path]) -> Library:
    """Recorded visits, a file of web/test/visitors.report.mjs for each bundle; DataError for what is none.

    Where a browser stops a download, what is on its way counts: a round trip's worth at the link's
    rate, which is the most that it can be.
    """
    found = [_read_one(path) for path in paths]
    if not found:
        raise DataError("no recorded visits; give at least one file of web/test/visitors.report.mjs")
    shapes = [[(p["name"], len(p["visits"])) for p in one["profiles"]] for one in found]
    for path, shape in zip(paths, shapes, strict=True):
        if shape != shapes[0]:
            raise DataError(f"{path}: its profiles are not those of {paths[0]}; record both in the same way")
    longest = max(len(one["files"]) for one in found)
    tables = [_tables(one, longest) for one in found]
    joined = {name: np.stack([table[name] for table in tables]) for name in _PER_FILE}
    flat = {
        name: np.concatenate([table[name] for table in tables]) for name in ("at", "file", "body", "kept")
    }
    counts = np.concatenate([table["counts"] for table in tables])
    return Library(
        names=tuple(one["scene"] for one in found),
        profiles=tuple(name for name, _ in shapes[0]),
        profile=np.repeat(np.arange(len(shapes[0])), [count for _, count in shapes[0]]),
        seconds=tables[0]["seconds"],
        start=np.concatenate([[0], np.cumsum(counts)]),
        **joined,
        **flat,
    )


_PER_FILE = ("kinds", "sizes", "hashed")


def _read_one(path: Path) -> dict[str, Any]:
    one = read_json(path)
    if not isinstance(one, dict) or one.get("format") != "sagesplat-visits":
        raise DataError(f"{path}: no recorded visits; make them by node web/test/visitors.report.mjs")
    try:
        files = len(one["files"])
        known = all(f["kind"] in KINDS and f["bytes"] >= 0 and f["uri"] for f in one["files"])
        rows = [row for p in one["profiles"] for visit in p["visits"] for row in visit["requests"]]
        fine = (
            known
            and rows
            and all(ms >= 0 and 0 <= file < files and min(came, default=0) >= 0 for ms, file, *came in rows)
        )
    except (KeyError, TypeError, IndexError, ValueError):
        fine = False
    if not fine:
        raise DataError(f"{path}: its requests are damaged; record them again")
    return one


def _tables(one: dict[str, Any], longest: int) -> dict[str, np.ndarray]:
    """The arrays of one bundle; files padded with kind -1."""
    files = one["files"]
    pad = [0] * (longest - len(files))
    kinds = np.array([KINDS.index(f["kind"]) for f in files] + [-1 for _ in pad])
    sizes = np.array([f["bytes"] for f in files] + pad, np.int64)
    page = np.array([f["uri"].startswith("assets/") for f in files] + pad, bool)
    hashed = (kinds >= KINDS.index("promises")) | page  # not so: index.html, poster.jpg, manifest.json
    visits = [(p, visit) for p in one["profiles"] for visit in p["visits"]]
    kept = np.zeros((len(visits), longest), bool)
    at, file, body = [], [], []
    for row, (profile, visit) in enumerate(visits):
        on_the_way = int(profile["mbit"] * 125 * profile["latencyMs"])  # bytes sent before a server hears
        for ms, index, *part in visit["requests"]:
            size = int(sizes[index])
            came, asked = (*part, size, size)[:2]  # left out where they are all of the file
            at.append(ms / 1000)
            file.append(index)
            body.append(min(came + on_the_way, asked))
            kept[row, index] |= came == size
    return {
        "kinds": kinds,
        "sizes": sizes,
        "hashed": hashed,
        "seconds": np.array([visit["seconds"] for _, visit in visits]),
        "counts": np.array([len(visit["requests"]) for _, visit in visits]),
        "at": np.array(at),
        "file": np.array(file, np.int64),
        "body": np.array(body, np.int64),
        "kept": kept,
    }
