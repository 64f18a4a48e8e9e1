"""What `sagesplat doctor` finds on machines of all kinds, and how it says so."""

import json
import sys
from pathlib import Path

import pytest
import torch

from sagesplat import cli
from sagesplat.cli import doctor
from sagesplat.cli.doctor import Finding
from sagesplat.raster import cuda


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine with one device, a CUDA toolkit and gsplat, not compiled yet."""

    class Card:
        name, total_memory, major, minor = "NVIDIA H200", 139 * 2**30, 9, 0

    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda index: Card())
    monkeypatch.setattr(cuda, "gsplat_version", lambda: "1.5.3")
    monkeypatch.setattr(cuda, "compiled", lambda: None)
    for name, content in (
        ("bin/nvcc", "#!/bin/sh\necho release 13.0, V13.0.1"),
        ("include/cuda_runtime.h", ""),
    ):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(content)
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("CUDA_HOME", str(tmp_path))
    return tmp_path


def test_here(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["sagesplat", "doctor", "--json"])
    cli.main()
    found = json.loads(capsys.readouterr().out)
    assert found["well"] is True
    by_part = {row["part"]: row for row in found["findings"]}
    assert by_part["cpu kernels"]["state"] == "fine"
    assert "agree with the reference" in by_part["cpu kernels"]["text"]
    assert by_part["gsplat"]["text"] == "1.5.3"
    assert all(row["cure"] for row in found["findings"] if row["state"] != "fine")
    assert all("\n" not in row["text"] + row["cure"] for row in found["findings"])


def test_kernels_that_fail_end_in_exit_code_1(capsys, monkeypatch) -> None:
    def broken(*arguments: object, **options: object) -> None:
        raise RuntimeError("LLVM ERROR:\nno such thing")

    for kernels, says in (
        (broken, "RuntimeError: LLVM ERROR: no such thing"),
        (lambda *_: 0.5, "by 5.0e-01"),
    ):
        monkeypatch.setattr(doctor, "_error", kernels)
        monkeypatch.setattr(sys, "argv", ["sagesplat", "doctor"])
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert end.value.code == 1
        lines = capsys.readouterr().out.splitlines()
        at = next(i for i, line in enumerate(lines) if "cpu kernels" in line)
        assert lines[at].startswith("✗")
        assert says in lines[at]
        assert "pip install --force-reinstall numba" in lines[at + 1]


def test_a_machine_without_gpu(monkeypatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", None)
    (found,) = doctor.gpus()
    assert found.state == "gap"
    assert found.text.endswith("is built without CUDA")
    assert found.cure.startswith("install a build with it")
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert doctor.gpus()[0].cure == "check nvidia-smi or use --device cpu"
    assert doctor.gsplat_kernels(build=True).text.endswith("finds no CUDA device or driver")


def test_a_machine_with_a_gpu(gpu, monkeypatch) -> None:
    monkeypatch.setattr(
        doctor, "_output", lambda *words: "580.1" if words[0] == "nvidia-smi" else "release 13.0, V"
    )
    assert doctor.gpus()[0].text == "NVIDIA H200, 139 GiB, compute capability 9.0, driver 580.1"
    assert doctor.compiler() == Finding("nvcc", "fine", f"13.0 at {gpu}/bin/nvcc, toolkit at {gpu}")
    assert doctor.gsplat() == Finding("gsplat", "fine", "1.5.3")
    found = doctor.gsplat_kernels(build=False)
    assert (found.state, found.text) == ("gap", "not compiled yet")
    assert found.cure == "the first use takes about a minute; sagesplat doctor --build does it now"
    monkeypatch.setattr(cuda, "compiled", lambda: gpu / "csrc.so")
    monkeypatch.setattr(doctor, "_error", lambda backend: {"cuda": 2e-5}[backend])
    assert doctor.gsplat_kernels(build=False).text.startswith("agree with the reference to 2e-05")


def test_building_without_a_gpu_is_an_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(sys, "argv", ["sagesplat", "doctor", "--build"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("sagesplat: --build: nothing was built: ")
    assert error.count("\n") == 1
    assert doctor.unbuilt([Finding("cuda kernels", "fine", "agree")]) == ""
