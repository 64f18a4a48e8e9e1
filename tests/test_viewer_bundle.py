"""Bundles as files: cells, which way is up, rounding, the manifest and its schema."""

import hashlib
import json
import math
from base64 import b64decode
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import pinhole, random_gaussians
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from make_viewer_vectors import (
    DATA,
    cameras_at,
    distance_cases,
    drawn_cameras,
    fidelity_models,
    make_cells,
    model,
    promise_cases,
)
from scipy.spatial.transform import Rotation

from sagesplat.adapt.cell_models import expect, promised
from sagesplat.adapt.cells import POINTS, Cells, describe_cells
from sagesplat.adapt.viewpoint import NO_CALIBRATION, Calibration, ViewModel
from sagesplat.core.errors import DataError, RunError
from sagesplat.core.second_opacity import SecondOpacities
from sagesplat.formats.increments import DIGITS, totals, write_increments
from sagesplat.formats.ply import read_ply
from sagesplat.formats.spz import read_spz
from sagesplat.formats.stream_header import AS_GIVEN
from sagesplat.formats.stream_increments import write_streams
from sagesplat.scene.scene import Camera
from sagesplat.viewer import frames, promises
from sagesplat.viewer.built import has_viewer
from sagesplat.viewer.bundle import SCHEMA, is_bundle, write_bundle, write_documents
from sagesplat.viewer.frames import FLIP
from sagesplat.viewer.manifest import CameraEntry, Category, Contents, documents
from sagesplat.viewer.numbers import packed, unpacked
from sagesplat.viewer.pack import Ladder, costs_of, gains_of, order_of
from sagesplat.viewer.promises import Seen, allowed_change, fidelity_document, of_cells, ssim_document
from sagesplat.viewer.quality import (
    curve_entry,
    curve_of,
    levels_of,
    of_levels,
    quality_entry,
    significant,
)
from sagesplat.viewer.sent_model import SentModel, read_fidelity, read_model

SIZES = {0: (4, 4, 10), 1: (3, 6, 12), 2: (2, 5, 8), 3: (0, 5, 9)}  # of cells
LABEL_OF = {0: -1, 1: 3, 2: 3, 3: 184}
NAMES = {3: "car", 184: "tree"}
CELL_IDS = torch.repeat_interleave(torch.arange(4), torch.tensor([10, 12, 8, 9])).short()
G = replace(random_gaussians(39, degree=1), label_ids=CELL_IDS)


def camera(angle: float = 0.0, tilt: float = 0.0, at: tuple = (0.0, 0.0, 0.0)) -> Camera:
    """A camera turned by `angle` around y and then down by `tilt`."""
    w2c = np.eye(4, dtype=np.float32)
    w2c[:3, :3] = Rotation.from_euler("yx", [angle, tilt]).as_matrix()
    w2c[:3, 3] = -w2c[:3, :3] @ np.array(at, np.float32)
    return replace(pinhole(), w2c=w2c)


def test_shared_vectors_are_what_is_computed() -> None:
    distances, promised = (
        json.loads((DATA / f"{name}.json").read_text())["cases"] for name in ("distances", "promises")
    )
    # positions are sent as integers: one that lies between two is rounded as the processor's last digit
    # has it, so predictions are compared from the stored documents
    documents = {case["name"]: case["promises"] for case in promised}  # packed
    for stored, cases in ((distances, distance_cases()), (promised, promise_cases(documents))):
        for old, new in zip(stored, cases, strict=True):
            assert old["name"] == new["name"]
            for case in (old, new) if "promises" in old else ():
                case["promises"] = unpacked(case["promises"])
            for a, b in zip(_numbers(old), _numbers(json.loads(json.dumps(new))), strict=True):
                assert a == pytest.approx(b, rel=1e-6, abs=1 if abs(a) > 100 else 1e-6)


def _numbers(value: Any) -> list[float]:
    if isinstance(value, dict):
        return [n for item in value.values() for n in _numbers(item)]
    if isinstance(value, list):
        return [n for item in value for n in _numbers(item)]
    return [float(value)] if isinstance(value, (int, float)) else []


# frames


def test_up_is_square_to_the_horizons_wherever_cameras_look() -> None:
    rng = np.random.default_rng(0)
    level = [camera(a, t) for a, t in zip(rng.uniform(0, 1.5, 30), rng.uniform(0.2, 0.9, 30), strict=True)]
    up = frames.upward(level)
    np.testing.assert_allclose(up, [0, 1, 0], atol=1e-6)
    mean = np.stack([frames.rotation(c)[:, 1] for c in level]).mean(0)
    assert np.degrees(np.arccos(mean[1] / np.linalg.norm(mean))) > 20  # which is what the mean gets wrong
    parallel = camera(0.3, 0.2)
    np.testing.assert_allclose(frames.upward([parallel] * 3), frames.rotation(parallel)[:, 1])


