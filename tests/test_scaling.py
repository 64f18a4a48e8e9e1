"""The simulated CDN against references and closed forms; conservation; recorded visits."""

from collections import OrderedDict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.common import RESULTS
from benchmarks.scaling import __main__ as report
from benchmarks.scaling import figures, theory
from benchmarks.scaling.cdn import DAY, HIT, MISS, VALIDATED, Outcome, Site, new_caches, serve, simulate
from benchmarks.scaling.visits import KINDS, Library, read

VISITS = Path(__file__).parent / "data" / "scaling_visits.json"
SITE = Site(viewers=3000, scenes=40, pops=4, pop_bytes=1.5e6, shield_bytes=4e6, mix=(0.4, 0.6), returning=0.3)


@pytest.fixture(scope="module")
def library() -> Library:
    return read([VISITS, VISITS])


@pytest.fixture(scope="module")
def day(library: Library) -> Outcome:
    return simulate(library, SITE)


def requests(files: np.ndarray, sizes: np.ndarray, capacity: float, **timing: float) -> np.ndarray:
    """Requests by outcome at one cache without a shield, a second apart, from `begin` on."""
    caches = new_caches(1, len(sizes), capacity, 0.0)
    tables, origin, minutes = np.zeros((2, 2, 4), int), np.zeros(2, int), np.zeros((3, 1441), int)
    values = np.array([timing.get("begin", 0.0), timing.get("fill", 0.0), timing.get("ttl", 0.0)])
    n, hashed = len(files), np.full(len(files), not timing.get("unhashed"))
    at, pop = np.arange(n) * 1.0, np.zeros(n, int)
    serve(at, pop, files, hashed, sizes[files], sizes, caches, values, tables, origin, minutes)
    assert caches.used[0] <= capacity
    return tables[0, 0]


def test_a_cache_drops_what_was_not_asked_for_longest():
    rng = np.random.default_rng(0)
    sizes = rng.integers(1, 40, 60)
    files = rng.integers(0, 60, 5000)
    kept: OrderedDict[int, int] = OrderedDict()
    hits = 0
    for file in files.tolist():
        hits += file in kept
        kept[file] = int(sizes[file])
        kept.move_to_end(file)
        while sum(kept.values()) > 300:
            kept.popitem(last=False)
    found = requests(files, sizes, 300.0)
    assert 500 < hits < 4500
    assert found.tolist() == [hits, 0, 0, 5000 - hits]


@pytest.mark.parametrize("share", [0.03, 0.1, 0.4])
def test_hit_rates_are_those_of_ches_approximation(share: float):
    rng = np.random.default_rng(1)
    n, count = 2000, 400_000
    rates = np.arange(1, n + 1) ** -0.8
    rates /= rates.sum()  # one request a second
    sizes = rng.integers(1000, 9000, n)
    capacity = share * sizes.sum()
    found = requests(rng.choice(n, count, p=rates), sizes, capacity, begin=count / 2)
    time = theory.characteristic_time(rates, sizes, capacity)
    assert found[HIT] / found.sum() == pytest.approx((rates * -np.expm1(-rates * time)).sum(), abs=0.005)


def test_no_byte_and_no_request_is_lost(day: Outcome):
    assert day.asked == day.browser + day.pop.sum()
    assert day.asked_bytes == day.browser_bytes + day.unsent_bytes + day.pop_bytes.sum()
    assert day.shield.sum() == day.pop[VALIDATED] + day.pop[MISS]
    assert day.origin == day.shield[VALIDATED] + day.shield[MISS]
    assert day.shield_bytes[MISS] <= day.origin_bytes  # the shield may lack what a point of presence holds
    assert day.minutes[0].sum() == day.pop.sum()
    assert day.minutes[1].sum() == day.origin
    assert day.minutes[2].sum() == day.pop_bytes.sum()
    assert (day.used[:-1] <= SITE.pop_bytes).all()
    assert day.used[-1] <= SITE.shield_bytes
    assert min(day.browser, day.unsent_bytes, day.pop[HIT], day.pop[MISS], day.shield[HIT]) > 0


def test_the_same_seed_gives_the_same_day(library: Library, day: Outcome):
    again, other = simulate(library, SITE), simulate(library, replace(SITE, seed=1))
    assert [again.egress, again.origin_bytes, *again.pop] == [day.egress, day.origin_bytes, *day.pop]
    assert again.egress != other.egress


def test_simulation_and_closed_form_agree(library: Library):
    site = replace(SITE, viewers=20_000, edge_ttl=DAY * 9, fill_seconds=0.0)
    day = simulate(library, site)
    asked, sent = theory.per_visit(library, site)
    assert day.pop.sum() / day.visits == pytest.approx(asked, rel=0.02)
    assert day.egress / day.visits == pytest.approx(sent, rel=0.03)
    assert day.row()["pop_hits_bytes"] == pytest.approx(theory.pop_hits(library, site)[1], abs=0.03)


def test_recorded_visits_are_read(library: Library):
    assert library.names == ("tiny", "tiny")
    assert (library.visits, library.profiles) == (4, ("everything", "target 0.8"))
    assert library.profile.tolist() == [0, 0, 1, 1]
    table = library.per_visit()
    assert table.shape == (2, 4, len(KINDS))
    assert table[0, 0].tolist() == [50_600, 2000, 3000, 90_000, 0]
    # 1 Mbit/s and 100 ms: 12,500 bytes were on their way when the visitor left, or stopped the pack
    assert table[1, 1].tolist() == [33_100, 0, 0, 0, 0]
    assert table[1, 2].tolist() == [50_600, 2000, 3000, 52_500, 47_000]
    assert table[1, 3].tolist() == [50_600, 2000, 3000, 52_500, 58_700]  # 700 of them a range of a file
    assert not library.kept[3, 6]
    assert library.kept[0, :5].tolist() == [True] * 5
    assert library.kept[2, :5].tolist() == [True, True, True, True, False]
    assert library.hashed[0].tolist() == [False, True, True, False, *[True] * 7]


def test_days_and_figures(library: Library, capsys: pytest.CaptureFixture[str]):
    rows = report.days(library, SITE, (50, 500))
    assert [row["viewers"] for row in rows] == [50, 500]
    assert len(capsys.readouterr().out.splitlines()) == 2
    sweep = [row | {"pop_bytes": 1e6 * i} for i, row in enumerate(rows, 1)]
    for figure in (
        figures.visits({"one": library, "two": library}),
        figures.hits(rows, {"one": sweep, "two": sweep}),
    ):
        figure.canvas.draw()


def test_committed_recordings_can_be_read():
    for name in report.SETS:
        found = read(sorted(RESULTS.glob(f"scaling-visits-*-{name}.json")))
        assert found.names == ("dinosaur", "garden")
        assert (found.kinds == KINDS.index("pack")).any(1).tolist() == [name != "files"] * 2
