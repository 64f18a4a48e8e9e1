"""LPIPS for the studies: which weights are there, and the networks that they make."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sagesplat.core.errors import SageError
from sagesplat.core.events import Emit, Warned
from sagesplat.metrics.lpips import Features, Lpips, Net, load_lpips, weights_path
from sagesplat.run.records import file_hash

NETS: tuple[Net, ...] = ("alex", "vgg")


def lpips_hashes(folder: Path | None) -> dict[str, str | None]:
    """What tells one set of LPIPS weights from another, by network."""
    paths = {net: weights_path(net, folder) for net in NETS}
    return {net: file_hash(path) if path.is_file() else None for net, path in paths.items()}


def load_metrics(emit: Emit, folder: Path | None, nets: Sequence[Net] = NETS) -> dict[str, Lpips]:
    """LPIPS as the field feeds it, by column; what cannot be loaded is left out with a warning."""
    found = {}
    for net in nets:
        try:
            found[f"lpips_{net}"] = load_lpips(net, folder, as_3dgs=net == "vgg")
        except SageError as error:
            emit(Warned(f"no LPIPS ({net}): {error}"))
    return found


def features_of(metrics: Mapping[str, Lpips], image: Float[np.ndarray, "H W 3"]) -> dict[str, Features]:
    """What each metric compares of an image, by its column."""
    return {column: metric.features(image) for column, metric in metrics.items()}