def test_cameras_look_along_minus_z() -> None:
    at = camera(0.3, 0.2, (1, 2, 3))
    np.testing.assert_allclose(frames.rotation(at) @ [0, 0, -1], at.direction * FLIP, atol=1e-6)
    np.testing.assert_allclose(
        Rotation.from_quat(frames.quaternion(at)).as_matrix(), frames.rotation(at), atol=1e-6
    )
    np.testing.assert_allclose(frames.position(at), np.array([1, 2, 3]) * FLIP, atol=1e-6)


def test_the_floor_is_where_the_ground_is() -> None:
    rng, up = np.random.default_rng(0), np.array([0.0, 1.0, 0.0])
    points = rng.uniform(-2, 2, (400, 3))
    points[:100, 1] = -1.6 + rng.normal(0, 0.01, 100)
    ground = np.arange(400) < 100
    cameras = [camera()]
    height = frames.floor(points, ground, cameras, up, 3.0)
    assert height == pytest.approx(-1.6, abs=0.01)
    assert frames.floor(points, ~ground & False, cameras, up, 3.0) == pytest.approx(-1.8, abs=0.2)
    assert frames.floor(points[:0], ground[:0], cameras, up, 3.0) == -3
    assert frames.guessed_scale(cameras, up, height) == pytest.approx(1.5 / 1.6, rel=0.01)
    assert frames.guessed_scale(cameras, up, 5.0) == 1  # below the floor
    assert frames.guessed_scale(cameras, up, -1e-9) == frames.SCALES[1]


# quality


@pytest.mark.parametrize("seed", range(4))
def test_curves_keep_what_they_say(seed: int) -> None:
    for curve in model(seed, 3, [1, 2, 3, 4, 5, 6]).curves:
        read = curve_of(json.loads(json.dumps(curve_entry(curve))))
        away = np.array([*np.linspace(0, 8, 500), np.nan, curve.params.beta])
        np.testing.assert_allclose(read(away), curve(away), atol=2e-4)


def own_views(made: ViewModel) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Distance, position, direction and screen of a model's views."""
    inputs = made.inputs
    distance = np.exp(inputs[:, -1]) * (1 + 1e-9)  # a curve may jump exactly there
    return distance, inputs[:, :3] * made.extent, inputs[:, 3:6], np.exp(inputs[:, 6])


def assert_close_means(read: SentModel, made: ViewModel, *at: np.ndarray) -> None:
    known = made.predict(*at).mean
    assert (np.abs(read.predict(*at).mean - known) <= allowed_change(known)).all()


def sent(made: ViewModel, seen: Seen | None = None) -> dict[str, Any]:
    """The document of a model, as it is read."""
    known = {} if seen is None else {made.label_id: seen}
    return passed_on(ssim_document({made.label_id: made}, cameras_at(made), known))


def passed_on(document: dict[str, Any]) -> dict[str, Any]:
    return unpacked(json.loads(json.dumps(packed(document))))


@pytest.mark.parametrize(("seed", "views"), [(2, 1), (3, 12), (5, 40)])
def test_a_model_that_is_sent_predicts_the_same(seed: int, views: int) -> None:
    made = model(seed, views, [1, 2, 4])
    read = read_model(sent(made), made.label_id)
    before, after = made.predict(*own_views(made)), read.predict(*own_views(made))
    assert_close_means(read, made, *own_views(made))
    asked = before.bound >= made.calibration.targets[0]
    assert (after.bound <= before.bound + 1e-12)[asked].all()  # nothing is promised that was not before
    np.testing.assert_allclose(after.bound, before.bound, atol=0.1)  # thresholds are 0.05 apart at 0.55
    np.testing.assert_allclose(after.support, before.support, atol=0.02)
    nowhere = np.array([2.0, np.nan]), np.full((2, 3), 1e3), np.eye(3)[:2]
    assert np.isnan(read.predict(*nowhere).bound).all()
    assert_close_means(read, made, *nowhere)


def test_of_very_many_views_some_are_sent_and_thresholds_allow_for_it(monkeypatch) -> None:
    made = model(5, 40, [1, 2, 4])
    monkeypatch.setattr(promises, "MOST_VIEWS", 16)
    document = sent(made)
    read = read_model(document, 7)
    assert len(read.inputs) == 14
    before, after = made.predict(*own_views(made)), read.predict(*own_views(made))
    assert np.abs(after.mean - before.mean).max() > 0.01
    asked = (before.bound >= made.calibration.targets[0]) & np.isfinite(after.bound)
    assert (after.bound <= before.bound + 1e-12)[asked].all()


