"""Bundles of runs: a small one from photos to folder, those of a training that goes on, a real one."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import job_of
from PIL import Image
from test_viewer_bundle import manifest_of, own_views

from sagesplat.adapt.cell_models import expect
from sagesplat.adapt.cell_models import read_fidelity as read_sampled
from sagesplat.adapt.ladder import read_prefixes
from sagesplat.adapt.viewpoint import read_promises
from sagesplat.core.errors import DataError, RunError
from sagesplat.formats.increments import read_increments, read_index, write_increments
from sagesplat.formats.levels import write_set
from sagesplat.formats.spz import read_spz
from sagesplat.io.files import read_json, write_json, write_text
from sagesplat.raster import rasterize
from sagesplat.run.job import Job
from sagesplat.run.records import FORMAT, input_hashes
from sagesplat.segment.display_colors import colors_of
from sagesplat.stages.bundle import BundleMade, bundle
from sagesplat.stages.export import increment_files
from sagesplat.stages.live_bundle import live_bundle, trains_antialiased
from sagesplat.stages.methods import NestedLevels
from sagesplat.stages.plan import main_target
from sagesplat.stages.results import increments_of
from sagesplat.stages.train import write_cap
from sagesplat.stages.view import run_bundle
from sagesplat.studies.measure.levels import levels_of
from sagesplat.viewer.built import package_viewer
from sagesplat.viewer.bundle import is_bundle
from sagesplat.viewer.frames import camera_at
from sagesplat.viewer.numbers import unpacked
from sagesplat.viewer.promises import allowed_change
from sagesplat.viewer.sent_model import read_fidelity, read_model


def approve(job: Job) -> None:
    """Record that the run's models were fitted to its increments as they are now."""
    record = job.run.path / "nested" / "provenance" / "fit.json"
    made = json.loads(record.read_text())
    made["inputs"] |= input_hashes(job.run, [job.run.increments / "index.json"])
    record.write_text(json.dumps(made))


@pytest.fixture(scope="module")
def bundled(finished_run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Job, BundleMade]:
    """The bundle of a run, with settings of its own for cars."""
    folder, job = tmp_path_factory.mktemp("bundled"), job_of(finished_run)
    write_text(folder / "viewer" / "index.html", "<body><!-- poster --></body>")
    settings = {"meters_per_unit": 2.0, "always": ["car"], "weights": {"car": 3}}
    made = bundle(job, folder / "out", viewer=folder / "viewer", **settings)
    return job, made


def test_a_bundle_of_a_run(bundled: tuple[Job, BundleMade]) -> None:
    job, made = bundled
    manifest = manifest_of(made.path)
    chunks = read_index(job.run.increments)
    assert (made.chunks, made.labels) == (len(chunks), len(manifest["labels"]))
    assert made.count == manifest["totals"]["count"] == sum(c.count for c in chunks)
    assert (manifest["frame"]["metersPerUnit"], manifest["frame"]["scale"]) == (2, "given")
    assert manifest["shDegree"] == read_increments(job.run.increments, chunks).sh_degree
    assert [(label["name"], label["weight"]) for label in manifest["labels"] if label["always"]] == [
        ("car", 3)
    ]
    assert len({label["color"] for label in manifest["labels"]}) == len(manifest["labels"])
    for uri in {chunk.uri for chunk in chunks}:
        assert (made.path / "chunks" / uri).read_bytes() == (job.run.increments / uri).read_bytes()
    cells = {cell["id"]: label["id"] for label in manifest["labels"] for cell in label["cells"]}
    assert cells == job.cells.label_of
    splits = [camera["split"] for camera in manifest["cameras"]]
    assert splits == [job.scene.split(row) for row in range(len(job.scene.views))]
    assert {"train", "test", "calibration"} == set(splits)
    assert (manifest["target"]["quality"], manifest["target"]["value"]) == main_target(job.run)


