"""Checks of this machine, printed by `sagesplat doctor`."""

import importlib.metadata
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from rich.console import Console
from rich.text import Text

from sagesplat import __version__
from sagesplat.cli.say import say
from sagesplat.core.errors import SageError
from sagesplat.core.extras import install
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.names import visible
from sagesplat.metrics.lpips import weights_path
from sagesplat.raster import Backend, cuda, rasterize
from sagesplat.scene.scene import Camera

# Of a small picture and its gradients, against the float64 reference; a GPU computes with fast math.
_TOLERANCES = {"cpu": 1e-4, "cuda": 1e-3}
_REPAIRS = {
    "cpu": f"{install('--force-reinstall', 'numba', 'llvmlite')}; "
    "delete numba's cache (*.nbi in sagesplat's folder)",
    "cuda": "delete gsplat_cuda in ~/.cache/torch_extensions, then sagesplat doctor --build",
}
EXTRAS = {  # of pyproject.toml: a package of each, and what it is for; `cuda` is checked by itself
    "poses": ("pycolmap", "poses from photos"),
    "hf": ("transformers", "segmentation by networks of Hugging Face"),
    "onnx": ("onnxruntime", "segmentation by ONNX networks"),
    "view": ("starlette", "the server of the viewer"),
    "video": ("av", "frames of a video"),
    "heic": ("pi-heif", "photos of iPhones"),
    "ray": ("ray", "clusters"),
}

_MARKS = {"fine": ("✓", "green"), "gap": ("·", "yellow"), "broken": ("✗", "red")}


@dataclass(frozen=True)
class Finding:
    """The result of one check. state "gap": something optional is missing, and `cure` says how to get it."""

    part: str
    state: Literal["fine", "gap", "broken"]
    text: str
    cure: str = ""


def examine(build: bool = False) -> list[Finding]:
    """Run all checks; with `build`, gsplat's kernels are compiled first."""
    return [
        Finding("python", "fine", f"{platform.python_version()} on {platform.system()} {platform.machine()}"),
        Finding("sagesplat", "fine", f"{__version__} in {Path(__file__).parents[1]}"),
        Finding("torch", "fine", f"{torch.__version__}, CUDA {torch.version.cuda or 'not built in'}"),
        processor(),
        memory(),
        kernels("cpu"),
        *gpus(),
        compiler(),
        gsplat(),
        gsplat_kernels(build),
        *(extra(name, *package) for name, package in EXTRAS.items()),
        lpips(),
    ]


def is_well(findings: Sequence[Finding]) -> bool:
    """Whether everything that is installed works; missing optional parts do not count."""
    return all(finding.state != "broken" for finding in findings)


def unbuilt(findings: Sequence[Finding]) -> str:
    """Why gsplat's kernels could not be compiled, and the cure; empty where they are."""
    gaps = [f for f in findings if f.part == "cuda kernels" and f.state != "fine"]
    return "; ".join(text for f in gaps for text in (f.text, f.cure) if text)


def processor() -> Finding:
    """Name, cores and vector width of the CPU, as numba sees them."""
    import llvmlite.binding as llvm
    from numba.core import config

    features = llvm.get_host_cpu_features()
    widths = (("avx512f", "512 bit (AVX-512)"), ("avx2", "256 bit (AVX2)"), ("neon", "128 bit (NEON)"))
    vectors = next((text for name, text in widths if features.get(name)), "128 bit or less")
    threads = config.NUMBA_NUM_THREADS  # type: ignore
    text = f"{llvm.get_host_cpu_name()}, {os.cpu_count()} cores, {threads} threads used, vectors of {vectors}"
    return Finding("cpu", "fine", text)


def memory() -> Finding:
    """Memory of the machine, and what of it is unused."""
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # Windows; macOS tells no free pages
        return Finding("memory", "fine", "the system does not say")
    return Finding("memory", "fine", f"{total / 2**30:.1f} GiB, {free / 2**30:.1f} GiB unused")


def kernels(backend: Literal["cpu", "cuda"]) -> Finding:
    """Whether the kernels of a backend compile and render what the reference renders."""
    part, began = f"{backend} kernels", time.monotonic()
    try:
        error = _error(backend)
    except Exception as problem:  # whatever it is, it is what this is for
        text = f"{type(problem).__name__}: {' '.join(str(problem).split())}"
        return Finding(part, "broken", text, _REPAIRS[backend])
    seconds = time.monotonic() - began
    if not error <= _TOLERANCES[backend]:
        text = f"pictures and gradients differ from the reference by {error:.1e}"
        return Finding(part, "broken", text, _REPAIRS[backend])
    text = f"agree with the reference to {error:.0e}, forward and backward in {seconds:.1f} s"
    return Finding(part, "fine", text)


