"""The documents of a bundle as plain data: manifest.json and promises-*.json.

manifest.json describes the bundle. A promises-*.json holds the viewpoint models of one quality, which are not
needed for the first frame. manifest.schema.json has the format of both, from which the viewer's types are
generated. All are deterministic: they contain no times.
"""

import hashlib
from base64 import b64encode
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jaxtyping import Bool, Float

from sagesplat import __version__
from sagesplat.adapt.cell_models import FidelityModel
from sagesplat.adapt.cells import STEPS, Cells
from sagesplat.adapt.viewpoint import QualityKind, ViewModel
from sagesplat.formats.increments import (
    DIGITS,
    DIGITS_OF_RANGE,
    GPU_BYTES,
    Increment,
    full_scene,
    palettes_of,
)
from sagesplat.scene.scene import Camera
from sagesplat.viewer import frames
from sagesplat.viewer.frames import FLIP
from sagesplat.viewer.numbers import packed
from sagesplat.viewer.pack import ASPECT, FOV_Y, HEIGHT, Ladder, order_of
from sagesplat.viewer.promises import Seen, fidelity_document, of_cells, ssim_document
from sagesplat.viewer.quality import (
    decimals_of,
    dumped,
    fidelity_entries,
    levels_of,
    of_levels,
    quality_entry,
    significant,
)

FORMAT, VERSION = "sagesplat-bundle", 1
LOOKS = "looks.jpg"
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
    name: str  # in the taxonomy
    title: str  # display name
    color: str  # #rrggbb
    weight: float = 1.0
    always: bool = False  # shipped in full whatever the plan says
    fidelity: FidelityModel | None = None  # with the ladder's levels
    ssim: ViewModel | None = None  # against photos, with the ladder's levels
    seen: Seen | None = None  # in the photos
    parent: str | None = None  # of an instance: its category


@dataclass(frozen=True, eq=False)
class Contents:
    """The contents of a bundle; cameras, points and cells in COLMAP's axes."""

    name: str
    extent: float  # Scene.extent, world units
    cameras: Sequence[CameraEntry]  # at least one
    categories: Sequence[Category]
    cells: Cells  # of these categories
    chunks: Sequence[Increment]  # of these cells: the files in chunks/
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
    looks: tuple[Sequence[float], bytes] | None = None  # fidelities, and a JPEG of them side by side

    @property
    def qualities(self) -> list[QualityKind]:
        """The qualities that some category has a model of, the one to show by default first."""
        there = {
            "fidelity": bool(self.drawn) and any(c.fidelity for c in self.categories),
            "ssim": bool(self.cameras) and any(c.ssim for c in self.categories),
        }
        return [quality for quality in QUALITIES if there[quality]]

    @cached_property
    def files(self) -> dict[int, list[Increment]]:
        """By cell id, its increments by level; without any there is no such cell."""
        by_cell: dict[int, list[Increment]] = {}
        for chunk in sorted(self.chunks, key=lambda c: c.level):
            by_cell.setdefault(chunk.cell, []).append(chunk)
        return by_cell

    @cached_property
    def levels(self) -> dict[int, list[int]]:
        """By cell id, the nested levels of its files."""
        return {cell: [chunk.level for chunk in chunks] for cell, chunks in self.files.items()}

    @property
    def last(self) -> int:
        """The last of the nested levels."""
        return max((chunk.level for chunk in self.chunks), default=0)

    @cached_property
    def shown(self) -> Cells:
        """The cells that have files."""
        return self.cells.select(np.flatnonzero(np.isin(self.cells.ids, list(self.files))))

    @cached_property
    def models(self) -> dict[int, FidelityModel]:
        """Models of fidelity by label id, with the levels of the files."""
        models = {c.label_id: c.fidelity for c in self.categories if c.fidelity is not None}
        return of_cells(models, self.levels, self.last) if models and self.drawn and self.files else {}

    def ladders(self) -> list[Ladder]:
        """Of each cell that has files."""
        weights, found = {c.label_id: c.weight for c in self.categories}, []
        for cell, label in self.shown.label_of.items():
            chunks = self.files[cell]
            replaces = [level for level, one in enumerate(chunks, 1) if one.refine == "REPLACE"]
            found.append(Ladder([one.nbytes for one in chunks], weights.get(label, 1.0), replaces))
        return found


