"""Test vectors of what the viewer evaluates: `python tests/make_viewer_vectors.py` writes them.

A case of tests/data/distances.json has cells as in a manifest, a camera, the planes of its frustum (left,
right, bottom, top, front) and the lens, and under "expected" by cell whether it is visible, the distance
(null: out of sight) and the apparent size, and the distance of all cells as one label, to 1e-5 of themselves:
cameras have single precision here.
A case of tests/data/promises.json has a document as in promises-*.json and viewpoints, with the focal length
in pixels (null: that of the photos).
Of SSIM against photos it has one label; a viewpoint has the distance, what it is corrected to, and the
expected mean and bound by level and the support, to 1e-9 (null: NaN).
Of fidelity it has the labels of a manifest too (id and cells); a viewpoint has planes and lens, and expected:
by cell the share and, for cells in sight, the mean by level; `away`; and by label the support, the mean of a
composition (`levels`: by cell, from 1) and its bound, to 1e-5 (null: NaN).
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sagesplat.adapt.cell_models import (
    FACTOR_STEP,
    LOG_STEP,
    STEP,
    TERMS,
    CellModel,
    FidelityModel,
    expect,
    promised,
    views_of,
)
from sagesplat.adapt.cells import POINTS, STEPS, Cells, label_distances, look
from sagesplat.adapt.eq3 import Eq3, SsimModel
from sagesplat.adapt.viewpoint import (
    NO_CALIBRATION,
    PHOTOS_ONLY,
    Calibration,
    QualityKind,
    ViewModel,
)
from sagesplat.scene.scene import Camera
from sagesplat.viewer.frames import FLIP, camera_at
from sagesplat.viewer.manifest import placed
from sagesplat.viewer.numbers import packed, unpacked
from sagesplat.viewer.promises import Seen, fidelity_document, ssim_document
from sagesplat.viewer.sent_model import read_fidelity, read_model

DATA = Path(__file__).parent / "data"
Case = dict[str, Any]

AHEAD = (0.0, 0.0, 0.0, 1.0)
FOCAL = 60.0  # of the photos, pixels
SCREENS = (0.5, 2.0)
EXTENT = 4.5
WIDTH, HEIGHT = 72, 48  # of pictures


def make_cells(seed: int, labels: Sequence[int], spread: float = 3.0) -> Cells:
    """Cells in COLMAP's axes, one for each label id of `labels`."""
    rng, C = np.random.default_rng(seed), len(labels)
    centre, size = rng.normal(0, spread, (C, 3)), rng.exponential(0.8, (C, 3))
    grid = rng.integers(0, STEPS + 1, (C, POINTS, 4)).astype(np.uint8)
    grid[:, 0, 3] = np.maximum(grid[:, 0, 3], 1)
    bounds = np.concatenate([centre - size, centre + size], 1).round(4)
    area, radius = rng.exponential(0.3, C).round(4) + 0.01, rng.exponential(0.2, C).round(3) + 1e-3
    return Cells(np.arange(C), np.array(labels), bounds, grid, area, radius)


def posed(where: Any, quaternion: Any, focal: float = FOCAL) -> Camera:
    """A camera at a pose in the bundle's axes."""
    fov_y = 2 * math.atan(HEIGHT / (2 * focal))
    return camera_at(np.array(where, np.float64), np.array(quaternion, np.float64), fov_y, WIDTH, HEIGHT)


