"""Downloads the published weights of LPIPS into the cache."""

import errno
import hashlib
import http.client
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from urllib.request import Request, urlopen

import numpy as np

from sagesplat.core.errors import BackendUnavailable, DataError, RunError, short
from sagesplat.io.files import atomic_path
from sagesplat.io.tensors import read_tensors
from sagesplat.metrics.lpips import Net, checked, load_lpips, shapes, weights_path

TIMEOUT = 30  # seconds without data
MAX_HEADS, MAX_BACKBONE = 10**6, 10**9  # bytes of what is downloaded; 6 KB and 528 MB are published

OnProgress = Callable[[str, int, int], None]  # name of a file, bytes done, all bytes (0 = unknown)


@dataclass(frozen=True)
class Source:
    """Where the weights of a network are published, as PyTorch state dicts."""

    backbone: str  # URL: torchvision's network
    sha256: str  # of that file
    convolutions: tuple[int, ...]  # their indices in the network's `features`
    heads: str  # URL: LPIPS's weights of the channels
    heads_sha256: str  # of that file, as in the package lpips 0.1.4


_TORCHVISION = "https://download.pytorch.org/models"
_LPIPS = "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1"
SOURCES: Mapping[Net, Source] = {
    "alex": Source(
        f"{_TORCHVISION}/alexnet-owt-7be5be79.pth",
        "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02",
        (0, 3, 6, 8, 10),
        f"{_LPIPS}/alex.pth",
        "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
    ),
    "vgg": Source(
        f"{_TORCHVISION}/vgg16-397923af.pth",
        "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
        (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28),
        f"{_LPIPS}/vgg.pth",
        "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
    ),
}


def download_lpips(
    folder: Path | None = None,
    nets: Sequence[Net] = ("alex", "vgg"),
    on_progress: OnProgress | None = None,
    *,
    sources: Mapping[Net, Source] = SOURCES,
) -> list[Path]:
    """Download the weights that `load_lpips` does not find in `folder` (default: the cache); their paths.

    Downloads 233 MB (alex) and 528 MB (vgg) and keeps the convolutions: 10 and 59 MB, as lpips_{net}.npz.
    Files are checked and written atomically. `on_progress` is called after each MB. Raises DataError for a
    failed or unexpected download, and RunError if `folder` cannot be written.
    """
    paths = [weights_path(net, folder) for net in nets]
    for net, path in zip(nets, paths, strict=True):
        with suppress(BackendUnavailable, DataError):
            load_lpips(net, path)
            continue
        try:
            with atomic_path(path) as temporary:
                np.savez(
                    temporary, allow_pickle=False, **_fetch_weights(net, path, sources[net], on_progress)
                )
        except OSError as error:
            reason = error.strerror or error
            raise RunError(f"{path}: cannot be written ({reason}); name another folder") from error
    return paths


def _fetch_weights(
    net: Net, path: Path, source: Source, on_progress: OnProgress | None
) -> dict[str, np.ndarray]:
    """The arrays of `path`. Downloads are kept in unnamed temporary files beside it."""
    layers = [(k, n, part) for k, n in enumerate(source.convolutions) for part in ("weight", "bias")]
    backbone = {f"conv{k}.{part}": f"features.{n}.{part}" for k, n, part in layers}
    heads = {f"lin{k}": f"lin{k}.model.1.weight" for k in range(5)}  # [1, C, 1, 1]
    both = " and ".join(weights_path(each, path.parent).name for each in SOURCES)
    cure = f"try again, or copy {both} from another machine to {path.parent}, or give --lpips FOLDER"
    expected, weights = shapes(net), {}
    files = (
        (source.heads, source.heads_sha256, heads, MAX_HEADS),
        (source.backbone, source.sha256, backbone, MAX_BACKBONE),
    )
    for url, sha256, keys, most in files:
        with tempfile.TemporaryFile(dir=path.parent) as file:
            try:
                digest = _fetch(url, file, most, on_progress)
            except (OSError, ValueError, http.client.HTTPException) as error:  # ValueError: of redirects
                if getattr(error, "errno", None) == errno.ENOSPC:
                    raise
                raise DataError(f"{url}: cannot be downloaded ({short(error)}); {cure}") from None
            if digest != sha256:  # before anything of the file is read
                raise DataError(f"{url}: not the file that was published (its SHA-256 is another); {cure}")
            try:
                state = read_tensors(file)
                for name, key in keys.items():
                    weights[name] = checked(name, state[key].detach().squeeze().numpy(), expected[name])
            except Exception as error:  # torch has a class of its own for each kind of failure
                reason = str(error).partition("\n")[0].partition(". ")[0]
                raise DataError(f"{url}: not the weights of LPIPS {net} ({reason}); {cure}") from None
    return weights


def _fetch(url: str, file: IO[bytes], most: int, on_progress: OnProgress | None) -> str:
    """Download `url`, at most `most` bytes, into `file`; the SHA-256 of the content.

    Raises OSError, HTTPException or ValueError.
    """
    digest, done = hashlib.sha256(), 0
    request = Request(url, headers={"User-Agent": "sagesplat"})  # some servers refuse Python's default
    with urlopen(request, timeout=TIMEOUT) as response:
        length = response.headers["Content-Length"] or ""
        total = int(length) if re.fullmatch(r"[0-9]{1,18}", length) else 0
        while block := response.read(1 << 20):
            file.write(block)
            digest.update(block)
            done += len(block)
            if done > most:
                raise OSError(f"more than {most / 1e6:g} MB")
            if on_progress is not None:
                on_progress(url.rpartition("/")[2], done, total)
    if done < total:
        raise OSError(f"ends after {done} of {total} bytes")
    file.flush()  # it is read through a memory map
    file.seek(0)
    return digest.hexdigest()
