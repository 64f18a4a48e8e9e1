"""Checkpoints: the whole training state in one file, so that a killed run goes on where it was."""

import json
import zipfile
from pathlib import Path
from tokenize import TokenError

import numpy as np
import torch

from sagesplat.errors import RunError
from sagesplat.files import atomic_path
from sagesplat.gaussians import PARAMETERS, Gaussians
from sagesplat.train.state import TrainState

_VERSION = 1


def write_checkpoint(path: Path, state: TrainState, settings: str) -> None:
    """Save a state; `settings` says what run it belongs to and is checked on reading."""
    state = state.to(torch.device("cpu"))
    g = state.gaussians
    arrays = {name: p.numpy() for name, p in g.parameters().items()}
    arrays |= {f"first/{name}": state.first[name].numpy() for name in PARAMETERS}
    arrays |= {f"second/{name}": state.second[name].numpy() for name in PARAMETERS}
    if state.place is not None:
        arrays["place"] = state.place.numpy()
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
    with atomic_path(path) as temporary:
        np.savez(
            temporary,
            allow_pickle=False,
            **arrays,
            label_ids=g.label_ids.numpy(),
            grad_sum=state.grad_sum.numpy(),
            grad_count=state.grad_count.numpy(),
            meta=np.array(json.dumps(meta)),
        )


def read_checkpoint(path: Path, settings: str) -> TrainState:
    """The state that `write_checkpoint` saved for the same settings; `RunError` for anything else."""
    cure = f"delete {path.name} (or add --force) to train from the start"
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: torch.from_numpy(file[name]) for name in file.files if name != "meta"}
            meta = json.loads(str(file["meta"]))
    except (
        OSError, EOFError, ValueError, KeyError, RuntimeError, TokenError, zipfile.BadZipFile
    ) as error:  # fmt: skip
        raise RunError(f"{path}: not a readable checkpoint ({error}); {cure}") from None
    if meta.get("version") != _VERSION:
        raise RunError(
            f"{path}: checkpoint version {meta.get('version')}, this sagesplat reads {_VERSION}; {cure}"
        )
    if meta["settings"] != settings:
        raise RunError(f"{path}: made with other settings or inputs; {cure}")
    for name, tensor in arrays.items():
        if tensor.is_floating_point() and not torch.isfinite(tensor).all():
            raise RunError(f"{path}: {name} holds NaN or Inf; {cure}")
    rng = np.random.default_rng()
    rng.bit_generator.state = meta["rng"]
    return TrainState(
        gaussians=Gaussians(**{n: arrays[n] for n in PARAMETERS}, label_ids=arrays["label_ids"]),
        first={n: arrays[f"first/{n}"] for n in PARAMETERS},
        second={n: arrays[f"second/{n}"] for n in PARAMETERS},
        grad_sum=arrays["grad_sum"],
        grad_count=arrays["grad_count"],
        rng=rng,
        queue=meta["queue"],
        step=meta["step"],
        last_reset=meta["last_reset"],
        frozen={int(label): int(step) for label, step in meta.get("frozen", ())},
        withheld=int(meta.get("withheld", 0)),
        place=arrays.get("place"),
    )
