"""What events hold is printed as it is, and never obeyed by rich or by the terminal."""

import io
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console as RichConsole

from sagesplat.cli.console import Console
from sagesplat.core.events import (
    Event,
    Noted,
    Progress,
    RunDone,
    StageDone,
    StageSkipped,
    StageStarted,
    TableMade,
    Training,
    Warned,
)
from sagesplat.core.names import visible

ANY = st.text(st.characters(), max_size=40) | st.sampled_from(["[/red]", "[old]", ":car:", "\x1b[31m", "\\["])


def printed(*events: Event, terminal: bool = False) -> str:
    output = io.StringIO()
    kept = RichConsole(file=output, width=400, force_terminal=terminal, color_system=None)
    with Console(kept) as console:
        for event in events:
            console(event)
    return output.getvalue()


def events_of(text: str) -> dict[str, Event]:
    return {
        "skipped": StageSkipped(text),
        "warned": Warned(text),
        "noted": Noted(text),
        "done": StageDone(text, 1.0, (text, text)),
        "table": TableMade(text, ("category", text), ((text, "1"), ("b", text))),
        "report": RunDone(Path("/runs") / visible(text).replace("/", "_"), ("view", "/runs")),
    }


def test_a_warning_of_several_stages_is_shown_once() -> None:
    assert printed(Warned("no weights"), Noted("a"), Warned("no weights"), Warned("other")).count("!") == 2


@settings(max_examples=60)
@given(ANY)
def test_whatever_events_hold_is_shown(text: str) -> None:
    for event in events_of(text).values():
        shown = printed(event)
        assert re.fullmatch(r"[^\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]*", shown)
        shown.encode()


@pytest.mark.parametrize("text", ["[/red]", ":car:", "\\[a]", "日本語"])
@pytest.mark.parametrize("kind", ["skipped", "warned", "noted", "done", "table"])
def test_brackets_and_codes_are_kept(kind: str, text: str) -> None:
    assert text in printed(events_of(text)[kind])


def test_a_run_ends_in_three_lines_with_the_next_command() -> None:
    done = RunDone(
        Path("/runs/a b/report/index.html"), ("view", "/runs/a b"), outcome="0.46 MB of 0.91 MB; SSIM 0.8"
    )
    assert printed(done).splitlines() == [
        "Result: 0.46 MB of 0.91 MB; SSIM 0.8",
        "Report: /runs/a b/report/index.html",
        "Next:   sagesplat view '/runs/a b'",
    ]


def test_the_next_command_can_be_typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "my env" / "bin" / "sagesplat"
    program.parent.mkdir(parents=True)
    program.touch(mode=0o755)
    monkeypatch.setattr("sys.argv", [str(program), "demo"])
    monkeypatch.setenv("PATH", str(program.parent))  # an active environment
    done = RunDone(Path("/runs/report/index.html"), ("view", "runs/demo"))
    assert printed(done).splitlines()[-1] == "Next:   sagesplat view runs/demo"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert printed(done).splitlines()[-1] == f"Next:   '{program}' view runs/demo"
    monkeypatch.chdir(tmp_path)
    assert printed(done).splitlines()[-1] == "Next:   'my env/bin/sagesplat' view runs/demo"


def test_the_bar_shows_names_as_they_are() -> None:
    began, counts = StageStarted("[/red]\x07"), {"[/b]": 3, "\x1b[2J": 4}
    shown = printed(began, Progress("[/red]", 2, 2, "[old] \x1b[31m"), terminal=True)
    assert "[/red]\\x07" in shown
    assert "[old] \\x1b[31m" in shown
    shown = printed(began, Training(1, 1, 0.5, counts, 7), terminal=True)
    assert "[/b] 0.0k" in shown
    assert "\x1b[2J" not in shown
