import csv
import dataclasses
import re
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import browser as chromium
import numpy as np
import pytest
from browser import launch, open_page
from conftest import cell_text
from page_checks import wrong_with, wrong_with_keyboard
from PIL import Image

from sagesplat.adapt.eq1 import plan_scene
from sagesplat.adapt.eq3 import fit_models
from sagesplat.adapt.evaluate import QUALITIES, UNIFORM, Evaluation, read_evaluation
from sagesplat.adapt.observe import TOTAL, Observations, read_observations
from sagesplat.adapt.plan import Choice, Plan, Reached
from sagesplat.adapt.viewpoint import QualityKind
from sagesplat.output import figures, report_figures
from sagesplat.output.figures import Panel
from sagesplat.output.next_steps import Commands, next_steps
from sagesplat.output.place_figures import Place, viewpoint_map
from sagesplat.output.report import write_report
from sagesplat.output.report_data import Look, PromiseFacts, ReportData

NAMES = {3: "vase", 7: "dining table", 9: "$x^2$ <b>&amp; _odd"}
COLOURS = {3: (250, 250, 10), 7: (0, 160, 180), 9: (90, 10, 200), -1: (128, 128, 128)}
LABELS: tuple[int, ...] = (-1, 3, 7, 9)
LEVELS = (1000, 2000, 3000)
VIEWS = 10
TEST = np.array([0, 5])


def quality(label: int, level: int, view: int) -> float:
    return 0.5 + 0.03 * label + 0.05 * LEVELS.index(level) - 0.01 * view


def columns(kind, rows: list[tuple]):
    types = [np.dtype(f.type.dtypes[0]) for f in dataclasses.fields(kind)]  # type: ignore
    missing = (0.75,) * (len(types) - len(rows[0]))  # without the photo's exposure, and colour-corrected
    return kind(*(np.array([(*row, *missing)[i] for row in rows], t) for i, t in enumerate(types)))


def make(panels: int = 2) -> ReportData:
    train = np.setdiff1d(np.arange(VIEWS), TEST)
    seen = [
        (label, level, view, 1 + view / 3, quality(label, level, view), 0.5, 25.0, 100)
        for label in (*LABELS, TOTAL)
        for level in LEVELS
        for view in range(VIEWS)
    ]
    observations = columns(Observations, seen)
    counts = {(i, level): (i + 2) * 100 * (k + 1) for i in LABELS for k, level in enumerate(LEVELS)}
    models = fit_models(observations, train)
    distances = dict.fromkeys(LABELS, 1 + train / 3)
    plans = [plan_scene(models, counts, distances, target) for target in (0.5, 0.6)]
    measured = []
    for plan in plans:
        kind = QUALITIES.index(plan.quality)
        for view in (*TEST, 1):  # view 1 is a training view and must not count
            for c in plan.choices:
                ssim = quality(c.label_id, c.level, view) - (0.3 if view == 1 else 0.0)
                promised = models[c.label_id, c.level](1 + view / 3)
                alike = 0.9 + 0.01 * LEVELS.index(c.level)
                key = (kind, plan.target, view, c.label_id, c.level)
                measured.append((*key, promised, alike, ssim, 24, 0.8, 26, 99))
            whole = 0.6 - 0.1 * (view == 1)
            measured.append((kind, plan.target, view, TOTAL, -1, np.nan, 0.93, whole, 24, 0.8, 26, 400))
    draw = np.random.default_rng(0)
    photo, full, composed = draw.integers(0, 255, (3, 24, 40, 3)).astype(np.uint8)
    ids = draw.choice(np.array(LABELS, np.int16), (24, 40))
    return ReportData(
        title="a <scene>",
        target=0.6,
        names=NAMES,
        colours=COLOURS,
        observations=observations,
        train_views=train,
        test_views=TEST,
        view_names=[f"view_{i}.jpg" for i in range(VIEWS)],
        counts=counts,
        recovering=frozenset({2000}),
        models=models,
        plans=plans,
        evaluation=columns(Evaluation, measured),
        panels=[
            Panel(f"view_{i}.jpg", photo, full, composed, ids, 0.6, 24.0, 0.8, 26.0) for i in range(panels)
        ],
        scene_facts=[("photos", "10")],
        timings=[("train", 12.5)],
    )


