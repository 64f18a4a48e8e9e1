""".splat files (antimatter15): 32 bytes a Gaussian, no header, no harmonics.

12   x y z, float32
12   scales, float32: standard deviations
4    r g b and opacity, times 255
4    rotation w x y z, times 128, plus 128
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from sagesplat.core.errors import DataError
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.sh import C0, sh0_to_rgb
from sagesplat.formats.labels import write_or_remove_labels
from sagesplat.formats.quantisation import logits_of_bytes
from sagesplat.formats.splat import Splat, SplatReader, SplatWriter, check_writable
from sagesplat.io.files import atomic_path

_ROW = np.dtype(
    [("means", "<f4", 3), ("scales", "<f4", 3), ("rgb", "u1", 3), ("alpha", "u1"), ("quat", "u1", 4)]
)


def read_dotsplat(path: Path) -> Splat:
    """Read a .splat file. Opacities of 0 and 255 become those a quarter of a step further inside.

    DataError if it cannot be read or is no whole number of rows: there is no header to check.
    """
    try:
        rows, rest = divmod(path.stat().st_size, _ROW.itemsize)
        if rest:
            raise DataError(
                f"{path}: {rest} bytes after {rows} Gaussians; the file is truncated, copy it again"
            )
        table: np.ndarray = np.fromfile(path, _ROW)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); give a .splat") from None
    with np.errstate(all="ignore"):  # scales of zero or less: such Gaussians are dropped
        log_scales = np.log(table["scales"])
    sh0 = ((table["rgb"] / np.float32(255) - 0.5) / C0).astype(np.float32)
    g = Gaussians(
        means=torch.from_numpy(table["means"].astype(np.float32)),
        quats=torch.from_numpy((table["quat"].astype(np.float32) - 128) / 128),
        log_scales=torch.from_numpy(log_scales.astype(np.float32)),
        logit_opacities=torch.from_numpy(logits_of_bytes(table["alpha"])),
        sh0=torch.from_numpy(sh0[:, None]),
        shN=torch.zeros(len(table), 0, 3),
        label_ids=torch.full((len(table),), -1, dtype=torch.int16),
    )
    return Splat(g, ".splat")


def write_dotsplat(
    path: Path,
    g: Gaussians,
    names: Mapping[int, str] | None = None,
    *,
    parents: Mapping[int, str] | None = None,
) -> None:
    """Write a .splat file atomically, rows as they are, without harmonics; labels go beside it.

    Colours and opacities are rounded to 1/255, components of rotations to 1/128. DataError for NaN or Inf, or
    a quaternion of zeros.
    """
    g = g.detach().to("cpu")
    check_writable(g, str(path))
    table: np.ndarray = np.empty(len(g), _ROW)
    table["means"], table["scales"] = g.means.numpy(), g.log_scales.exp().numpy()
    table["rgb"] = (sh0_to_rgb(g.sh0[:, 0]).clamp(0, 1) * 255).round().numpy()
    table["alpha"] = (torch.sigmoid(g.logit_opacities) * 255).round().numpy()
    table["quat"] = (torch.nn.functional.normalize(g.quats) * 128 + 128).round().clamp(0, 255).numpy()
    with atomic_path(path) as temporary:
        table.tofile(temporary)
        write_or_remove_labels(path, g.label_ids, names or {}, parents or {})


READER = SplatReader(lambda path, _: read_dotsplat(path), suffix=".splat")
WRITER = SplatWriter(
    lambda path, g, names, parents, _: write_dotsplat(path, g, names, parents=parents),
    antialiases=False,
    sh_degree=0,
)
