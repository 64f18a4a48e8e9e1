"""Test vectors of what the viewer evaluates: `python tests/make_viewer_vectors.py` writes them.

A case of tests/data/distances.json has boxes, a camera, its half spaces and under "expected" the distance
(null: nothing in sight), whether the category is visible and which boxes touch; also the half spaces within
LENS, the photos', and the distance by them. Planes are to be equal to 1e-9, distances to 1e-9 of themselves.
A case of tests/data/promises.json has a document as in promises-*.json with one label, and viewpoints with
the focal length in pixels (null: that of the photos), the distance, what it is corrected to, and the expected
mean and bound by level and the support, to 1e-9 (null: NaN).
"""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sagesplat.adapt.eq3 import Eq3, SsimModel
from sagesplat.adapt.viewpoint import (
    NO_CALIBRATION,
    PHOTOS_ONLY,
    Calibration,
    QualityKind,
    ViewModel,
    constant_curve,
)
from sagesplat.scene.scene import Camera
from sagesplat.viewer import boxes
from sagesplat.viewer.frames import FLIP
from sagesplat.viewer.promises import Seen, promises_document
from sagesplat.viewer.sent_model import read_model

DATA = Path(__file__).parent / "data"
Case = dict[str, Any]

AHEAD = (0.0, 0.0, 0.0, 1.0)
UNIT = [[-1, -1, -6, 1, 1, -4]]
LENS = (0.35, 0.3)  # half width and half height at distance 1
FOCAL = 60.0  # of the photos, pixels
SCREENS = (0.5, 2.0)
ROOM = [[-3, -1, -3, 3, 1, 3], [-1, 0, -9, 1, 2, -7]]


def _distance_case(
    name: str, found: list, position: tuple, quaternion: tuple, fov_y: float, aspect: float
) -> Case:
    box, planes = (
        np.array(found, np.float64).reshape(-1, 6),
        boxes.frustum(position, quaternion, fov_y, aspect),
    )
    touches = boxes.touching(box, planes)
    photo = boxes.photo_frustum(position, quaternion, fov_y, aspect, LENS)
    camera = {"position": position, "quaternion": quaternion, "fovY": fov_y, "aspect": aspect}
    return {
        "name": name, "boxes": box.tolist(), "camera": camera, "frustum": planes.tolist(),
        "lens": LENS, "photo": photo.tolist(),
        "expected": {
            "distance": _plain(boxes.distance(box, position, planes)),
            "inPhoto": _plain(boxes.distance(box, position, planes, photo)),
            "visible": bool(touches.any()),
            "touching": touches.tolist(),
        },
    }  # fmt: skip


def distance_cases() -> list[Case]:
    """All cases of distances.json."""
    origin, right = (0.0, 0.0, 0.0), (0.0, math.sin(-math.pi / 4), 0.0, math.cos(-math.pi / 4))
    by_hand = [
        ("ahead", UNIT, origin, AHEAD, 1.0, 1.5),
        ("behind", [[-1, -1, 4, 1, 1, 6]], origin, AHEAD, 1.0, 1.5),
        ("beside", [[4, -1, -2, 6, 1, -1]], origin, AHEAD, 1.0, 1.0),
        ("beside, after a turn", [[4, -1, -2, 6, 1, -1]], origin, right, 1.0, 1.0),
        ("inside", ROOM, origin, AHEAD, 1.0, 1.5),
        ("a corner in sight and no sample", [[2.0, -1, -6, 8, 1, -5]], origin, AHEAD, 0.9, 0.9),
        ("a flat box", [[-1, -1, -5, 1, -1, -3]], origin, AHEAD, 1.2, 1.0),
        ("a point", [[0, 0, -5, 0, 0, -5]], origin, AHEAD, 1.2, 1.0),
        ("no box", [], origin, AHEAD, 1.0, 1.0),
        ("a portrait picture", [[1.2, -1, -6, 2.2, 1, -4]], origin, AHEAD, 1.2, 0.3),
    ]
    rng = np.random.default_rng(8)
    cases = [_distance_case(*case) for case in by_hand]
    for i in range(24):
        centre, size = rng.normal(0, 4, (int(rng.integers(1, 17)), 3)), rng.exponential(1.0, 3)
        found = np.column_stack([centre - size, centre + size]).round(4).tolist()
        q = rng.normal(size=4)
        q = (q / np.linalg.norm(q)).round(6)
        fov_y, aspect = float(rng.uniform(0.4, 1.4).__round__(3)), float(rng.uniform(0.4, 2.2).__round__(3))
        position = tuple(rng.normal(0, 4, 3).round(4).tolist())
        cases.append(_distance_case(f"random {i}", found, position, tuple(q.tolist()), fov_y, aspect))
    return cases