@dataclass
class Page(HTMLParser):
    links: list[str]
    text: str = ""

    def __init__(self, path: Path):
        super().__init__()
        self.links = []
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag, attrs):
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "data", "action")]

    def handle_data(self, data):
        self.text += data


@pytest.fixture
def undrawn(monkeypatch) -> None:
    """For tests of what is written: drawing a report's figures takes seconds."""
    monkeypatch.setattr(figures, "save_figure", lambda figure, path, svg=True: b"<svg/>")


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> tuple[Path, ReportData, Page]:
    folder = tmp_path_factory.mktemp("run") / "report"
    data = make()
    path = write_report(folder, data)
    return path, data, Page(path)


def test_page_stands_alone(written):
    path, _, page = written
    assert path.name == "index.html"
    without_pictures = re.sub(r"base64,[A-Za-z0-9+/=]*", "", path.read_text("utf-8"))
    assert not re.search("//|@import|url\\(", without_pictures)
    for link in page.links:
        assert link.startswith("data:") or (path.parent / link).is_file(), link[:80]


def test_every_category_is_on_it(written):
    path, _, page = written
    for name in (*NAMES.values(), "unlabelled", "whole image"):
        assert name in page.text
    assert "<b>&amp;amp; _odd" not in path.read_text("utf-8")  # escaped, not markup
    assert "a <scene>" in page.text
    assert "nan" not in page.text.lower().split()


def test_headline_is_computed_from_unseen_views(written):
    _, data, page = written
    plan = data.plans[1]
    full = sum(count for (_, level), count in data.counts.items() if level == LEVELS[-1])
    words = " ".join(page.text.split())
    assert f"{plan.count:,} of {full:,} Gaussians" in words
    assert f"{int(100 * (1 - plan.count / full))}% fewer Gaussians" in words
    assert "On 2 photos" in words
    assert "SSIM 0.600 and 24.00 dB" in words  # view 1 would have lowered the mean


def test_files_beside_the_page(written):
    path, data, _ = written
    figure_names = {"size_by_target", "quality_over_size", "asked_and_measured"}
    figure_names |= {"ssim_over_levels", "ssim_over_distance"}
    assert {f.stem for f in (path.parent / "figures").glob("*.svg")} == figure_names
    for name in figure_names | {"panel_0", "panel_1"}:
        with Image.open(path.parent / "figures" / f"{name}.png") as image:
            assert np.ptp(np.asarray(image.convert("L"))) > 100
    for file in (path.parent / "tables").glob("*.csv"):
        with file.open(newline="", encoding="utf-8") as handle:
            rows = list(csv.reader(handle))
        assert len(rows) > 1
        assert len({len(row) for row in rows}) == 1
    raw = read_observations(path.parent / "tables" / "observations.csv")
    np.testing.assert_array_equal(raw.ssim, data.observations.ssim)
    assert set(read_evaluation(path.parent / "tables" / "evaluation_rows.csv").view) == set(TEST)


def test_without_test_views_and_pictures(tmp_path):
    data = make(panels=0)
    data = dataclasses.replace(data, test_views=TEST[:0], models={}, timings=())
    text = write_report(tmp_path, data).read_text("utf-8")
    assert "See the difference" not in text
    assert "unseen it measures" not in text
    assert "dining table" in text
    assert not (tmp_path / "figures" / "quality_over_size.svg").exists()


def led_by_fidelity(panels: int = 0) -> ReportData:
    """The same capture with nested levels: plans for fidelity, one for SSIM beside them."""
    data = make(panels)
    sizes = {key: 30 * count for key, count in data.counts.items()}
    reached = Reached(0.97, 0.94, 0.99, 240)
    plans = []
    asked: list[tuple[QualityKind, float]] = [("fidelity", 0.9), ("fidelity", 0.95), ("ssim", 0.6)]
    for kind, target in asked:
        choices = [
            dataclasses.replace(
                c, transfer_bytes=sizes[c.label_id, c.level], predicted=target + 0.01, status="ok",
                calibrated=kind == "fidelity", reached=reached,
            )
            for c in data.plans[0].choices
        ]  # fmt: skip
        choices[0] = dataclasses.replace(choices[0], status="no promise", predicted=np.nan)
        choices[1] = dataclasses.replace(choices[1], status="infeasible" if kind == "ssim" else "ok")
        plans.append(Plan(target, None, tuple(choices), 0.95, quality=kind))
    rows = []
    for plan in plans:
        kind = QUALITIES.index(plan.quality)
        for view in TEST:
            for c in plan.choices:
                alike = 0.96 if view else 0.94
                rows.append((kind, plan.target, view, c.label_id, c.level, 0.9, alike, 0.62, 24, 0.8, 26, 99))
            rows.append((kind, plan.target, view, TOTAL, -1, np.nan, 0.955, 0.7, 24, 0.8, 26, 400))
    for level, view in ((1000, 0), (1000, 5), (2000, 0), (2000, 5)):
        alike = 0.8 + level / 1e5 + view / 1e3
        rows.append((0, np.nan, view, UNIFORM, level, np.nan, alike, 0.5, 20, 0.8, 26, 400))
    evaluation = columns(Evaluation, rows)
    return dataclasses.replace(
        data,
        plans=plans,
        evaluation=evaluation,
        quality="fidelity",
        target=0.95,
        ssim_target=0.6,
        sizes=sizes,
    )


