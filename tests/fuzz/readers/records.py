"""Readers of what lies in a run folder, a bundle or a study: JSON, CSV and TOML."""

import json
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sagesplat.adapt import eq3, fidelity, plan_files, viewpoint, viewpoints
from sagesplat.adapt.evaluate import Evaluation, read_evaluation
from sagesplat.adapt.observe import Observations, read_observations
from sagesplat.core.events import Event
from sagesplat.formats import label_edits
from sagesplat.io import lock
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
from tests.fuzz.readers.making import PHOTOS, as_json, file, put, put_photos, written
from tests.fuzz.readers.splats import CHUNK

CURVE = {
    "label_id": 2,
    "level": 1,
    "d_range": [1, 9.5],
    "median": 0.8,
    "rmse": 0.01,
    "num_observations": 7,
    "status": "",
}
CHOICE = {"label_id": 2, "level": 1, "predicted": 0.8, "distance": None, "count": 3, "status": ""}
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


def _json(folder: Path, size: int) -> list[bytes]:
    return as_json({"a": [1, "x", None, 1.5] * size}, [[], {}])


def _refined(folder: Path, size: int) -> list[bytes]:
    w2c, exposure = (np.tile(np.eye(n, 4, dtype=np.float32), (3 * size, 1, 1)) for n in (4, 3))
    cameras = RefinedCameras(w2c, exposure, np.zeros(len(w2c), bool))
    (folder / "views").write_text(str(len(w2c)))
    return [written(folder / "c.npz", lambda path: write_refined(path, cameras))]


def _read_refined(path: Path) -> None:
    read_refined(path, int(path.with_name("views").read_text()))


def _sky(folder: Path, size: int) -> list[bytes]:
    xyz = np.tile(np.array([[20, 0, 1], [0, 20, 1]], np.float32), (20 * size, 1))
    sky = Sky(Shell(np.array([0, 0, 1], np.float32), 20.0, 2.0, (3, 9)), xyz, np.ones(xyz.shape, np.uint8))
    return [written(folder / "s.npz", lambda path: write_sky(path, sky))]


def _figures(folder: Path, size: int) -> list[bytes]:
    numbers = {"pixels": 0.3, "degrees": 0.1, "shift": 0.01, "diverged": 1, "fitted": 2, "held_out": 3}
    entry = numbers | {"psnr": [20.5, 24.0], "ssim": None}
    measured = dict.fromkeys(("plain", "exposed", "cc"), 20.5)
    exposure = {"range_ev": 1.4, "psnr": measured, "ssim": None}
    return as_json({"poses": entry, "exposure": exposure} | {f"note{i}": i for i in range(size - 1)})


def _floaters(folder: Path, size: int) -> list[bytes]:
    counts, decibels = dict.fromkeys(CRITERIA, 3), {"train": 20.5, "calibration": 19.0}
    entry = {"gaussians": 50, "found": counts, "removed": counts, "before": decibels, "after": decibels}
    return as_json(entry | {f"note{i}": i for i in range(size - 1)})


def _models(folder: Path, size: int) -> list[bytes]:
    params = {field.name: 0.5 for field in fields(eq3.Eq3)}
    curve = CURVE | {"params": params, "status": sorted(eq3.STATUSES)[0]}
    return as_json({"models": [curve | {"level": 1 + i} for i in range(size)]})


def _promises(folder: Path, size: int) -> list[bytes]:
    curve = json.loads(_models(folder, 1)[0])["models"][0]
    entry = dict.fromkeys(("extent", "median_log_distance", "heldout_variance", "rmse"), 0.5) | {
        "curves": [curve],
        "lengths": [1, 2, 0.5],
    }
    entry |= {"inputs": [[0.1] * 7, [0.2] * 7], "heldout_inputs": [False, True], "weights": [[0.1], [0.2]]}
    calibration = {"status": sorted(viewpoint.STATUSES)[0], "confidence": 0.95, "num_views": 20}
    calibration |= {"targets": [0.5, 0.7], "thresholds": [0.52, 0.7], "least_support": 0.2}  # type: ignore
    entry |= {"quality": "fidelity", "calibration": calibration}  # type: ignore
    return as_json({"promises": [entry | {"label_id": 2 + i} for i in range(size)]})


