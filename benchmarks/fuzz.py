"""Damaged files for every reader: guided by coverage where atheris is installed, else at random.

A process for each reader, so that nothing that happens there ends the run.
"""

import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from hashlib import sha256
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from random import Random
from typing import Any

from benchmarks.hostile import Reader, check
from benchmarks.mutate import mutate

CORPUS = Path(__file__).parents[1] / "tests" / "data" / "hostile"
MEMORY = 16 * 2**30  # bytes of address space; torch takes some of them for itself
# What is measured; compiled kernels cannot be
MODULES = [
    "core.errors", "core.gaussians", "io.files", "io.npz", "io.columns", "io.ply_header",
    "download.remote_zip", "formats.ply", "formats.spz", "formats.increments", "formats.levels",
    "scene.blocks", "scene.stored",
    "scene.colmap", "scene.colmap_read", "scene.loading", "scene.nerfstudio", "scene.points",
    "scene.undistort", "segment.coco", "segment.masks", "segment.onnx", "segment.soft", "segment.lift",
    "segment.taxonomies", "train.checkpoint", "adapt.ladder", "adapt.eq3", "adapt.plan", "adapt.viewpoint",
    "studies.sweep.file",
]  # fmt: skip


def run(seconds: float, only: tuple[str, ...], out: Path, seed: int = 0) -> Iterator[dict[str, Any]]:
    """Fuzz the readers, each for its share of the time; files that a reader fails on go to `out`/READER.

    A row for each: reader, executions, branches covered (None without atheris), findings by kind.
    """
    command = [sys.executable, "-m", "benchmarks.fuzz", str(seconds), str(out), str(seed), *only]
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


def _main(seconds: float, out: Path, seed: int, only: list[str]) -> None:
    """Print the rows of `run`. Imports once, then forks for each reader."""
    with _instrumented() if _guided() else nullcontext():
        from benchmarks.hostile_readers import READERS
    readers = [reader for reader in READERS if not only or reader.name in only]
    for reader in readers:
        folder = out / reader.name
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as temporary:
            child = os.fork()
            if not child:
                _child(reader, seconds / len(readers), folder, Path(temporary), seed)
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(json.dumps(_row(reader.name, folder, code)), flush=True)


def _row(name: str, folder: Path, code: int) -> dict[str, Any]:
    found = json.loads((folder / "found.json").read_text())
    log = (folder / "log").read_text(errors="replace")
    if code:
        found["findings"]["crash"] = f"exit code {code}: {log[-300:]}"
        (folder / "last").rename(folder / "crash")
    else:
        (folder / "last").unlink()
    if covered := re.findall(r"cov: (\d+)", log):
        found["branches"] = int(covered[-1])
    return {"reader": name, "executions": 0, "branches": None, **found}


def _guided() -> bool:
    return find_spec("atheris") is not None


def _instrumented() -> Any:
    atheris: Any = import_module("atheris")
    return atheris.instrument_imports(include=[f"sagesplat.{name}" for name in MODULES])


def _child(reader: Reader, seconds: float, out: Path, temporary: Path, seed: int) -> None:
    """Fuzz one reader, and end the process."""
    with (out / "log").open("w") as log:  # libFuzzer's, and what a crash leaves
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    folder, findings, executions = temporary / "files", {}, 0
    folder.mkdir()
    samples = reader.make(folder)
    seeds = [*samples, *(path.read_bytes() for path in sorted((CORPUS / reader.name).glob("*")))]

    def execute(content: bytes) -> None:
        nonlocal executions
        executions += 1
        (out / "last").write_bytes(content)  # what is there after a crash
        finding = check(reader, folder, content)
        if finding and finding.kind not in findings:
            findings[finding.kind] = finding.text
            (out / f"{sha256(content).hexdigest()[:12]}{reader.suffix}").write_bytes(content)
        if finding or executions % 50 == 1:
            (out / "found.json").write_text(json.dumps({"executions": executions, "findings": findings}))

    end = time.monotonic() + seconds
    for content in seeds:
        execute(content)
    if _guided():
        corpus = temporary / "corpus"
        corpus.mkdir()
        for number, content in enumerate(seeds):
            (corpus / str(number)).write_bytes(content)
        _by_coverage(execute, corpus, seeds, max(1, round(end - time.monotonic())), seed)
    rng = Random(seed)
    while time.monotonic() < end:
        execute(mutate(rng.choice(samples), seeds, rng))
    os._exit(0)


def _by_coverage(
    execute: Callable[[bytes], None], corpus: Path, seeds: list[bytes], seconds: int, seed: int
) -> None:
    """By libFuzzer, more than half of the time with our mutator and else with its own; ends the process."""
    atheris: Any = import_module("atheris")

    def mutated(data: bytes, most: int, number: int) -> bytes:
        rng = Random(number)
        return mutate(data, seeds, rng)[:most] if rng.random() < 0.6 else atheris.Mutate(data, most)

    options = [f"-max_total_time={seconds}", f"-seed={seed + 1}", "-max_len=20000", "-rss_limit_mb=0"]
    atheris.Setup(["fuzz", *options, "-timeout=60", str(corpus)], execute, custom_mutator=mutated)
    atheris.Fuzz()


if __name__ == "__main__":
    _main(float(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])