def test_the_poster_is_the_first_view(bundled: tuple[Job, BundleMade]) -> None:
    job, made = bundled
    assert '<img id="poster" src="poster.jpg" alt="" />' in (made.path / "index.html").read_text()
    picture = np.asarray(Image.open(made.path / "poster.jpg"), np.float64)
    first = read_json(made.path / "manifest.json")["start"]
    camera = camera_at(np.array(first["position"]), np.array(first["quaternion"]), np.pi / 3, 640, 360)
    g = read_increments(job.run.increments, read_index(job.run.increments))
    truth = rasterize(g, camera, backend="cpu").rgb.clamp(0, 1).numpy() * 255
    assert np.sqrt(np.mean((picture - truth) ** 2)) < 4  # JPEG


def test_promises_survive_the_bundle(bundled: tuple[Job, BundleMade]) -> None:
    job, made = bundled
    manifest = manifest_of(made.path)
    promises = unpacked(json.loads((made.path / manifest["promises"]["ssim"]["uri"]).read_text()))
    known = {label["id"] for label in manifest["labels"] if "ssim" in label["quality"]}
    models = read_promises(job.run.promises)
    assert {entry["id"] for entry in promises["labels"]} == known == set(models)
    for entry in promises["labels"]:
        model, (whole,) = models[entry["id"]], entry["cells"]
        assert 0 < max(whole["shares"]) <= 10_000
        if len(whole["levels"]) < len(model.levels):
            continue  # a level that adds nothing has no file
        at = own_views(model)
        told, kept = read_model(promises, entry["id"]).predict(*at), model.predict(*at)
        assert (np.abs(told.mean - kept.mean) <= allowed_change(kept.mean)).all()
        asked = kept.bound >= model.calibration.targets.min(initial=2)
        assert not (told.bound > kept.bound + 1e-9)[asked].any()
        np.testing.assert_array_equal(np.isnan(told.bound), np.isnan(kept.bound))


def test_fidelity_survives_the_bundle(bundled: tuple[Job, BundleMade]) -> None:
    """At photos, of compositions of cells by the ladder's levels, as far as each level has a file."""
    job, made = bundled
    manifest = manifest_of(made.path)
    document = json.loads((made.path / manifest["promises"]["fidelity"]["uri"]).read_text())
    read = read_fidelity(unpacked(document))
    models, cameras = read_sampled(job.run.fidelity), [view.camera for view in job.scene.views]
    assert set(read) == set(models)
    files: dict[int, list[int]] = {}
    for one in read_index(job.run.increments):
        files.setdefault(one.cell, []).append(one.level)
    K = len(job.ladder.levels)
    before = expect(models, job.cells, cameras, K)
    after = expect(read, job.cells, cameras, max(map(len, files.values())))
    np.testing.assert_allclose(after.share, before.share, atol=1e-9)  # what was calibrated is what is sent
    for level in range(1, K + 1):
        number = [max(1, sum(one <= level for one in files[cell])) for cell in job.cells.ids.tolist()]
        kept = before.of_composition(np.full(before.share.shape, level))
        told = after.of_composition(np.tile(number, (len(cameras), 1)))
        np.testing.assert_allclose(told, kept, atol=1e-4)


def test_the_same_run_gives_the_same_bytes(bundled: tuple[Job, BundleMade], tmp_path: Path) -> None:
    job, made = bundled
    settings = {"meters_per_unit": 2.0, "always": ["car"], "weights": {"car": 3}}
    for _ in range(2):  # into a new folder, and over the earlier one
        bundle(job, tmp_path / "out", viewer=made.path.parent / "viewer", **settings)
    files = {path.relative_to(made.path) for path in made.path.rglob("*") if path.is_file()}
    assert {p.relative_to(tmp_path / "out") for p in (tmp_path / "out").rglob("*") if p.is_file()} == files
    for name in files:
        assert (tmp_path / "out" / name).read_bytes() == (made.path / name).read_bytes(), name


def test_a_finished_run_is_shown_without_its_capture(run: Path, tmp_path: Path, viewer: Path) -> None:
    """The run keeps the cameras and points; the photos are needed by nothing that a bundle shows."""
    made = bundle(job_of(run), tmp_path / "before", viewer=viewer)
    scene = read_json(run / "scene.json")
    write_json(run / "scene.json", {**scene, "path": str(tmp_path / "gone")})
    again = bundle(job_of(run), tmp_path / "after", viewer=viewer)
    assert made.count == again.count
    before, after = (
        {path.name: path.read_bytes() for path in (tmp_path / name).rglob("*") if path.is_file()}
        for name in ("before", "after")
    )
    assert before == after


