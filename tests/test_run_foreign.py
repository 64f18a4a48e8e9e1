"""Run folders from elsewhere: whatever their documents hold, a command works or says one line.

Documents are changed so that the records of the stages agree with them, as in a folder made on purpose.
"""

import json
import os
import random
import shutil
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import SMALL_RUN, job_of

from sagesplat.cli import commands, parse
from sagesplat.core.config import FitConfig
from sagesplat.core.errors import RunError, SageError
from sagesplat.io.files import read_json, write_json
from sagesplat.run import records
from sagesplat.run.job import Job
from sagesplat.run.recorded import stage_seconds
from sagesplat.run.run_dir import RunDir, check_links
from sagesplat.run.stage_table import STAGES
from sagesplat.scene.blocks import read_blocks, read_division
from sagesplat.segment.masks import Taxonomy
from sagesplat.stages import report, view
from sagesplat.stages.api import open_run
from sagesplat.stages.bundle import bundle
from sagesplat.stages.clean import clean_levels
from sagesplat.stages.compose import compose_plan
from sagesplat.stages.evaluate import evaluate_plans
from sagesplat.stages.fit import fit_ladder
from sagesplat.stages.label import read_edit_table
from sagesplat.stages.live_bundle import live_bundle
from sagesplat.stages.nest import nest_levels
from sagesplat.stages.pipeline import run_all
from sagesplat.stages.plan import make_plan
from sagesplat.stages.train import read_cap, read_frozen, train_levels
from sagesplat.viewer.site import Site

VALUES = [
    None, True, -1, 0, 7, 2**70, 10**400, 1e308, float("nan"), float("inf"), "x", "\0", "a" * 5000, "\ud800",
    [], {}, [[]], "../../etc", "/etc/passwd",
]  # fmt: skip
NUMBERS = ["-1", "-2", "-5", "99", "1e9", "nan", "inf", "", "x", "2147483647", "99999999999", "0", "\0"]
WHOLE = [
    b"", b"[]", b"7", b"null", b'"x"', b"{}", b"[" * 100_000, b"\xff\xfe", bytes(30), b"[[]]", b'{"a":',
]  # fmt: skip
VARIANTS = 40  # of the values in a document, besides those of the whole


def redone(stage: str, run: Path, act: Callable[[Job], Any]) -> None:
    """A command whose stage is not done yet."""
    RunDir(run).provenance(stage).unlink(missing_ok=True)
    act(job_of(run))


def settings(run: Path) -> None:
    """What every command does first."""
    with redirect_stderr(StringIO()):
        for name in ("fit", "plan", "nest", "train", "lift"):
            parse.arguments(name, commands()[name], [str(run)])
    stage_seconds(RunDir(run))


def resume(run: Path) -> None:
    """`sagesplat run --force`, with training, labels and nested levels to be made again."""
    for stage in ("train", "lift", "masks", "nest"):
        RunDir(run).provenance(stage).unlink(missing_ok=True)
    run_all(job_of(run, force=True), run.parent / "capture", SMALL_RUN)


