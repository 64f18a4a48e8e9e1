import csv
import math
from dataclasses import fields, replace

import numpy as np
import pytest
from conftest import cell_text
from hypothesis import given
from hypothesis import strategies as st

from sagesplat.adapt.eq3 import fit_model
from sagesplat.adapt.evaluate import QUALITIES, Evaluation
from sagesplat.adapt.observe import TOTAL, Observations
from sagesplat.adapt.plan import Choice, Plan, Reached
from sagesplat.io.columns import text_cell
from sagesplat.output import tables

NAMES = {3: "vase", 7: "dining, table"}
COUNTS = {(3, 1000): 10, (3, 2000): 40, (7, 1000): 50, (7, 2000): 60, (-1, 1000): 5, (-1, 2000): 5}
LABELS = [7, 3, -1]


def observe() -> Observations:
    rows = [
        (label, level, view, 2.0, ssim + view / 100, np.nan, 20.0, 9)
        for label, ssim in ((3, 0.5), (7, 0.7), (TOTAL, 0.6))
        for level in (1000, 2000)
        for view in range(3)
    ]
    rows.append((-1, 1000, 0, np.nan, np.nan, np.nan, np.nan, 0))
    kinds = ["i4", "i4", "i4", "f4", "f4", "f4", "f4", "i4"]
    return Observations(*(np.array(c, k) for c, k in zip(zip(*rows, strict=True), kinds, strict=True)))


def evaluate(rows: list[tuple[float, int, float, float]]) -> Evaluation:
    """Rows of (target, label, predicted, measured), one view, of a plan for SSIM."""
    target, label, predicted, ssim = (np.array(c) for c in zip(*rows, strict=True))
    zero, one = np.zeros(len(rows), np.int32), np.full(len(rows), 0.9, np.float32)
    f = np.float32
    measured = (predicted.astype(f), one, ssim.astype(f), 30 * one, one, 33 * one)
    kind = zero + QUALITIES.index("ssim")
    return Evaluation(
        kind, target.astype(f), zero, label.astype(np.int32), zero, *measured, zero, *[one] * 12
    )


def as_text(table: tables.Table, path) -> list[dict[str, str]]:
    table.write_csv(path)
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_quality_averages_the_views_asked_for(tmp_path):
    table = tables.quality_table(observe(), np.array([0, 2]), LABELS, NAMES, "training")
    rows = as_text(table, tmp_path / "t.csv")
    assert [row["level"] for row in rows] == ["1000", "2000"]
    assert float(rows[0]["dining, table"]) == pytest.approx(0.71)
    assert float(rows[1]["whole image"]) == pytest.approx(0.61)
    assert rows[0]["unlabelled"] == ""
    assert table.cells()[0] == ["1,000", "0.610", "0.710", "0.510", "–"]


def test_plan_and_targets(tmp_path):
    choices = (
        Choice(-1, 2000, math.nan, math.nan, 5, "no model"),
        Choice(3, 1000, 0.61, 2.0, 10, "ok"),
        Choice(7, 2000, 0.55, 2.5, 60, "infeasible"),
    )
    plan = Plan(0.6, None, choices, 0.95)
    rows = as_text(tables.plan_table(plan, COUNTS, NAMES), tmp_path / "t.csv")
    assert [row["category"] for row in rows] == ["dining, table", "vase", "unlabelled"]
    assert [row["status"] for row in rows] == ["infeasible", "ok", "no model"]
    assert float(rows[1]["of full model"]) == 0.25
    assert float(rows[1]["MB as floats"]) == 10 * 248 / 1e6
    rows = as_text(tables.targets_table([plan, plan], COUNTS, LABELS, NAMES), tmp_path / "t.csv")
    assert rows[-1]["full model Gaussians"] == "105"
    assert rows[-1]["SSIM 0.6 Gaussians"] == "75"
    assert rows[-1]["SSIM 0.6 status"] == "infeasible"


def test_promise_counts_only_what_was_promised():
    rows = evaluate(
        [
            (0.6, 3, 0.62, 0.61),  # kept
            (0.6, 3, 0.60, 0.58),  # broken
            (0.6, 7, 0.59, 0.70),  # nothing promised
            (0.6, 7, 0.65, np.nan),  # nothing measured
            (0.6, 7, np.nan, 0.7),  # no model
            (0.6, TOTAL, np.nan, 0.7),
        ]
    )
    kept = tables.promise_kept(rows)
    assert (kept.promised, kept.kept, kept.share) == (2, 1, 0.5)
    assert math.isnan(tables.promise_kept(rows.select(rows.label_id == TOTAL)).share)


def test_evaluation_table(tmp_path):
    rows = evaluate([(0.5, 3, 0.6, 0.5), (0.5, 3, 0.6, 0.4), (0.7, 3, 0.6, 0.5), (0.5, TOTAL, np.nan, 0.8)])
    lines = as_text(tables.evaluation_table(rows, LABELS, NAMES), tmp_path / "t.csv")
    assert [(line["target"], line["category"]) for line in lines] == [
        ("0.5", "vase"), ("0.5", "whole image"), ("0.7", "vase"),
    ]  # fmt: skip
    assert (lines[0]["promised"], lines[0]["kept"], lines[0]["share kept"]) == ("2", "1", "0.5")
    assert lines[1]["promised"] == ""
    assert lines[2]["promised"] == "0"


