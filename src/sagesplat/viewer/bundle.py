"""A bundle: a static folder with the chunks of a nested ladder, what is promised of them, and the viewer.

manifest.json says what there is (manifest.schema.json says how), promises-*.json holds the viewpoint models,
which the first picture need not wait for, scene-*.pack all chunks once more, as one stream. The same contents
give the same bytes: there are no times in it.
"""

import hashlib
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from sagesplat import __version__
from sagesplat.adapt.viewpoint import ViewModel
from sagesplat.core.errors import DataError, RunError, SageError
from sagesplat.formats.increments import Increment
from sagesplat.io.files import atomic_folder, read_json, write_text
from sagesplat.scene.scene import Camera
from sagesplat.segment.block_categories import split_name
from sagesplat.viewer import frames
from sagesplat.viewer.frames import FLIP
from sagesplat.viewer.pack import Ladder, order_of, write_pack
from sagesplat.viewer.quality import (
    decimals_of,
    dumped,
    of_files,
    quality_entry,
    rounded_entry,
    rows_of,
    significant,
)

FORMAT, VERSION = "sagesplat-bundle", 1
MANIFEST, SCHEMA, POSTER = "manifest.json", "manifest.schema.json", "poster.jpg"
THIRD_PARTY = "THIRD_PARTY_LICENSES.txt"  # of the built viewer
_LICENSES = """\
The viewer in this folder is part of sagesplat, licensed under the Apache License, Version 2.0
(SPDX: Apache-2.0). It contains other people's software: see THIRD_PARTY_LICENSES.txt.

The scene (chunks/, manifest.json, promises-*.json) was made of somebody's photos: their owner
decides how it may be used.
"""


@dataclass(frozen=True, eq=False)
class CameraEntry:
    """A photo's camera."""

    name: str
    split: str  # train, test or calibration
    camera: Camera


@dataclass(frozen=True, eq=False)
class Category:
    """What a bundle says of a category besides its chunks."""

    label_id: int
    name: str  # in the taxonomy; of a part of a scene in blocks CATEGORY@BLOCK
    title: str  # for people
    color: str  # #rrggbb
    boxes: Float[np.ndarray, "B 6"]  # in the bundle's axes
    weight: float = 1.0
    always: bool = False  # shipped in full whatever the plan says
    model: ViewModel | None = None  # with the chunks' levels; None: nothing is promised
    shares: Float[np.ndarray, " V"] | None = None  # of the pixels of each shot; None: 0
    distance: Float[np.ndarray, " V"] | None = None  # d_min in each shot; None: unknown
    corrections: Float[np.ndarray, " V"] | None = None  # log of that over what the boxes tell; None: 0
    block: int | None = None  # of the scene that it is a part of; None: in none

    @property
    def category(self) -> str:
        """The name without the block."""
        return self.name if self.block is None else split_name(self.name)[0]