COMMAND = {
    "settings": settings,
    "view": lambda run: view._fill(Site(), run, lambda event: None, follow=False),
    "bundle": lambda run: bundle(job_of(run), run.parent / "bundle"),
    "live": lambda run: redone("train", run, lambda job: live_bundle(job, run / "bundle-live")),
    "open": lambda run: (lambda opened: (opened.scene, opened.plans, opened.promises))(open_run(run)),
    "plan": lambda run: redone("plan", run, lambda job: make_plan(job, SMALL_RUN.plan)),
    "compose": lambda run: redone("compose", run, compose_plan),
    "evaluate": lambda run: redone("evaluate", run, evaluate_plans),
    "report": lambda run: redone("report", run, report.make_report),
    "fit": lambda run: redone("fit", run, lambda job: fit_ladder(job, FitConfig())),
    "run": lambda run: run_all(job_of(run), run.parent / "capture", SMALL_RUN),
    "nest": lambda run: redone("nest", run, lambda job: nest_levels(job, SMALL_RUN.nest, 0)),
    "train": lambda run: redone(
        "train", run, lambda job: train_levels(replace(job, force=True), SMALL_RUN.train, 0)
    ),
    "clean": lambda run: redone("clean", run, lambda job: clean_levels(job, SMALL_RUN.clean)),
    "resume": resume,
}
READERS = {  # the commands that read a document
    "scene.json": ("settings", "view", "plan", "run"),
    "photos.json": ("plan", "run"),
    "cap.json": ("settings", "train", "resume"),
    "segmented/options.json": ("settings",),
    "segmented/labels.json": ("resume",),
    "masks/labels.json": ("bundle", "compose", "plan", "report", "live"),
    "masks/edit.json": ("run",),
    "provenance/scene.json": ("settings", "view", "report", "run"),
    "provenance/masks.json": ("settings", "report", "run"),
    "provenance/train.json": ("settings", "bundle", "evaluate", "report", "nest", "live"),
    "nested/provenance/observe.json": ("settings", "fit", "plan", "report"),
    "nested/provenance/fit.json": ("settings", "bundle", "plan", "evaluate"),
    "nested/provenance/plan.json": ("settings", "compose", "evaluate", "report"),
    "nested/provenance/nest.json": ("settings", "run", "report"),
    "nested/observations.csv": ("bundle", "fit", "plan", "report"),
    "nested/evaluation.csv": ("report",),
    "nested/models.json": ("report",),
    "nested/promises.json": ("open", "bundle", "plan", "evaluate"),
    "nested/plan.json": ("open", "compose", "evaluate", "report"),
    "nested/increments/index.json": ("view", "bundle", "plan", "evaluate"),
    "labels.npz": ("plan", "bundle", "fit", "resume"),
    "nested/ladder.npz": ("compose", "plan", "bundle", "evaluate"),
    "levels/000006.npz": ("nest", "live"),
    "checkpoint.npz": ("train", "resume"),
}


def nodes(document: Any, path: tuple = ()) -> Iterator[tuple]:
    """Where values are in a JSON document: of lists the first few."""
    entries = document.items() if isinstance(document, dict) else []
    entries = list(enumerate(document))[:4] if isinstance(document, list) else entries
    for key, value in entries:
        yield (*path, key)
        yield from nodes(value, (*path, key))


def json_variants(content: bytes, draw: random.Random) -> Iterator[bytes]:
    yield from WHOLE
    places = list(nodes(json.loads(content)))
    for _ in range(VARIANTS if places else 0):
        document = json.loads(content)
        *above, last = draw.choice(places)
        at = document
        for key in above:
            at = at[key]
        at[last] = draw.choice(VALUES)
        if draw.random() < 0.15:
            del at[last]
        yield json.dumps(document).encode()


def csv_variants(content: bytes, draw: random.Random) -> Iterator[bytes]:
    header, *rows = content.decode().splitlines()
    yield from (b"", f"{header}\n".encode(), bytes(9), b"\xff\xfe,", "\n".join(rows).encode())
    for _ in range(2 * VARIANTS):
        cells, column, value = (
            [row.split(",") for row in rows],
            draw.randrange(header.count(",") + 1),
            draw.choice(NUMBERS),
        )
        for row in cells if draw.random() < 0.3 else [draw.choice(cells)]:
            row[column] = value
        yield "\n".join([header, *map(",".join, cells)]).encode()