def seen_from(camera: Camera) -> Case:
    """A camera as the viewer has it."""
    wide, high = (n / (2 * float(camera.K[i, i])) for i, n in enumerate((WIDTH, HEIGHT)))
    normals = np.array([[1, 0, -wide], [-1, 0, -wide], [0, 1, -high], [0, -1, -high], [0, 0, -1]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    back = FLIP[:, None] * camera.w2c[:3, :3].T.astype(np.float64) * FLIP  # camera to world
    world, where = normals @ back.T, -back @ (FLIP * camera.w2c[:3, 3].astype(np.float64))
    return {
        "position": where.tolist(),
        "direction": (camera.direction.astype(np.float64) * FLIP).tolist(),
        "frustum": np.column_stack([world, -world @ where]).tolist(),
        "lens": [wide, high],
    }


def _distance_case(name: str, cells: Cells, where: Any, quaternion: Any) -> Case:
    camera = posed(where, quaternion)
    sight = look(cells, [camera])
    whole = label_distances(replace(cells, labels=np.zeros(len(cells.ids), int)), [camera])[0, 0]
    expected = {
        "visible": (sight.apparent[0] > 0).tolist(),
        "distance": [_plain(value) for value in sight.distance[0]],
        "apparent": sight.apparent[0].tolist(),
        "whole": _plain(whole),
    }
    return {"name": name, "cells": cells_of(cells), "camera": seen_from(camera), "expected": expected}


def cells_of(cells: Cells) -> list[Case]:
    """The cells as a manifest has them, without levels."""
    return [placed(cells, row) for row in range(len(cells.ids))]


def distance_cases() -> list[Case]:
    """All cases of distances.json."""
    one = make_cells(1, [7])
    ahead = replace(one, bounds=np.array([[-1.0, -1, 4, 1, 1, 6]]))  # z is forward in COLMAP's axes
    flat = replace(ahead, bounds=np.array([[-1.0, 1, 3, 1, 1, 5]]), radius=np.zeros(1))
    right = (0.0, math.sin(-math.pi / 4), 0.0, math.cos(-math.pi / 4))
    beside = replace(ahead, bounds=np.array([[4.0, -1, 1, 6, 1, 2]]))
    cases = [
        _distance_case("ahead", ahead, np.zeros(3), AHEAD),
        _distance_case(
            "behind", replace(ahead, bounds=-ahead.bounds[:, [3, 4, 5, 0, 1, 2]]), np.zeros(3), AHEAD
        ),
        _distance_case("beside", beside, np.zeros(3), AHEAD),
        _distance_case("beside, after a turn", beside, np.zeros(3), right),
        _distance_case(
            "inside", replace(ahead, bounds=np.array([[-2.0, -2, -2, 2, 2, 2]])), np.zeros(3), AHEAD
        ),
        _distance_case("flat, without a radius", flat, np.zeros(3), AHEAD),
    ]
    rng = np.random.default_rng(8)
    for i in range(12):
        q = rng.normal(size=4)
        cells = make_cells(20 + i, [7] * int(rng.integers(1, 5)))
        cases.append(
            _distance_case(f"random {i}", cells, rng.normal(0, 2, 3).round(4), q / np.linalg.norm(q))
        )
    return cases


def model(seed: int, views: int, levels: list[int], *, unseen: bool = True) -> ViewModel:
    """A model of SSIM of a category, with curves of every kind."""
    rng = np.random.default_rng(seed)
    position, direction = rng.normal(0, 0.7, (views, 3)), rng.normal(size=(views, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return ViewModel(
        label_id=7,
        quality="ssim",
        curves=_curves(rng, levels),
        extent=EXTENT,
        median_log_distance=float(rng.uniform(0.3, 1.2)),
        focal=FOCAL,
        screens=PHOTOS_ONLY,
        inputs=np.column_stack([position, direction, np.zeros((views, 2)), rng.normal(0.8, 0.4, views)]),
        heldout_inputs=(np.arange(views) % 5 == 2) & unseen,
        lengths=tuple(rng.uniform(0.2, 1.2, 4).tolist()),  # pyright: ignore[reportArgumentType]
        heldout_variance=float(rng.uniform(0, 0.4)) * unseen,
        photos=np.zeros((6, 0)),
        weights=rng.normal(0, 0.05, (views, len(levels))),
        rmse=0.03,
        calibration=calibration("ssim"),
    )


def fidelity_models(
    cells: Cells, cameras: Sequence[Camera], levels: int, seed: int, last: float = 1.0
) -> dict[int, FidelityModel]:
    """A model of fidelity for each category; every third cell has no views, and every fourth few factors.

    `last`: of the last level; below 1 as of an adopted splat, which keeps targets up to that less 0.01.
    """
    known = replace(calibration("fidelity"), least_support=0.05)
    if last < 1:
        known = replace(known, targets=np.append(known.targets[:-1], last - 0.01))
    rng, found = np.random.default_rng(seed), {}
    views = np.round(views_of(cameras, EXTENT, FOCAL, SCREENS) / STEP) * STEP
    places = (np.arange(levels) + 0.5) / levels
    for label in np.unique(cells.labels).tolist():
        made = []
        for i, cell in enumerate(cells.ids[cells.labels == label].tolist()):
            rows = np.flatnonzero(rng.uniform(size=len(views)) < (0.0 if cell % 3 == 2 else 0.7))
            factors = np.where(rng.uniform(size=len(views)) < (0.9 if i % 4 == 3 else 0.3), -1.0, 0.0)
            factors = np.where(factors < 0, factors, FACTOR_STEP * rng.integers(0, 30, len(views)))
            offsets = np.append(np.sort(rng.uniform(0.6, last - 0.02, levels - 1)), last).round(4)
            values = np.round(rng.normal(0, 5, (TERMS, len(rows)))).astype(int)
            logs = LOG_STEP * np.round(rng.normal(0.8, 0.4, len(rows)) / LOG_STEP)
            made.append(CellModel(cell, offsets, places, rows, logs, 0.7, values, factors))
        found[label] = FidelityModel(
            label_id=label,
            extent=EXTENT,
            focal=FOCAL,
            screens=SCREENS,
            views=views,
            lengths=tuple(rng.uniform(0.3, 1.2, 4).tolist()),  # pyright: ignore[reportArgumentType]
            photos=_photos(seed, 5),
            cells=tuple(made),
            rmse=0.03,
            calibration=known,
        )
    return found


def _photos(seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(100 + seed)
    direction = rng.normal(size=(3, count))
    return np.concatenate([rng.normal(0, 0.7, (3, count)), direction / np.linalg.norm(direction, axis=0)])


def calibration(quality: QualityKind) -> Calibration:
    """Thresholds and slopes that rise unevenly; of fidelity the full model keeps all targets."""
    targets = np.array([0.3, 0.5, 0.6, 0.8, 0.9, 0.95])
    thresholds = np.array([0.32, 0.55, 0.601, 0.85, 0.92, 0.971])
    slopes = np.array([0.25, 0.3, 0.3, 0.2, 0.15, 0.1])
    if quality == "fidelity":
        targets, thresholds = np.append(targets, 1.0), np.append(thresholds, 1.0)
        slopes = np.append(slopes, 0.0)
    return Calibration("calibrated", 0.95, 40, targets, thresholds, slopes, 0.3)


def _curves(rng: np.random.Generator, levels: list[int]) -> tuple[SsimModel, ...]:
    kinds = ("two regimes", "one regime", "constant")
    curves = []
    for i, level in enumerate(levels):
        top = 0.4 + 0.5 * (i + rng.uniform(-0.6, 0.6)) / len(levels)
        near, far = (top, 0.4, 1.0, 1.3), (top - 0.05, 0.1, 2.5, 0.8)
        if kinds[i % 3] != "two regimes":
            near = far = (top, 0.2, 1.0, 1.1) if kinds[i % 3] == "one regime" else (top, 0.0, 0.0, 1.0)
        curves.append(
            SsimModel(7, level, Eq3(*near, *far, 2.0), (0.8, 6.0), top - 0.02, 0.03, 40, kinds[i % 3])
        )
    return tuple(curves)


def cameras_at(made: ViewModel) -> list[Camera]:
    """Cameras at the model's own views."""
    cameras = []
    for row in made.inputs:
        focal = made.focal * math.exp(row[6])
        K = np.array([[focal, 0, 35], [0, focal, 25], [0, 0, 1]], np.float32)
        z = row[3:6]
        x = np.cross([0.1, 1, 0.2], z)
        x /= np.linalg.norm(x)
        w2c = np.eye(4)
        w2c[:3, :3] = np.stack([x, np.cross(z, x), z])
        w2c[:3, 3] = -w2c[:3, :3] @ (row[:3] * made.extent)
        cameras.append(Camera(w2c.astype(np.float32), K, 70, 50, (0, 0, 0)))
    return cameras


def _ssim_case(name: str, made: ViewModel, seed: int, stored: Mapping[str, Case]) -> Case:
    rng = np.random.default_rng(seed)
    n = made.num_views
    seen = Seen(rng.uniform(0, 0.3, n), np.full(n, np.nan), rng.normal(0, 0.2, n))
    document = packed(ssim_document({made.label_id: made}, cameras_at(made), {made.label_id: seen}))
    sent = read_model(unpacked(stored.get(name, document)), made.label_id)
    position, direction = rng.normal(0, 3, (6, 3)), rng.normal(size=(6, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    for i in (0, 2, 3):  # a known view, and viewpoints beside it: the support is large enough
        position[i] = made.inputs[0, :3] * made.extent + 0.05 * i
        direction[i] = made.inputs[0, 3:6]
    position[1] = 1e3  # far from all
    away = np.array([math.exp(made.inputs[0, -1]), 2.0, math.nan, 2.1, 1.9999, 50.0])
    screen = np.array([1.0, 1.0, 1.0, 2.0, 1.0, 0.1])
    told = sent.predict(away, position, direction, screen)
    right = sent.corrected(away, position, direction)
    points = [
        {
            "position": (position[i] * FLIP).tolist(), "direction": (direction[i] * FLIP).tolist(),
            "focal": None if screen[i] == 1 else float(screen[i] * document["focal"]),
            "distance": _plain(away[i]), "corrected": _plain(right[i]),
            "mean": told.mean[i].tolist(), "bound": [_plain(value) for value in told.bound[i]],
            "support": float(told.support[i]),
        }
        for i in range(len(away))
    ]  # fmt: skip
    return {"name": name, "promises": document, "viewpoints": points}


def drawn_cameras(seed: int, count: int) -> list[Camera]:
    """Cameras around the origin that look in all directions, on screens of SCREENS and beyond."""
    rng = np.random.default_rng(seed)
    cameras = []
    for _ in range(count):
        q = rng.normal(size=4)
        where, focal = rng.normal(0, 2.5, 3), FOCAL * float(rng.uniform(0.4, 2.2))
        cameras.append(posed(where, q / np.linalg.norm(q), focal))
    return cameras


def fidelity_case(
    name: str,
    labels: Sequence[int],
    views: int,
    levels: int,
    seed: int,
    stored: Mapping[str, Case],
    last: float = 1.0,
) -> Case:
    """A case of fidelity; every fifth cell has one file less."""
    cells, cameras = make_cells(seed, labels, 2.5), drawn_cameras(seed, views)
    models = fidelity_models(cells, cameras, levels, seed, last)
    files = {c: list(range(1 + (c % 5 == 4 and levels > 1), levels + 1)) for c in cells.ids.tolist()}
    document = packed(fidelity_document(models, files, levels, cameras))
    there = [*cameras[:3], *drawn_cameras(seed + 1, 4), posed((900.0, 0, 0), AHEAD)]
    sent = read_fidelity(unpacked(stored.get(name, document)))
    expected = expect(sent, cells, there, max(map(len, files.values())))
    rng = np.random.default_rng(seed)
    composed = 1 + (
        rng.uniform(size=expected.share.shape) * [len(files[c]) for c in cells.ids.tolist()]
    ).astype(int)
    mean = expected.of_composition(composed)
    bound, of_last = (promised(sent, expected, one) for one in (mean, expected.last))
    points = [
        {
            **seen_from(camera),
            "focal": float(camera.focal),
            "levels": composed[i].tolist(),
            "expected": {
                "share": expected.share[i].tolist(),
                "means": [
                    expected.mean[i, c, : len(files[cell])].tolist() if expected.share[i, c] > 0 else None
                    for c, cell in enumerate(cells.ids.tolist())
                ],
                "away": float(expected.away[i]),
                "support": expected.support[i].tolist(),
                "mean": [_plain(value) for value in mean[i]],
                "bound": [_plain(value) for value in bound[i]],
                "last": [_plain(value) for value in of_last[i]],
            },
        }
        for i, camera in enumerate(there)
    ]
    listed = [
        {"id": label, "cells": [placed(cells, row) for row in np.flatnonzero(cells.labels == label).tolist()]}
        for label in np.unique(cells.labels).tolist()
    ]
    for label in listed:
        for cell in label["cells"]:
            cell["numLevels"] = len(files[cell["id"]])
    return {"name": name, "labels": listed, "promises": document, "viewpoints": points}


def promise_cases(stored: Mapping[str, Case] | None = None) -> list[Case]:
    """All cases of promises.json, in the frame of a bundle; predicted from `stored` documents if any."""
    known = stored or {}
    nothing = replace(model(2, 6, [1, 2, 3]), calibration=NO_CALIBRATION)
    steep = replace(model(5, 20, [1, 2, 3]), calibration=_with_slopes([0.6, -0.4, 0.2, 0.3, 0.05, -0.1]))
    return [
        _ssim_case("one view, one level", model(1, 1, [1]), 1, known),
        _ssim_case("curves of three kinds", model(2, 6, [1, 2, 3]), 2, known),
        _ssim_case("levels without a promise", model(3, 9, [2, 3, 5]), 3, known),
        _ssim_case("no view unseen", model(4, 12, [1, 2, 3, 4], unseen=False), 4, known),
        _ssim_case("no target that can be kept", nothing, 8, known),
        _ssim_case("thresholds that overtake each other", steep, 9, known),
        fidelity_case("fidelity, a cell", [7], 3, 2, 11, known),
        fidelity_case("fidelity, cells of a label", [7] * 5, 16, 4, 12, known),
        fidelity_case("fidelity, cells of labels", [3, 3, 7, 7, 7, 7, 9, 9], 20, 5, 13, known),
        fidelity_case("fidelity of an adopted splat", [3, 3, 7, 7, 7], 20, 4, 14, known, last=0.985),
    ]


def _with_slopes(slopes: Sequence[float]) -> Calibration:
    return replace(calibration("ssim"), slopes=np.array(slopes), least_support=0.0)


def _plain(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def write(path: Path, cases: list[Case]) -> None:
    """Write a file, a case a line."""
    path.parent.mkdir(exist_ok=True)
    path.write_text('{"cases":[\n' + ",\n".join(json.dumps(case) for case in cases) + "\n]}\n")


def main() -> None:
    """Write both files."""
    write(DATA / "distances.json", distance_cases())
    write(DATA / "promises.json", promise_cases())


if __name__ == "__main__":
    main()