def test_thresholds_that_are_close_never_promise_more() -> None:
    targets = np.array([0.5, 0.6, 0.7, 0.98, 1.0])
    close = np.array([0.5, 0.50000001, 0.50000002, 0.99999999, 1.0])
    made = replace(
        model(3, 12, [1, 2]),
        calibration=Calibration("uncalibrated", 0.95, 3, targets, close, np.zeros(5), 0.123456),
    )
    (entry,) = sent(made)["labels"]
    assert entry["targets"][:3] == [5000, 6000, 7000]
    assert (entry["targets"][-1], entry["thresholds"][-1]) == (10000, 10000)
    read = read_model(sent(made), made.label_id).calibration
    below = np.linspace(0.51, 0.9997, 200)[None]  # targets of the full model lend nothing to what is below it
    assert (read.bound(below, np.ones(1)) <= made.calibration.bound(below, np.ones(1)) + 1e-9).all()
    assert (np.diff(entry["thresholds"][:4]) >= 0).all()
    assert entry["leastSupport"] == 0.1235  # up: no promise that was not given
    assert entry["status"] == "uncalibrated"
    nothing = sent(replace(made, calibration=NO_CALIBRATION))
    assert [nothing["labels"][0][name] for name in ("targets", "thresholds", "slopes")] == [[], [], []]
    assert np.isnan(read_model(nothing, 7).predict(*own_views(made)).bound).all()


def test_the_first_frame_knows_a_mean_and_a_bound_for_all_viewpoints() -> None:
    made = model(5, 40, [1, 2, 3])
    told, entry = made.predict(*own_views(made)), quality_entry(made)
    np.testing.assert_allclose(entry["mean"], told.mean.mean(0), atol=1e-3)
    assert ((told.bound >= np.array(entry["bound"])).mean(0) >= 0.95).all()
    assert quality_entry(replace(made, calibration=NO_CALIBRATION))["bound"] is None


# fidelity


@pytest.mark.parametrize(
    ("labels", "views", "seed"), [([7], 4, 1), ([7] * 6, 24, 2), ([3, 3, 7, 7, 9], 24, 3)]
)
def test_compositions_are_promised_no_more_than_before_they_were_sent(labels, views, seed) -> None:
    cells, drawn = make_cells(seed, labels, 2.5), drawn_cameras(seed, views)
    models = fidelity_models(cells, drawn, 5, seed)
    files = {cell: [1, 2, 3, 4, 5] for cell in cells.ids.tolist()}
    document = passed_on(fidelity_document(models, files, 5, drawn))
    shorter = [2 * np.degrees(np.arctan(min(one.width, one.height) / 2 / one.focal)) for one in drawn]
    assert document["fov"] == round(max(shorter))
    read = read_fidelity(document)
    before, after = (expect(some, cells, drawn, 5) for some in (models, read))
    rng = np.random.default_rng(seed)
    for _ in range(20):
        levels = rng.integers(1, 6, before.share.shape)
        known = promised(models, before, before.of_composition(levels))
        told = promised(read, after, after.of_composition(levels))
        asked = (known >= 0.3) & np.isfinite(told)
        assert (told[asked] <= known[asked] + 1e-4).all()
        assert (np.isfinite(told) <= np.isfinite(known)).all()
    np.testing.assert_allclose(after.share, before.share, atol=1e-9)
    np.testing.assert_allclose(after.mean, before.mean, atol=1e-4)
    full = promised(read, after, after.of_composition(np.full(before.share.shape, 5)))
    assert (full[np.isfinite(full)] == 1).all()


def test_cells_of_fewer_files_have_fewer_levels() -> None:
    cells, drawn = make_cells(4, [7, 7], 2.5), drawn_cameras(4, 12)
    models = fidelity_models(cells, drawn, 4, 4)
    kept = of_cells(models, {0: [1, 3], 1: [1, 2, 3, 4]}, 4)[7]
    offsets = [cell.offsets for cell in models[7].cells]
    np.testing.assert_array_equal(kept.cells[0].offsets, offsets[0][[1, 3, 3, 3]])
    np.testing.assert_array_equal(kept.cells[1].offsets, offsets[1])
    assert levels_of([[1, 3], [1, 2, 3, 4]], 4) == [1, 2, 3, 4]
    assert levels_of([[1, 3], [1, 4]], 4) == [2, 4]