def _error(backend: Literal["cpu", "cuda"]) -> float:
    """Largest difference from the reference, over a small render and its normalised gradients."""
    generator = torch.Generator().manual_seed(0)
    w2c = np.eye(4, dtype=np.float32)
    K = np.array([[40, 0, 20], [0, 40, 12], [0, 0, 1]], np.float32)
    results = []
    backends: tuple[tuple[Backend, str], ...] = (("reference", "cpu"), (backend, backend))
    for name, device in backends:
        generator.manual_seed(0)
        means = torch.randn(50, 3, generator=generator) * 0.6 + torch.tensor([0.0, 0.0, 4.0])
        values = [torch.randn(50, *shape, generator=generator) for shape in ((4,), (3,), (), (1, 3), (15, 3))]
        quats, log_scales, logits, sh0, shN = values
        leaves = [means, quats, log_scales * 0.3 - 2.5, logits - 1, sh0, shN * 0.1]
        leaves = [leaf.to(device).requires_grad_() for leaf in leaves]
        labels = torch.zeros(50, dtype=torch.int16, device=device)
        gaussians = Gaussians(*leaves, label_ids=labels)
        render = rasterize(gaussians, Camera(w2c, K, 40, 24), backend=name)
        render.rgb.square().sum().backward()
        gradients = [leaf.grad for leaf in leaves if leaf.grad is not None]
        results.append([render.rgb.detach(), *(g / g.abs().max().clamp_min(1e-9) for g in gradients)])
    pairs = zip(*results, strict=True)
    return max(float((a.double().cpu() - b.double().cpu()).abs().max()) for a, b in pairs)


def gpus() -> list[Finding]:
    """The CUDA devices, or why there are none."""
    gap = cuda.device_gap()
    if gap is not None:
        text, _, cure = gap.partition("; ")
        return [Finding("gpu", "gap", text, cure)]
    found = []
    for index in range(torch.cuda.device_count()):
        card = torch.cuda.get_device_properties(index)
        text = (
            f"{card.name}, {card.total_memory / 2**30:.0f} GiB, compute capability {card.major}.{card.minor}"
        )
        found.append(Finding(f"gpu {index}", "fine", f"{text}, driver {_driver()}"))
    return found


def _driver() -> str:
    asked = _output("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader")
    return asked.partition("\n")[0] or "unknown"


def _output(*words: str) -> str:
    """Standard output of a program; empty if it is not installed or fails."""
    if shutil.which(words[0]) is None:
        return ""
    try:
        return subprocess.run(words, capture_output=True, text=True, timeout=20, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""


def compiler() -> Finding:
    """The CUDA compiler, which gsplat needs to compile its kernels."""
    nvcc = cuda.nvcc()
    if nvcc is None:
        if cuda.compiled() is not None:
            return Finding("nvcc", "fine", "none, and none needed: gsplat's kernels are compiled")
        return Finding("nvcc", "gap", "no CUDA compiler", "install the CUDA toolkit and set CUDA_HOME")
    version = _output(str(nvcc), "--version")
    release = version.partition("release ")[2].partition(",")[0] or "of unknown version"
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    root = Path(home) if home else nvcc.resolve().parents[1]
    if not (root / "include" / "cuda_runtime.h").exists():  # a wrapper on the PATH: torch would guess wrong
        cure = "set CUDA_HOME to the toolkit's folder, the one that holds include/cuda_runtime.h"
        return Finding("nvcc", "gap", f"{release} at {nvcc}, but no toolkit at {root}", cure)
    return Finding("nvcc", "fine", f"{release} at {nvcc}, toolkit at {root}")


def gsplat() -> Finding:
    """The gsplat package."""
    gap = cuda.version_gap()
    if gap is not None:
        text, _, cure = gap.partition("; ")
        return Finding("gsplat", "gap", text, cure)
    return Finding("gsplat", "fine", str(cuda.gsplat_version()))


def gsplat_kernels(build: bool) -> Finding:
    """Whether gsplat's kernels can be used, are compiled, and render what the reference renders."""
    gap = cuda.missing()
    if gap is not None:
        text, _, cure = gap.partition("; ")
        return Finding("cuda kernels", "gap", text, cure)
    if cuda.compiled() is None and not build:
        cure = "the first use takes about a minute; sagesplat doctor --build does it now"
        return Finding("cuda kernels", "gap", "not compiled yet", cure)
    if build:
        try:
            with redirect_stdout(sys.stderr):  # gsplat tells how it goes; standard output may be JSON
                cuda.kernels()
        except SageError as problem:
            say(*str(problem.__cause__ or "").splitlines(), file=sys.stderr)
            return Finding("cuda kernels", "gap", str(problem), "read what the compiler printed above")
    return kernels("cuda")


def extra(name: str, package: str, use: str) -> Finding:
    """An optional package."""
    try:
        return Finding(name, "fine", f"{package} {importlib.metadata.version(package)}")
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, "gap", f"no {package}, for {use}", install(f"sagesplat[{name}]"))


def lpips() -> Finding:
    """The weights of the perceptual metric."""
    path = weights_path("vgg")
    if path.exists():
        return Finding("lpips", "fine", str(path))
    return Finding("lpips", "gap", "no weights, for the perceptual metric", "sagesplat download lpips")


def as_json(findings: Sequence[Finding]) -> str:
    """All findings as JSON, with whether everything works."""
    return json.dumps({"well": is_well(findings), "findings": [asdict(f) for f in findings]}, indent=1)


def print_findings(findings: Sequence[Finding], out: Console | None = None) -> None:
    """Print a line per finding, and its cure below where something is missing."""
    out = out or Console(highlight=False, file=sys.stdout)
    width = max(len(finding.part) for finding in findings)
    for finding in findings:
        text = visible(f" {finding.part:{width}}  {finding.text}")
        out.print(Text.assemble(_MARKS[finding.state], text), soft_wrap=True)
        if finding.cure:
            out.print(Text(f"  {'':{width}}  ").append(visible(f"→ {finding.cure}"), "dim"), soft_wrap=True)
