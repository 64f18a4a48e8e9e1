"""Readers of what lies in a run folder, a bundle or a study: JSON, CSV and TOML."""

import json
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sagesplat.adapt import cell_models, cells, eq3, fidelity, plan_files, viewpoint, viewpoints
from sagesplat.adapt.evaluate import Evaluation, read_evaluation
from sagesplat.adapt.observe import Observations, read_observations
from sagesplat.core.events import Event
from sagesplat.formats import label_edits
from sagesplat.io import lock
from sagesplat.io.columns import from_rows
from sagesplat.io.files import read_json
from sagesplat.run import remote
from sagesplat.run.capture import fingerprint, photo_hashes
from sagesplat.run.job import Job
from sagesplat.run.recorded import recorded_settings, stage_seconds
from sagesplat.run.records import FORMAT, input_hashes, is_done, is_made_from, settings_of
from sagesplat.run.run_dir import RunDir
from sagesplat.run.stage import Stage, _follows
from sagesplat.scene import load_scene
from sagesplat.scene.blocks import Blocks, read_blocks, read_division, write_blocks
from sagesplat.scene.cameras import read_camera_file
from sagesplat.scene.refined import RefinedCameras, read_refined, write_refined
from sagesplat.scene.scene import Camera
from sagesplat.segment import segmenters
from sagesplat.segment.masks import Taxonomy
from sagesplat.segment.parents import read_parents, write_parents
from sagesplat.stages import label, live_bundle, view
from sagesplat.stages.clean import read_clean_figures
from sagesplat.stages.edited import LabelSettings, label_settings, write_edited
from sagesplat.stages.prompts import read_scores
from sagesplat.stages.refine import read_refined_figures
from sagesplat.stages.train import read_cap, read_frozen
from sagesplat.studies.compare.report import OfLabel, Point, Walk, read_comparison, write_comparison
from sagesplat.studies.measure.levels import levels_of
from sagesplat.studies.paper.cross_view import CrossView, read_cross_view
from sagesplat.studies.paper.same_size import SameSize, read_same_size
from sagesplat.studies.sweep.file import read_sweep
from sagesplat.train.clean import CRITERIA
from sagesplat.train.sky import Shell, Sky, read_sky, write_sky
from sagesplat.viewer.bundle import is_bundle
from tests.fuzz.hostile import MIB, Reader
from tests.fuzz.readers.captures import points
from tests.fuzz.readers.making import (
    PHOTOS,
    Make,
    as_json,
    documents,
    file,
    noted,
    put,
    put_photos,
    written,
    written_by,
)
from tests.fuzz.readers.splats import CHUNK

MEASURED = dict.fromkeys(("plain", "exposed", "cc"), 20.5)
FIGURES = {
    "poses": {"pixels": 0.3, "degrees": 0.1, "shift": 0.01, "diverged": 1, "fitted": 2, "held_out": 3}
    | {"psnr": [20.5, 24.0], "ssim": None},
    "exposure": {"range_ev": 1.4, "psnr": MEASURED, "ssim": None},
}
COUNTS, DECIBELS = dict.fromkeys(CRITERIA, 3), {"train": 20.5, "calibration": 19.0}
FLOATERS = {"gaussians": 50, "found": COUNTS, "removed": COUNTS, "before": DECIBELS, "after": DECIBELS}
CURVE = {"label_id": 2, "level": 1, "d_range": [1, 9.5], "median": 0.8, "rmse": 0.01, "num_observations": 7}
CHOICE = {"label_id": 2, "level": 1, "predicted": 0.8, "distance": None, "count": 3, "status": ""}
CAMERA = Camera(np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32), 4, 3)
TRAINED = {"antialiased": True, "max_steps": 9, "seed": 3}
SWEEP = """targets = [0.4, 0.3]
seeds = [0, 5]
settings.ladder = "snapshots"
settings.train = { max_steps = 60, level_every = 20 }
scenes.plot = "demo"
variants.track = {}
variants.published.train.lr_schedule = "published"
"""


def _ignore(event: Event) -> None:
    pass


def _refined(folder: Path, size: int) -> list[bytes]:
    w2c, exposure = (np.tile(np.eye(n, 4, dtype=np.float32), (3 * size, 1, 1)) for n in (4, 3))
    cameras = RefinedCameras(w2c, exposure, np.zeros(len(w2c), bool))
    (folder / "views").write_text(str(len(w2c)))
    return [written(folder / "c.npz", lambda path: write_refined(path, cameras))]