def model(
    seed: int, views: int, levels: list[int], *, quality: QualityKind = "ssim", unseen: bool = True
) -> ViewModel:
    """A model of a category: of SSIM with curves of every kind, or of fidelity with constants."""
    rng = np.random.default_rng(seed)
    last = (
        np.array([level != levels[-1] for level in levels]) if quality == "fidelity" else np.ones(len(levels))
    )
    position, direction = rng.normal(0, 0.7, (views, 3)), rng.normal(size=(views, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    screens = SCREENS if quality == "fidelity" else PHOTOS_ONLY
    low, high = np.log(screens)
    log_screen = rng.uniform(low, high, views)
    return ViewModel(
        label_id=7,
        quality=quality,
        curves=_constants(levels) if quality == "fidelity" else _curves(rng, levels),
        extent=4.5,
        median_log_distance=float(rng.uniform(0.3, 1.2)),
        focal=FOCAL,
        screens=screens,
        inputs=np.column_stack([position, direction, log_screen, rng.normal(0.8, 0.4, views)]),
        heldout_inputs=(np.arange(views) % 5 == 2) & unseen & (quality == "ssim"),
        lengths=tuple(rng.uniform(0.2, 1.2, 4).tolist()),  # pyright: ignore[reportArgumentType]
        heldout_variance=float(rng.uniform(0, 0.4)) * unseen,
        photos=_photos(seed, 5 * (quality == "fidelity")),
        weights=rng.normal(0, 0.05, (views, len(levels))) * last,
        rmse=0.03,
        calibration=calibration(quality),
    )


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


def _constants(levels: list[int]) -> tuple[SsimModel, ...]:
    means = np.linspace(0.6, 1, len(levels)) if len(levels) > 1 else [1.0]
    return tuple(
        constant_curve(7, level, float(mean), 0.01, 40) for level, mean in zip(levels, means, strict=True)
    )


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


def _promise_case(name: str, made: ViewModel, seed: int) -> Case:
    rng = np.random.default_rng(seed)
    n = made.num_views
    seen = Seen(rng.uniform(0, 0.3, n), np.full(n, np.nan), rng.normal(0, 0.2, n))
    document = promises_document(made.quality, {made.label_id: made}, cameras_at(made), {made.label_id: seen})
    sent = read_model(document, made.label_id)
    position, direction = rng.normal(0, 3, (8, 3)), rng.normal(size=(8, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    for i in (0, 2, 3):  # a known view, and viewpoints beside it: the support is large enough
        position[i] = made.inputs[0, :3] * made.extent + 0.05 * i
        direction[i] = made.inputs[0, 3:6]
    position[1] = 1e3  # far from all
    away = np.array([math.exp(made.inputs[0, 7]), 2.0, math.nan, 2.1, 1.9999, 3.3, 50.0, 5.0])
    # on the view's own screen, on that of the photos, and on some beyond both ends of what is known
    screen = np.array([math.exp(made.inputs[0, 6]), 1.0, 0.5, 2.0, 1.3, 0.7, 0.1, 9.0])
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


def promise_cases() -> list[Case]:
    """All cases of promises.json, in the frame of a bundle."""
    nothing = replace(model(2, 6, [1, 2, 3]), calibration=NO_CALIBRATION)
    many = model(9, 30, [1, 2, 3, 4, 5, 6], quality="fidelity")
    # slopes of both signs, by which thresholds overtake each other, and those that would exceed 1
    crossing = replace(many, calibration=_with_slopes(many, [0.6, -0.4, 0.2, 0.3, 0.05, -0.1, 0.0]))
    inputs = many.inputs.copy()
    inputs[:, 6] = math.log(1.2)
    one_screen = replace(many, screens=(1.2, 1.2), inputs=inputs)
    steep = replace(many, calibration=_with_slopes(many, [0.1, 0.8, 1.5, 2.0, 4.0, 8.0, 0.0]))
    return [
        _promise_case("one view, one level", model(1, 1, [1]), 1),
        _promise_case("curves of three kinds", model(2, 6, [1, 2, 3]), 2),
        _promise_case("levels without a promise", model(3, 9, [2, 3, 5]), 3),
        _promise_case("no view unseen", model(4, 12, [1, 2, 3, 4], unseen=False), 4),
        _promise_case("many views", model(5, 40, [1, 2, 3, 4, 5, 6]), 5),
        _promise_case("fidelity", model(6, 20, [1, 2, 3, 4, 5], quality="fidelity"), 6),
        _promise_case("fidelity, one level", model(7, 3, [1], quality="fidelity"), 7),
        _promise_case("no target that can be kept", nothing, 8),
        _promise_case("thresholds that overtake each other", crossing, 9),
        _promise_case("thresholds beyond 1", steep, 10),
        _promise_case("one screen", one_screen, 11),
    ]


def _with_slopes(made: ViewModel, slopes: Sequence[float]) -> Calibration:
    return replace(made.calibration, slopes=np.array(slopes), least_support=0.0)


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
