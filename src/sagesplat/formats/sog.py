"""SOG, PlayCanvas's splats as lossless WebP images: versions 1 and 2, in a folder or a .sog archive.

`meta.json` names the images. Row i of the scene is pixel i, row by row, of each; 8 bits a channel:

    means_l, means_u    low and high byte of sign(x) ln(1 + |x|) between the scene's smallest and largest
    quats               three components times sqrt(2), in [-1, 1]; alpha - 252: which of w x y z is largest,
                        positive and omitted
    scales              rows of a codebook of log scales (version 1: between the smallest and largest)
    sh0                 rows of a codebook of sh0; alpha: opacity (version 1: ranges, opacity as logit)
    shN_labels          red and green: low and high byte of a row of the palette
    shN_centroids       the palette, 64 rows in each row of pixels: rows of a codebook (version 1: a range)
"""

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sagesplat.core.errors import DataError, short
from sagesplat.core.gaussians import Gaussians
from sagesplat.core.sh import BASES
from sagesplat.formats.quantisation import largest_restored, logits_of_bytes
from sagesplat.formats.splat import Splat, SplatReader
from sagesplat.io.files import loads_json, regular
from sagesplat.io.pictures import PictureError, open_picture

META = "meta.json"
_CURE = "convert the scene again"
_SUITS = 4  # times its Gaussians, and `_FREE`, is what an image may have of pixels
_FREE = 2**14
_PER_BYTE = 64  # Gaussians for each byte of the images, beyond _FREE; the low bytes of positions are noise
_PALETTE = 2**16  # rows, at most
_PER_ROW = 64  # of the palette, in a row of pixels
_EXPANDS = 100  # times its packed size is what meta.json may have in an archive; images do not shrink

Load = Callable[[str], bytes]


def read_sog(path: Path) -> Splat:
    """Read a SOG scene: its `meta.json`, or the .sog archive of that and the images.

    Opacities of 0 and 255 become those a quarter of a step further inside, as in `decode_spz`. DataError
    where something is missing, damaged, or does not fit together.
    """
    try:
        with path.open("rb") as file:
            packed = file.read(2) == b"PK"
        if packed:
            with zipfile.ZipFile(path) as archive:
                return _read(path, lambda name: _member(archive, name))
        return _read(path, lambda name: regular(path.parent / name if name != META else path).read_bytes())
    except DataError:
        raise
    except (OSError, KeyError) as error:
        reason = getattr(error, "strerror", None) or short(error)
        name = Path(getattr(error, "filename", None) or path).name
        raise DataError(f"{path}: {name} cannot be read ({reason}); {_CURE}") from None
    except Exception as error:  # zipfile and zlib raise errors of many kinds for damaged files
        raise DataError(f"{path}: not a SOG scene ({short(error)}); {_CURE}") from None


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    info = archive.getinfo(name)
    allowed = info.compress_size * (_EXPANDS if name == META else 1) + 1024
    if info.file_size > allowed:
        raise ValueError(f"{name} unpacks to {info.file_size:,} bytes")
    return archive.read(info)


def _read(path: Path, load: Load) -> Splat:
    meta = loads_json(load(META))
    first = not isinstance(meta, dict) or "version" not in meta
    count = meta["means"]["shape"][0] if first else meta["count"]
    if type(count) is not int or count < 0 or (not first and meta["version"] != 2):
        raise ValueError(f"version {meta.get('version', 1)!r:.20}, {count!r:.20} Gaussians")
    parts = ["means", "scales", "quats", "sh0"] + ["shN"] * bool(meta.get("shN"))
    files = {part: [load(_plain(name)) for name in meta[part]["files"]] for part in parts}
    if count > max(_FREE, _PER_BYTE * sum(len(content) for part in files.values() for content in part)):
        raise ValueError(f"{count:,} Gaussians announced, more than fit")
    images = {part: [_image(content, count) for content in files[part]] for part in parts if part != "shN"}
    with np.errstate(all="ignore"):  # values out of range become infinite; such Gaussians are dropped
        values = _values(meta, images, first)
        values["shN"] = np.zeros((count, 0, 3), np.float32)
        if "shN" in files:
            values["shN"] = _harmonics(meta["shN"], files["shN"], count, first)
    tensors = {
        name: torch.from_numpy(np.ascontiguousarray(value, np.float32)) for name, value in values.items()
    }
    g = Gaussians(**tensors, label_ids=torch.full((count,), -1, dtype=torch.int16))
    antialiased = meta.get("antialias") is True or meta.get("model") == "antialiased"
    return Splat(g, "SOG 1" if first else "SOG", antialiased=antialiased)


