"""The command line: errors are one line and exit code 2, and help answers at once."""

import subprocess
import sys
from pathlib import Path

import pytest

from sagesplat import cli


def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    """Exit code and standard error of a command."""
    monkeypatch.setattr(sys, "argv", ["sagesplat", *words])
    try:
        cli.main()
    except SystemExit as end:
        return int(end.code or 0), capsys.readouterr().err
    return 0, capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["fly"], "no command 'fly'; there are info, run"),
        (["info", "nowhere"], "nowhere: "),
        (["run", "nowhere", "out"], "nowhere: "),
        (["train", "nowhere"], "not a run folder"),
        (["plan", "nowhere", "--target-ssim", "0.5"], "not a run folder"),
        (["report", "nowhere"], "not a run folder"),
        (["run", ".", "out", "--device", "cuda"], "use --device cpu"),
    ],
)
def test_a_users_mistake_is_one_line(
    words: list[str],
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    code, error = call(monkeypatch, capsys, *words)
    assert code == 2
    assert error.startswith("sagesplat: ")
    assert error.count("\n") == 1
    assert says in error
    assert not (tmp_path / "out").exists()


def test_ctrl_c_and_a_full_disk_are_one_line_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sagesplat import scene

    for error, says in (
        (KeyboardInterrupt(), "interrupted"),
        (OSError(28, "No space left on device", "x"), "x: No space"),
    ):

        def fail(*args: object, error: BaseException = error, **options: object) -> None:
            raise error

        monkeypatch.setattr(scene, "load_scene", fail)
        code, line = call(monkeypatch, capsys, "info", str(tmp_path))
        assert code == 2
        assert says in line


def test_flags_reach_their_settings(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sagesplat.stages import pipeline

    seen = {}
    monkeypatch.setattr(pipeline, "run_all", lambda job, scene, config: seen.update(job=job, config=config))
    words = (
        "run a b --downscale 2 --target-ssim 0.7 --train.max-steps 70 --segmenter onnx --seed 3 --threads 1"
    )
    assert call(monkeypatch, capsys, *words.split())[0] == 0
    config = seen["config"]
    assert (config.scene.downscale, config.plan.target_ssim, config.train.max_steps) == (2, 0.7, 70)
    assert (config.masks.segmenter, config.seed, seen["job"].threads) == ("onnx", 3, 1)


def test_processes_are_counted(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    code, line = call(monkeypatch, capsys, *["run", "a", "b", "--processes", "0"])
    assert code == 2
    assert "--processes 0 is impossible; choose 1 or more" in line


def test_help_imports_no_torch() -> None:
    code = "import sys, sagesplat.cli; sys.exit(any(m in sys.modules for m in ('torch', 'numba', 'numpy')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_help_lists_every_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["sagesplat", "--help"])
    cli.main()
    text = capsys.readouterr().out
    assert all(f"  {name} " in text for name in cli.COMMANDS)
    for name in cli.COMMANDS:
        monkeypatch.setattr(sys, "argv", ["sagesplat", name, "--help"])
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert end.value.code == 0
        assert f"sagesplat {name}" in capsys.readouterr().out
