"""Tables on terminals of any width, and the remaining time of a stage."""

import io
from itertools import pairwise

import pytest
from rich.console import Console as RichConsole

from sagesplat.cli import console
from sagesplat.cli.console import Console, Remaining
from sagesplat.cli.layout import fitted
from sagesplat.core.events import Progress, StageDone, StageStarted, TableMade

HEADER = ("category", "level", "Gaussians", "share", "promised", "test", "all", "status")
ROWS = tuple(
    (name, "14", "1,234,567", "100%", "0.525", "0.531", "0.592", "infeasible")
    for name in (
        "building-other-merged",
        "pavement-merged",
        "a category of a network with a long name",
        "sky",
    )
)


def shown(width: int, *events: object) -> str:
    out = io.StringIO()
    with Console(RichConsole(file=out, width=width, highlight=False)) as log:
        for event in events:
            log(event)  # type: ignore[arg-type]
    return out.getvalue()


@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_no_cell_of_a_table_is_cut(width: int) -> None:
    text = shown(width, TableMade("Plan for SSIM 0.8: promised, and measured", HEADER, ROWS))
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= width
    for cell in ("1,234,567", "0.525", "0.531", "0.592", "infeasible"):
        assert text.count(cell) == len(ROWS)
    for word in " ".join((*HEADER, *(row[0] for row in ROWS))).replace("-", " ").split():
        assert word in text


def test_a_table_that_fits_is_one() -> None:
    assert fitted(HEADER, ROWS, 200) == [(list(HEADER), [list(row) for row in ROWS])]
    parts = fitted(HEADER, ROWS, 40)
    assert [name for heads, _ in parts for name in heads[1:]] == list(HEADER[1:])
    assert all(heads[0] == "category" for heads, _ in parts)


def test_remaining_time_does_not_jump_with_the_time_of_a_step() -> None:
    """Steps of 0.05 and 0.2 s in turns of 25: the true rest falls from 125 s."""
    estimate, now, total = Remaining(), 20.0, 1000  # 20 s of compiling come first
    seconds = [0.05 if step // 25 % 2 else 0.2 for step in range(total)]
    told = []
    for done in range(1, total + 1):
        now += seconds[done - 1]
        left = estimate(now, done, total)
        assert (left is None) == (done - 1 < 0.02 * (total - 1))
        if left is not None:
            told.append((left, sum(seconds[done:])))
    # from a tenth on within half of the truth, and from one step to the next without a jump
    assert all(abs(left - true) < 0.5 * 125 for left, true in told[80:])
    assert max(abs(a[0] - b[0]) for a, b in pairwise(told[80:])) < 2.0
    assert told[-1][0] == 0


def test_a_log_gets_few_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: clock[0])

    def lines(seconds: float) -> list[str]:
        out = io.StringIO()
        with Console(RichConsole(file=out, width=80)) as log:
            log(StageStarted("train"))
            for done in range(1, 1001):
                clock[0] += seconds / 1000
                log(Progress("train", done, 1000, "loss 0.1"))
            log(StageDone("train", seconds, ("done",)))
        return out.getvalue().splitlines()

    assert len(lines(30)) == 1  # the end
    assert len(lines(600)) == 5  # 10, 25, 50, 75 %, and the end
    day = lines(86_400)
    assert 100 < len(day) < 160  # every ten minutes
    assert all(" left  loss 0.1" in line for line in day[5:-1])