def npz_variants(content: bytes, draw: random.Random, folder: Path) -> Iterator[bytes]:
    yield from (b"", content[: len(content) // 2], bytes(len(content)))
    path = folder / "variant.npz"
    path.write_bytes(content)
    with np.load(path) as file:
        arrays = dict(file)
    for _ in range(VARIANTS):
        name = draw.choice(sorted(arrays))
        array = arrays[name]
        other = draw.choice(
            [
                array[:0] if array.ndim else array,
                array[..., None],
                array * 0 if array.dtype.kind in "iuf" else array,
            ]
        )
        np.savez(path, **{**arrays, name: other})
        yield path.read_bytes()
    np.savez(path, **{name.replace("184", "185"): array for name, array in arrays.items()})
    yield path.read_bytes()


def agree(run: Path) -> None:
    """Let the records of all stages say that their inputs are as they are."""
    for stage in STAGES:
        path = RunDir(run).provenance(stage)
        try:
            record = read_json(path)
            paths = {name: (run / name).resolve() for name in record["inputs"]}
            # of folders those of the run: "/" would be read whole
            names = [
                name for name, at in paths.items() if at.is_file() or (at.exists() and at.is_relative_to(run))
            ]
            record["inputs"] |= records.input_hashes(RunDir(run), [run / name for name in names])
            write_json(path, record)
        except (SageError, TypeError, KeyError, ValueError):
            continue


def works_or_says_one_line(command: str, run: Path) -> None:
    try:
        COMMAND[command](run)
    except SageError as error:
        text = str(error)
    else:
        text = ""
    assert "\n" not in text, text[:500]
    assert len(text) < 1500, text[:500]


@pytest.mark.parametrize("name", READERS)
def test_a_document_of_something_else(run: Path, name: str) -> None:
    (run / name).write_bytes(b"[]")
    agree(run)
    works_or_says_one_line(READERS[name][0], run)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_any_document_and_command(
    run: Path, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "sagesplat.output.report.write_report",
        lambda folder, data: (folder.mkdir(exist_ok=True), (folder / "index.html").touch()),
    )
    monkeypatch.setattr("sagesplat.stages.bundle._poster", lambda *_: b"")
    draw, content = random.Random(name), (run / name).read_bytes()
    if name.endswith(".npz"):
        variants = npz_variants(content, draw, tmp_path)
    else:
        variants = (csv_variants if name.endswith(".csv") else json_variants)(content, draw)
    for number, variant in enumerate(variants):
        for command in READERS[name]:
            other = tmp_path / "copy" / "run"
            shutil.copytree(run, other, copy_function=os.link)
            (other.parent / "capture").symlink_to(tmp_path / "capture")
            (other / name).unlink()
            (other / name).write_bytes(variant)
            if number >= len(WHOLE) or number % 2:
                agree(other)
            works_or_says_one_line(command, other)
            shutil.rmtree(other.parent)


# what belongs together


@pytest.mark.parametrize(
    ("command", "name", "old", "new", "complaint"),
    [
        ("fit", "nested/observations.csv", "\n3,", "\n77,", "category 77 is not this run's"),
        ("plan", "nested/observations.csv", "\n3,1,", "\n3,9,", "level 9 is not this run's"),
        ("bundle", "nested/observations.csv", "\n3,1,0,", "\n3,1,99,", "view 99 is not this run's"),
        ("report", "nested/evaluation.csv", "\n1,0.4,0,", "\n1,0.4,-9,", "view -9 is not this run's"),
        ("compose", "nested/plan.json", '"label_id": 3', '"label_id": 4', "of category 4 is not this run's"),
        ("plan", "nested/promises.json", '"label_id": 3', '"label_id": 4', "category 4 is not this run's"),
        ("plan", "nested/increments/index.json", '"level": 4', '"level": 5', "level 5 is not this run's"),
        ("bundle", "nested/increments/index.json", '"count": 1', '"count": 2', "Gaussians of cell"),
        ("compose", "masks/labels.json", '"3"', '"5"', r"of category 3, which .*labels\.json does not name"),
    ],
)
def test_documents_that_do_not_belong_to_the_others(
    run: Path, command: str, name: str, old: str, new: str, complaint: str
) -> None:
    text = (run / name).read_text()
    assert old in text
    (run / name).write_text(text.replace(old, new))
    agree(run)
    with pytest.raises(SageError, match=complaint):
        COMMAND[command](run)


@pytest.mark.parametrize(
    ("reader", "name", "gone", "again"),
    [
        ("compose", "nested/plan.json", "nested/plan.json", "plan"),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                ("plan", "scene.json", "scene.json", "run"),
                ("fit", "nested/observations.csv", "nested/observations.csv", "observe"),
                ("report", "nested/models.json", "nested/models.json", "fit"),
                ("plan", "nested/increments/index.json", "nested/increments", "nest"),
                ("compose", "nested/ladder.npz", "nested/ladder.npz", "nest"),
                ("clean", "levels/000006.npz", "levels", "train"),
            )
        ),
    ],
)
def test_a_damaged_document_is_made_again_as_its_error_says(
    run: Path, tmp_path: Path, reader: str, name: str, gone: str, again: str
) -> None:
    """The cures as they are typed: what the error names is deleted, and the run goes on."""
    (run / name).write_bytes(b"[]")
    with pytest.raises(SageError, match=rf"delete .*run `sagesplat {again}") as caught:
        COMMAND[reader](run)
    assert str(run / name) in str(caught.value)
    if (run / gone).is_dir():
        shutil.rmtree(run / gone)
    else:
        (run / gone).unlink()
    for checkpoint in run.glob("checkpoint*.npz") if again == "train" else ():
        checkpoint.unlink()
    for _ in range(2):
        run_all(job_of(run), tmp_path / "capture", SMALL_RUN)
    assert (run / name).stat().st_size > 100