@pytest.mark.parametrize(
    ("missing", "command"),
    [
        ("nested/increments", "nest"),
        ("nested/promises.json", "fit"),
    ],
)
def test_an_unfinished_run_names_the_command(run, tmp_path, viewer, missing, command) -> None:
    path = run / missing
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    with pytest.raises(RunError, match=rf"finished nested levels: run `sagesplat {command} {run}`, or"):
        bundle(job_of(run), tmp_path / "out", viewer=viewer)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("absent", [True, False])
def test_a_run_without_photos_has_fidelity_only(
    run: Path, tmp_path: Path, viewer: Path, absent: bool
) -> None:
    """Promises of SSIM are not there, or there are none in the file."""
    if absent:
        record = run / "nested" / "provenance" / "fit.json"
        made = json.loads(record.read_text())
        del made["inputs"]["nested/observations.csv"]
        record.write_text(json.dumps(made))
        (run / "nested" / "observations.csv").unlink()
        (run / "nested" / "promises.json").unlink()
    else:
        (run / "nested" / "promises.json").write_text('{"promises": []}')
    made = bundle(job_of(run), tmp_path / "out", viewer=viewer)
    manifest = manifest_of(tmp_path / "out")
    assert list(manifest["promises"]) == ["fidelity"]
    assert manifest["target"]["quality"] == "fidelity"
    assert all(list(label["quality"]) in ([], ["fidelity"]) for label in manifest["labels"])
    assert made.sizes.promises == manifest["promises"]["fidelity"]["bytes"]
    if (package_viewer() / "index.html").exists():
        assert is_bundle(run_bundle(job_of(run)))


def test_bad_input_is_one_line(run: Path, tmp_path: Path, viewer: Path) -> None:
    job, out = job_of(run), tmp_path / "out"
    with pytest.raises(RunError, match="dragon, unicorn: no such category; there are "):
        bundle(job, out, always=["unicorn"], weights={"dragon": 2}, viewer=viewer)
    with pytest.raises(RunError, match=r"weight .* is impossible"):
        bundle(job, out, weights={job.taxonomy.name(-1): float("nan")}, viewer=viewer)
    with pytest.raises(RunError, match=r"a\.html: a bundle is a folder; add --single-file for one page"):
        bundle(job, tmp_path / "a.html", viewer=viewer)
    with pytest.raises(RunError, match="metres per unit are impossible"):
        bundle(job, out, meters_per_unit=0.0, viewer=viewer)
    chunk = next((run / "nested" / "increments").glob("*.sgst"))
    chunk.write_bytes(chunk.read_bytes()[:-1])
    with pytest.raises(DataError, match=f"{chunk.name}: "):
        bundle(job, out, viewer=viewer)
    assert not out.exists()


def test_promises_of_other_chunks(run: Path, tmp_path: Path, viewer: Path) -> None:
    index = run / "nested" / "increments" / "index.json"
    index.write_text(index.read_text() + "\n")
    with pytest.raises(RunError, match="fitted to other increments; run `sagesplat fit`"):
        bundle(job_of(run), tmp_path / "out", viewer=viewer)


def test_a_training_that_goes_on_says_how_its_gaussians_are_drawn(tmp_path: Path) -> None:
    job = job_of(tmp_path)
    assert not trains_antialiased(job)  # nothing has begun
    for antialiased in (True, False):
        write_cap(job.run.cap, 0, {"antialiased": antialiased, "seed": 3})
        assert trains_antialiased(job) is antialiased


