"""Everything that is owed of a machine with a GPU, in one unattended run of at most ten minutes."""

import importlib.metadata
import importlib.util
import json
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro

from benchmarks.common import GARDEN, RESULTS, rounded
from benchmarks.gpu.agreement import agreement
from benchmarks.gpu.base import Asked, Bench, Outcome, one_line
from benchmarks.gpu.runs import full, multi, race
from benchmarks.gpu.split import split
from sagesplat.core.errors import BackendUnavailable, SageError
from sagesplat.raster import Backend, cuda, resolve_backend, set_threads
from sagesplat.scene import load_scene
from sagesplat.scene.images import Photos
from sagesplat.segment.lift import lift
from sagesplat.segment.mask_files import import_masks
from sagesplat.segment.masks import Masks, Taxonomy

CHECKS: dict[str, Callable[[Bench], Outcome]] = {
    "agreement": agreement, "full": full, "race": race, "split": split, "multi": multi,
}  # fmt: skip


def main(
    scene: Path = GARDEN,
    downscale: int = 1,
    steps: int = 30_000,
    minutes: float = 9.0,
    device: Literal["cuda", "cpu"] = "cuda",
    only: tuple[str, ...] = (),
    runs: tuple[str, ...] = (),
    masks: Path | None = None,
    lpips: Path | None = None,
    out: Path | None = None,
    write: bool = False,
) -> None:
    """All checks that a machine with a GPU owes, in so many minutes; `--device cpu` tries the script.

    `runs`: the trainings of `race`, of ours, gsplat, mcmc (gsplat's, as many Gaussians as ours),
    ours-mcmc (our own), large (ours, four millions); none: all of them.
    """
    asked = Asked(scene, downscale, steps, minutes, device, only, runs, masks, lpips, out, write)
    raise SystemExit(check(asked))


def check(asked: Asked) -> int:
    """Do the checks; 0: all well, 1: some failed, 2: this machine cannot."""
    unknown = [name for name in asked.only if name not in CHECKS]
    if unknown:
        print(f"--only {unknown[0]}: no such check; choose from {', '.join(CHECKS)}", file=sys.stderr)
        return 2
    try:
        if asked.device == "cuda":
            if gap := cuda.device_gap() or cuda.version_gap():
                raise BackendUnavailable(gap)
            set_toolkit()
        backend = resolve_backend("auto", asked.device)
        set_threads(0 if asked.device == "cuda" else torch.get_num_threads())
        compiled = build() if backend == "cuda" else 0.0
        end = time.perf_counter() + 60 * asked.minutes  # compiling is not counted
        with tempfile.TemporaryDirectory() as folder:
            if asked.out is None:
                asked = replace(asked, out=Path(folder) / "out")
            bench = prepare(asked, backend, end, Path(folder) / "masks")
            machine = describe(bench, compiled)
            print(json.dumps(rounded(machine)), flush=True)
            save(bench, "machine", machine)
            outcomes = check_all(bench)
    except SageError as error:
        print(error, file=sys.stderr)
        return 2
    print()
    for name, outcome in outcomes.items():
        print(f"{name:10} {outcome.state:8} {outcome.line}")
    return int(any(outcome.state == "FAILED" for outcome in outcomes.values()))


def check_all(bench: Bench) -> dict[str, Outcome]:
    """Each check by itself."""
    outcomes: dict[str, Outcome] = {}
    for name in filter(bench.chosen, CHECKS):
        begin = time.perf_counter()
        try:
            if bench.left() <= 0:
                raise RuntimeError("no time left")
            outcomes[name] = CHECKS[name](bench)
        except Exception as error:
            outcomes[name] = Outcome("FAILED", one_line(error))
        seconds = time.perf_counter() - begin
        print(f"{name}: {outcomes[name].state} after {seconds:.0f} s, {outcomes[name].line}", flush=True)
        save(bench, name, {**vars(outcomes[name]), "check_seconds": seconds})
    return outcomes


def save(bench: Bench, name: str, figures: Mapping[str, Any]) -> None:
    """Keep figures at once: a run that is ended leaves what it has."""
    folders = [bench.asked.out] if bench.asked.out else []
    if bench.asked.write:
        folders.append(RESULTS / (slug(torch.cuda.get_device_name()) if not bench.small else "trial"))
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.json").write_text(json.dumps(rounded(figures), indent=1) + "\n")


def slug(name: str) -> str:
    """A device's name as a folder's: nvidia-h200."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def prepare(asked: Asked, backend: Backend, end: float, folder: Path) -> Bench:
    """Read the capture, all photos and its label images (normalised into `folder`)."""
    scene = load_scene(asked.scene, downscale=asked.downscale)
    photos = Photos(scene.views, 2**34)
    for row in range(len(photos)):  # no run waits for files
        photos[row]
    masks, labels = None, np.full(len(scene.points.xyz), -1, np.int16)
    source = asked.masks or asked.scene / "masks"
    try:
        import_masks(scene, source, folder)
        masks = Masks(folder, Taxonomy.read(folder / "labels.json"))
        labels = lift(scene, masks).label_ids
    except SageError as error:
        print(f"no categories: {error}")
        masks = None
    return Bench(asked, backend, end, scene, photos, masks, labels)


def describe(bench: Bench, compiled: float) -> dict[str, Any]:
    """The machine, the versions and the capture."""
    camera = bench.scene.views[0].camera
    found: dict[str, Any] = {"device": "cpu (a trial)", "torch": torch.__version__}
    found |= {"python": sys.version.split()[0], "cores": os.cpu_count(), "gsplat": cuda.gsplat_version()}
    if not bench.small:
        found |= {"device": torch.cuda.get_device_name(), "gpus": torch.cuda.device_count()}
        found |= {"memory_gib": torch.cuda.mem_get_info()[1] / 2**30, "compiled_s": compiled}
        found["triton"] = importlib.metadata.version("triton")
    found |= {"scene": bench.scene.name, "views": len(bench.scene.views)}
    found |= {"size": [camera.width, camera.height], "points": len(bench.scene.points.xyz)}
    found["labels"] = len(np.unique(bench.labels))
    return found


def set_toolkit() -> None:
    """Name the CUDA toolkit and the architecture where the environment does not: torch may guess wrongly."""
    nvcc = shutil.which("nvcc")
    places = [Path(nvcc).resolve().parents[1]] if nvcc else []
    places += [Path("/usr/local/cuda"), *sorted(Path("/usr/local").glob("cuda-*"), reverse=True)]
    places += [Path(folder) / "nvidia" / "cu13" for folder in sys.path]
    good = (p for p in places if (p / "include/cuda_runtime.h").exists() and (p / "bin/nvcc").exists())
    if not os.environ.get("CUDA_HOME") and (place := next(good, None)):
        os.environ["CUDA_HOME"] = str(place)
    os.environ.setdefault("TORCH_CUDA_ARCH_LIST", ".".join(map(str, torch.cuda.get_device_capability())))
    os.environ.setdefault("MAX_JOBS", str(os.cpu_count() or 4))


def build() -> float:
    """Seconds that gsplat's kernels took to compile or load."""
    begin = time.perf_counter()
    print(f"gsplat's kernels: CUDA_HOME {os.environ.get('CUDA_HOME')}", flush=True)
    cuda.kernels()
    seconds = time.perf_counter() - begin
    print(f"gsplat's kernels compiled or loaded in {seconds:.0f} s", flush=True)
    return seconds


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.gpu")