def _viewpoints(folder: Path, size: int) -> list[bytes]:
    camera = Camera(np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32), 4, 3)
    drawn = viewpoints.Viewpoints(viewpoints.Rule(), "capture", (camera,) * size, ("fit",) * size)
    return [written(folder / "v.json", lambda path: viewpoints.write_viewpoints(path, drawn))]


def _read_cameras(path: Path) -> None:
    viewpoints.read_cameras(path, Camera(np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32), 4, 3))


def _camera_files(folder: Path, size: int) -> list[bytes]:
    entry = {"id": 0, "img_name": "a", "width": 4, "height": 3, "position": [0, 0, 1], "fx": 4.0, "fy": 4.0}
    entry |= {"rotation": np.eye(3).tolist()}  # type: ignore
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}] * size
    shared = {"w": 4, "h": 3, "fl_x": 4.0, "cx": 2.0, "k1": 0.01}
    return [*as_json([entry] * size, shared | {"frames": frames}), *_viewpoints(folder, size)]


def _bundled(folder: Path, size: int) -> list[bytes]:
    chunk = {"uri": "chunks/a.spz", "count": 3, "bytes": 9, "gpuBytes": 9, "sha256": "0" * 64}
    files = [chunk, chunk | {"refine": "REPLACE"}] * size
    ranges = [chunk | {"uri": "chunks/a.sgst", "offset": 9 * i, "weight": 0.5} for i in range(size)]
    labels = [{"id": i, "title": "sky", "levels": levels} for i, levels in enumerate((files, ranges))]
    return as_json(*({"format": "sagesplat-bundle", "antialiased": True, "labels": [one]} for one in labels))


def _cameras(folder: Path, size: int) -> list[bytes]:
    frames = {"frames": [{"transform_matrix": np.eye(4).tolist()}] * size}
    return [*as_json(frames), *_viewpoints(folder, size)]


def _sampled(folder: Path, size: int) -> list[bytes]:
    table = fidelity.SampledFidelity(
        (3, 7), np.full((size, 2, 3), 0.5, np.float32), np.full((size, 2), 4, np.int32),
        np.full(size, 9, np.int32), np.ones((size, 3), np.float32), np.ones((size, 2), np.float32),
    )  # fmt: skip
    return [written(folder / "f.npz", lambda path: fidelity.write_sampled(path, table))]


def _plans(folder: Path, size: int) -> list[bytes]:
    choice = CHOICE | {"status": "ok", "transfer_bytes": 9}
    scene = {"target": 0.8, "view": None, "share": 0.9, "choices": [choice]}
    budget = scene | {"target": None, "budget": 1e6, "unit": "bytes", "fits": True}
    views = [scene | {"view": 1 + i} for i in range(size)]
    return as_json({"targets": [0.8], "scene": [scene], "views": views, "budget": budget})


def _read_plans(path: Path) -> None:
    plan_files.read_plans(path)
    plan_files.read_budget_plan(path)


def _table(kind: Any) -> Any:
    """Makers of the CSV files of a kind of table."""

    def make(folder: Path, size: int) -> list[bytes]:
        rows = {name: np.full(2 * size, 1, dtype) for name, dtype in _types(kind).items()}
        return [written(folder / "t.csv", kind(**rows).write_csv)]

    return make


def _types(kind: Any) -> dict[str, Any]:
    from sagesplat.io.columns import _types as types

    return types(kind)


def _partition(folder: Path, size: int) -> list[bytes]:
    low, high = np.array([[-np.inf, 0], [1, -np.inf]]), np.array([[1, np.inf], [np.inf, 2.5]])
    blocks = Blocks(np.eye(3)[:2], low, high, 0.5)
    made = {"points": [3, 4], "views": [5, 6], "sees": [[1], [0]], "note": [3.5] * size}
    return [written(folder / "b.json", lambda path: write_blocks(path, blocks, **made))]


def _read_partition(path: Path) -> None:
    read_blocks(path)
    read_division(path)


def _sweep(folder: Path, size: int) -> list[bytes]:
    return [(SWEEP + "".join(f'scenes.s{i} = "demo"\n' for i in range(size - 1))).encode()]


def _comparison(folder: Path, size: int) -> list[bytes]:
    fields: Any = [dict.fromkeys(kind.__dataclass_fields__, 1) for kind in (OfLabel, Point, Walk)]
    named = {"method": "SAGE", "name": "0.8", "labels": {2: OfLabel(**fields[0])}}
    point, walk = Point(**fields[1] | named), Walk(**fields[2] | {"method": "SAGE", "keeps": True})
    return [written(folder / "c.json", lambda path: write_comparison(path, [point] * size, [walk]))]