def _read_refined(path: Path) -> None:
    read_refined(path, int(path.with_name("views").read_text()))


def _write_sky(path: Path, size: int) -> None:
    xyz = np.tile(np.array([[20, 0, 1], [0, 20, 1]], np.float32), (20 * size, 1))
    sky = Sky(Shell(np.array([0, 0, 1], np.float32), 20.0, 2.0, (3, 9)), xyz, np.ones(xyz.shape, np.uint8))
    write_sky(path, sky)


def _models(folder: Path, size: int) -> list[bytes]:
    params = {field.name: 0.5 for field in fields(eq3.Eq3)}
    curve = CURVE | {"params": params, "status": sorted(eq3.STATUSES)[0]}
    return as_json({"models": [curve | {"level": 1 + i} for i in range(size)]})


def _fidelity(folder: Path, size: int) -> list[bytes]:
    promise = json.loads(_promises(folder, 1)[0])["promises"][0]
    names = ("extent", "focal", "screens", "lengths", "photos", "rmse", "calibration")
    cell = {
        "cell": 1, "offsets": [0.5, 1.0], "places": [0.25, 0.75], "rows": [0, 1], "log_distances": [0.1, 0.2],
        "median_log_distance": 0.1, "values": [[1, -2]] * 6, "factors": [0.5, -1.0],
    }  # fmt: skip
    entry = {name: promise[name] for name in names} | {"views": [[0.1] * 8, [0.2] * 8], "cells": [cell]}
    return as_json({"models": [entry | {"label_id": 2 + i} for i in range(size)]})


def _write_cells(path: Path, size: int) -> None:
    ids, ones = np.arange(size), np.ones(size)
    grid = np.full((size, cells.POINTS, 4), 9, np.uint8)
    cells.write_cells(path, cells.Cells(ids, ids // 2, np.ones((size, 6)), grid, ones, ones))


def _promises(folder: Path, size: int) -> list[bytes]:
    curve = json.loads(_models(folder, 1)[0])["models"][0]
    entry = dict.fromkeys(("extent", "median_log_distance", "heldout_variance", "rmse", "focal"), 0.5) | {
        "curves": [curve],
        "lengths": [1, 2, 0.5, 0.7],
        "screens": [0.5, 2],
    }
    entry |= {"inputs": [[0.1] * 9, [0.2] * 9], "heldout_inputs": [False, True], "weights": [[0.1], [0.2]]}
    entry["photos"] = [[0.1, 0.3]] * 6
    calibration = {"status": sorted(viewpoint.STATUSES)[0], "confidence": 0.95, "num_views": 20}
    calibration |= {"targets": [0.5, 0.7], "thresholds": [0.52, 0.7], "least_support": 0.2}  # type: ignore
    calibration |= {"slopes": [0.1, 0]}
    entry |= {"quality": "fidelity", "calibration": calibration}  # type: ignore
    return as_json({"promises": [entry | {"label_id": 2 + i} for i in range(size)]})


def _write_viewpoints(path: Path, size: int) -> None:
    drawn = viewpoints.Viewpoints(viewpoints.Rule(), "capture", 4.0, (CAMERA,) * size, ("fit",) * size)
    viewpoints.write_viewpoints(path, drawn)


_viewpoints = written_by("v.json", _write_viewpoints)


def _camera_files(folder: Path, size: int) -> list[bytes]:
    entry = {"id": 0, "img_name": "a", "width": 4, "height": 3, "position": [0, 0, 1], "fx": 4.0, "fy": 4.0}
    entry |= {"rotation": np.eye(3).tolist()}  # type: ignore
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}] * size
    shared = {"w": 4, "h": 3, "fl_x": 4.0, "cx": 2.0, "k1": 0.01}
    return [*as_json([entry] * size, shared | {"frames": frames}), *_viewpoints(folder, size)]


def _bundled(folder: Path, size: int) -> list[bytes]:
    chunk = {"uri": "chunks/a.spz", "counts": [3], "bytes": [9], "sha256": "0" * 12}
    files = [chunk, chunk | {"refine": "REPLACE"}] * size
    stream = {"counts": [3] * size, "bytes": [9] * size, "weights": [0.5] * size}
    ranges = [chunk | stream | {"uri": "chunks/a.sgst", "offset": 9}]
    cells = [{"id": i, "levels": levels} for i, levels in enumerate((files, ranges))]
    labels = [{"id": 3, "title": "sky", "cells": cells}]
    return as_json(*({"format": "sagesplat-bundle", "antialiased": True, "labels": [one]} for one in labels))


