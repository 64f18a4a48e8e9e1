"""One reader in a process of its own: inputs, by coverage or at random, and what is found of them."""

import json
import mmap
import os
import re
import resource
import shutil
import signal
import struct
import time
import warnings
from hashlib import sha256
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from random import Random
from typing import Any

from tests.fuzz.hostile import Finding, Reader, check, honest_memory, watchdog
from tests.fuzz.mutate import MOST, mutate

CORPUS = Path(__file__).parents[1] / "data" / "hostile"
MEMORY = 16 * 2**30  # bytes of address space; torch takes some of them for itself
MEASURED = 32  # of so many inputs one has its memory measured in Python, which takes time
LARGE = 512  # of so many inputs one is a damaged copy of a large file
SHARED = 2**22  # bytes of what a process shares with the one that watches it


def guided() -> bool:
    """Whether atheris is installed."""
    return find_spec("atheris") is not None


def progress(folder: Path) -> tuple[int, bytes]:
    """Executions of the process of a reader's folder, and its last input: what is there after a crash."""
    with (folder / "shared").open("rb") as file:
        count, length = struct.unpack("<QQ", file.read(16))
        return count, file.read(length)


def keep(out: Path, reader: Reader, kind: str, content: bytes) -> None:
    """Keep an input that a reader fails on."""
    folder = out / reader.name
    folder.mkdir(parents=True, exist_ok=True)
    name = re.sub(r"[^\w]+", "-", kind).strip("-").lower()[:60]
    (folder / f"{name}-{sha256(content).hexdigest()[:6]}{reader.suffix}").write_bytes(content)


def fuzz_reader(reader: Reader, folder: Path, seconds: float, out: Path, seed: int) -> None:
    """Fuzz one reader for a time, and end the process.

    `folder` is the reader's: it gets what the reader needs and a log. Files that it fails on go to `out`.
    """
    with (folder / "log").open("a") as log:  # libFuzzer's, and what a crash leaves
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("error")
    end = time.monotonic() + seconds
    with watchdog():
        target = _Target(reader, folder, out, Random(seed))
        for content in target.seeds:
            target.execute(content, measure=True)
        if guided():
            _by_coverage(target, folder / "corpus", max(1, round(end - time.monotonic())), seed)
        while time.monotonic() < end:
            target.execute(mutate(target.rng.choice(target.samples), target.seeds, target.rng))
    os._exit(0)


class _Target:
    """A reader that is fed, and what has been found of it."""

    def __init__(self, reader: Reader, folder: Path, out: Path, rng: Random):
        self.reader, self.out, self.rng = reader, out, rng
        self.files, large = folder / "files", folder / "large"
        for made in (self.files, large):
            shutil.rmtree(made, ignore_errors=True)
            made.mkdir()
        self.samples = self.reader.make(self.files, 1)
        kept = sorted((CORPUS / self.reader.name).glob("*"))
        self.seeds = [*self.samples, *(path.read_bytes() for path in kept)]
        self.honest, self.large = honest_memory(self.reader, large)
        with (folder / "shared").open("r+b") as file:
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
            keep(self.out, self.reader, finding.kind, content)
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

    options = [f"-max_total_time={seconds}", f"-seed={seed + 1}", f"-max_len={MOST}", "-rss_limit_mb=0",
        f"-artifact_prefix={corpus.parent}/"]  # fmt: skip
    atheris.Setup(["fuzz", *options, "-timeout=600", str(corpus)], target.execute, custom_mutator=mutated)
    signal.setitimer(signal.ITIMER_REAL, 0.25, 0.25)
    atheris.Fuzz()
