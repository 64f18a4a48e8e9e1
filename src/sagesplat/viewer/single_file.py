"""Writes a bundle as one HTML page that opens from the disk, without a server.

Scripts, styles and all files of the bundle are in the page: the files as base64, in elements that browsers do
not run (web/src/inside.ts reads them). Its Content-Security-Policy names scripts and styles by their hashes
and lets it ask nobody for anything.
"""

import base64
import hashlib
import re
from pathlib import Path

from sagesplat.core.errors import RunError, SageError
from sagesplat.io.files import atomic_path, unwritable
from sagesplat.viewer.built import PAGE, POSTER, check_viewer, with_poster
from sagesplat.viewer.bundle import LICENSES, MANIFEST, BundleSizes, verified_files
from sagesplat.viewer.manifest import LOOKS, THIRD_PARTY, Contents, documents
from sagesplat.viewer.quality import dumped

MOST = 256 * 2**20  # bytes of increments: browsers keep the text of the page in memory, a third larger
_MARK = '<meta name="generator" content="sagesplat bundle --single-file" />'
_HEAD = 4096  # bytes at the start of a page in which the mark is
_POLICY = (
    "default-src 'none'; script-src {script} 'wasm-unsafe-eval'; style-src {style}; img-src data: blob:; "
    "connect-src data: blob:; worker-src blob:; base-uri 'none'; form-action 'none'"
)
_SCRIPT = re.compile(r'<script type="module"[^>]* src="\./(assets/[\w.-]+\.js)"></script>')
_STYLE = re.compile(r'<link rel="stylesheet"[^>]* href="\./(assets/[\w.-]+\.css)">')
_META = re.compile(r'<meta http-equiv="Content-Security-Policy"[^>]*/>')
_PRELOAD = re.compile(r'<link rel="preload"[^>]*/>')
_HINT = re.compile(r'<p class="hint">.*?</p>', re.DOTALL)


def write_single_file(
    out: Path, contents: Contents, viewer: Path, poster: bytes | None = None
) -> BundleSizes:
    """Write a bundle as the HTML page `out`, which is new or an earlier one; it is replaced as a whole.

    `viewer` and `poster` as in `write_bundle`. RunError for another file, or a scene that is too large;
    SageError without a viewer; DataError for a chunk that is missing or not what the index says.
    """
    check_page(out)
    check_viewer(viewer)
    chunks = sum(chunk.nbytes for chunk in contents.chunks)
    if chunks > MOST:
        raise RunError(
            f"{out}: {chunks / 1e6:.0f} MB of increments are more than the {MOST / 1e6:.0f} MB that browsers "
            "open as one page; leave out --single-file"
        )
    manifest, promises = documents(contents, (viewer / THIRD_PARTY).exists())
    named = {manifest["promises"][quality]["uri"]: content for quality, content in promises.items()}
    text = dumped(manifest)
    small = {MANIFEST: text, "LICENSES.txt": LICENSES.encode(), **named}
    if contents.looks is not None:
        small[LOOKS] = contents.looks[1]
    if any(chunk.format != "stream" for chunk in contents.chunks):
        small["assets/spark.wasm"] = _decoder(viewer)
    if (viewer / THIRD_PARTY).exists():
        small[THIRD_PARTY] = (viewer / THIRD_PARTY).read_bytes()
    before, after = _page(viewer, poster)
    try:
        with atomic_path(out, nbytes=2 * chunks) as temporary, temporary.open("wb") as file:
            file.write(before)
            for uri, content in small.items():
                file.write(_element(uri, content))
            for uri, content in verified_files(contents):
                file.write(_element(f"chunks/{uri}", content))
            file.write(after)
    except OSError as error:
        raise RunError(unwritable(out, error)) from error
    return BundleSizes(len(text), sum(map(len, promises.values())), chunks, out.stat().st_size)


def _decoder(viewer: Path) -> bytes:
    """What decodes other formats than streams. SageError for a viewer of another layout."""
    found = next((viewer / "assets").glob("spark-*.wasm"), None)
    if found is None:
        raise SageError(f"{viewer}: not a viewer that fits into a page; run `make web` again")
    return found.read_bytes()


def check_page(out: Path) -> None:
    """RunError unless a page may be written to `out`."""
    if out.suffix.lower() not in (".html", ".htm"):
        raise RunError(f"{out}: --single-file writes a page; give it a name that ends in .html")
    if out.is_dir():
        raise RunError(f"{out}: a folder; name a new file that ends in .html")
    if out.exists() and not _is_ours(out):
        raise RunError(f"{out}: not a page that sagesplat wrote; name a new file")


def _is_ours(page: Path) -> bool:
    try:
        with page.open("rb") as file:
            return _MARK.encode() in file.read(_HEAD)
    except OSError:
        return False


def _page(viewer: Path, poster: bytes | None) -> tuple[bytes, bytes]:
    """The page up to its files, and what follows them. SageError for a viewer of another layout."""
    page = (viewer / PAGE).read_text(encoding="utf-8")
    found = [pattern.search(page) for pattern in (_SCRIPT, _STYLE)]
    if None in found or not _META.search(page) or "</body>" not in page:
        raise SageError(f"{viewer}: not a viewer that fits into a page; run `make web` again")
    script, style = ((viewer / match[1]).read_text(encoding="utf-8") for match in found if match)
    # a script ends where "</script" is, even in a text in it
    script = re.sub("<(?=/script|!--)", r"\\x3c", script, flags=re.IGNORECASE)
    policy = _POLICY.format(script=_hashed(script), style=_hashed(style))
    policy_and_mark = f'<meta http-equiv="Content-Security-Policy" content="{policy}" />\n    {_MARK}'
    hint = '<p class="hint">If this stays: the page needs JavaScript and WebGL 2.</p>'
    for pattern, text in (
        (_META, policy_and_mark),
        (_PRELOAD, ""),
        (_SCRIPT, ""),
        (_STYLE, f"<style>{style}</style>"),
        (_HINT, hint),
    ):
        page = pattern.sub(lambda _, text=text: text, page, count=1)
    if poster is not None:
        inside = f"data:image/jpeg;base64,{base64.b64encode(poster).decode()}"
        page = with_poster(page).replace(f'src="{POSTER}"', f'src="{inside}"', 1)
    before, _, after = page.rpartition("</body>")
    return before.encode(), f'<script type="module">{script}</script>\n  </body>{after}'.encode()


def _hashed(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _element(uri: str, content: bytes) -> bytes:
    """A file as an element that no browser runs."""
    head = f'<script type="application/octet-stream" data-uri="{uri}">'
    return head.encode() + base64.b64encode(content) + b"</script>\n"