def _cameras(folder: Path, size: int) -> list[bytes]:
    frames = {"frames": [{"transform_matrix": np.eye(4).tolist()}] * size}
    return [*as_json(frames), *_viewpoints(folder, size)]


def _write_sampled(path: Path, size: int) -> None:
    table = fidelity.SampledFidelity(
        (3, 7), np.full((size, 2, 3), 0.5, np.float32), np.full((size, 2), 4, np.int32),
        np.full(size, 9, np.int32), np.ones((size, 3), np.float32), np.ones((size, 2), np.float32),
    )  # fmt: skip
    fidelity.write_sampled(path, table)


def _plans(folder: Path, size: int) -> list[bytes]:
    choice = CHOICE | {"status": "ok", "transfer_bytes": 9}
    scene = {"target": 0.8, "view": None, "share": 0.9, "choices": [choice]}
    budget = scene | {"target": None, "budget": 1e6, "unit": "bytes", "fits": True}
    views = [scene | {"view": 1 + i} for i in range(size)]
    return as_json({"targets": [0.8], "scene": [scene], "views": views, "budget": budget})


def _read_plans(path: Path) -> None:
    plan_files.read_plans(path)
    plan_files.read_budget_plan(path)


def _table(kind: Any) -> Make:
    """Makers of the CSV files of a kind of table."""
    row = dict.fromkeys((field.name for field in fields(kind)), 1)
    return written_by("t.csv", lambda path, size: from_rows(kind, [row] * 2 * size).write_csv(path))


def _write_partition(path: Path, size: int) -> None:
    low, high = np.array([[-np.inf, 0], [1, -np.inf]]), np.array([[1, np.inf], [np.inf, 2.5]])
    blocks = Blocks(np.eye(3)[:2], low, high, 0.5)
    write_blocks(path, blocks, points=[3, 4], views=[5, 6], sees=[[1], [0]], note=[3.5] * size)


def _read_partition(path: Path) -> None:
    read_blocks(path)
    read_division(path)


def _sweep(folder: Path, size: int) -> list[bytes]:
    return [(SWEEP + "".join(f'scenes.s{i} = "demo"\n' for i in range(size - 1))).encode()]


def _write_comparison(path: Path, size: int) -> None:
    fields: Any = [dict.fromkeys(kind.__dataclass_fields__, 1) for kind in (OfLabel, Point, Walk)]
    named = {"method": "SAGE", "name": "0.8", "labels": {2: OfLabel(**fields[0])}}
    point, walk = Point(**fields[1] | named), Walk(**fields[2] | {"method": "SAGE", "keeps": True})
    write_comparison(path, [point] * size, [walk])


@cache
def _capture(folder: Path) -> dict[str, Any]:
    """A capture with three photos, and the scene.json of its run."""
    capture = folder / "capture"
    put_photos(capture / "images")
    (capture / "points.ply").write_bytes(points(capture, 1)[0])
    pose = np.eye(4)
    pose[2, 3] = 5  # in front of the points, so that they are not replaced by random ones
    frames = [{"file_path": f"images/{name}", "transform_matrix": pose.tolist()} for name in PHOTOS]
    shared = {"w": 16, "h": 12, "fl_x": 14.0, "ply_file_path": "points.ply", "frames": frames}
    (capture / "transforms.json").write_text(json.dumps(shared))
    settings: dict[str, Any] = {"downscale": 1, "test_every": 8}
    scene = load_scene(capture, **settings)
    photos = photo_hashes(folder / "none.json", scene).sha256
    return {"path": str(capture), "settings": settings, "fingerprint": fingerprint(scene), "photos": photos}


def _scenes(folder: Path, size: int) -> list[bytes]:
    return as_json(_capture(folder) | {f"note{i}": [i, 0.5] for i in range(size - 1)})


def _read_scene(path: Path) -> None:
    run = RunDir(path.parent)
    len(Job(run, _ignore).scene.views)
    recorded_settings(run)


def _hashes(folder: Path, size: int) -> list[bytes]:
    made = _capture(folder)
    more = {f"{i}.png": [9, 9, 9, "0" * 64] for i in range(size - 1)}
    return as_json({name: [9, 9, 9, sha256] for name, sha256 in made["photos"].items()} | more)


