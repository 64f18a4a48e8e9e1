"""Levels of anybody against their scene: files, streamed SOG, bundles and runs; tables, picture and files."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import orbit, random_gaussians

from sagesplat.adapt.observe import TOTAL
from sagesplat.adapt.viewpoints import Rule, Viewpoints, write_viewpoints
from sagesplat.core.config import MeasureConfig
from sagesplat.core.errors import RunError
from sagesplat.core.events import Emit, Event, TableMade, Warned
from sagesplat.core.gaussians import Gaussians
from sagesplat.formats.increments import read_increments, read_index, shown
from sagesplat.formats.ply import write_ply
from sagesplat.metrics.flip import flip_map
from sagesplat.metrics.image import psnr, ssim_map
from sagesplat.metrics.ms_ssim import ms_ssim
from sagesplat.raster import rasterize
from sagesplat.run.job import Job
from sagesplat.run.run_dir import RunDir
from sagesplat.stages.bundle import bundle
from sagesplat.studies.measure import report, run, score
from sagesplat.studies.measure.levels import levels_of
from sagesplat.studies.measure.report import Measured, levels_table
from sagesplat.studies.measure.run import measure_levels
from sagesplat.studies.measure.score import COVERED
from tests.fuzz.readers.foreign_splats import put_sog, sog, streamed

FULL = random_gaussians(150, degree=1, logit=2.0)
NAMES = {3: "car", 184: "tree"}
VIEWS = 3


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Drawing takes most of the time."""
    if request.function is not test_files_against_a_file:
        monkeypatch.setattr(report, "save_figure", lambda *_: b"")
        monkeypatch.setattr(run, "contact_sheet", lambda *_, **options: None)


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A scene, the same again, a third of it, and viewpoints; nothing for LPIPS."""
    write_ply(tmp_path / "full.ply", FULL, NAMES)
    write_ply(tmp_path / "same.ply", FULL, NAMES)
    write_ply(tmp_path / "third.ply", third())
    drawn = Viewpoints(Rule(), "capture", 50.0, tuple(orbit(VIEWS)), ("fit",) * VIEWS)
    write_viewpoints(tmp_path / "views.json", drawn)
    return tmp_path


def measure(
    paths: Sequence[Path | Gaussians], out: Path, config: MeasureConfig, emit: Emit = lambda event: None
) -> Measured:
    return measure_levels(paths[0], paths[1:], out, config, on_event=emit, threads=1)


def third() -> Gaussians:
    return FULL.select(torch.arange(0, 150, 3))


def settings(folder: Path, **more) -> MeasureConfig:
    return MeasureConfig(**{"cameras": folder / "views.json", "lpips": folder / "no-weights", **more})


def ignore(event: Event) -> None:
    pass


def test_files_against_a_file(files):
    events: list[Event] = []
    paths = [files / name for name in ("full.ply", "same.ply", "third.ply")]
    found = measure(paths, files / "out", settings(files), events.append)
    for name in ("measure.png", "measure.svg", "viewpoints.png"):
        assert (files / "out" / name).stat().st_size > 1000
    assert found.names == ["same.ply", "third.ply"]
    assert found.counts == [150, 50]
    assert found.nbytes == [path.stat().st_size for path in paths[1:]]
    assert all(row.ssim > 0.99999 and row.psnr > 99 for row in found.of(0, TOTAL))
    for row, camera in zip(found.of(1, TOTAL), orbit(VIEWS), strict=True):
        a, b = (rasterize(g, camera).rgb.clamp(0, 1).numpy().copy() for g in (third(), FULL))
        assert row.ssim == pytest.approx(float(ssim_map(a, b).mean()), abs=1e-6)
        assert row.psnr == pytest.approx(float(psnr(np.square(a - b).mean())), abs=1e-4)
        assert row.others["MS-SSIM"] == pytest.approx(ms_ssim(a, b), abs=1e-5)
    assert max(row.ssim for row in found.of(1, TOTAL)) < 0.9
    assert found.labels() == [3, 184] or found.labels() == [184, 3]
    assert {found.region(label) for label in found.labels()} == {"car", "tree"}
    titles = [event.title for event in events if isinstance(event, TableMade)]
    assert titles == ["Levels against full.ply, means over 3 viewpoints", "SSIM by category"]
    assert [e.text[:15] for e in events if isinstance(e, Warned) and "LPIPS" in e.text] == [
        "no LPIPS (alex)",
        "no LPIPS (vgg):",
    ]


def test_flip_is_measured(files):
    paths = [files / name for name in ("full.ply", "same.ply", "third.ply")]
    found = measure(paths, files / "out", settings(files), ignore)
    assert found.others == ["MS-SSIM", "FLIP"]
    camera = orbit(VIEWS)[0]
    a, b = (rasterize(g, camera).rgb.clamp(0, 1).numpy().copy() for g in (third(), FULL))
    assert found.of(1, TOTAL)[0].others["FLIP"] == pytest.approx(float(flip_map(a, b).mean()), abs=1e-5)
    assert found.of(0, TOTAL)[0].others["FLIP"] < 1e-3
    table = levels_table(found)
    assert float(table.rows[1][table.header.index("FLIP")]) > 0.01
    assert "67 pixels per degree" in table.notes[1]
    level = json.loads((files / "out" / "measure.json").read_text())["levels"][0]
    assert level["MS-SSIM"] == pytest.approx(1, abs=1e-5)
    assert level["FLIP"] < 1e-3


def test_an_empty_background_does_not_count_as_covered(files):
    found = measure([files / "full.ply", files / "third.ply"], files / "out", settings(files), ignore)
    for whole, covered in zip(found.of(0, TOTAL), found.of(0, COVERED), strict=True):
        assert 0 < covered.pixels < whole.pixels
        assert covered.ssim < whole.ssim
    table = levels_table(found)
    assert table.rows[0][table.header.index("share")] == pytest.approx(1 / 3)


def test_viewpoints_are_drawn_where_none_are_given(files):
    config = settings(files, cameras=None, views=2, size=64, kind="object")
    found = measure([files / "full.ply", files / "third.ply"], files / "out", config, ignore)
    assert found.views == ["001", "002"]
    assert found.of(0, TOTAL)[0].pixels == 64 * 48
    lines = json.loads((files / "out" / "measure.json").read_text())["viewpoints"]
    assert lines[0].startswith("object: as asked")


def put_streamed(folder: Path) -> Path:
    for level in ("0", "1"):
        put_sog(folder / f"{level}_0", *sog(6, 0))
    (folder / "lod-meta.json").write_text(json.dumps(streamed()))
    return folder / "lod-meta.json"


def test_levels_of_streamed_sog(tmp_path):
    path = put_streamed(tmp_path / "robot")
    for given in (path, path.parent):
        levels = levels_of(given)
        assert [level.name for level in levels] == ["robot level 0", "robot level 1"]
        assert {level.series for level in levels} == {"robot"}
    files = [p for p in (path.parent / "0_0").iterdir() if p.suffix in (".json", ".webp")]
    assert levels[0].nbytes == sum(p.stat().st_size for p in files)
    assert len(levels[0].load().gaussians) > len(levels[1].load().gaussians)


def test_levels_of_a_run_and_of_its_bundle(finished_run, tmp_path):
    viewer = tmp_path / "viewer"
    viewer.mkdir()
    (viewer / "index.html").write_text("<!doctype html><body><!-- poster --></body>")
    bundle(Job(RunDir(finished_run), ignore), tmp_path / "out", viewer=viewer)
    of_run, of_bundle = levels_of(finished_run), levels_of(tmp_path / "out")
    assert [level.name for level in of_run] == [f"run level {k}" for k in (4, 3, 2, 1)]
    assert [level.nbytes for level in of_run] == [level.nbytes for level in of_bundle]
    folder = RunDir(finished_run).increments
    listed = read_index(folder)
    chunks = [chunk for label in {c.label_id for c in listed} for chunk in shown(listed, label, 2)]
    assert len(of_run[2].load().gaussians) == len(read_increments(folder, chunks))
    for a, b in zip(of_run, of_bundle, strict=True):
        a, b = a.load(), b.load()
        assert torch.equal(a.gaussians.means, b.gaussians.means)
        assert torch.equal(a.gaussians.label_ids, b.gaussians.label_ids)
        assert (a.names, a.antialiased) == (b.names, b.antialiased)


def test_the_finest_level_is_the_reference_of_the_others(finished_run, files):
    found = measure([finished_run], files / "out", settings(files), ignore)
    assert found.reference == "run level 4"
    assert found.names == ["run level 3", "run level 2", "run level 1"]
    assert list(found.counts) == sorted(found.counts, reverse=True)
    quality = [np.mean([row.ssim for row in found.of(level, TOTAL)]) for level in range(3)]
    assert quality[0] > quality[2]
    assert found.labels()


def test_levels_that_do_not_fit_into_memory_together(files, monkeypatch):
    paths = [files / name for name in ("full.ply", "same.ply", "third.ply")]
    together = measure(paths, files / "out", settings(files), ignore)
    monkeypatch.setattr(score, "_TOGETHER", 1)
    alone = measure(paths, files / "out", settings(files), ignore)
    key = [(row.level, row.view, row.label_id) for row in together.rows]
    assert sorted(key) == sorted((row.level, row.view, row.label_id) for row in alone.rows)
    assert together.counts == alone.counts
    assert together.of(1, TOTAL) == alone.of(1, TOTAL)


def test_the_command(files, monkeypatch, command):
    monkeypatch.chdir(files)
    weights = ["--lpips", "none", "--threads", "1"]
    code, _ = command("measure", "full.ply", "nowhere.ply", *weights)
    assert code == 2
    words = ["full.ply", "third.ply", "same.ply", "--cameras", "views.json", *weights]
    code, _ = command("measure", *words)
    assert code == 0
    assert (files / "measure" / "levels.csv").is_file()


def test_gaussians_of_a_script_are_measured_as_their_files_are(files: Path) -> None:
    by_path = measure([files / "full.ply", files / "third.ply"], files / "out", settings(files))
    given = measure([FULL, third()], files / "again", settings(files))
    assert [row.ssim for row in given.of(0, TOTAL)] == [row.ssim for row in by_path.of(0, TOTAL)]
    assert (given.reference, list(given.names), list(given.nbytes)) == ("reference", ["level 1"], [50 * 248])
    mixed = measure_levels(FULL, str(files / "third.ply"), files / "mixed", settings(files), threads=1)
    assert list(mixed.names) == ["third.ply"]
    with pytest.raises(RunError, match=r"^reference: one level, and nothing to compare it with"):
        measure([FULL], files / "out", settings(files))


def test_printed_it_is_a_row_for_each_level(files: Path) -> None:
    found = measure([FULL, third(), FULL], files / "out", settings(files))
    title, head, *rows = str(found).splitlines()
    assert title == f"Levels against reference, means over {VIEWS} viewpoints"
    assert head.split() == ["level", "Gaussians", "MB", "SSIM", "PSNR", "worst", "SSIM"]
    assert [row.split()[:3] for row in rows] == [["level", "1", "50"], ["level", "2", "150"]]
    assert len({len(line) for line in (head, *rows)}) == 1
    assert repr(found) == f"<measured: level 1, level 2 at {VIEWS} viewpoints>"
