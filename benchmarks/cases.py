"""What becomes of a folder of inputs: each is read, refused with one line, or at fault.

    python -m benchmarks cases --folder ../shared/cases

Every folder in it is one case: a capture, photos, a video, splats, or cameras. Each is tried as `info`, `run`
(without training) and `adopt` would read it.
"""

import tempfile
import traceback
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tyro

from benchmarks.common import ROOT, finish
from sagesplat.core.errors import SageError
from sagesplat.core.geometry import offset_text
from sagesplat.formats.splats import read_splat
from sagesplat.scene import describe, load_scene
from sagesplat.scene.cameras import read_camera_file
from sagesplat.scene.detect import VIDEOS, detect
from sagesplat.scene.images import load_photo
from sagesplat.scene.photos import prepare_photos
from sagesplat.scene.video import extract_frames
from sagesplat.segment.mask_files import import_masks
from sagesplat.segment.valid import write_valid

SPLATS = (".ply", ".spz", ".sog", ".ssog", ".zip", ".glb", ".gltf", ".splat")
VERDICTS = ("read", "refused", "fault")  # from the best to the worst


def main(folder: Path = ROOT.parent / "shared" / "cases", write: bool = False) -> None:
    """A line for each input: read, with what was found and said; refused, with the message; or a fault.

    Args:
        folder: its folders are the cases.
        write: keep the counts in benchmarks/results.
    """
    found: dict[str, str] = {}
    for case in sorted(path for path in folder.iterdir() if path.is_dir() and path.name[0] != "."):
        tried = [(path, *attempt(path)) for path in inputs(case)]
        for path, verdict, said in tried:
            name = case.name if path == case else f"{case.name}/{path.name}"
            print(f"{name:46} {verdict:8} {said}")
        found[case.name] = max((verdict for _, verdict, _ in tried), key=VERDICTS.index)
    if not found:
        raise SystemExit(f"{folder}: no folders in it; name a folder of cases")
    counts = Counter(found.values())
    result: dict[str, Any] = {"cases": len(found), **{verdict: counts[verdict] for verdict in VERDICTS}}
    result |= {f"{verdict} cases": [n for n, v in found.items() if v == verdict] for verdict in VERDICTS[1:]}
    finish("cases", result, write)
    if counts["fault"]:
        raise SystemExit(1)


def inputs(case: Path) -> Iterator[Path]:
    """What one gives to a command: the folder, unless it holds no capture but files to read."""
    files = sorted(path for path in case.iterdir() if path.is_file())
    alone = [p for p in files if p.suffix.lower() in (*SPLATS, *VIDEOS) or p.name == "cameras.json"]
    try:
        kind = detect(case)
    except SageError:
        kind = ""
    if kind or not alone:
        yield case
    else:
        yield from alone


def attempt(path: Path) -> tuple[str, str]:
    """The verdict on an input, and what was found or said."""
    with tempfile.TemporaryDirectory() as scratch:
        try:
            said = read(path, Path(scratch))
        except SageError as error:
            line = str(error)
            clear = line.isprintable() and ";" in line
            return ("refused" if clear else "fault"), line
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            return "fault", f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
    return ("read" if said.isprintable() else "fault"), said


def read(path: Path, scratch: Path) -> str:
    """What an input holds, read as the commands do. Raises what they raise."""
    if path.suffix.lower() in SPLATS:
        splat = read_splat(path)
        parts = [f"{len(splat.gaussians):,} Gaussians ({splat.kind})"]
        parts += [f"{count:,} left out: {reason}" for reason, count in splat.dropped.items()]
        parts += [f"offset {offset_text(splat.offset)}"] if any(splat.offset) else []
        return "; ".join([*parts, *splat.notes])
    if path.name == "cameras.json":
        return f"{len(read_camera_file(path))} cameras"
    kind = detect(path)
    if kind == "video":
        return f"{len(extract_frames(path, scratch / 'frames', max_frames=8))} frames"
    if kind == "photos":
        photos, unreadable = prepare_photos(path, scratch / "photos", scratch, lambda *_: None)
        left_out = f", {len(unreadable)} unreadable" if unreadable else ""
        return f"{len(photos)} photos without poses{left_out}"
    scene = load_scene(path)
    describe(scene)
    load_photo(scene.views[0])
    parts = [f"{kind}: {len(scene.views)} views", f"{len(scene.points.xyz):,} points", *scene.notes]
    parts += [f"offset {offset_text(scene.offset)}"] if any(scene.offset) else []
    shares = write_valid(scene, scratch / "valid", say=parts.append)
    parts += [f"{shares.mean():.0%} of the pixels do not count"] if shares.any() else []
    if (path / "masks" / "labels.json").is_file():
        parts += import_masks(scene, path / "masks", scratch / "masks")
    return "; ".join(parts)


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.cases")