@pytest.mark.usefixtures("undrawn")
def test_the_first_page_leads_with_fidelity(tmp_path):
    data = led_by_fidelity()
    plan, full = data.plans[1], sum(n for (_, level), n in (data.sizes or {}).items() if level == LEVELS[-1])
    words = " ".join(Page(write_report(tmp_path, data)).text.split())
    first = words[: words.index("What each category gets")]
    assert f"{(plan.transfer_bytes or 0) / 1e6:.2f} MB of {full / 1e6:.2f} MB for fidelity 0.95" in first
    assert "Fidelity ≥ 0.95 in every category for 95 % of viewpoints" in first
    words_of_plan = words[words.index("What each category gets") : words.index("Bars: length")]
    assert "Each category measures fidelity 0.95 or more at 97 % or more of the viewpoints" in words_of_plan
    assert "fidelity 0.955" in words_of_plan
    counted = "3 of 6 measurements there reach 0.95: one for each category in each view (not counted: "
    assert f"{counted}2 without a promise for it)." in words_of_plan
    choices = tuple(dataclasses.replace(c, reached=Reached(1.0, 0.9, 1.0, 40)) for c in plan.choices)
    plans = [data.plans[0], dataclasses.replace(plan, choices=choices), data.plans[2]]
    all_reach = write_report(tmp_path / "all", dataclasses.replace(data, plans=plans))
    said = "At all viewpoints drawn within the capture, every category measures fidelity 0.95 or more."
    assert said in " ".join(Page(all_reach).text.split())
    for word in ("infeasible", "uncalibrated", "cannot reach"):
        assert word not in first
    assert "nan" not in words.lower().split()
    assert (tmp_path / "tables" / "plan_ssim.csv").exists()
    rows = list(csv.DictReader((tmp_path / "tables" / "evaluation.csv").read_text("utf-8").splitlines()))
    assert {(row["quality"], row["target"]) for row in rows} == {
        ("fidelity", "0.9"), ("fidelity", "0.95"), ("SSIM", "0.6"),
    }  # fmt: skip