def _plain(name: Any) -> str:
    """A file name of meta.json; ValueError for a path."""
    if not isinstance(name, str) or not name or name.startswith(".") or set(name) & set("/\\:\0"):
        raise ValueError(f"{name!r:.60} is no file name")
    return name


def _image(content: bytes, count: int) -> np.ndarray:
    """The first `count` pixels, uint8 [count, 4]."""
    return _pixels(content, count, _SUITS * count).reshape(-1, 4)[:count]


def _pixels(content: bytes, least: int, most: int) -> np.ndarray:
    """An image's pixels, uint8 [h, w, 4]; ValueError unless it has from `least` to `most` of them, or few."""
    most = max(most, _FREE)
    try:
        with open_picture(content, ("WEBP",), free=most) as image:
            if not least <= image.width * image.height <= most:
                raise PictureError(f"{image.width} x {image.height} pixels for {least} Gaussians")
            return np.asarray(image.convert("RGBA"))
    except PictureError as error:
        raise ValueError(f"an image: {error.reason}") from None


def _values(meta: dict[str, Any], images: dict[str, list[np.ndarray]], first: bool) -> dict[str, np.ndarray]:
    low, high = images["means"]
    (scales,), (quats,), (sh0,) = images["scales"], images["quats"], images["sh0"]
    fixed = low[:, :3].astype(np.uint16) | high[:, :3].astype(np.uint16) << 8
    logs = _ranged(meta["means"], fixed, 65535, 3)
    rotations = largest_restored(quats[:, 3] & 3, (quats[:, :3] / 127.5 - 1) / 2**0.5)
    rotations[quats[:, 3] < 252] = [1, 0, 0, 0]  # as other readers have it
    if first:
        colours = _ranged(meta["sh0"], sh0, 255, 4)
        log_scales, opacities = _ranged(meta["scales"], scales[:, :3], 255, 3), colours[:, 3]
    else:
        colours, opacities = _codebook(meta["sh0"])[sh0[:, :3]], logits_of_bytes(sh0[:, 3])
        log_scales = _codebook(meta["scales"])[scales[:, :3]]
    means = np.sign(logs) * np.expm1(np.abs(logs))
    return {
        "means": means, "quats": rotations, "log_scales": log_scales, "logit_opacities": opacities,
        "sh0": colours[:, None, :3],
    }  # fmt: skip


def _ranged(part: dict[str, Any], values: np.ndarray, most: int, width: int) -> np.ndarray:
    low, high = (_numbers(part[end], width) for end in ("mins", "maxs"))
    return low + (high - low) * (values / most)


def _codebook(part: dict[str, Any]) -> np.ndarray:
    """256 values, float32; NaN after the last one."""
    values = _numbers(part["codebook"], None)
    if len(values) > 256:
        raise ValueError(f"a codebook of {len(values)} values")
    return np.append(values, np.full(256 - len(values), np.nan)).astype(np.float32)


def _numbers(values: Any, width: int | None) -> np.ndarray:
    """A list of numbers as float64 [width]; ValueError for anything else. Null, as JSON has NaN, is NaN."""
    if not isinstance(values, list) or width not in (None, len(values)):
        raise ValueError(f"{values!r:.60} in place of {width or 'some'} numbers")
    if not all(value is None or type(value) in (int, float) for value in values):
        raise ValueError(f"{values!r:.60} in place of numbers")
    return np.array([np.nan if value is None else float(value) for value in values])


def _harmonics(part: dict[str, Any], files: list[bytes], count: int, first: bool) -> np.ndarray:
    """SH coefficients, float32 [count, K, 3]."""
    packed, labels = files
    centroids = _pixels(packed, 0, _PER_BYTE * len(packed))
    bases, odd = divmod(centroids.shape[1], _PER_ROW)
    if odd or bases not in BASES[1:] or (not first and part["bands"] != BASES.index(bases)):
        raise ValueError(
            f"{centroids.shape[1]} pixels in a row of the palette, {part.get('bands')!r:.20} bands"
        )
    palette = centroids.reshape(-1, bases, 4)[:_PALETTE, :, :3]
    pixels = _image(labels, count)
    rows = pixels[:, 0].astype(np.int64) | pixels[:, 1].astype(np.int64) << 8
    if len(rows) and rows.max() >= len(palette):
        raise ValueError(f"row {rows.max()} of a palette of {len(palette)}")
    if first:
        low, high = (_numbers([part[end]], 1)[0] for end in ("mins", "maxs"))
        codebook = (low + (high - low) * np.arange(256) / 255).astype(np.float32)
    else:
        codebook = _codebook(part)
    return codebook[palette[rows]]


READER = SplatReader(lambda path, _: read_sog(path), magic=(b"PK\x03\x04",), json_key="means", in_folder=META)