def test_the_first_view_is_level() -> None:
    rng = np.random.default_rng(0)
    up = np.array([0.1, 1.0, 0.2]) / np.linalg.norm([0.1, 1.0, 0.2])
    camera = pinhole(64, 48)
    found = frames.start([camera], rng.normal((0, 0, 4), size=(50, 3)), 1.0, up)
    axes = Rotation.from_quat(found["quaternion"]).as_matrix()
    assert axes[:, 0] @ up == pytest.approx(0, abs=1e-9)
    ahead = (found["target"] - found["position"]) / np.linalg.norm(found["target"] - found["position"])
    np.testing.assert_allclose(-axes[:, 2], ahead, atol=1e-9)


def test_known_views_correct_the_distances() -> None:
    made = replace(model(2, 12, [1]), lengths=(0.05, 0.05, 1.0, 1.0))  # no view is close to another
    missed = np.linspace(-0.5, 0.5, 12)
    read = read_model(sent(made, Seen(np.zeros(12), np.zeros(12), missed)), 7)
    _, position, direction, _ = own_views(made)
    told = np.linspace(1, 3, 12)
    right = read.corrected(told, position, direction)
    np.testing.assert_allclose(right, told * np.exp(missed), rtol=3e-3)
    np.testing.assert_allclose(read.corrected(told, position + 1e3, direction), told, rtol=1e-9)
    assert np.isnan(read.corrected(np.full(12, np.nan), position, direction)).all()


def test_levels_without_a_file_take_the_last_promise_of_what_they_show() -> None:
    made = model(1, 5, [1, 2, 3, 4, 5])
    told = of_levels(made, levels_of([[2, 4]], 5))  # nothing, A, A, B, B
    assert told.levels == (1, 2)
    np.testing.assert_array_equal(told.weights, made.weights[:, [2, 4]])
    assert [c.params for c in told.curves] == [made.curves[2].params, made.curves[4].params]
    assert of_levels(model(1, 5, [4]), [2, 3]).curves == ()


@given(st.floats(-1e12, 1e12), st.integers(2, 15))
def test_significant_digits(value: float, digits: int) -> None:
    assert significant(value, digits) == pytest.approx(value, rel=10.0 ** (1 - digits))
    assert significant([value, [1]], digits) == [significant(value, digits), [1]]


# bundles


@pytest.fixture
def viewer(tmp_path: Path) -> Path:
    folder = tmp_path / "viewer"
    (folder / "assets").mkdir(parents=True)
    (folder / "index.html").write_text("<!doctype html>")
    (folder / "assets" / "index-1.js").write_text("1;")
    (folder / "THIRD_PARTY_LICENSES.txt").write_text("MIT")
    return folder


@pytest.fixture
def contents(tmp_path: Path) -> Contents:
    """Three categories of four cells in three levels, one of them with models."""
    chunks = write_increments(tmp_path / "chunks", G, SIZES, NAMES, label_of=LABEL_OF)
    made = replace(model(3, 6, [1, 2, 3]), label_id=3)
    cells, drawn = describe_cells(G, LABEL_OF), drawn_cameras(4, 9)
    entries = [
        CameraEntry(f"{i}.jpg", "calibration" if heldout else "train", at)
        for i, (at, heldout) in enumerate(zip(cameras_at(made), made.heldout_inputs, strict=True))
    ]
    entries.append(CameraEntry("none.jpg", "test", camera()))
    seen = Seen(np.full(len(entries), 0.25), np.full(len(entries), 2.0))
    fidelity = fidelity_models(cells, drawn, 3, 4)[3]
    categories = [
        Category(-1, "unlabelled", "everything else", "#808080"),
        Category(3, "car", "car", "#112233", 2.0, True, fidelity, made, seen),
        Category(184, "tree", "tree", "#445566"),
    ]
    points = np.random.default_rng(0).normal(size=(50, 3))
    return Contents(
        "tiny", made.extent, entries, categories, cells, chunks, tmp_path / "chunks", 1, points=points,
        drawn=drawn,
    )  # fmt: skip


def manifest_of(folder: Path) -> dict[str, Any]:
    """The manifest; it and the promises that it names are checked against the schema that lies beside it."""
    schema = json.loads((folder / SCHEMA).read_text())
    Draft202012Validator.check_schema(schema)
    manifest = json.loads((folder / "manifest.json").read_text())
    Draft202012Validator(schema).validate(manifest)
    promises = Draft202012Validator({"$ref": "#/$defs/promises", "$defs": schema["$defs"]})
    for reference in manifest["promises"].values():
        promises.validate(unpacked(json.loads((folder / reference["uri"]).read_text())))
    return manifest