def whole_page() -> ReportData:
    """With everything that a finished run has: commands, a map, drawn viewpoints, what else was made."""
    draw = np.random.default_rng(1)
    directions = draw.normal(size=(VIEWS, 2))
    place = Place(draw.normal(size=(300, 2)), draw.random((300, 3)), 3 * directions, -directions)
    drawn = {label: np.sort(draw.random((10, len(LEVELS))), axis=1).astype(np.float32) for label in LABELS}
    return dataclasses.replace(
        led_by_fidelity(panels=2),
        commands=Commands("'/runs/a place'", "/photos", 1000),
        can_view=True,
        links=[("Its bundle", "../../bundle/index.html"), ("The paper's tables", "paper/index.html")],
        place=place,
        drawn=drawn,
        planned={label: values[:, 1] for label, values in drawn.items()},
        drawn_at=Place(place.points, place.colours, place.at[:10], place.towards[:10]),
        looks=[
            Look(0.9, 120_000, 0.934, 0.871, np.full((8, 12, 3), 90, np.uint8)),
            Look(1.0, 350_000, 1.0, 1.0, np.full((8, 12, 3), 99, np.uint8)),
        ],
        promise=PromiseFacts(0.95, 57, 27, 83, "screens of 0.5 to 2 times the photos' focal length"),
        settings=[("train.max_steps", "1000")],
        provenance=[("sha256 of scene.json", "f" * 64)],
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    return write_report(tmp_path_factory.mktemp("whole"), whole_page())


def test_a_map_of_shares_that_are_all_alike_has_the_whole_scale():
    place = whole_page().drawn_at
    assert place is not None
    for share in (1.0, np.nan):
        figure = viewpoint_map(place, np.full(10, share))
        assert {
            dots.get_clim() for dots in figure.axes[0].collections[1:] if dots.get_array() is not None
        } == {(0.0, 1.0)}


def test_what_was_asked_is_pictured_with_its_bytes_and_what_it_measures(whole):
    page = whole.read_text()
    assert "0.9 asked</b><br>0.12 MB<br>measured 0.934, here 0.871" in page
    assert "full model</b><br>0.35 MB</figcaption>" in page


def test_the_next_step_is_what_was_measured():
    data = whole_page()
    rows, names = data.observations, ("a", "b", "c", "d", "e", "f", "g", "h", "i", "j")

    def steps(seen: np.ndarray, commands: Commands) -> list:
        of = dataclasses.replace(rows, ssim=seen.astype(np.float32))
        return next_steps(of, data.train_views, TEST, names, NAMES, data.plans[1], commands)

    typed = Commands("run", "/photos", 1000)
    unseen = np.isin(rows.view, TEST)
    worse = np.where(unseen, 0.7, 0.95) - 0.2 * (unseen & (rows.label_id == 7)) - 0.1 * (rows.view == 5)
    found = steps(worse, typed)
    assert [step.title for step in found] == ["More photos", "Measure at more viewpoints"]
    assert "SSIM 0.950, unseen ones 0.650" in found[0].why
    assert "largest for dining table" in found[0].why
    assert "in f (0.600; see the map)" in found[0].why
    assert "show unlabelled to" in found[1].why
    pale = steps(np.full(len(rows), 0.8), typed)
    assert [step.title for step in pale] == ["Train longer", "Measure at more viewpoints"]
    assert pale[0].command == "sagesplat run /photos run --train.max-steps 2000 --force"
    assert steps(np.full(len(rows), 0.97), typed)[0].command.startswith("sagesplat sample run ")
    assert [step.title for step in steps(worse, Commands("run"))] == ["Measure at more viewpoints"]


@pytest.mark.slow
@pytest.mark.skipif(chromium.missing() is not None, reason=chromium.missing() or "")
def test_the_page_is_for_everybody(whole):
    with launch() as browser:
        with open_page(whole.as_uri(), (1280, 800), browser=browser) as opened:
            page = opened.page
            assert wrong_with(page) == []
            page.get_by_role("button", name="view_1.jpg", exact=True).click()
            assert page.locator(".view:visible img").first.get_attribute("alt") == "view_1.jpg: full model"
            page.evaluate("navigator.clipboard.writeText = async (text) => { window.copied = text }")
            page.get_by_role("button", name="Copy").first.click()
            assert page.evaluate("copied") == "sagesplat view '/runs/a place'"
            assert page.locator("[data-served]").is_hidden()  # a bundle needs a server
            assert opened.complaints == []
        with open_page(whole.as_uri(), (360, 740), browser=browser, scheme="dark") as opened:
            assert wrong_with_keyboard(opened.page) == []
            opened.page.evaluate("for (const part of document.querySelectorAll('details')) part.open = true")
            assert wrong_with(opened.page) == []
            assert opened.complaints == []


def test_plans_for_fidelity_are_compared_with_equal_levels_at_the_same_views():
    data = led_by_fidelity()
    uniform = data.evaluation.uniform("fidelity")
    assert uniform == pytest.approx({1000: 0.8125, 2000: 0.8225})
    figure = figures.quality_over_size(uniform, data.sizes or {}, data.plans, data.evaluation, "fidelity")
    equal, composed = (np.asarray(line.get_xydata()) for line in figure.axes[0].lines)
    sizes = [sum(n for (_, i), n in (data.sizes or {}).items() if i == level) / 1e6 for level in uniform]
    assert equal == pytest.approx(np.column_stack([sizes, list(uniform.values())]))
    assert composed[:, 1] == pytest.approx([0.955, 0.955])  # the plan for SSIM is not in it


def test_the_lowest_category_is_drawn_beside_the_whole_image():
    data = led_by_fidelity()
    drawn = {3: np.array([[0.5, 0.9, 1], [0.7, np.nan, np.nan]]), 7: np.array([[0.8, 0.85, 1]] * 2)}
    uniform, sizes = data.evaluation.uniform("fidelity"), data.sizes or {}
    figure = figures.quality_over_size(
        uniform, sizes, data.plans, data.evaluation, "fidelity", drawn=drawn
    )  # fmt: skip
    equal, planned = (np.asarray(line.get_ydata()) for line in figure.axes[0].lines[2:4])
    assert equal == pytest.approx([0.6, 0.85])
    assert planned == pytest.approx([0.6, 0.6])  # both at their first level


def test_pictures():
    ids = np.array([[3, -1], [7, 55]], np.int16)
    image = figures.label_image(ids, COLOURS)
    assert image.tolist() == [[[250, 250, 10], [128, 128, 128]], [[0, 160, 180], [128, 128, 128]]]
    photo = np.zeros((2, 2, 3), np.uint8)
    other = photo.copy()
    other[0, 0] = 255
    error = figures.error_image(other, photo)
    assert error.shape == (2, 2, 3)
    assert error[0, 0].sum() > 600
    assert error[1, 1].sum() < 10


AWKWARD = (
    *("[/red]", '=HYPERLINK("x")', "$x^2$", "_grass", "a|b & c_%", "日本語", "é", "🚗", "x" * 100, "W" * 99),
    *("a--b-->", "</svg>", "{{ 1 }}", "🚗" * 100, "\\frac{", "__", "%s %d {0}"),
)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "first", [0, *(pytest.param(first, marks=pytest.mark.slow) for first in range(4, len(AWKWARD), 4))]
)
def test_awkward_names_are_drawn_and_listed_as_they_are(tmp_path: Path, first: int) -> None:
    some = (AWKWARD * 2)[first : first + 4]
    data = dataclasses.replace(make(), names=dict(zip(LABELS, some, strict=True)), title=some[0])
    path = write_report(tmp_path / "report", data)
    for name in some[1:]:  # of the first, unlabelled, the name is ours
        assert name in Page(path).text
    with (tmp_path / "report" / "tables" / "plan.csv").open(newline="", encoding="utf-8") as file:
        cells = [row[0] for row in csv.reader(file)]
    assert {cell_text(cell) for cell in cells} > set(some[1:])
    for drawing in (tmp_path / "report" / "figures").glob("*.svg"):
        ElementTree.parse(drawing)