@cache
def _capture(folder: Path) -> dict[str, Any]:
    """A capture with three photos, and the scene.json of its run."""
    capture = folder / "capture"
    put_photos(capture / "images")
    (capture / "points.ply").write_bytes(points(capture, 1)[0])
    pose = np.eye(4).tolist()
    frames = [{"file_path": f"images/{name}", "transform_matrix": pose} for name in PHOTOS]
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


def _taxonomies(folder: Path, size: int) -> list[bytes]:
    return as_json({str(i): f"thing {i}" for i in range(size)})


def _read_taxonomy(path: Path) -> None:
    segmenters._begin(path.parent, Taxonomy({0: "thing 0"}), [])


def _caps(folder: Path, size: int) -> list[bytes]:
    put(folder / "scene.json", _scenes(folder, 1)[0])
    return as_json({"cap": 900, "settings": TRAINED | {f"note{i}": i for i in range(size - 1)}})


def _read_cap(path: Path) -> None:
    run = RunDir(path.parent)
    recorded_settings(run)
    read_cap(path)


def _options(folder: Path, size: int) -> list[bytes]:
    more = {f"note{i}": i for i in range(size - 1)}
    return as_json({"masks": "/p", "classes": None, "segmenter": "onnx", "keep": ["sky"], **more})


def _read_options(path: Path) -> None:
    recorded_settings(RunDir(path.parents[1]))


def _manifest(folder: Path, size: int) -> list[bytes]:
    (folder / "index.html").write_text("<title>x</title>")
    put(
        folder / "run/nested/increments/index.json",
        json.dumps({"format": "spz", "chunks": [CHUNK | {"uri": "2-1.spz"}]}).encode(),
    )
    put(folder / "run/nested/promises.json", b"{}")
    levels = [{"uri": "chunks/2-1.spz", "sha256": "0" * 64, "nbytes": 9}]
    labels = [{"id": 2 + i, "name": "sky", "levels": levels} for i in range(size)]
    return as_json({"format": "sagesplat-bundle", "version": 1, "labels": labels})


def _read_manifest(path: Path) -> None:
    is_bundle(path.parent)
    view.is_bundle(path.parent)
    view._is_current(RunDir(path.parent / "run"), path.parent)


def _begun(folder: Path, size: int) -> list[bytes]:
    """A checkpoint from which a bundle of a training reads one setting."""
    from tests.fuzz.readers.splats import _checkpoints

    return _checkpoints(folder, size)


def _read_begun(path: Path) -> None:
    live_bundle.trains_antialiased(Job(RunDir(path.parent), _ignore))


def _frozen(folder: Path, size: int) -> list[bytes]:
    return as_json({str(label): 500 for label in range(2 * size)})


def _edits(folder: Path, size: int) -> list[bytes]:
    return as_json({"table": [0, 7, -1, *range(size)], "labels": {"7": "sky"}})


def _read_edits(path: Path) -> None:
    label.read_edit_table(path, Taxonomy({0: "sky", 2: "tree"}))


def _label_edits(folder: Path, size: int) -> list[bytes]:
    listed = [label_edits.Rename("sky", f"sky {i}") for i in range(size)]
    more = (
        label_edits.Merge("car", "sky"), label_edits.Split("sky", "sun", {"sky": ((0, 3), (7, 2))}),
        label_edits.Hide("sky", True), label_edits.Weigh("sky", 2.0), label_edits.Full("sky", False),
    )  # fmt: skip
    return [label_edits.dump_edits(label_edits.LabelEdits("0" * 64, (*listed, *more)))]


def _parents(folder: Path, size: int) -> list[bytes]:
    parents = {f"chair {i}": "chair" for i in range(size)}
    return [written(folder / "p.json", lambda path: write_parents(path, parents))]


def _edited(folder: Path, size: int) -> list[bytes]:
    settings = LabelSettings({f"sky {i}": 2.0 for i in range(size)}, ("sky",), ("tree",))
    return [
        written(folder / "edited.json", lambda path: write_edited(RunDir(path.parent), "r", [], settings))
    ]


def _read_edited(path: Path) -> None:
    label_settings(RunDir(path.parent))


NETWORK = {"segmenter": "onnx", "model": "0" * 64}


def _networks(folder: Path, size: int) -> list[bytes]:
    return as_json(NETWORK | {f"note{i}": i for i in range(size - 1)})