def test_links_out_of_a_run_folder_are_refused(run: Path, tmp_path: Path) -> None:
    check_links(run)
    (run / "inside").symlink_to(run / "levels")
    check_links(run)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name, target in (("a", elsewhere), ("nested/b", "../../elsewhere"), ("masks/c", "/etc/passwd")):
        (run / name).symlink_to(target)
        for act in (lambda: check_links(run), lambda: open_run(run), lambda: COMMAND["view"](run)):
            with pytest.raises(RunError, match=rf"{name}: a link out of the run folder"):
                act()
        with pytest.raises(RunError, match="a link out of the run folder"):
            parse.arguments("plan", commands()["plan"], [str(run)])
        (run / name).unlink()
    link = tmp_path / "link"
    link.symlink_to(run)  # the folder itself may be named by a link
    check_links(link)
    assert not any(elsewhere.iterdir())


def test_names_in_a_run_folder_lead_nowhere_else(run: Path, tmp_path: Path) -> None:
    """Of all names in a run folder, only the capture's may be outside of it."""
    secret = tmp_path / "secret.spz"
    secret.write_bytes(b"x")
    index = read_json(run / "nested/increments/index.json")
    for uri in ("../../../secret.spz", str(secret), ".hidden", "a/b.spz", "x\0.spz"):
        index["chunks"][0]["uri"] = uri
        write_json(run / "nested/increments/index.json", index)
        agree(run)
        with pytest.raises(SageError, match=r"not an index of increments \(chunks\[0\]: .* is no file name"):
            COMMAND["bundle"](run)


# readers


@pytest.mark.parametrize(
    ("read", "content", "says"),
    [
        (read_cap, '{"cap": -1}', "delete it, and run the same command again"),
        (read_frozen, '{"99999": 1}', r"write \{\} into it"),
        (
            lambda path: read_edit_table(path, Taxonomy({3: "car"})),
            '{"table": [1]}',
            "`sagesplat masks` again",
        ),
        (read_blocks, '{"low": [[1]], "high": [[1]], "axes": [], "margin": 1}', "not a partition"),
        (read_division, "{}", "not a partition .*delete it and run"),
    ],
)
def test_small_documents(tmp_path: Path, read: Callable[[Path], object], content: str, says: str) -> None:
    (tmp_path / "it.json").write_text(content)
    with pytest.raises(SageError, match=rf"it\.json: .*{says}"):
        read(tmp_path / "it.json")


def test_settings_of_a_wrong_type_are_no_record(run: Path) -> None:
    path = RunDir(run).provenance("train")
    record = read_json(path)
    for name, value in [("max_steps", "6"), ("antialiased", 1), ("grow_grad", None), ("seed", 10**30)]:
        write_json(path, record | {"settings": record["settings"] | {name: value}})
        with pytest.raises(RunError, match=rf"not the record of a stage \({name}: expected .*--force"):
            records.read_record(path)
    del record["settings"]["antialiased"]
    write_json(path, record)
    with pytest.raises(RunError, match="no setting antialiased in it"):
        assert replace(job_of(run)).antialiased
