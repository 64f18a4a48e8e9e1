"""The closed form of a CDN beside a cache that is asked request by request; recorded visits."""

import json
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import scaling
from benchmarks.common import RESULTS
from benchmarks.scaling import DAY, KINDS, Bundle, Site, absent, day, read

VISITS = Path(__file__).parent / "data" / "scaling_visits.json"


@pytest.fixture
def bundle(monkeypatch: pytest.MonkeyPatch) -> Bundle:
    monkeypatch.setattr(scaling, "MIX", (0.4, 0.6))
    return read(VISITS)


@pytest.mark.parametrize("share", [0.03, 0.1, 0.4, 1.0])
def test_what_is_absent_is_what_a_cache_dropped_or_never_had(share: float, monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(1)
    n, count = 500, 100_000
    rates = np.arange(1, n + 1) ** -0.8
    rates /= rates.sum()  # one request a second
    sizes = rng.integers(1000, 9000, n)
    kept: OrderedDict[int, int] = OrderedDict()
    used, missed = 0, 0
    for second, file in enumerate(rng.choice(n, count, p=rates).tolist()):
        if file not in kept:
            missed += second >= count // 2
            used += sizes[file]
        kept[file] = sizes[file]
        kept.move_to_end(file)
        while used > share * sizes.sum():
            used -= kept.popitem(last=False)[1]
    monkeypatch.setattr(scaling, "AGES", np.linspace(0.5, 1, 50) * count)
    there = absent(rates, sizes, share * sizes.sum())
    assert (rates * there).sum() == pytest.approx(missed / (count / 2), abs=0.006)


def test_recorded_visits_are_read(bundle: Bundle):
    assert (bundle.name, bundle.profiles) == ("tiny", ("everything", "target 0.8"))
    assert bundle.profile.tolist() == [0, 0, 1, 1]
    by_kind = np.stack([bundle.sent[:, bundle.kinds == kind].sum(1) for kind in range(len(KINDS))], 1)
    # 1 Mbit/s and 100 ms: 12,500 bytes were on their way when the visitor left, or stopped the pack
    assert by_kind.tolist() == [
        [50_600, 2000, 3000, 90_000, 0],
        [33_100, 0, 0, 0, 0],
        [50_600, 2000, 3000, 52_500, 47_000],
        [50_600, 2000, 3000, 52_500, 58_700],  # 700 of them a range of a file
    ]
    assert (bundle.first <= bundle.sent).all()
    assert bundle.hashed.tolist() == [False, True, True, False, *[True] * 7]


def test_a_visit_takes_what_its_browser_did_not_keep(bundle: Bundle, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(scaling, "RETURNING", 0.0)
    new = day([bundle], Site(1000))
    assert new["mb_per_visit"] * 1e6 == pytest.approx(
        0.4 * bundle.sent[:2].sum(1).mean()
        + 0.6 * bundle.sent[2:].sum(1).mean()
        + 500 * new["requests_per_visit"]
    )
    monkeypatch.setattr(scaling, "RETURNING", 1 - 1e-12)
    whole = replace(bundle, sent=np.tile(bundle.sizes, (4, 1)))
    again = day([whole], Site(1000))  # asks only whether what has no hash is as before
    unhashed = bundle.weighted(bundle.requests)[~bundle.hashed].sum()
    assert again["requests_per_visit"] == pytest.approx(unhashed)
    assert again["mb_per_visit"] * 1e6 == pytest.approx(500 * unhashed)


def test_many_visitors_are_answered_near_them_and_ask_the_origin_for_what_has_no_hash(bundle: Bundle):
    few, many = (day([bundle, bundle], Site(viewers, scenes=40)) for viewers in (100, 1e8))
    assert few["pop_hits_bytes"] < 0.8
    assert few["origin_gb"] > 0
    assert many["pop_hits_bytes"] == pytest.approx(1)
    assert many["origin_gb"] == 0
    unhashed = bundle.weighted(bundle.requests)[~bundle.hashed].sum()
    assert 1 - many["pop_hits"] == pytest.approx(unhashed / many["requests_per_visit"])
    assert many["peak_origin_requests_per_s"] == pytest.approx(1.6e8 / DAY * unhashed)
    assert many["fresh_peak_origin_requests_per_s"] <= 40 * 2 / 60
    small = day([bundle], Site(1e4, scenes=40, pop_bytes=1e6))
    assert small["pop_hits_bytes"] < day([bundle], Site(1e4, scenes=40))["pop_hits_bytes"]


def test_committed_recordings_make_the_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scaling.main(tmp_path)
    result = json.loads(capsys.readouterr().out)
    assert [row["viewers"] for row in result["days"]] == list(scaling.VIEWERS)
    assert (tmp_path / "scaling.png").stat().st_size > 10_000
    for path in RESULTS.glob("scaling-visits-*.json"):
        assert (read(path).kinds == list(KINDS).index("pack")).any()