def _read_hashes(path: Path) -> None:
    scene = load_scene(Path(_capture(path.parent)["path"]))
    assert photo_hashes(path, scene).sha256.keys() == {view.name for view in scene.views}


def _read_elsewhere(path: Path) -> None:
    """As a process of another machine reads it."""
    job = Job(RunDir(path.parent), _ignore)
    remote._kept.__wrapped__(job.spec, path.read_bytes())


def _provenance(folder: Path, size: int) -> list[bytes]:
    put(folder / "scene.json", b"{}")
    put(folder / "labels.npz", b"x")
    inputs = {"scene.json": "0" * 64} | {f"levels/{i:06d}.npz": "1" * 64 for i in range(size - 1)}
    made = {"format": FORMAT, "stage": "train", "version": "1", "seconds": 3.5, "settings": TRAINED}
    return as_json(made | {"inputs": inputs})


def _read_provenance(path: Path) -> None:
    run = RunDir(path.parents[1])
    stage_seconds(run)
    recorded_settings(run)
    _follows(Job(run, _ignore), Stage("train", TRAINED, [], []))
    is_done(run, "train", TRAINED, None, [run.scene], False)
    settings_of(run, "train")
    is_made_from(run, "train", run.scene)


def _read_shown(path: Path) -> None:
    """As a viewer looks at it, and as the hash of an input that others were made from."""
    run = RunDir(path.parents[1])
    view._open_run(run.path, _ignore)
    input_hashes(run, [path])


def _caps(folder: Path, size: int) -> list[bytes]:
    put(folder / "scene.json", _scenes(folder, 1)[0])
    return as_json({"cap": 900, "settings": TRAINED | {f"note{i}": i for i in range(size - 1)}})


def _read_cap(path: Path) -> None:
    run = RunDir(path.parent)
    recorded_settings(run)
    read_cap(path)


def _manifest(folder: Path, size: int) -> list[bytes]:
    (folder / "index.html").write_text("<title>x</title>")
    put(
        folder / "run/nested/increments/index.json",
        json.dumps({"format": "spz", "chunks": [CHUNK | {"uri": "2-1.spz"}]}).encode(),
    )
    put(folder / "run/nested/promises.json", b"{}")
    levels = [{"uri": "chunks/2-1.spz"}]
    cells = [{"id": i, "levels": levels} for i in range(size)]
    labels = [{"id": 2 + i, "name": "sky", "cells": cells[i : i + 2]} for i in range(size)]
    return as_json({"format": "sagesplat-bundle", "version": 1, "ladder": "aa", "labels": labels})


def _read_manifest(path: Path) -> None:
    is_bundle(path.parent)
    view.is_bundle(path.parent)
    view._is_current(RunDir(path.parent / "run"), path.parent)


def _label_edits(folder: Path, size: int) -> list[bytes]:
    listed = [label_edits.Rename("sky", f"sky {i}") for i in range(size)]
    more = (
        label_edits.Merge("car", "sky"), label_edits.Split("sky", "sun", {"sky": ((0, 3), (7, 2))}),
        label_edits.Hide("sky", True), label_edits.Weigh("sky", 2.0), label_edits.Full("sky", False),
    )  # fmt: skip
    return [label_edits.dump_edits(label_edits.LabelEdits("0" * 64, (*listed, *more)))]


def _write_edited(path: Path, size: int) -> None:
    settings = LabelSettings({f"sky {i}": 2.0 for i in range(size)}, ("sky",), ("tree",))
    write_edited(RunDir(path.parent), "r", [], settings)


