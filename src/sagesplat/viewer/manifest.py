"""The documents of a bundle as plain data: manifest.json and promises-*.json.

manifest.json describes the bundle (its format: manifest.schema.json). promises-*.json holds the viewpoint
models, which are not needed for the first frame. Both are deterministic: they contain no times.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from sagesplat import __version__
from sagesplat.adapt.viewpoint import ViewModel
from sagesplat.formats.increments import Increment
from sagesplat.scene.scene import Camera
from sagesplat.segment.block_categories import split_name
from sagesplat.viewer import frames
from sagesplat.viewer.frames import FLIP
from sagesplat.viewer.pack import Ladder, order_of
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
THIRD_PARTY = "THIRD_PARTY_LICENSES.txt"  # of the built viewer


@dataclass(frozen=True, eq=False)
class CameraEntry:
    """The camera of a photo, with its name and split."""

    name: str
    split: str  # train, test or calibration
    camera: Camera


@dataclass(frozen=True, eq=False)
class Category:
    """A category in a bundle: all that its manifest entry needs besides the increments."""

    label_id: int
    name: str  # in the taxonomy; CATEGORY@BLOCK in a scene in blocks
    title: str  # display name
    color: str  # #rrggbb
    boxes: Float[np.ndarray, "B 6"]  # in the bundle's axes
    weight: float = 1.0
    always: bool = False  # shipped in full whatever the plan says
    model: ViewModel | None = None  # with the increments' levels; None: no bounds
    shares: Float[np.ndarray, " V"] | None = None  # pixel share in each camera; None: 0
    distance: Float[np.ndarray, " V"] | None = None  # d_min in each camera; None: unknown
    corrections: Float[np.ndarray, " V"] | None = None  # log of d_min over the distance by boxes; None: 0
    block: int | None = None  # in a scene in blocks; else None

    @property
    def category(self) -> str:
        """The category's name without the block."""
        return self.name if self.block is None else split_name(self.name)[0]


@dataclass(frozen=True, eq=False)
class Contents:
    """The contents of a bundle; cameras and points in COLMAP's axes, boxes in the bundle's."""

    name: str
    extent: float  # Scene.extent, world units
    cameras: Sequence[CameraEntry]  # at least one
    categories: Sequence[Category]
    chunks: Sequence[Increment]  # SPZ increments of these categories: the files in chunks/
    folder: Path  # of the increments
    sh_degree: int
    antialiased: bool = False
    points: Float[np.ndarray, "P 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    ground: Bool[np.ndarray, " P"] | None = None  # points on the ground
    meters_per_unit: float | None = None  # None: guessed
    live: bool = False  # training still runs


def documents(contents: Contents, third_party: bool = False) -> tuple[dict[str, Any], bytes | None]:
    """The manifest as plain data, and the bytes of promises-*.json (None without viewpoint models)."""
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
        "background": [round(c / 255, 6) for c in contents.cameras[0].camera.background],
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
        "cameras": [_camera(entry, contents.extent) for entry in contents.cameras],
        "start": {key: significant(value) for key, value in start_of(contents).items()},
        "licenses": _licenses(third_party),
    }
    return manifest, promises


def _models(contents: Contents) -> dict[int, ViewModel]:
    """By label id, the viewpoint models with the levels of the label's files."""
    by_label = _chunks_by_label(contents.chunks)
    last = max((chunk.level for chunk in contents.chunks), default=0)
    return {
        c.label_id: of_files(c.model, [chunk.level for chunk in by_label[c.label_id]], last)
        for c in contents.categories
        if c.model is not None and by_label.get(c.label_id)
    }


def pack_order(contents: Contents) -> list[tuple[int, int]]:
    """The order of the files in the pack: (index of the label in the manifest, level)."""
    by_label, models = _chunks_by_label(contents.chunks), _models(contents)
    first = start_of(contents)
    known = np.array([entry.split != "test" for entry in contents.cameras])
    cameras = [entry.camera for entry in contents.cameras if entry.split != "test"]
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
    """The bytes of promises-*.json: the models, and the views that they share; None without a model."""
    if not models:
        return None
    cameras = [entry.camera for entry in contents.cameras]
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
        corrections = np.zeros(len(cameras)) if category.corrections is None else category.corrections
        mine = np.searchsorted(used, rows[category.label_id])
        at = (away, position, direction)
        entries.append(rounded_entry(model, mine, shares[used], corrections[used], views, at))
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
    by_label: dict[int, list[Increment]] = {}
    for chunk in sorted(chunks, key=lambda c: c.level):
        by_label.setdefault(chunk.label_id, []).append(chunk)
    return by_label


def _frame(contents: Contents) -> dict[str, Any]:
    cameras = [entry.camera for entry in contents.cameras]
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


def _camera(entry: CameraEntry, extent: float) -> dict[str, Any]:
    camera, K = entry.camera, entry.camera.K
    return {
        "name": entry.name,
        "split": entry.split,
        "position": np.round(frames.position(camera), decimals_of(extent, 5)).tolist(),
        "quaternion": np.round(frames.quaternion(camera), 6).tolist(),
        "fovY": significant(frames.fov_y(camera)),
        "width": camera.width,
        "height": camera.height,
        "intrinsics": significant([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]),
    }


def start_of(contents: Contents) -> dict[str, Any]:
    """Position, quaternion and target of the start view, in the bundle's axes."""
    cameras = [entry.camera for entry in contents.cameras if entry.split == "train"]
    cameras = cameras or [entry.camera for entry in contents.cameras]
    return frames.start(cameras, contents.points, contents.extent, frames.upward(cameras))


def _licenses(third_party: bool) -> list[dict[str, str]]:
    ours = {"what": "viewer (sagesplat)", "license": "Apache-2.0", "url": "LICENSES.txt"}
    others = [{"what": what, "license": "MIT", "url": THIRD_PARTY} for what in ("three.js", "Spark")]
    scene = {"what": "scene", "license": "as the owner of its photos decides", "url": "LICENSES.txt"}
    return [ours, *(others if third_party else []), scene]


def _reference(content: bytes) -> dict[str, Any]:
    digest = hashlib.sha256(content).hexdigest()
    return {"uri": f"promises-{digest[:12]}.json", "bytes": len(content), "sha256": digest}