def test_a_live_bundle_follows_the_training(run: Path, tmp_path: Path, viewer: Path) -> None:
    later = sorted((run / "levels").glob("*.npz"))
    assert len(later) == 3
    for path in later:
        path.rename(tmp_path / path.name)
    (run / "provenance" / "train.json").unlink()
    shutil.rmtree(run / "nested")
    folder = tmp_path / "live"
    with pytest.raises(RunError, match="no level yet"):
        live_bundle(job_of(run), folder, viewer)
    assert not folder.exists()
    uris, job = [], job_of(run)
    for path in later:
        (tmp_path / path.name).rename(path)
        (run / "levels" / ".half-written.npz").write_bytes(b"")  # what training is writing
        assert live_bundle(job, folder, viewer)
        before = (folder / "manifest.json").read_bytes()
        assert not live_bundle(job, folder, viewer)
        assert (folder / "manifest.json").read_bytes() == before
        manifest = manifest_of(folder)
        assert manifest["live"]
        assert (manifest["promises"], manifest["pack"]) == ({}, None)
        levels = [cell["levels"] for label in manifest["labels"] for cell in label["cells"]]
        assert len(levels) == len(manifest["labels"])
        uris.append({level["uri"] for (level,) in levels})
        for (level,) in levels:
            assert [len(read_spz(folder / level["uri"]))] == level["counts"]
        assert all(label["quality"] == {} for label in manifest["labels"])
    write_json(
        run / "provenance" / "train.json",
        {"format": FORMAT, "settings": {"antialiased": False}, "inputs": {}},
    )
    assert manifest_of(folder)["antialiased"]
    later[-1].touch()
    (viewer / "index.html").write_text("<!doctype html>of a newer package")
    assert live_bundle(job, folder, viewer)  # rewritten: a training that began again
    assert (folder / "index.html").read_bytes() == (viewer / "index.html").read_bytes()
    assert not manifest_of(folder)["antialiased"]
    (folder / "manifest.json").unlink()
    assert live_bundle(job, folder, viewer)  # repaired
    assert is_bundle(folder)
    there = {f"chunks/{path.name}" for path in (folder / "chunks").iterdir()}
    assert there >= uris[1] | uris[2]
    assert not there & (uris[0] - uris[1] - uris[2])
    assert not (folder / ".chunks").exists()