OPTIONS = {"masks": "/p", "classes": None, "segmenter": "onnx", "keep": ["sky"]}
NETWORK = {"segmenter": "onnx", "model": "0" * 64}
READERS = (
    Reader("json", ".json", documents(lambda n: {"a": [1, "x", None, 1.5] * n}, lambda n: [[], {}]),
           file("m.json", read_json)),
    Reader("models", ".json", _models, file("models.json", eq3.read_models)),
    Reader("promises", ".json", _promises, file("promises.json", viewpoint.read_promises)),
    Reader("fidelity", ".json", _fidelity, file("fidelity.json", cell_models.read_fidelity)),
    Reader("cells", ".npz", written_by("c.npz", _write_cells), file("cells.npz", cells.read_cells), 1000),
    Reader("viewpoints", ".json", _viewpoints, file("viewpoints.json", viewpoints.read_viewpoints), 100),
    Reader("bundle-levels", ".json", _bundled, file("manifest.json", lambda p: levels_of(p.parent)), 100),
    Reader("camera-files", ".json", _camera_files, file("c.json", read_camera_file), 100),
    Reader("cameras", ".json", _cameras,
           file("path.json", lambda p: viewpoints.read_cameras(p, CAMERA)), 100),
    Reader("refined", ".npz", _refined, file("cameras.npz", _read_refined), 1000),
    Reader("sky", ".npz", written_by("s.npz", _write_sky), file("sky.npz", read_sky), 1000),
    Reader("refined-figures", ".json", noted(FIGURES), file("refined.json", read_refined_figures), 3000),
    Reader("floaters", ".json", noted(FLOATERS), file("floaters.json", read_clean_figures), 3000),
    Reader("sampled", ".npz", written_by("f.npz", _write_sampled),
           file("fidelity.npz", fidelity.read_sampled), 1000),
    Reader("plans", ".json", _plans, file("plan.json", _read_plans), 100),
    Reader("observations", ".csv", _table(Observations), file("o.csv", read_observations), 1000),
    Reader("evaluation", ".csv", _table(Evaluation), file("e.csv", read_evaluation), 1000),
    Reader("cross-view", ".csv", _table(CrossView), file("c.csv", read_cross_view), 1000),
    Reader("same-size", ".csv", _table(SameSize), file("s.csv", read_same_size), 1000),
    Reader("partition", ".json", written_by("b.json", _write_partition),
           file("b.json", _read_partition), 10_000),
    Reader("sweep", ".toml", _sweep, file("s.toml", read_sweep), 300, 16 * MIB),
    Reader("comparison", ".json", written_by("c.json", _write_comparison),
           file("compare.json", read_comparison)),
    Reader("scene", ".json", _scenes, file("scene.json", _read_scene), 3000),
    Reader("scene-elsewhere", ".json", _scenes, file("scene.json", _read_elsewhere), 3000),
    Reader("provenance", ".json", _provenance, file("provenance/train.json", _read_provenance), 1000),
    Reader("provenance-shown", ".json", _provenance, file("provenance/scene.json", _read_shown), 1000),
    Reader("cap", ".json", _caps, file("cap.json", _read_cap), 3000),
    Reader("options", ".json", noted(OPTIONS),
           file("segmented/options.json", lambda p: recorded_settings(RunDir(p.parents[1]))), 3000),
    Reader("manifest", ".json", _manifest, file("manifest.json", _read_manifest)),
    Reader("segmented", ".json", documents(lambda n: {str(i): f"thing {i}" for i in range(n)}),
           file(".taxonomy.json", lambda p: segmenters._begin(p.parent, Taxonomy({0: "thing 0"}), [])), 1000),
    Reader("photo-hashes", ".json", _hashes, file("photos.json", _read_hashes), 1000),
    Reader("frozen", ".json", documents(lambda n: {str(label): 500 for label in range(2 * n)}),
           file("frozen.json", read_frozen), 3000),
    Reader("edits", ".json", documents(lambda n: {"table": [0, 7, -1, *range(n)], "labels": {"7": "sky"}}),
           file("edit.json", lambda p: label.read_edit_table(p, Taxonomy({0: "sky", 2: "tree"}))), 10_000),
    Reader("label-edits", ".json", _label_edits, file("labels.edit.json", label_edits.read_edits), 1000),
    Reader("parents", ".json",
           written_by("p.json", lambda p, n: write_parents(p, {f"chair {i}": "chair" for i in range(n)})),
           file("parents.json", read_parents), 3000),
    Reader("edited", ".json", written_by("edited.json", _write_edited),
           file("edited.json", lambda p: label_settings(RunDir(p.parent))), 3000),
    Reader("segmenting", ".json", noted(NETWORK),
           file(".network.json", lambda p: label._is(p, NETWORK)), 3000),
    Reader("prompts", ".json",
           documents(lambda n: {"best": {f"prompt {i}": 0.5 for i in range(n)}, "threshold": 0.3},
               lambda n: {"best": []}),
           file(".prompts-0.json", read_scores), 3000),
    Reader("live", ".json",
           documents(lambda n: {"of": {"level": "1.npz", "written": 9}, "kept": [["chunks/a.spz"] * n]}),
           file("live.json", live_bundle.read_live), 3000),
    Reader("lock", ".json",
           documents(lambda n: {"pid": 9, "host": "h", "command": "sagesplat run" * n, "since": "2026"}),
           file("lock", lock._holder), 3000),
)  # fmt: skip
