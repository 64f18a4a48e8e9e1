"""Bytes of splats as they came in, as coded streams and as splat-transform's SOG, at what they look like.

All Gaussians are one stream. The steps are chosen as `adopt` chooses them, from viewpoints that the
comparison does not use. A SOG that is there already is taken: a palette of many Gaussians takes CPUs hours.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.adopt import FRESH, SPLATS, find_transform, score
from benchmarks.common import finish
from sagesplat.adapt.free_viewpoints import free_cameras
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.splats import Splat, read_splat
from sagesplat.formats.stream import decode_stream, encode_stream
from sagesplat.formats.stream_header import AS_GIVEN, Precision, harmonics_of, rounded, turned_round
from sagesplat.formats.stream_palette import Palette
from sagesplat.scene.cameras import read_camera_file
from sagesplat.scene.scene import Camera
from sagesplat.stages.adopt_levels import KEPT

SOURCES = ("guitar.compressed.ply", "biker.compressed.ply", "playbot")


def main(
    folder: Path = Path("runs/coded"),
    splats: tuple[str, ...] = SOURCES,
    splat_transform: Path | None = None,
    views: int = 8,
    write: bool = False,
) -> None:
    """Bytes and SSIM of coded streams beside splat-transform's SOG of the same Gaussians.

    Args:
        folder: where SOG files are made; those that are there are taken.
        splats: files, or names in the folder of splats; FILE@CAPTURE: compared at cameras of a capture, and
            not at viewpoints that are drawn.
        splat_transform: its command (default: by npx).
        views: viewpoints to compare in.
        write: keep the figures in benchmarks/results/cpu/coded.json.
    """
    results = {}
    for splat in splats:
        name, _, capture = splat.partition("@")
        source = Path(name) if Path(name).exists() else SPLATS / name
        results[source.name.split(".")[0]] = compare(
            source, folder, Path(capture) if capture else None, splat_transform, views
        )
    finish("coded", results, write)


def compare(
    source: Path, folder: Path, given: Path | None, transform: Path | None, views: int
) -> dict[str, Any]:
    """Bytes and quality of both."""
    splat = read_splat(source)
    everything = cameras_of(splat, given, 3 * views)
    chosen, cameras = everything[::3], everything[1::3]
    rival = sog_of(source, folder, transform)
    g, nbytes = read_splat(rival).gaussians, sum(path.stat().st_size for path in files_of(rival))
    result: dict[str, Any] = {"count": len(splat.gaussians)}
    result["sog"] = {"bytes": nbytes} | score(g, splat.gaussians, cameras, splat.antialiased)
    step, precision = precision_of(splat, chosen)
    coded, decoded = encoded(splat.gaussians, precision)
    result["stream"] = {"bytes": coded, "precision": step, "of_sog": round(coded / nbytes, 4)}
    result["stream"] |= score(decoded, splat.gaussians, cameras, splat.antialiased)
    print(source.name, result)
    return result


def cameras_of(splat: Splat, given: Path | None, count: int) -> Sequence[Camera]:
    """Cameras of a capture, or drawn ones."""
    if given is None:
        return free_cameras(splat.gaussians, count, seed=FRESH).cameras
    cameras = [one.camera for one in read_camera_file(given)]
    return [cameras[i] for i in np.linspace(0, len(cameras) - 1, count).round().astype(int)]


def sog_of(source: Path, folder: Path, transform: Path | None) -> Path:
    """The splat as SOG: as it came, as it lies in the folder, or as splat-transform makes it."""
    if source.is_dir():
        return next(path for path in (source / "0_0" / "meta.json", source / "meta.json") if path.exists())
    out = folder / f"{source.name.split('.')[0]}.sog"
    if not out.exists():
        folder.mkdir(parents=True, exist_ok=True)
        find_transform(transform)(source, out)
    return out


def files_of(sog: Path) -> list[Path]:
    """All files of a SOG."""
    return [sog] if sog.suffix == ".sog" else sorted(sog.parent.iterdir())


def precision_of(splat: Splat, cameras: Sequence[Camera]) -> tuple[int, Precision]:
    """The coarsest of `AS_GIVEN` that looks the same, and its place there."""
    for step, precision in enumerate(AS_GIVEN[:-1]):
        found = rounded(splat.gaussians, precision)
        if score(found, splat.gaussians, cameras, splat.antialiased)["ssim"] >= KEPT:
            return step, precision
    return len(AS_GIVEN) - 1, AS_GIVEN[-1]


def encoded(g: Gaussians, precision: Precision) -> tuple[int, Gaussians]:
    """Bytes of one stream of Gaussians with its palette, and what it is decoded to."""
    harmonics = harmonics_of(turned_round(g).shN, precision.sh_bits, precision.sh_range)
    palette = Palette.of(harmonics, precision.sh_bits)
    content = encode_stream(g, [len(g)], precision=precision, palette=palette).content
    nbytes = len(content) + len(palette.encoded() if palette else b"")
    return nbytes, decode_stream(content, palette=palette).gaussians


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.coded")