def levels_in(cell: dict[str, Any]) -> list[dict[str, Any]]:
    """The levels of a cell in a manifest, one by one."""
    return [
        {
            "uri": some["uri"],
            "format": some["format"],
            "offset": some.get("offset", 0) + sum(some["bytes"][:i]),
            "bytes": nbytes,
            "count": some["counts"][i],
            "sha256": some["sha256"][i * (n := len(some["sha256"]) // len(some["bytes"])) : (i + 1) * n],
            "refine": None if i else some.get("refine"),
            "weight": some["weights"][i] if "weights" in some else None,
        }
        for some in cell["levels"]
        for i, nbytes in enumerate(some["bytes"])
    ]


def test_a_category_with_fewer_files_than_others_has_as_many_levels(tmp_path, contents, viewer) -> None:
    def levels_of(made: Contents) -> list[int]:
        write_bundle(tmp_path / "out", made, viewer)
        (car,) = (one for one in manifest_of(tmp_path / "out")["labels"] if one["name"] == "car")
        most = max(len(levels_in(cell)) for cell in car["cells"])
        levels = car["quality"]["fidelity"]["levels"]
        assert levels == list(range(1, most + 1))
        assert len(car["quality"]["fidelity"]["mean"]) == most
        return levels

    assert levels_of(contents) == [1, 2, 3]
    sizes = SIZES | {3: (1, 5, 9)}  # the tree has three files
    chunks = write_increments(tmp_path / "chunks", G, sizes, NAMES, label_of=LABEL_OF)
    fewer = [one for one in chunks if LABEL_OF[one.cell] != 3 or one.level < 3]
    assert levels_of(replace(contents, chunks=fewer)) == [1, 2]


def test_a_bundle_holds_what_its_manifest_says(tmp_path, contents, viewer) -> None:
    out = tmp_path / "out"
    written = write_bundle(out, contents, viewer)
    manifest = manifest_of(out)
    assert [label["id"] for label in manifest["labels"]] == [-1, 3, 184]
    cells = [cell for label in manifest["labels"] for cell in label["cells"]]
    assert [cell["id"] for cell in cells] == [0, 1, 2, 3]
    assert [[level["count"] for level in levels_in(cell)] for cell in cells] == [
        [4, 6], [3, 3, 6], [2, 3, 3], [5, 4],
    ]  # fmt: skip
    total = 0
    for cell in cells:
        points, bounds = (
            np.frombuffer(b64decode(cell["points"]), np.uint8).reshape(-1, 4),
            np.array(cell["bounds"]),
        )
        there = bounds[:3] + points[:, :3] / 255 * (bounds[3:] - bounds[:3])
        known = contents.cells.points()[cell["id"], : len(there)] * FLIP
        np.testing.assert_allclose(there, known, atol=1e-4)
        for level in levels_in(cell):
            content = (out / level["uri"]).read_bytes()
            assert len(content) == level["bytes"]
            assert hashlib.sha256(content).hexdigest()[:DIGITS] == level["sha256"]
            assert len(read_spz(out / level["uri"])) == level["count"]
            total += len(content)
    assert manifest["totals"]["bytes"] == written.chunks == total
    assert manifest["totals"]["count"] == 39
    order = packed_parts(out)
    listed = [[cell["id"], k + 1] for cell in cells for k in range(len(levels_in(cell)))]
    assert [one for one in listed if one in order] == sorted(order)
    assert sorted(order[:4]) == [[cell, 1] for cell in range(4)]  # the smallest of everything
    assert written.manifest == (out / "manifest.json").stat().st_size
    assert written.total == sum(p.stat().st_size for p in out.rglob("*") if p.is_file())
    ours = {"manifest.json", "manifest.schema.json", manifest["pack"]["uri"], "chunks", "LICENSES.txt"}
    documents = {reference["uri"] for reference in manifest["promises"].values()}
    assert len(documents) == 2
    ours |= documents
    assert {p.name for p in out.iterdir()} == ours | {"index.html", "assets", "THIRD_PARTY_LICENSES.txt"}
    assert {entry["what"] for entry in manifest["licenses"]} >= {"three.js", "Spark"}
    assert not list(tmp_path.glob(".out*"))
    assert is_bundle(out)
    for name in ("manifest.json", *documents):
        assert "://" not in (out / name).read_text()


def test_promises_know_the_model_s_views_and_shares(contents) -> None:
    promises, made = unpacked(json.loads(documents(contents)[1]["ssim"])), contents.categories[1].ssim
    (entry,) = promises["labels"]
    (whole,) = entry["cells"]
    views = np.array(promises["views"]).T / 1e4
    assert (promises["focal"], promises["screens"]) == (made.focal, list(made.screens))
    assert len(views) == made.num_views  # the test photo taught nothing
    assert whole["shares"] == [2500] * len(views)
    inputs = read_model(promises, 3).inputs[:, :-1].round(3)
    wanted = sorted(map(tuple, made.inputs[:, :-1].round(3).tolist()))
    np.testing.assert_allclose(sorted(map(tuple, inputs.tolist())), wanted, atol=2e-3)


def test_a_bundle_says_what_the_viewer_begins_with(contents) -> None:
    assert documents(contents)[0]["target"] == {"quality": "fidelity", "value": 0.95}
    asked = replace(contents, target=("ssim", 0.6))
    assert documents(asked)[0]["target"] == {"quality": "ssim", "value": 0.6}
    photos = replace(contents, drawn=())  # nothing was drawn
    manifest, promises = documents(photos)
    assert manifest["target"] == {"quality": "ssim", "value": 0.7}
    assert list(promises) == list(manifest["promises"]) == ["ssim"]


def packed_parts(out: Path) -> list[list[int]]:
    """The order of a bundle's pack, whose parts are those that the manifest names."""
    manifest = manifest_of(out)
    pack, at = manifest["pack"], 0
    content = (out / pack["uri"]).read_bytes()
    levels = {cell["id"]: levels_in(cell) for label in manifest["labels"] for cell in label["cells"]}
    for cell, level in pack["order"]:
        entry = levels[cell][level - 1]
        part = content[at : at + entry["bytes"]]
        file, begin = (out / entry["uri"]).read_bytes(), entry["offset"]
        assert part == file[begin : begin + entry["bytes"]]
        assert hashlib.sha256(part).hexdigest().startswith(entry["sha256"])
        at += len(part)
    assert at == len(content) == pack["bytes"]
    assert pack["sha256"] == hashlib.sha256(content).hexdigest()
    assert pack["uri"] == f"scene-{pack['sha256'][:12]}.pack"
    return pack["order"]


def test_the_page_names_the_pack(tmp_path, contents, viewer) -> None:
    (viewer / "index.html").write_text("<head><!-- pack --></head>")
    out = tmp_path / "out"
    for _ in range(2):
        write_bundle(out, contents, viewer)
        pack = json.loads((out / "manifest.json").read_text())["pack"]
        levels = {c["id"]: c["levels"] for label in manifest_of(out)["labels"] for c in label["cells"]}
        first = sum(levels[cell][0]["bytes"][0] for cell, level in pack["order"] if level == 1)
        page, promises = (out / "index.html").read_text(), manifest_of(out)["promises"]["fidelity"]["uri"]
        named = f'<meta name="pack" content="{pack["uri"]} {first}" />'
        assert page == f'<head>{named}<link rel="preload" href="{promises}" as="fetch" crossorigin /></head>'
        assert has_viewer(out, viewer)
        write_documents(out, contents)  # names it anew


def test_levels_that_replace_are_in_the_manifest(tmp_path, contents, viewer) -> None:
    chunks = write_increments(
        tmp_path / "chunks", G, SIZES, NAMES, label_of=LABEL_OF, replaces={1: (3,)},
        kind=lambda cell, level: "ply" if cell == 1 and level == 3 else "spz",
    )  # fmt: skip
    written = write_bundle(tmp_path / "out", replace(contents, chunks=chunks), viewer)
    manifest = manifest_of(tmp_path / "out")
    cells = [cell for label in manifest["labels"] for cell in label["cells"]]
    assert [level.get("refine") for level in cells[1]["levels"]] == [None, None, "REPLACE"]
    assert [level["format"] for level in cells[1]["levels"]] == ["spz", "spz", "ply"]
    others = [some for cell in cells if cell["id"] != 1 for some in cell["levels"]]
    assert {"refine"} & {key for level in others for key in level} == set()
    assert manifest["totals"]["count"] == 39 - 6  # of the full scene
    assert written.chunks == sum(chunk.nbytes for chunk in chunks) > manifest["totals"]["bytes"]
    assert len(read_ply(tmp_path / "out" / cells[1]["levels"][2]["uri"])) == 6


def test_coded_streams_are_ranges_in_manifest_and_pack(tmp_path, contents, viewer) -> None:
    g = replace(random_gaussians(39, degree=1, logit=3), label_ids=G.label_ids)
    second = SecondOpacities(g.logit_opacities - 1, dict.fromkeys(SIZES, (0.0, 0.5, 1.0)))
    made = write_streams(tmp_path / "chunks", g, SIZES, NAMES, label_of=LABEL_OF, second=second)
    written = write_bundle(tmp_path / "out", replace(contents, chunks=made.increments), viewer)
    manifest = manifest_of(tmp_path / "out")
    cells = [cell for label in manifest["labels"] for cell in label["cells"]]
    listed = [level for cell in cells for level in levels_in(cell)]
    assert [one["offset"] for one in listed] == [one.offset for one in made.increments]
    assert [len(cell["levels"]) for cell in cells] == [1] * len(cells)
    assert [level["weight"] for level in listed] == [round(one.weight or 0, 6) for one in made.increments]
    assert {level["format"] for level in listed} == {"stream"}
    assert len(list((tmp_path / "out" / "chunks").iterdir())) == 3
    assert 4 <= len(packed_parts(tmp_path / "out")) <= len(listed)
    assert written.chunks == manifest["totals"]["bytes"]


def test_a_palette_is_the_first_range_of_its_file(tmp_path, contents, viewer) -> None:
    g = random_gaussians(900, degree=1, logit=3)
    cells = torch.from_numpy(np.resize(G.label_ids.numpy(), 900)).sort().values
    g = replace(g, shN=g.shN[torch.arange(900) % 7], label_ids=cells)
    counts = {cell: int((cells == cell).sum()) for cell in SIZES}
    made = write_streams(
        tmp_path / "chunks", g, {i: (1, n // 3, n) for i, n in counts.items()}, NAMES, label_of=LABEL_OF,
        replaces=dict.fromkeys(counts, (2,)), last=AS_GIVEN[1],
    )  # fmt: skip
    write_bundle(tmp_path / "out", replace(contents, chunks=made.increments), viewer)
    manifest = manifest_of(tmp_path / "out")
    sent = totals(made.increments, sorted(counts), 3, "nbytes")
    first = totals([replace(one, offset=0) for one in made.increments], sorted(counts), 3, "nbytes")
    palettes = [label["palette"]["bytes"] for label in manifest["labels"]]
    assert (sent[:, 0] == first[:, 0]).all()
    for column in (
        1,
        2,
    ):  # from the level that replaces on, its part of the palette
        assert sum(palettes) <= (sent - first)[:, column].sum() < sum(palettes) + len(counts)
    assert 0 <= sent[:, -1].sum() - manifest["totals"]["bytes"] < len(counts)
    for label in manifest["labels"]:
        palette, levels = label["palette"], [one for cell in label["cells"] for one in levels_in(cell)]
        content = (tmp_path / "out" / palette["uri"]).read_bytes()
        assert {one["uri"] for one in levels} == {palette["uri"]}
        begin = min(one["offset"] for one in levels)
        assert (palette["offset"], palette["bytes"]) == (0, begin)
        assert hashlib.sha256(content[: palette["bytes"]]).hexdigest()[:DIGITS] == palette["sha256"]
        assert palette["bytes"] + sum(one["bytes"] for one in levels) == len(content)
    uri = made.increments[0].uri
    damaged = bytearray((tmp_path / "chunks" / uri).read_bytes())
    damaged[20] ^= 1
    (tmp_path / "chunks" / uri).write_bytes(damaged)
    with pytest.raises(DataError, match="not the chunk that was written"):
        write_bundle(tmp_path / "other", replace(contents, chunks=made.increments), viewer)


def order_at_origin(*ladders: Ladder, behind: Sequence[int] = ()) -> list[tuple[int, int]]:
    """Of the view along z from the origin, of cells without models; `behind`: those out of sight."""
    C = len(ladders)
    grid = np.tile(np.array([128, 128, 128, 255], np.uint8), (C, POINTS, 1))
    bounds = np.tile([-1.0, -1, 4, 1, 1, 6], (C, 1))
    bounds[list(behind), 2], bounds[list(behind), 5] = -6, -4
    cells = Cells(np.arange(C), np.arange(C), bounds, grid, np.full(C, 0.5), np.full(C, 0.1))
    return order_of(ladders, cells, {}, pinhole(), 0.95)


def test_what_the_first_view_does_not_need_is_not_in_the_pack() -> None:
    one = Ladder([10, 20, 100, 50], 1.0, [3])  # unknown: wanted in full
    assert order_at_origin(one) == [(0, 1), (0, 3), (0, 4)]  # the third replaces the second
    order = order_at_origin(replace(one, replaces=()), replace(one, replaces=[2, 3]))
    assert sorted(order) == [(i, k) for i in (0, 1) for k in (1, 2, 3, 4) if (i, k) != (1, 2)]
    assert order_at_origin(one, one, behind=[0, 1]) == [(0, 1), (1, 1)]
    assert costs_of([one, Ladder([5])]).tolist() == [[10, 30, 100, 150], [5, 5, 5, 5]]


def test_what_gains_more_a_byte_comes_first_in_the_pack() -> None:
    one = Ladder([10, 100, 100])
    heavy, dear = replace(one, weight=50.0), replace(one, sizes=[10, 1000, 1000])
    assert order_at_origin(one, heavy) == [(1, 1), (0, 1), (1, 2), (1, 3), (0, 2), (0, 3)]
    assert order_at_origin(dear, one)[2:] == [(1, 2), (1, 3), (0, 2), (0, 3)]
    assert order_at_origin(one, one) == [(0, 1), (1, 1), (0, 2), (1, 2), (0, 3), (1, 3)]
    assert order_at_origin(replace(one, weight=0.0)) == [(0, 1), (0, 2), (0, 3)]
    assert order_at_origin(one, one, behind=[0]) == [(1, 1), (0, 1), (1, 2), (1, 3)]
    assert order_at_origin() == []


@given(st.lists(st.tuples(st.integers(1, 50), st.floats(-1, 1) | st.just(math.nan)), min_size=1, max_size=9))
def test_gains_never_rise_and_lie_on_the_hull(steps: list[tuple[int, float]]) -> None:
    total = np.cumsum([size for size, _ in steps]).astype(float)
    ssim = np.array([value for _, value in steps])
    gains = gains_of(ssim, total)
    assert len(gains) == len(steps) - 1
    assert (gains > 0).all()
    assert (np.diff(gains) <= 0).all()
    reached = max(0.0, ssim[0]) + np.concatenate([[0], np.cumsum(gains * np.diff(total))])
    known = np.isfinite(ssim)
    assert (reached[known] >= ssim[known] - 1e-9).all()  # above every level


def test_an_earlier_bundle_is_replaced_and_nothing_of_it_stays(tmp_path, contents, viewer) -> None:
    out = tmp_path / "out"
    write_bundle(out, contents, viewer)
    few = replace(contents, categories=contents.categories[:1], chunks=contents.chunks[:2])
    write_bundle(out, few, viewer)
    manifest = manifest_of(out)
    assert manifest["promises"] == {}
    assert not list(out.glob("promises-*"))
    assert [path.name for path in out.glob("scene*")] == [manifest["pack"]["uri"]]
    assert len(list((out / "chunks").iterdir())) == 2


def test_without_points_or_labels() -> None:
    entry = CameraEntry("a", "test", camera())
    cells = Cells(**{name: array[:0] for name, array in vars(describe_cells(G, LABEL_OF)).items()})
    empty = Contents("none", 0.0, [entry], [], cells, [], Path("none"), 0)
    manifest, promises = documents(empty)
    assert promises == manifest["promises"] == {}
    assert manifest["pack"] is None
    assert manifest["labels"] == []
    assert manifest["totals"] == {"count": 0, "bytes": 0}
    assert np.isfinite(manifest["start"]["target"]).all()


def test_another_folder_is_left_alone(tmp_path, contents, viewer) -> None:
    out = tmp_path / "photos"
    out.mkdir()
    write_bundle(out, contents, viewer)  # an empty one is fine
    other = tmp_path / "other"
    other.mkdir()
    (other / "manifest.json").write_text('{"format": "else"}')
    with pytest.raises(RunError, match="neither empty nor a bundle"):
        write_bundle(other, contents, viewer)
    (tmp_path / "file").write_text("x")
    with pytest.raises(RunError, match="neither empty nor a bundle"):
        write_bundle(tmp_path / "file", contents, viewer)
    with pytest.raises(RunError, match="cannot be written"):
        write_bundle(tmp_path / "file" / "out", contents, viewer)
    (out / "mine.html").write_text("x")
    with pytest.raises(RunError, match=r"mine\.html: no part of a bundle"):
        write_bundle(out, contents, viewer)
    assert (out / "mine.html").exists()
    (out / "mine.html").unlink()
    write_bundle(out, contents, viewer)
    assert (tmp_path / "file").read_text() == "x"
    assert [p.name for p in other.iterdir()] == ["manifest.json"]


@pytest.mark.parametrize("missing", [False, True])
def test_a_damaged_chunk_is_named_and_the_old_bundle_stays(tmp_path, contents, viewer, missing) -> None:
    write_bundle(tmp_path / "out", contents, viewer)
    path = contents.folder / contents.chunks[1].uri
    before = path.read_bytes()
    path.unlink()
    if not missing:
        path.write_bytes(before[:-1] + b"x")
    with pytest.raises(DataError, match=rf"{contents.chunks[1].uri}: .*sagesplat nest"):
        write_bundle(tmp_path / "out", contents, viewer)
    assert manifest_of(tmp_path / "out")["totals"]["count"] == 39
    assert not list(tmp_path.glob(".out*"))