def _read_network(path: Path) -> None:
    label._is(path, NETWORK)


def _scores(folder: Path, size: int) -> list[bytes]:
    return as_json({"best": {f"prompt {i}": 0.5 for i in range(size)}, "threshold": 0.3}, {"best": []})


def _live(folder: Path, size: int) -> list[bytes]:
    return as_json({"of": {"level": "1.npz", "written": 9}, "kept": [["chunks/a.spz"] * size]})


def _lock(folder: Path, size: int) -> list[bytes]:
    return as_json({"pid": 9, "host": "h", "command": "sagesplat run" * size, "since": "2026"})


READERS = (
    Reader("json", ".json", _json, file("m.json", read_json)),
    Reader("models", ".json", _models, file("models.json", eq3.read_models)),
    Reader("promises", ".json", _promises, file("promises.json", viewpoint.read_promises)),
    Reader("viewpoints", ".json", _viewpoints, file("viewpoints.json", viewpoints.read_viewpoints), 100),
    Reader("bundle-levels", ".json", _bundled, file("manifest.json", lambda p: levels_of(p.parent)), 100),
    Reader("camera-files", ".json", _camera_files, file("c.json", read_camera_file), 100),
    Reader("cameras", ".json", _cameras, file("path.json", _read_cameras), 100),
    Reader("refined", ".npz", _refined, file("cameras.npz", _read_refined), 1000),
    Reader("sky", ".npz", _sky, file("sky.npz", read_sky), 1000),
    Reader("refined-figures", ".json", _figures, file("refined.json", read_refined_figures), 3000),
    Reader("floaters", ".json", _floaters, file("floaters.json", read_clean_figures), 3000),
    Reader("sampled", ".npz", _sampled, file("fidelity.npz", fidelity.read_sampled), 1000),
    Reader("plans", ".json", _plans, file("plan.json", _read_plans), 100),
    Reader("observations", ".csv", _table(Observations), file("o.csv", read_observations), 1000),
    Reader("evaluation", ".csv", _table(Evaluation), file("e.csv", read_evaluation), 1000),
    Reader("cross-view", ".csv", _table(CrossView), file("c.csv", read_cross_view), 1000),
    Reader("same-size", ".csv", _table(SameSize), file("s.csv", read_same_size), 1000),
    Reader("partition", ".json", _partition, file("b.json", _read_partition), 10_000),
    Reader("sweep", ".toml", _sweep, file("s.toml", read_sweep), 300, 16 * MIB),
    Reader("comparison", ".json", _comparison, file("compare.json", read_comparison)),
    Reader("scene", ".json", _scenes, file("scene.json", _read_scene), 3000),
    Reader("scene-elsewhere", ".json", _scenes, file("scene.json", _read_elsewhere), 3000),
    Reader("provenance", ".json", _provenance, file("provenance/train.json", _read_provenance), 1000),
    Reader("provenance-shown", ".json", _provenance, file("provenance/scene.json", _read_shown), 1000),
    Reader("cap", ".json", _caps, file("cap.json", _read_cap), 3000),
    Reader("options", ".json", _options, file("segmented/options.json", _read_options), 3000),
    Reader("manifest", ".json", _manifest, file("manifest.json", _read_manifest)),
    Reader("begun", ".npz", _begun, file("checkpoint.npz", _read_begun)),
    Reader("segmented", ".json", _taxonomies, file(".taxonomy.json", _read_taxonomy), 1000),
    Reader("photo-hashes", ".json", _hashes, file("photos.json", _read_hashes), 1000),
    Reader("frozen", ".json", _frozen, file("frozen.json", read_frozen), 3000),
    Reader("edits", ".json", _edits, file("edit.json", _read_edits), 10_000),
    Reader("label-edits", ".json", _label_edits, file("labels.edit.json", label_edits.read_edits), 1000),
    Reader("parents", ".json", _parents, file("parents.json", read_parents), 3000),
    Reader("edited", ".json", _edited, file("edited.json", _read_edited), 3000),
    Reader("segmenting", ".json", _networks, file(".network.json", _read_network), 3000),
    Reader("prompts", ".json", _scores, file(".prompts-0.json", read_scores), 3000),
    Reader("live", ".json", _live, file("live.json", live_bundle.read_live), 3000),
    Reader("lock", ".json", _lock, file("lock", lock._holder), 3000),
)
