"""The command line: errors are one line and exit code 2, and help answers at once."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import Call, random_gaussians, write_capture
from PIL import Image

from sagesplat import cli
from sagesplat.cli import help
from sagesplat.cli.overview import GROUPS, summaries
from sagesplat.core.names import visible
from sagesplat.formats.splats import write_splat


@pytest.mark.parametrize(("given", "found"), [(None, "PASSIVE"), ("ACTIVE", "ACTIVE")])
def test_idle_threads_sleep_unless_the_environment_says_otherwise(given: str | None, found: str) -> None:
    code = (
        "import os, sys; from sagesplat.__main__ import program; sys.argv = ['sagesplat', '--version']\n"
        "try: program()\nfinally: print(os.environ['OMP_WAIT_POLICY'])"
    )
    env = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    env |= {} if given is None else {"OMP_WAIT_POLICY": given}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
    assert done.stdout.split()[-1] == found


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["fly"], "no command 'fly'; there are info, run"),
        (["info", "nowhere"], "nowhere: "),
        (["plan", "nowhere", "--target-ssim", "0.5"], "not a run folder"),
        (["run", ".", "out", "--device", "cuda"], "use --device cpu"),
    ],
)
def test_a_users_mistake_is_one_line(
    words: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Call
) -> None:
    monkeypatch.chdir(tmp_path)
    code, error = command(*words)
    assert code == 2
    assert error.startswith("sagesplat: ")
    assert error.count("\n") == 1
    assert says in error
    assert not (tmp_path / "out").exists()


def test_ctrl_c_and_a_full_disk_are_one_line_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Call
) -> None:
    from sagesplat import scene

    for error, says in (
        (KeyboardInterrupt(), "interrupted"),
        (OSError(28, "No space left on device", "x"), "x: No space"),
    ):

        def fail(*args: object, error: BaseException = error, **options: object) -> None:
            raise error

        monkeypatch.setattr(scene, "load_scene", fail)
        code, line = command("info", str(tmp_path))
        assert code == 2
        assert says in line


def test_flags_reach_their_settings(monkeypatch: pytest.MonkeyPatch, command: Call) -> None:
    from sagesplat.stages import pipeline

    seen = {}
    monkeypatch.setattr(pipeline, "run_all", lambda job, scene, config: seen.update(job=job, config=config))
    words = (
        "run a b --downscale 2 --target-ssim 0.7 --train.max-steps 70 --segmenter onnx --seed 3 --threads 1"
    )
    assert command(*words.split())[0] == 0
    config = seen["config"]
    assert (config.scene.downscale, config.plan.target_ssim, config.train.max_steps) == (2, 0.7, 70)
    assert (config.masks.segmenter, config.seed, seen["job"].threads) == ("onnx", 3, 1)


@pytest.mark.parametrize(
    ("words", "targets"),
    [
        ("", [("fidelity", t) for t in (0.8, 0.9, 0.95, 0.98)]),
        ("--target-fidelity 0.9 --other-targets 0.5", [("fidelity", 0.5), ("fidelity", 0.9)]),
        ("--target-fidelity 1", [("fidelity", t) for t in (0.8, 0.9, 0.98, 1)]),
        ("--target-ssim 0.7", [("ssim", t) for t in (0.6, 0.7, 0.8)]),
        (
            "--target-ssim 0.7 --target-fidelity 0.98",
            [*(("fidelity", t) for t in (0.8, 0.9, 0.98)), ("ssim", 0.7)],
        ),
        ("--ladder snapshots", [("ssim", t) for t in (0.7, 0.8, 0.9)]),
    ],
)
def test_targets_of_both_qualities(
    monkeypatch: pytest.MonkeyPatch, words: str, targets: list, command: Call
) -> None:
    from sagesplat.stages import pipeline
    from sagesplat.stages.plan import check_targets

    seen = {}
    monkeypatch.setattr(pipeline, "run_all", lambda job, scene, config: seen.update(config=config))
    assert command("run", "a", "b", *words.split())[0] == 0
    config = check_targets(seen["config"].plan, seen["config"].ladder)
    assert config.all_targets == targets
    assert (config.quality, config.target) in config.all_targets


def test_the_overview_loads_no_command() -> None:
    code = (
        "import sys; from sagesplat.cli import main; sys.argv = ['sagesplat', '--help']; main()\n"
        "sys.exit(any(m in sys.modules for m in ('tyro', 'sagesplat.cli.stages', 'inspect', 'numpy')))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")


def test_the_overview_is_of_the_commands_that_there_are() -> None:
    first = {name: (function.__doc__ or "").splitlines()[0] for name, function in cli.commands().items()}
    assert list(summaries()) == list(first.items())
    grouped = [name for names in GROUPS.values() for name in names.split()]
    assert sorted(grouped) == sorted(first)


def test_help_lists_every_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["sagesplat", "--help"])
    cli.main()
    text = capsys.readouterr().out
    assert all(f"  {name} " in text for name in cli.commands())
    for name in cli.commands():
        monkeypatch.setattr(sys, "argv", ["sagesplat", name, "--help"])
        cli.main()
        assert f"sagesplat {name}" in capsys.readouterr().out


@pytest.mark.parametrize("words", ["--help", "run --help-all"])
def test_a_reader_that_closes_its_end_is_no_error(words: str) -> None:
    """As `| head -1` does."""
    command = [sys.executable, "-m", "sagesplat", *words.split()]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.close()
    _, errors = process.communicate(timeout=600)
    assert (process.returncode, errors) == (0, b"")


def printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: str) -> str:
    monkeypatch.setattr(sys, "argv", ["sagesplat", *words])
    monkeypatch.setenv("COLUMNS", "80")
    cli.main()
    return capsys.readouterr().out


def test_help_of_run_shows_first_what_most_people_need(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    short, full = (printed(monkeypatch, capsys, "run", flag) for flag in ("--help", "--help-all"))
    shown = [line.split()[0] for line in short.splitlines() if line.startswith("  --")]
    assert set(shown) == help._COMMON
    assert "--help-all" in short
    everything = {flag.name for flag in help.flags_of(cli.commands()["run"]) if flag.name.startswith("--")}
    assert {line.split()[0] for line in full.splitlines() if line.startswith("  --")} == everything
    for text in (short, full):
        assert "SCENE" in text
        assert max(len(line) for line in text.splitlines() if "{" not in line) <= 80


def test_every_argument_of_every_command_has_help() -> None:
    for name, function in cli.commands().items():
        flags = list(help.flags_of(function))
        assert len({flag.name for flag in flags}) == len(flags), name
        assert [f.name for f in flags if not f.help] == [], name
        assert not [f.name for f in flags if "worth" in f.help or "put together" in f.help.lower()]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["run", "a"], "Missing from sagesplat run: RUN"),
        (
            ["run", "a", "b", "--train.max-steps", "x"],
            "Error parsing --train.max-steps: not a whole number: 'x'",
        ),
        (
            ["run", "a", "b", "--trian.max-steps", "3"],
            "no option --trian.max-steps; did you mean --train.max",
        ),
        (["run", "a", "b", "--max-steps", "3"], "no option --max-steps; did you mean --train.max-steps?"),
        (["demo", "a", "b"], "'b' is one argument too many"),
        (["demo", "--devce", "cpu"], "no option --devce; did you mean --device?"),
        (["run", "a", "b", "--device", "gpu"], "invalid choice 'gpu' for argument '--device'"),
        (["export", "a", "b", "--level"], "Missing value for argument '--level'"),
    ],
)
def test_words_that_cannot_be_parsed_are_one_line(words: list[str], says: str, command: Call) -> None:
    code, error = command(*words)
    assert code == 2
    assert error.startswith(f"sagesplat: {says}")
    assert error.endswith(f"see `sagesplat {words[0]} --help`\n")
    assert error.count("\n") == 1


SPLAT, CAPTURE, RUN = "splat.spz", "capture", "made"
NO_BUNDLE, NO_RUN = "neither a bundle (no manifest.json) nor a run folder", "(no scene.json)"
NO_CAPTURE = (
    "neither a transforms .json, an .xml of Metashape nor a video; give one of these, or a folder "
    "(unpack archives)"
)
BEGIN, ADOPT = "begin with `sagesplat run SCENE RUN`", f"`sagesplat adopt {SPLAT} RUN` makes one of a splat"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["run", RUN, "new"], f"{RUN}: a run folder; give the capture it was made of, or"),
        (["info", SPLAT], f"{SPLAT}: {NO_CAPTURE}; `sagesplat adopt {SPLAT} RUN` is for splats"),
        (["adopt", SPLAT, SPLAT], f"{SPLAT}: a file; name a new folder for the run"),
        (["adopt", RUN, "new"], f"{RUN}: a run folder; `sagesplat export {RUN} scene.ply` writes its splat"),
        (["measure", CAPTURE], f"{CAPTURE}: neither a run, a bundle nor a splat; give one of these"),
        (["view", CAPTURE], f"{CAPTURE}: {NO_BUNDLE} {NO_RUN}; {BEGIN}"),
        (["view", SPLAT], f"{SPLAT}: no such folder; {ADOPT}"),
        (["bundle", CAPTURE, "new"], f"{CAPTURE}: not a run folder {NO_RUN}; {BEGIN}"),
        (["export", SPLAT, SPLAT], f"{SPLAT}: not a run folder {NO_RUN}; {ADOPT}"),
        (["export", "a", "b", "--chunks", "spz", "--level", "2"], "b: --level does not go with --chunks"),
        (["export", "a", "b", "--chunks", "spz", "--target-ssim", "0.5"], "b: --target-ssim does not go"),
        (["transfer", RUN, CAPTURE], f"{CAPTURE}: not a run folder {NO_RUN}; {BEGIN}"),
        (["compare", CAPTURE], f"{CAPTURE}: not a run folder {NO_RUN}; {BEGIN}"),
    ],
)  # fmt: skip
def test_a_path_of_another_kind_is_told_by_its_kind_and_nothing_is_written(
    words: list[str], says: str, command: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_capture(tmp_path / CAPTURE, random_gaussians(12))
    write_splat(tmp_path / SPLAT, random_gaussians(12))
    (tmp_path / RUN / "provenance").mkdir(parents=True)
    (tmp_path / RUN / "scene.json").write_text("{}")
    (tmp_path / RUN / "masks").mkdir()
    Image.new("RGB", (8, 8)).save(tmp_path / RUN / "masks/a.png")
    before = sorted(tmp_path.rglob("*"))
    code, error = command(*words)
    assert code == 2
    assert error.startswith(f"sagesplat: {says}")
    assert error.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", ["[/red]", "\x1b[31mred", "caf\udce9", "a\u202eb"])
def test_errors_repeat_what_was_typed_and_obey_none_of_it(name: str, command: Call) -> None:
    for words in (["info", name], [name], ["info", ".", name], ["plan", "x", "--ladder", name],
                  ["run", "a", "b", f"--{name}"], ["run", "a", "b", "--train.max-steps", name]):  # fmt: skip
        code, error = command(*words)
        assert code == 2
        assert error.count("\n") == 1
        assert error[:-1].isprintable()
    assert visible("a[old]b") in command("info", "a[old]b")[1]


def test_a_path_that_is_not_utf8_is_printed(tmp_path: Path) -> None:
    run = tmp_path / os.fsdecode(b"caf\xe9 [/red]")
    write_capture(run, random_gaussians(12))
    code = (
        "import sys; from sagesplat.cli import main; main(); sys.stdout.flush()\n"
        "sys.stdout.reconfigure(encoding='utf-8'); main()"
    )
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [sys.executable, "-c", code, "info", run], env=environment, capture_output=True, check=True
    )
    assert done.stdout.count(b"caf\\xe9 [/red]") == 2
