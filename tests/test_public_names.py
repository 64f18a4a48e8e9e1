"""`import sagesplat`: what it exports, that it loads nothing heavy, and that no name hides a subpackage."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import random_gaussians, write_capture

import sagesplat

PACKAGE = Path(sagesplat.__file__).parent
SUBPACKAGES = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}


@pytest.mark.parametrize("name", sagesplat.__all__)
def test_every_exported_name_is_there(name):
    value = getattr(sagesplat, name)
    assert value is getattr(sagesplat, name)
    assert (getattr(value, "__doc__", None) or "").strip()


def test_files_and_captures_are_found_by_text(tmp_path):
    g, path = random_gaussians(20), str(tmp_path / "scene")
    write_capture(tmp_path / "capture", g)
    assert len(sagesplat.load_scene(str(tmp_path / "capture")).views) == 8
    sagesplat.write_ply(f"{path}.ply", g)
    sagesplat.write_spz(f"{path}.spz", g)
    assert len(sagesplat.read_ply(f"{path}.ply")) == len(sagesplat.read_spz(f"{path}.spz")) == 20
    assert sagesplat.read_splat(f"{path}.ply").kind == "PLY"
    with pytest.raises(sagesplat.SageError, match=f"{path}: "):
        sagesplat.read_splat(path)


def test_exports_are_those_that_type_checkers_see():
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.asname or alias.name: (node.module, alias.name)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    loaded = {
        name: (f"sagesplat.{module}", sagesplat._NAME_THERE.get(name, name))
        for name, module in sagesplat._MODULE_OF.items()
    }
    assert seen == loaded
    assert sorted(loaded) == sorted(sagesplat.__all__)


def test_import_loads_neither_torch_nor_numba():
    code = (
        "import sys, sagesplat; from sagesplat import RunConfig, SageError; RunConfig()\n"
        "print([m for m in ('torch', 'numba', 'numpy', 'scipy', 'matplotlib') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_modules_import_no_more_than_the_version_from_the_package_itself():
    """Its exports come from all layers: an import of one would turn the order of the layers around."""
    found = [
        f"{path.name}: {alias.name}"
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and node.module == "sagesplat"
        for alias in node.names
        if alias.name != "__version__" and alias.name not in SUBPACKAGES
    ]
    assert found == []
