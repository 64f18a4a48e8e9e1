"""Checkpoints: the full training state in one file, from which a killed run resumes.

The previous one is kept beside it (checkpoint-1.npz), in case the newest file is damaged.
"""

import json
import os
import shutil
import time
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sagesplat.core.errors import RunError, short
from sagesplat.core.gaussians import PARAMETERS, Gaussians, checked
from sagesplat.io.files import atomic_path, sync_files
from sagesplat.io.npz import Npz
from sagesplat.train.state import SECOND, TrainState
from sagesplat.train.view_parameters import ViewParameters

_VERSION = 3
_APART = 20  # times as long as writing takes passes between two
_OF_VIEWS = ("values", "exp_avg", "exp_avg_sq", "counts")  # of `ViewParameters`
# what truncated or changed files raise
_DAMAGED = (OSError, KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError)


class _Damaged(RunError):
    """A checkpoint whose content is not what was written."""


def previous(path: Path) -> Path:
    """Where the checkpoint before that at `path` is kept."""
    return path.with_name(f"{path.stem}-1{path.suffix}")


def remove_checkpoints(path: Path) -> None:
    """Remove a checkpoint and the one before it."""
    for each in (path, previous(path)):
        each.unlink(missing_ok=True)


def can_resume(path: Path, settings: str) -> bool:
    """Whether a checkpoint is there, belongs to these settings and can be read."""
    try:
        latest_checkpoint(path, settings)
    except RunError:
        return False
    return True


def write_checkpoint(path: Path, state: TrainState, settings: str) -> None:
    """Save a state; `settings` identifies its run and is checked on reading.

    The file at `path` becomes the previous one, once the new one is on the disk and reads back as it was
    written; at no time is there none. RunError where the disk is full: then both stay as they were.
    """
    state = state.to(torch.device("cpu"))
    g = state.gaussians
    arrays = {name: p.numpy() for name, p in g.parameters().items()}
    arrays |= {f"exp_avg/{name}": moment.numpy() for name, moment in state.exp_avg.items()}
    arrays |= {f"exp_avg_sq/{name}": moment.numpy() for name, moment in state.exp_avg_sq.items()}
    if state.second_opacities is not None:
        arrays[SECOND] = state.second_opacities.numpy()
    if state.order_share is not None:
        arrays["order_share"] = state.order_share.numpy()
    arrays |= {"label_ids": g.label_ids.numpy(), "grad_sum": state.grad_sum.numpy()}
    arrays["grad_count"] = state.grad_count.numpy()
    for kind, parameters in state.per_view.items():
        arrays |= {f"view/{kind}/{name}": getattr(parameters, name).numpy() for name in _OF_VIEWS}
    meta = {
        "version": _VERSION,
        "settings": settings,
        "step": state.step,
        "last_reset": state.last_reset,
        "frozen": list(state.frozen.items()),
        "withheld": state.withheld,
        "queue": state.queue,
        "rng": state.rng.bit_generator.state,
    }
    meta["crc32"] = _checksum(meta, arrays)
    with atomic_path(path, nbytes=sum(a.nbytes for a in arrays.values())) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays, meta=np.array(json.dumps(meta)))
        _verify(temporary, path)
        _keep(path)


class Pace:
    """Keeps the writing of checkpoints below a twentieth of the time: a GPU takes 500 steps in a second."""

    def __init__(self) -> None:
        self._next = 0.0

    def due(self) -> bool:
        """Whether enough time has passed since the last one."""
        return time.monotonic() >= self._next

    def write(self, path: Path, state: TrainState, settings: str) -> None:
        """`write_checkpoint`, timed."""
        begin = time.monotonic()
        write_checkpoint(path, state, settings)
        end = time.monotonic()
        self._next = end + _APART * (end - begin)


