"""How much memory a training will take, and the cap of Gaussians that keeps it within a limit."""

import ctypes
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from sagesplat.core.config import TrainConfig
from sagesplat.core.errors import RunError
from sagesplat.core.sh import num_bases
from sagesplat.scene.scene import Scene
from sagesplat.train.strategy import STRATEGIES

GIB = 2**30
_MARGIN = 0.1  # of what a machine has, left for others
_MOST_PHOTOS, _PHOTO_SHARE = GIB, 0.25  # bytes that keep photos; share of the limit
# Of a CPU, measured (docs/performance.md): the interpreter with torch and the kernels; how often a Gaussian's
# parameters are there while they are sorted or cloned; images and what a pixel's loss takes.
_BASE, _COPIES, _PIXEL = 430e6, 8, 150
_STEP = 1000  # lowered caps are multiples of this


@dataclass(frozen=True)
class Fitted:
    """A training within a memory limit. Memory in bytes."""

    config: TrainConfig  # as asked, or with a lower cap
    cap: int  # Gaussians at most, as asked
    needed: int  # at that cap, predicted
    lowered: int  # Gaussians at most, as fits; the same where all fits
    limit: int
    began: bool = False  # the cap is that of a training that resumes

    def __str__(self) -> str:
        """One line for the user."""
        needs = f"needs about {self.needed / GIB:.1f} GiB at the densification cap of {self.cap:,} Gaussians"
        if self.lowered == self.cap:
            return f"{needs}, of {self.limit / GIB:.1f}"
        why = "as training began" if self.began else f"to fit into {self.limit / GIB:.1f}"
        return f"{needs}; the cap is lowered to {self.lowered:,}, {why}"


def fit(scene: Scene, config: TrainConfig, limit: int = 0, *, processes: int = 1, began: int = 0) -> Fitted:
    """The settings with a cap that fits into `limit` bytes (0: what the machine has, but for a tenth).

    `began`: the cap of a training that resumes, which is kept: another one would change the result. RunError
    where that cap, or the initial points, do not fit.
    """
    limit = limit or default_limit()
    camera, points = scene.views[0].camera, len(scene.points.xyz)
    pixels = camera.width * camera.height
    most = max(STRATEGIES[config.strategy].max_count(config, pixels, points), points)
    fixed, each = fixed_and_each(scene, config.sh_degree, limit, processes)
    needed = int(fixed + each * most)
    room = int((limit - fixed) / each)
    lowered = began or (most if room >= most else max(room // _STEP * _STEP, points))
    if room < lowered:
        least = (fixed + each * lowered) / GIB
        raise RunError(
            f"{scene.path}: {lowered:,} Gaussians need about {least:.1f} GiB, the limit is "
            f"{limit / GIB:.1f}; raise --memory-limit, or begin a run with --downscale 2"
        )
    if lowered != most:
        config = replace(config, max_gaussians=lowered)
    return Fitted(config, most, needed, lowered, limit, began > 0)


def fixed_and_each(scene: Scene, sh_degree: int, limit: int, processes: int = 1) -> tuple[float, int]:
    """Bytes that training takes whatever it trains, and bytes for each Gaussian."""
    pixels = scene.views[0].camera.width * scene.views[0].camera.height
    photos = min(photo_cache(limit), 3 * pixels * len(scene.train_ids))
    fixed = processes * (_BASE + _PIXEL * pixels + photos)
    return fixed, processes * _COPIES * 4 * (11 + 3 * num_bases(sh_degree))


def photo_cache(limit: int = 0) -> int:
    """Bytes that may keep photos, of a limit in bytes (0: what the machine has, but for a tenth)."""
    return min(_MOST_PHOTOS, int(_PHOTO_SHARE * (limit or default_limit())))


def default_limit() -> int:
    """Bytes that this process may use: what the machine or its container has, but for a tenth."""
    return int((1 - _MARGIN) * min(_physical(), *_cgroup_limits(Path("/"))))


def _cgroup_limits(root: Path) -> list[int]:
    """Limits of the control groups (v2 and v1) that this process is in."""
    groups = root / "sys/fs/cgroup"
    found: list[int] = [sys.maxsize]
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return found
    for line in lines:
        _, kind, name = line.split(":", 2)
        if kind and "memory" not in kind.split(","):
            continue
        top, file = (groups / "memory", "memory.limit_in_bytes") if kind else (groups, "memory.max")  # v1, v2
        inner = top / name.lstrip("/")
        for folder in (inner, *inner.parents):  # the outer ones count too
            if not folder.is_relative_to(top):
                break
            try:
                found.append(int((folder / file).read_text()))
            except (OSError, ValueError):  # "max" is no number, and a container sees but its own
                continue
    return found


def _physical() -> int:
    """Bytes of memory of this machine."""
    if sys.platform == "win32":

        class Status(ctypes.Structure):
            _fields_ = [
                ("length", ctypes.c_ulong),
                ("load", ctypes.c_ulong),
                ("total", ctypes.c_ulonglong),
                ("others", ctypes.c_ulonglong * 6),
            ]

        status = Status(length=ctypes.sizeof(Status))
        ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status))
        return int(status.total)
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
