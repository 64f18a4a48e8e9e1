"""The documents of a bundle as plain data: manifest.json and promises-*.json.

manifest.json describes the bundle. A promises-*.json holds the viewpoint models of one quality, which are not
needed for the first frame. manifest.schema.json has the format of both, from which the viewer's types are
generated. All are deterministic: they contain no times.
"""

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jaxtyping import Bool, Float

from sagesplat import __version__
from sagesplat.adapt.observe import widest_lens
from sagesplat.adapt.viewpoint import QualityKind, ViewModel
from sagesplat.formats.increments import Increment, full_scene
from sagesplat.scene.scene import Camera
from sagesplat.segment.block_categories import split_name
from sagesplat.viewer import frames
from sagesplat.viewer.frames import FLIP
from sagesplat.viewer.pack import Ladder, order_of
from sagesplat.viewer.promises import Seen, promises_document
from sagesplat.viewer.quality import decimals_of, dumped, of_files, quality_entry, significant

FORMAT, VERSION = "sagesplat-bundle", 1
QUALITIES: tuple[QualityKind, ...] = get_args(QualityKind)
TARGETS: dict[QualityKind, float] = {"fidelity": 0.95, "ssim": 0.7}  # where no plan says one
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
    models: Mapping[QualityKind, ViewModel] = field(default_factory=dict)  # with the ladder's levels
    seen: Mapping[QualityKind, Seen] = field(default_factory=dict)  # in the quality's viewpoints
    block: int | None = None  # in a scene in blocks; else None
    parent: str | None = None  # of an instance: its category

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
    chunks: Sequence[Increment]  # of these categories: the files in chunks/
    folder: Path  # of the increments
    sh_degree: int
    antialiased: bool = False
    points: Float[np.ndarray, "P 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    ground: Bool[np.ndarray, " P"] | None = None  # points on the ground
    meters_per_unit: float | None = None  # None: guessed
    live: bool = False  # training still runs
    drawn: Sequence[Camera] = ()  # viewpoints at which fidelity was sampled
    target: tuple[QualityKind, float] | None = None  # of the run's plan; None: a usual one
    ladder: str | None = None  # `formats.label_edits.ladder_hash`; None: labels cannot be edited
    hidden: Collection[str] = ()  # names of categories that are not shown to begin with

    def viewpoints(self, quality: QualityKind) -> list[Camera]:
        """The viewpoints that the models of a quality were fitted at, and maybe others."""
        return list(self.drawn) if quality == "fidelity" else [entry.camera for entry in self.cameras]

    @property
    def qualities(self) -> list[QualityKind]:
        """The qualities that some category has a model of, the one to show by default first."""
        return [q for q in QUALITIES if any(q in c.models for c in self.categories) and self.viewpoints(q)]


def documents(
    contents: Contents, third_party: bool = False
) -> tuple[dict[str, Any], dict[QualityKind, bytes]]:
    """The manifest as plain data, and by quality the bytes of promises-*.json."""
    by_label = _chunks_by_label(contents.chunks)
    full = full_scene(contents.chunks)
    models: dict[QualityKind, dict[int, ViewModel]] = {
        quality: some for quality in contents.qualities if (some := _models(contents, quality))
    }
    promises: dict[QualityKind, bytes] = {
        quality: _promises(contents, quality, some) for quality, some in models.items()
    }
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
            "count": sum(chunk.count for chunk in full),
            "bytes": sum(chunk.nbytes for chunk in full),
            "gpuBytes": sum(chunk.gpu_bytes for chunk in full),
        },
        **({} if contents.ladder is None else {"ladder": contents.ladder}),
        "labels": [
            _label(c, by_label[c.label_id], models, contents.extent, c.name in contents.hidden)
            for c in contents.categories
            if by_label.get(c.label_id)
        ],
        "promises": {quality: _reference(content) for quality, content in promises.items()},
        "target": _target(contents),
        "pack": None,
        "cameras": [_camera(entry, contents.extent) for entry in contents.cameras],
        "start": {key: significant(value) for key, value in start_of(contents).items()},
        "licenses": _licenses(third_party),
    }
    return manifest, promises