def test_promises_are_counted_in_the_quality_of_the_plan(tmp_path):
    """Measured fidelity is 0.9 in every row, SSIM is given."""
    rows = evaluate([(0.8, 3, 0.85, 0.5), (0.95, 3, 0.96, 0.97), (0.8, TOTAL, np.nan, 0.6)])
    rows = replace(rows, quality=np.zeros(3, np.int32))
    lines = as_text(tables.evaluation_table(rows, LABELS, NAMES), tmp_path / "t.csv")
    assert [(line["quality"], line["target"], line["kept"]) for line in lines] == [
        ("fidelity", "0.8", "1"), ("fidelity", "0.8", ""), ("fidelity", "0.95", "0"),
    ]  # fmt: skip
    assert [float(line["fidelity"]) for line in lines] == pytest.approx([0.9] * 3)
    assert [float(line["SSIM"]) for line in lines] == pytest.approx([0.5, 0.6, 0.97])


def test_plans_of_both_qualities_side_by_side(tmp_path):
    choices = (
        Choice(3, 1000, 0.81, math.nan, 10, "ok", 300, False, Reached(0.97, 0.94, 0.99, 240)),
        Choice(7, 2000, math.nan, math.nan, 60, "no promise", 900),
    )
    plan = Plan(0.8, None, choices, 0.95, quality="fidelity")
    first, second = as_text(tables.plan_table(plan, COUNTS, NAMES), tmp_path / "t.csv")
    assert (first["status"], first["reached in"]) == ("no promise", "")
    assert [second[name] for name in ("status", "reached in", "from", "to", "views", "MB to send")] == [
        "ok, uncalibrated", "0.97", "0.94", "0.99", "240", "0.0003",
    ]  # fmt: skip
    rows = evaluate([(0.8, 3, 0.85, 0.5), (0.8, TOTAL, np.nan, 0.6)])
    both = Evaluation(
        *(np.concatenate([getattr(r, f.name) for r in (rows, rows)]) for f in fields(Evaluation))
    )
    both.quality[:2] = 0  # the same target of both qualities
    table = as_text(tables.outcome_table(plan, COUNTS, both, NAMES), tmp_path / "t.csv")
    assert float(table[1]["fidelity"]) == pytest.approx(0.9)
    assert float(table[1]["SSIM"]) == pytest.approx(0.5)
    assert len(both.of(plan)) == len(both.of(replace(plan, quality="ssim"))) == 2
    two = as_text(
        tables.targets_table([plan, replace(plan, quality="ssim")], COUNTS, LABELS, NAMES), tmp_path / "t"
    )
    assert {"fidelity 0.8 status", "SSIM 0.8 status"} < set(two[0])


AWKWARD = (
    '=HYPERLINK("x")',
    "+1",
    "-1+2",
    "@SUM(A1)",
    "'=1",
    "''@x",
    "'tis",
    "＝1",
    "a|b",
    "a\\",
    "[a](b)",
    "_a_",
    "*a",
)


def test_no_cell_is_a_formula_and_names_come_back(tmp_path):
    header = ("category", "=1+1", "count")
    rows: list[tuple[str | int | float, ...]] = [(name, "x", -3) for name in AWKWARD]
    table = tables.Table("t", header, ("", "", ",d"), rows, marks={(0, 1): "m"})
    table.write_csv(tmp_path / "t.csv")
    with (tmp_path / "t.csv").open(newline="", encoding="utf-8") as file:
        first, *lines = csv.reader(file)
    assert tuple(cell_text(cell) for cell in first[:3]) == header
    assert tuple(cell_text(line[0]) for line in lines) == AWKWARD
    assert {line[2] for line in lines} == {"-3"}
    assert lines[0][3] == "'=1+1: m"
    text = [cell for line in (first, *lines) for cell in line if cell != "-3"]
    assert not [cell for cell in text if cell.startswith(tuple("=+-@＝"))]


@given(st.text())
def test_text_cells_come_back(text):
    cell = text_cell(text)
    assert cell[:1] not in tuple("=+-@\t\r\n")
    assert cell_text(cell) == text


def test_markdown_and_latex_take_names_as_they_are():
    table = tables.Table(
        "t", ("a|b",), ("",), [(name,) for name in (*AWKWARD, "<b>&amp;", "c_%", "≥ x^2 – 1")]
    )
    lines = table.markdown().splitlines()
    assert lines[0] == "| a\\|b |"
    assert {
        "| a\\\\ |",
        "| \\[a\\](b) |",
        "| \\_a\\_ |",
        "| \\*a |",
        "| &lt;b>&amp;amp; |",
        "| c\\_% |",
    } < set(lines)
    latex = table.latex().splitlines()
    assert r"$<$b$>$\&amp; \\" in latex
    assert r"$\geq$ x\textasciicircum{}2 -- 1 \\" in latex
    assert {r"{[}a](b) \\", r"{*}a \\", r"\_a\_ \\", r"c\_\% \\", r"a\textbackslash{} \\"} < set(latex)


def test_models_table(tmp_path):
    distance = np.linspace(1, 5, 30, dtype=np.float32)
    model = fit_model(3, 1000, distance, 0.8 * np.exp(-0.1 * distance))
    row = as_text(tables.models_table({(3, 1000): model}, NAMES), tmp_path / "t.csv")[0]
    assert row["category"] == "vase"
    assert float(row["K1"]) == model.params.K1
    assert (float(row["d min"]), float(row["d max"])) == (1, 5)
    assert tables.models_table({}, NAMES).rows == []
