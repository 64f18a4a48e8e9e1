"""Spark's tree of levels, built in Chromium by the package's own builder."""

import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from tests.browser import launch, open_page

_PAGE = b"""<!doctype html><link rel="icon" href="data:,"><script type="importmap">{"imports": {"three":
"/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}</script>"""
# what Spark's manual calls the recommended tree (`build-lod --quality`), in the encoding that rounds least
_BUILD = """async () => {
  const { ExtSplats } = await import("/spark/dist/spark.module.js")
  const fileBytes = new Uint8Array(await (await fetch("/model.ply")).arrayBuffer())
  const splats = new ExtSplats({ fileBytes, fileType: "ply", lod: "quality" })
  await splats.initialized
  const tree = splats.lodSplats
  const arrays = { ext0: tree.extArrays[0], ext1: tree.extArrays[1], lodTree: tree.extra.lodTree }
  for (const [name, array] of Object.entries(arrays)) {
    const words = array.subarray(0, 4 * tree.numSplats)
    await fetch("/put/" + name, { method: "POST", body: words.slice() })
  }
  return tree.numSplats
}"""


class _Handler(SimpleHTTPRequestHandler):
    """Serves the page, the packages and the model, and takes the arrays of the tree."""

    def __init__(self, *args: Any, places: dict[str, Path], taken: dict[str, bytes]):
        self.places, self.taken = places, taken
        super().__init__(*args)

    def do_GET(self) -> None:
        """A file of a place, or the page."""
        top, _, rest = self.path.strip("/").partition("/")
        path = self.places.get(top)
        content = _PAGE if path is None else (path / rest if rest else path).read_bytes()
        kind = "text/javascript" if self.path.endswith(".js") else "text/html" if path is None else "any/any"
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def do_POST(self) -> None:
        """An array."""
        self.taken[self.path.rpartition("/")[2]] = self.rfile.read(int(self.headers["Content-Length"]))
        self.send_response(204)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Nothing."""


def built(model: Path, package: Path) -> dict[str, np.ndarray]:
    """The arrays of the tree that Spark builds of a PLY, uint32 [N, 4] each.

    `package`: the folder of @sparkjsdev/spark; three is looked for beside it.
    """
    taken: dict[str, bytes] = {}
    places = {"spark": package, "three": package.parents[1] / "three", "model.ply": model}
    handler = partial(_Handler, places=places, taken=taken)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            with launch() as browser, open_page(
                f"http://127.0.0.1:{server.server_address[1]}/", browser=browser
            ) as opened:  # fmt: skip
                count = opened.page.evaluate(_BUILD)
        finally:
            server.shutdown()
            thread.join()
    arrays = {name: np.frombuffer(content, np.uint32).reshape(-1, 4) for name, content in taken.items()}
    if len(arrays) != 3 or any(len(array) != count for array in arrays.values()):
        raise SystemExit(f"Spark's tree of {count} splats came in parts of other lengths")
    return arrays