@pytest.mark.usefixtures("undrawn")
def test_an_address_is_a_qr_code_only_where_there_is_one(whole, tmp_path):
    assert "QR code of" not in whole.read_text("utf-8")
    data = dataclasses.replace(whole_page(), url="https://example.org/x/")
    page = write_report(tmp_path, data).read_text("utf-8")
    assert '<a href="https://example.org/x/">' in page
    assert re.search(r'<img class="qr" src="data:image/svg\+xml[^"]{400,}" alt="QR code of https', page)


@pytest.mark.usefixtures("undrawn")
def test_pixels_that_are_ignored_are_grey_in_the_error_and_explained(written, tmp_path):
    data, said = make(panels=1), "grey: ignored, and in none of these figures"
    (panel,) = data.panels
    valid = np.ones(panel.photo.shape[:2], bool)
    valid[:5, :5] = False
    error = figures.error_image(panel.composed, panel.photo, valid)
    assert (error[valid] == figures.error_image(panel.composed, panel.photo)[valid]).all()
    assert len(np.unique(error[~valid])) == 1
    assert said not in written[2].text
    data = dataclasses.replace(data, panels=[dataclasses.replace(panel, valid=valid)])
    assert said in Page(write_report(tmp_path, data)).text


def test_the_map_of_viewpoints_counts_what_reaches_the_target():
    """Two categories; the second viewpoint shows one of them, the third none."""
    nan = np.nan
    plan = Plan(
        0.9,
        None,
        (Choice(3, 2, nan, nan, 5, "ok"), Choice(7, 1, nan, nan, 5, "ok")),
        0.95,
        quality="fidelity",
    )
    planned = {3: np.array([0.95, 0.85, nan], np.float32), 7: np.array([0.8, nan, nan], np.float32)}
    data = dataclasses.replace(whole_page(), planned=planned)
    np.testing.assert_array_equal(report_figures._reached(data, plan), [0.5, 0.0, nan])