def _checksum(meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> int:
    """CRC-32 of all that a checkpoint holds, names and shapes included."""
    crc = zlib.crc32(json.dumps({k: v for k, v in meta.items() if k != "crc32"}, sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        crc = zlib.crc32(f"{name} {array.dtype.str} {array.shape}".encode(), crc)
        crc = zlib.crc32(array.reshape(-1).view(np.uint8), crc)  # type: ignore
    return crc


def _verify(written: Path, path: Path) -> None:
    """Read a file back from the disk and compare it with the checksums of what was handed over."""
    sync_files([written])
    with written.open("rb") as file:
        if hasattr(os, "posix_fadvise"):  # else it would come from memory
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        with zipfile.ZipFile(file) as archive:
            broken = archive.testzip()  # in pieces: it takes no memory
    if broken is not None:
        raise RunError(f"{path}: {broken} does not read back as written; check the disk, then run again")


def _keep(path: Path) -> None:
    """Make the checkpoint at `path` the previous one, without taking it away from there."""
    kept = previous(path)
    if not path.exists():
        kept.unlink(missing_ok=True)  # of another training
        return
    with atomic_path(kept, sync=False) as temporary:
        temporary.unlink()
        try:
            os.link(path, temporary)
        except OSError:  # some disks have no links
            shutil.copy2(path, temporary)


def latest_checkpoint(path: Path, settings: str) -> tuple[TrainState, str]:
    """The state at `path`, or the previous one where that file is damaged, and what was wrong ("": nothing).

    RunError where both are damaged, or for other settings.
    """
    try:
        return read_checkpoint(path, settings), ""
    except _Damaged as error:
        damage, kept = str(error).partition("; ")[0], previous(path)
        if not kept.exists():
            raise
        try:
            return read_checkpoint(kept, settings), damage
        except _Damaged as older:
            reason = str(older).partition("; ")[0]
            raise RunError(
                f"{damage}, and {reason}; delete both (or add --force) to train from the start"
            ) from None


def read_checkpoint(path: Path, settings: str) -> TrainState:
    """The state that `write_checkpoint` saved for the same settings; `RunError` for anything else."""
    cure = f"delete {path.name} (or add --force) to train from the start"
    try:
        with Npz(path) as file:
            found = {name: file[name] for name in file.names if name != "meta"}
            meta = json.loads(str(file["meta"]))
            version = meta.get("version")
            intact = version != _VERSION or meta["crc32"] == _checksum(meta, found)
    except _DAMAGED as error:
        raise _Damaged(f"{path}: not a readable checkpoint ({short(error)}); {cure}") from None
    if version != _VERSION:
        raise RunError(
            f"{path}: checkpoint version {short(version)}, this sagesplat reads {_VERSION}; {cure}"
        )
    for name, array in found.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise _Damaged(f"{path}: {short(name)} holds NaN or Inf; {cure}")
    if not intact:
        raise _Damaged(f"{path}: damaged, its content does not match its checksum; {cure}")
    if meta.get("settings") != settings:
        raise RunError(f"{path}: made with other settings or inputs; {cure}")
    try:
        return _state(found, meta)
    except _DAMAGED as error:  # a checksum does not prove that the content is valid
        raise _Damaged(f"{path}: not a whole checkpoint ({short(repr(error))}); {cure}") from None


def _state(found: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> TrainState:
    """The state of a file's content; one of `_DAMAGED` where its parts do not belong together."""
    arrays = {name: torch.from_numpy(array) for name, array in found.items()}
    rng = np.random.default_rng()
    rng.bit_generator.state = meta["rng"]
    gaussians = checked(Gaussians(**{n: arrays[n] for n in PARAMETERS}, label_ids=arrays["label_ids"]))
    parameters = {name: p.shape for name, p in gaussians.parameters().items()}
    if SECOND in arrays:
        parameters[SECOND] = gaussians.logit_opacities.shape
    shapes = {f"{kind}/{n}": s for kind in ("exp_avg", "exp_avg_sq") for n, s in parameters.items()}
    shapes |= {SECOND: parameters[SECOND]} if SECOND in arrays else {}
    shapes |= dict.fromkeys(("grad_sum", "grad_count"), gaussians.logit_opacities.shape)
    shapes |= {"order_share": gaussians.logit_opacities.shape} if "order_share" in arrays else {}
    if wrong := [n for n, s in shapes.items() if arrays[n].shape != s or not arrays[n].is_floating_point()]:
        raise ValueError(f"shape of {wrong[0]}")
    numbers = [meta["step"], meta["last_reset"] + 1, *meta["queue"]]
    if not all(type(number) is int and 0 <= number < 2**31 for number in numbers):
        raise ValueError("steps or views that are none")
    return TrainState(
        gaussians=gaussians,
        exp_avg={n: arrays[f"exp_avg/{n}"] for n in parameters},
        exp_avg_sq={n: arrays[f"exp_avg_sq/{n}"] for n in parameters},
        grad_sum=arrays["grad_sum"],
        grad_count=arrays["grad_count"],
        rng=rng,
        queue=meta["queue"],
        step=meta["step"],
        last_reset=meta["last_reset"],
        frozen={int(label): int(step) for label, step in meta["frozen"]},
        withheld=int(meta["withheld"]),
        order_share=arrays.get("order_share"),
        second_opacities=arrays.get(SECOND),
        per_view=_per_view(arrays),
    )


def _per_view(arrays: Mapping[str, torch.Tensor]) -> dict[str, ViewParameters]:
    """The parameters of the views, by kind."""
    found: dict[str, ViewParameters] = {}
    for kind in sorted({name.split("/")[1] for name in arrays if name.startswith("view/")}):
        values, exp_avg, exp_avg_sq, counts = (arrays[f"view/{kind}/{name}"] for name in _OF_VIEWS)
        floats = (values, exp_avg, exp_avg_sq)
        if values.ndim != 2 or any(a.shape != values.shape or a.dtype != torch.float32 for a in floats):
            raise ValueError(f"shape of view/{kind}")
        if counts.shape != values.shape[:1] or counts.dtype != torch.int64 or (counts < 0).any():
            raise ValueError(f"counts of view/{kind}")
        found[kind] = ViewParameters(*floats, counts)
    return found