def test_a_live_bundle_that_was_killed_before_its_manifest_goes_on(
    run: Path, tmp_path: Path, viewer: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (viewer / "assets").mkdir()
    (viewer / "assets" / "a.js").write_text("1")

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    folder = tmp_path / "live"
    for name in ("shutil.copytree", "write_text", "write_increments", "write_documents"):
        with monkeypatch.context() as patch:
            patch.setattr(f"sagesplat.stages.live_bundle.{name}", killed)
            with pytest.raises(KeyboardInterrupt):
                live_bundle(job_of(run), folder, viewer)
    assert live_bundle(job_of(run), folder, viewer)
    assert is_bundle(folder)
    assert (folder / "assets" / "a.js").read_text() == "1"
    assert not live_bundle(job_of(run), folder, viewer)


def test_colours_are_distinct_and_stay() -> None:
    rng = np.random.default_rng(0)
    wanted = {-1: (128, 128, 128)} | {i: tuple(rng.integers(0, 256, 3).tolist()) for i in range(40)}
    colors = colors_of(wanted)
    assert colors == colors_of(wanted)
    assert set(colors) == set(wanted)
    assert max(list(colors.values()).count(c) for c in colors.values()) == 3  # 16 in the palette
    few = colors_of({i: wanted[i] for i in (-1, 3, 7, 9)})
    assert len(set(few.values())) == 4
    assert colors_of({5: (0, 200, 0)})[5] in ("#3f9f4f", "#6dbd6a")


def test_a_run_with_levels_that_replace(run: Path, tmp_path: Path, viewer: Path) -> None:
    """Costs, full scene and bundle are of what the levels hold, and PLY levels lose nothing."""
    job = job_of(run)
    before = read_prefixes(job.run.prefixes)
    g, sizes = before.gaussians, before.sizes
    label, ends = max(sizes.items(), key=lambda item: item[1][-1])
    level = next(k for k in range(3, 1 + len(ends)) if ends[k - 1] > ends[k - 2])
    replaces = {label: (level,)}
    chunks = write_increments(
        job.run.increments, g, sizes, job.names(), label_of={i: i for i in sizes}, replaces=replaces,
        kind=lambda i, k: "ply" if i == label and k >= level else "spz",
    )  # fmt: skip
    sent = read_increments(job.run.increments, chunks)
    write_set(job.run.prefixes, sent, 1, sizes, replaces=replaces, exact=True)
    approve(job)

    job = job_of(run)
    costs, row = NestedLevels(job).costs, sorted(sizes).index(label)
    below = ends[level - 2]
    assert costs.count[row].tolist() == [n - below * (k >= level) for k, n in enumerate(ends, 1)]
    top = job.ladder.load(len(ends), [label])
    mine = g.of_labels([label])
    assert torch.equal(top.sh0, mine.sh0[below:])
    assert torch.equal(top.quats, mine.quats[below:])
    bundled = bundle(job, tmp_path / "out", viewer=viewer)
    manifest = manifest_of(tmp_path / "out")
    assert bundled.count == manifest["totals"]["count"] == costs.count[:, -1].sum()
    assert bundled.chunks == len(chunks)
    index = job.run.increments / "index.json"
    index.write_text(index.read_text().replace("REPLACE", "ADD"))
    with pytest.raises(DataError, match=rf"Gaussians of cell {label} is not this run's"):
        increments_of(job_of(run))


def test_streams_as_files_of_spz(run: Path, tmp_path: Path, viewer: Path) -> None:
    job = job_of(run)
    made, listed = bundle(job, tmp_path / "spz", chunks="spz", viewer=viewer), increments_of(job)
    assert (made.chunks, made.count) == (len(listed), sum(one.count for one in listed))
    manifest = manifest_of(tmp_path / "spz")
    assert manifest["promises"] == {}  # one opacity: none of lower levels holds
    assert {path.suffix for path in (tmp_path / "spz" / "chunks").iterdir()} == {".spz"}
    (full, *_), (wanted, *_) = levels_of(tmp_path / "spz"), levels_of(run)
    g, streamed = full.load().gaussians, wanted.load().gaussians
    assert torch.equal(g.shN, streamed.shN)
    torch.testing.assert_close(g.sh0, streamed.sh0, rtol=0, atol=1e-4)
    torch.testing.assert_close(g.log_scales, streamed.log_scales, rtol=0, atol=1e-4)
    torch.testing.assert_close(g.logit_opacities, streamed.logit_opacities, rtol=0, atol=1e-4)
    torch.testing.assert_close(g.means, streamed.means, rtol=0, atol=0.04)  # an eighth of their size


def test_a_run_without_streams_has_none_to_bundle(run: Path, tmp_path: Path, viewer: Path) -> None:
    job = job_of(run)
    increment_files(job, tmp_path / "files", "spz")
    shutil.rmtree(job.run.increments)
    (tmp_path / "files").rename(job.run.increments)
    approve(job)
    with pytest.raises(RunError, match="in SPZ files, not in coded streams; leave out --chunks"):
        bundle(job, tmp_path / "out", chunks="stream", viewer=viewer)
    made = bundle(job, tmp_path / "out", chunks="spz", viewer=viewer)
    assert made.count == len(levels_of(run)[0].load().gaussians)


def test_a_run_as_one_page(run: Path, tmp_path: Path) -> None:
    if not (package_viewer() / "index.html").exists():
        pytest.skip("the viewer is not built")
    job, out = job_of(run), tmp_path / "scene.html"
    made = bundle(job, out, single_file=True, weights={"car": 3})
    assert made.sizes.total == out.stat().st_size > made.sizes.chunks
    listed = read_index(job.run.increments)
    assert made.chunks == len(listed)
    assert out.read_text().count('data-uri="chunks/') == len({one.uri for one in listed})
    with pytest.raises(RunError, match=r"name that ends in \.html"):
        bundle(job, tmp_path / "folder", single_file=True)


def test_a_folder_that_is_no_run_has_no_bundle(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"not a run folder \(no scene\.json\); begin with `sagesplat run"):
        bundle(job_of(tmp_path), tmp_path / "out")