def documents(
    contents: Contents, third_party: bool = False
) -> tuple[dict[str, Any], dict[QualityKind, bytes]]:
    """The manifest as plain data, and by quality the bytes of promises-*.json."""
    full, ssim = full_scene(contents.chunks), _ssim_models(contents)
    entries: dict[QualityKind, dict[int, dict[str, Any]]] = {}
    promises: dict[QualityKind, bytes] = {}
    if models := contents.models:
        around = [*contents.drawn, *(entry.camera for entry in contents.cameras)]
        given = {c.label_id: c.fidelity for c in contents.categories if c.label_id in models and c.fidelity}
        document = fidelity_document(given, contents.levels, contents.last, around)
        promises["fidelity"] = dumped(packed(document))
        counts = {cell: len(levels) for cell, levels in contents.levels.items()}
        entries["fidelity"] = fidelity_entries(models, contents.shown, contents.drawn, counts)
    if ssim:
        seen = {c.label_id: c.seen for c in contents.categories if c.seen is not None}
        photos = [entry.camera for entry in contents.cameras]
        promises["ssim"] = dumped(packed(ssim_document(ssim, photos, seen)))
        entries["ssim"] = {label: quality_entry(model) for label, model in ssim.items()}
    cells, palettes = _cells(contents), _palettes(contents)
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
            "bytes": sum(chunk.nbytes for chunk in full) + sum(one["bytes"] for one in palettes.values()),
        },
        "gpuBytes": GPU_BYTES[contents.sh_degree],
        **({} if contents.ladder is None else {"ladder": contents.ladder}),
        "labels": [
            _label(c, cells[c.label_id], palettes.get(c.label_id), entries, c.name in contents.hidden)
            for c in contents.categories
            if c.label_id in cells
        ],
        "promises": {quality: _reference(content) for quality, content in promises.items()},
        "target": _target(contents),
        "pack": None,
        "cameras": [_camera(entry, contents.extent) for entry in contents.cameras],
        "start": {key: significant(value) for key, value in start_of(contents).items()},
        **({} if contents.looks is None else {"looks": {"uri": LOOKS, "targets": list(contents.looks[0])}}),
        "licenses": _licenses(third_party),
    }
    return manifest, promises


def _ssim_models(contents: Contents) -> dict[int, ViewModel]:
    """Models of SSIM by label id, with the levels of the cells' files; without any level none."""
    found = {}
    for category in contents.categories:
        files = [
            contents.levels[cell]
            for cell, label in contents.shown.label_of.items()
            if label == category.label_id
        ]
        if category.ssim is not None and files and contents.cameras:
            found[category.label_id] = of_levels(category.ssim, levels_of(files, contents.last))
    return {label: model for label, model in found.items() if model.curves}


def _target(contents: Contents) -> dict[str, Any]:
    """What the viewer begins with: the plan's target, or a usual one of the first quality that there is."""
    known = contents.qualities
    quality, value = contents.target or ("fidelity", TARGETS["fidelity"])
    if known and quality not in known:
        quality, value = known[0], TARGETS[known[0]]
    return {"quality": quality, "value": significant(value)}


def pack_order(contents: Contents) -> list[tuple[int, int]]:
    """The order of the files in the pack: (id of the cell, level)."""
    first, target = start_of(contents), _target(contents)
    size = round(ASPECT * HEIGHT), HEIGHT
    camera = frames.camera_at(first["position"], first["quaternion"], FOV_Y, *size)
    wanted = target["value"] if target["quality"] == "fidelity" else TARGETS["fidelity"]
    return order_of(contents.ladders(), contents.shown, contents.models, camera, wanted)