def _models(contents: Contents, quality: QualityKind) -> dict[int, ViewModel]:
    """By label id, the models of a quality with the levels of the label's files; without any level none."""
    by_label = _chunks_by_label(contents.chunks)
    last = max((chunk.level for chunk in contents.chunks), default=0)
    found = {
        c.label_id: of_files(c.models[quality], [chunk.level for chunk in by_label[c.label_id]], last)
        for c in contents.categories
        if quality in c.models and by_label.get(c.label_id)
    }
    return {label: model for label, model in found.items() if model.curves}


def _target(contents: Contents) -> dict[str, Any]:
    """What the viewer begins with: the plan's target, or a usual one of the first quality that there is."""
    known = contents.qualities
    quality, value = contents.target or ("fidelity", TARGETS["fidelity"])
    if known and quality not in known:
        quality, value = known[0], TARGETS[known[0]]
    return {"quality": quality, "value": significant(value)}


def pack_order(contents: Contents) -> list[tuple[int, int]]:
    """The order of the files in the pack: (index of the label in the manifest, level).

    By fidelity at the drawn viewpoints where the bundle has it, else by SSIM at the photos.
    """
    known = contents.qualities
    quality: QualityKind = known[0] if known else "ssim"
    by_label, models = _chunks_by_label(contents.chunks), _models(contents, quality)
    first, target = start_of(contents), _target(contents)
    cameras = contents.viewpoints(quality)
    used = np.ones(len(cameras), bool)
    if quality == "ssim":
        used = np.array([entry.split != "test" for entry in contents.cameras])
    ladders = [
        Ladder(
            [chunk.nbytes for chunk in by_label[c.label_id]],
            c.weight,
            c.boxes,
            models.get(c.label_id),
            c.seen[quality].shares[used] if quality in c.seen else None,
            [level for level, chunk in enumerate(by_label[c.label_id], 1) if chunk.refine == "REPLACE"],
            target["value"] if target["quality"] == quality else 1.0,
        )
        for c in contents.categories
        if by_label.get(c.label_id)
    ]
    cameras = [camera for camera, use in zip(cameras, used, strict=True) if use]
    lens = widest_lens([entry.camera for entry in contents.cameras])
    return order_of(ladders, cameras, first["position"], first["quaternion"], lens)


def _promises(contents: Contents, quality: QualityKind, models: Mapping[int, ViewModel]) -> bytes:
    seen = {c.label_id: c.seen[quality] for c in contents.categories if quality in c.seen}
    return dumped(promises_document(quality, models, contents.viewpoints(quality), seen))


def _label(
    category: Category,
    chunks: Sequence[Increment],
    models: Mapping[QualityKind, Mapping[int, ViewModel]],
    extent: float,
    hidden: bool,
) -> dict[str, Any]:
    return {
        "id": category.label_id,
        "name": category.name,
        **({} if category.block is None else {"category": category.category, "block": category.block}),
        **({} if category.parent is None else {"parent": category.parent}),
        "title": category.title,
        "color": category.color,
        "weight": significant(category.weight),
        "always": category.always,
        **({"hidden": True} if hidden else {}),
        "boxes": np.round(category.boxes, decimals_of(extent, 3)).tolist(),
        "levels": [
            {
                "uri": f"chunks/{chunk.uri}",
                "format": chunk.format,
                **({"refine": "REPLACE"} if chunk.refine == "REPLACE" else {}),
                **({"offset": chunk.offset} if chunk.format == "stream" else {}),
                **({} if chunk.weight is None else {"weight": round(chunk.weight, 6)}),
                "bytes": chunk.nbytes,
                "gpuBytes": chunk.gpu_bytes,
                "count": chunk.count,
                "sha256": chunk.sha256,
            }
            for chunk in chunks
        ],
        "quality": {
            quality: quality_entry(some[category.label_id])
            for quality, some in models.items()
            if category.label_id in some
        },
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