@dataclass(frozen=True, eq=False)
class Contents:
    """All that a bundle is made of; cameras and points in COLMAP's axes."""

    name: str
    extent: float  # of the cameras
    shots: Sequence[CameraEntry]  # at least one
    categories: Sequence[Category]
    chunks: Sequence[Increment]  # SPZ; of the categories above
    folder: Path  # where the chunks are
    sh_degree: int
    antialiased: bool = False
    points: Float[np.ndarray, "P 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    ground: Bool[np.ndarray, " P"] | None = None  # which points lie on the ground
    meters_per_unit: float | None = None  # None: guessed
    live: bool = False  # training goes on


@dataclass(frozen=True)
class BundleSizes:
    """Sizes of a bundle, bytes."""

    manifest: int
    promises: int
    chunks: int
    total: int  # with the viewer


def write_bundle(out: Path, contents: Contents, viewer: Path, poster: bytes | None = None) -> BundleSizes:
    """Write a bundle into a folder, which is new, empty or an earlier bundle; it is replaced as a whole.

    Where that fails, or is killed, the earlier bundle is kept (see `atomic_folder`).

    `viewer`: the folder with the built viewer. `poster`: a JPEG of the first view, shown until the scene is
    drawn. RunError for another folder; SageError without a viewer;
    DataError for a chunk that is missing or not what the index says.
    """
    check_target(out)
    check_viewer(viewer)
    out = out.resolve()
    try:
        with atomic_folder(out) as fresh:
            shutil.copytree(viewer, fresh, dirs_exist_ok=True)
            (fresh / "chunks").mkdir()
            for chunk in contents.chunks:
                (fresh / "chunks" / chunk.uri).write_bytes(_verified(contents.folder, chunk))
            if poster is not None:
                _put_up(fresh, poster)
            return write_documents(fresh, contents)
    except OSError as error:
        raise RunError(
            f"{out}: cannot be written ({error.strerror}); free some space or name another folder"
        ) from error


def _put_up(folder: Path, poster: bytes) -> None:
    """Show a picture in the page before any script of it is there."""
    page = folder / "index.html"
    (folder / POSTER).write_bytes(poster)
    write_text(page, _with_poster(page.read_text(encoding="utf-8")))


def _with_poster(page: str) -> str:
    return page.replace("<!-- poster -->", f'<img id="poster" src="{POSTER}" alt="" />')


def has_viewer(folder: Path, viewer: Path) -> bool:
    """Whether a bundle has this viewer: its page names all its parts by their content."""
    pages = [path / "index.html" for path in (folder, viewer)]
    if not all(page.is_file() for page in pages):
        return False
    mine, page = (page.read_text(encoding="utf-8") for page in pages)
    return mine in (page, _with_poster(page))


def write_documents(folder: Path, contents: Contents) -> BundleSizes:
    """Write all but the chunks, which must be there, and the viewer; the manifest last."""
    manifest, promises = documents(contents, (folder / THIRD_PARTY).exists())
    if contents.chunks and not contents.live:
        manifest["pack"] = write_pack(folder, manifest["labels"], _order(contents))
    if promises is not None:
        (folder / manifest["promises"]["uri"]).write_bytes(promises)
    write_text(folder / SCHEMA, files("sagesplat.viewer").joinpath(SCHEMA).read_text(encoding="utf-8"))
    write_text(folder / "LICENSES.txt", _LICENSES)
    text = dumped(manifest)
    write_text(folder / MANIFEST, text.decode())
    total = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return BundleSizes(len(text), len(promises or b""), manifest["totals"]["bytes"], total)


def check_target(out: Path) -> None:
    """RunError unless a bundle may be written to `out`."""
    if out.is_dir() and not any(out.iterdir()):
        return
    if out.exists() and not is_bundle(out):
        raise RunError(f"{out}: neither empty nor a bundle of sagesplat; name a new folder")


def is_bundle(folder: Path) -> bool:
    """Whether a folder holds a manifest of ours."""
    try:
        return read_json(folder / MANIFEST)["format"] == FORMAT
    except (RunError, KeyError, TypeError):
        return False


def check_viewer(viewer: Path) -> None:
    """SageError unless the built viewer is there."""
    if not (viewer / "index.html").is_file():
        raise SageError(f"{viewer}: viewer not built: run `make web` (installed packages have it)")


def _verified(folder: Path, chunk: Increment) -> bytes:
    try:
        content = (folder / chunk.uri).read_bytes()
    except OSError as error:
        raise DataError(
            f"{folder / chunk.uri}: cannot be read ({error.strerror}); run `sagesplat nest --force` again"
        ) from None
    if hashlib.sha256(content).hexdigest() != chunk.sha256:
        raise DataError(
            f"{folder / chunk.uri}: not the chunk that was written; run `sagesplat nest --force` again"
        )
    return content


def documents(contents: Contents, third_party: bool = False) -> tuple[dict[str, Any], bytes | None]:
    """The manifest as plain data, and the bytes of promises-*.json if anything is promised."""
    by_label, models = _chunks_by_label(contents.chunks), _models(contents)
    promises = _promises(contents, {i: m for i, m in models.items() if m.curves})
    manifest = {
        "format": FORMAT,
        "version": VERSION,
        "generator": f"sagesplat {__version__}",
        "name": contents.name,
        "live": contents.live,
        "frame": _frame(contents),
        "shDegree": contents.sh_degree,
        "antialiased": contents.antialiased,
        "background": [round(c / 255, 6) for c in contents.shots[0].camera.background],
        "totals": {
            "count": sum(chunk.count for chunk in contents.chunks),
            "bytes": sum(chunk.nbytes for chunk in contents.chunks),
            "gpuBytes": sum(chunk.gpu_bytes for chunk in contents.chunks),
        },
        "labels": [
            _label(c, by_label[c.label_id], models.get(c.label_id), contents.extent)
            for c in contents.categories
            if by_label.get(c.label_id)
        ],
        "promises": promises and _reference(promises),
        "pack": None,
        "cameras": [_camera(shot, contents.extent) for shot in contents.shots],
        "start": {key: significant(value) for key, value in start_of(contents).items()},
        "licenses": _license_entries(third_party),
    }
    return manifest, promises


def _models(contents: Contents) -> dict[int, ViewModel]:
    """By label id, the models with the levels of the label's files."""
    by_label = _chunks_by_label(contents.chunks)
    last = max((chunk.level for chunk in contents.chunks), default=0)
    return {
        c.label_id: of_files(c.model, [chunk.level for chunk in by_label[c.label_id]], last)
        for c in contents.categories
        if c.model is not None and by_label.get(c.label_id)
    }


def _order(contents: Contents) -> list[tuple[int, int]]:
    """Of the files in the pack: index of the label in the manifest, level."""
    by_label, models = _chunks_by_label(contents.chunks), _models(contents)
    first = start_of(contents)
    known = np.array([shot.split != "test" for shot in contents.shots])
    cameras = [shot.camera for shot in contents.shots if shot.split != "test"]
    ladders = [
        Ladder(
            [chunk.nbytes for chunk in by_label[c.label_id]],
            c.weight,
            c.boxes,
            models[c.label_id] if c.label_id in models and models[c.label_id].curves else None,
            None if c.shares is None else c.shares[known],
        )
        for c in contents.categories
        if by_label.get(c.label_id)
    ]
    return order_of(ladders, cameras, first["position"], first["quaternion"])


def _promises(contents: Contents, models: dict[int, ViewModel]) -> bytes | None:
    """promises-*.json: the models of labels with the views that they share; None without a model."""
    if not models:
        return None
    cameras = [shot.camera for shot in contents.shots]
    position = np.stack([camera.position for camera in cameras]).astype(np.float64)
    direction = np.stack([camera.direction for camera in cameras]).astype(np.float64)
    rows = {label: rows_of(model, position, direction) for label, model in models.items()}
    used = np.unique(np.concatenate(list(rows.values())))
    decimals = decimals_of(contents.extent, 5)
    views = np.column_stack([np.round(position * FLIP, decimals), np.round(direction * FLIP, 5)])[used]
    entries = []
    for category in contents.categories:
        if (model := models.get(category.label_id)) is None:
            continue
        shares = np.zeros(len(cameras)) if category.shares is None else category.shares
        away = np.full(len(cameras), np.nan) if category.distance is None else category.distance
        missed = np.zeros(len(cameras)) if category.corrections is None else category.corrections
        mine = np.searchsorted(used, rows[category.label_id])
        at = (away, position, direction)
        entries.append(rounded_entry(model, mine, shares[used], missed[used], views, at))
    extent = next(iter(models.values())).extent
    return dumped({"version": VERSION, "extent": extent, "views": views.tolist(), "labels": entries})


def _label(
    category: Category, chunks: Sequence[Increment], model: ViewModel | None, extent: float
) -> dict[str, Any]:
    return {
        "id": category.label_id,
        "name": category.name,
        **({} if category.block is None else {"category": category.category, "block": category.block}),
        "title": category.title,
        "color": category.color,
        "weight": significant(category.weight),
        "always": category.always,
        "boxes": np.round(category.boxes, decimals_of(extent, 3)).tolist(),
        "levels": [
            {
                "uri": f"chunks/{chunk.uri}",
                "format": "spz",
                "bytes": chunk.nbytes,
                "gpuBytes": chunk.gpu_bytes,
                "count": chunk.count,
                "sha256": chunk.sha256,
            }
            for chunk in chunks
        ],
        "quality": None if model is None or not model.curves else quality_entry(model),
    }


def _chunks_by_label(chunks: Sequence[Increment]) -> dict[int, list[Increment]]:
    found: dict[int, list[Increment]] = {}
    for chunk in sorted(chunks, key=lambda c: c.level):
        found.setdefault(chunk.label_id, []).append(chunk)
    return found


def _frame(contents: Contents) -> dict[str, Any]:
    cameras = [shot.camera for shot in contents.shots]
    up = frames.upward(cameras)
    ground = np.zeros(len(contents.points), bool) if contents.ground is None else contents.ground
    height = frames.floor(contents.points * FLIP, ground, cameras, up, contents.extent)
    given = contents.meters_per_unit
    return {
        "axes": "rub",
        "up": significant(up),
        "floor": significant(height),
        "extent": significant(contents.extent),
        "metersPerUnit": significant(frames.guessed_scale(cameras, up, height) if given is None else given),
        "scale": "guessed" if given is None else "given",
    }


def _camera(shot: CameraEntry, extent: float) -> dict[str, Any]:
    camera, K = shot.camera, shot.camera.K
    return {
        "name": shot.name,
        "split": shot.split,
        "position": np.round(frames.position(camera), decimals_of(extent, 5)).tolist(),
        "quaternion": np.round(frames.quaternion(camera), 6).tolist(),
        "fovY": significant(frames.fov_y(camera)),
        "width": camera.width,
        "height": camera.height,
        "intrinsics": significant([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]),
    }


def start_of(contents: Contents) -> dict[str, Any]:
    """Position, quaternion and target of the first view, in the bundle's axes."""
    cameras = [shot.camera for shot in contents.shots if shot.split == "train"]
    cameras = cameras or [shot.camera for shot in contents.shots]
    return frames.start(cameras, contents.points, contents.extent, frames.upward(cameras))


def _license_entries(third_party: bool) -> list[dict[str, str]]:
    ours = {"what": "viewer (sagesplat)", "license": "Apache-2.0", "url": "LICENSES.txt"}
    others = [{"what": what, "license": "MIT", "url": THIRD_PARTY} for what in ("three.js", "Spark")]
    scene = {"what": "scene", "license": "as the owner of its photos decides", "url": "LICENSES.txt"}
    return [ours, *(others if third_party else []), scene]


def _reference(content: bytes) -> dict[str, Any]:
    digest = hashlib.sha256(content).hexdigest()
    return {"uri": f"promises-{digest[:12]}.json", "bytes": len(content), "sha256": digest}