def _label(
    category: Category,
    cells: Sequence[dict[str, Any]],
    palette: dict[str, Any] | None,
    entries: Mapping[QualityKind, Mapping[int, dict[str, Any]]],
    hidden: bool,
) -> dict[str, Any]:
    return {
        "id": category.label_id,
        "name": category.name,
        **({} if category.parent is None else {"parent": category.parent}),
        "title": category.title,
        "color": category.color,
        "weight": significant(category.weight),
        "always": category.always,
        **({"hidden": True} if hidden else {}),
        **({} if palette is None else {"palette": palette}),
        "cells": cells,
        "quality": {
            quality: some[category.label_id] for quality, some in entries.items() if category.label_id in some
        },
    }


def _cells(contents: Contents) -> dict[int, list[dict[str, Any]]]:
    """By label id, the entries of its cells."""
    found: dict[int, list[dict[str, Any]]] = {}
    for row, (cell, label) in enumerate(contents.shown.label_of.items()):
        levels = [_levels(run) for run in _runs(contents.files[cell])]
        found.setdefault(label, []).append({**placed(contents.shown, row), "levels": levels})
    return found


def _palettes(contents: Contents) -> dict[int, dict[str, Any]]:
    """By label id, the entries of the palettes: what comes before the first stream of a file."""
    label_of = {chunk.uri: chunk.label_id for chunk in contents.chunks}
    found = {}
    for uri, nbytes in palettes_of(contents.chunks).items():
        with (contents.folder / uri).open("rb") as file:
            digest = hashlib.sha256(file.read(nbytes)).hexdigest()[:DIGITS]
        found[label_of[uri]] = {"uri": f"chunks/{uri}", "offset": 0, "bytes": nbytes, "sha256": digest}
    return found


def placed(cells: Cells, row: int) -> dict[str, Any]:
    """Where a cell is, in the bundle's axes."""
    bounds, grid = cells.bounds[row].reshape(2, 3) * FLIP, cells.grid[row].astype(int)
    grid[:, :3] = np.where(FLIP < 0, STEPS - grid[:, :3], grid[:, :3])
    used = grid[:, 3] > 0
    return {
        "id": int(cells.ids[row]),
        "bounds": significant([*bounds.min(0), *bounds.max(0)]),
        "points": b64encode((grid[used] if used.any() else grid[:1]).astype(np.uint8).tobytes()).decode(),
        "area": significant(cells.area[row]),
        "radius": significant(cells.radius[row], 4),
    }


def _runs(chunks: Sequence[Increment]) -> list[list[Increment]]:
    """The increments of a cell, those of a stream together."""
    runs: list[list[Increment]] = []
    for chunk in chunks:
        if chunk.format == "stream" and chunk.refine != "REPLACE" and runs and runs[-1][0].uri == chunk.uri:
            runs[-1].append(chunk)
        else:
            runs.append([chunk])
    return runs


def _levels(run: Sequence[Increment]) -> dict[str, Any]:
    first, is_stream = run[0], run[0].format == "stream"
    weights = [round(chunk.weight, 6) for chunk in run if chunk.weight is not None]
    return {
        "uri": f"chunks/{first.uri}",
        "format": first.format,
        **({"refine": "REPLACE"} if first.refine == "REPLACE" else {}),
        **({"offset": first.offset} if is_stream else {}),
        **({"weights": weights} if weights else {}),
        "bytes": [chunk.nbytes for chunk in run],
        "counts": [chunk.count for chunk in run],
        "sha256": "".join(chunk.sha256[: DIGITS_OF_RANGE if is_stream else DIGITS] for chunk in run),
    }


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
        "position": np.round(frames.position(camera), decimals_of(extent, 4)).tolist(),
        "quaternion": np.round(frames.quaternion(camera), 5).tolist(),
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
