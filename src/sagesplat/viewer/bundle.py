"""Writes bundles: static folders with the increments of nested levels, their quality bounds, and the viewer.

chunks/ holds the increments, scene-*.pack again those of the first view, manifest.json and promises-*.json
describe them (`viewer.manifest`). The same contents give the same bytes.
"""

import hashlib
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from typing import Any

from sagesplat.core.errors import DataError, RunError
from sagesplat.formats.increments import STREAM
from sagesplat.formats.stream import end_of_palette
from sagesplat.io.files import atomic_folder, unwritable, write_text
from sagesplat.io.typed import known_json
from sagesplat.viewer.built import PAGE, POSTER, check_viewer, with_files, with_poster
from sagesplat.viewer.manifest import FORMAT, LOOKS, THIRD_PARTY, Contents, documents, pack_order
from sagesplat.viewer.pack import beginning_of, write_pack
from sagesplat.viewer.quality import dumped

_CURE = "delete that folder and run `sagesplat nest` again"
MANIFEST, SCHEMA = "manifest.json", "manifest.schema.json"
# what is in a bundle's folder, of any version of the viewer; and what systems put into every folder
_OWN = re.compile(
    r"(LICENSES|THIRD_PARTY_LICENSES)\.txt|assets|chunks|index\.html|(looks|poster)\.jpg|"
    r"manifest(\.schema)?\.json|promises-.*\.json|scene-.*\.pack|\.lock|\.DS_Store|Thumbs\.db|desktop\.ini"
)
LICENSES = """\
The viewer in this folder is part of sagesplat, licensed under the Apache License, Version 2.0
(SPDX: Apache-2.0). It contains other people's software: see THIRD_PARTY_LICENSES.txt.

The scene (chunks/, manifest.json, promises-*.json) was made of somebody's photos: their owner
decides how it may be used.
"""


@dataclass(frozen=True)
class BundleSizes:
    """Sizes of the parts of a bundle, bytes."""

    manifest: int
    promises: int
    chunks: int  # the increments, in chunks/
    total: int  # including the viewer


def write_bundle(out: Path, contents: Contents, viewer: Path, poster: bytes | None = None) -> BundleSizes:
    """Write a bundle into a folder, which is new, empty or an earlier bundle; it is replaced as a whole.

    Where that fails, or is killed, the earlier bundle is kept (see `atomic_folder`).

    `viewer`: the folder with the built viewer. `poster`: a JPEG of the first view, shown until the scene is
    drawn. RunError for another folder; SageError without a viewer;
    DataError for a chunk that is missing or not what the index says; RunError too where another process
    writes there.
    """
    check_target(out)
    check_viewer(viewer)
    out = out.resolve()
    try:
        with atomic_folder(out) as fresh:
            shutil.copytree(viewer, fresh, dirs_exist_ok=True)
            (fresh / "chunks").mkdir()
            for uri, content in verified_files(contents):
                (fresh / "chunks" / uri).write_bytes(content)
            if poster is not None:
                _put_up(fresh, poster)
            return write_documents(fresh, contents)
    except OSError as error:
        raise RunError(unwritable(out, error)) from error


def _put_up(folder: Path, poster: bytes) -> None:
    """Show the poster in the page until its scripts are loaded."""
    page = folder / PAGE
    (folder / POSTER).write_bytes(poster)
    write_text(page, with_poster(page.read_text(encoding="utf-8")))


def _name_files(page: Path, manifest: Mapping[str, Any]) -> None:
    """Name in the page what is asked for with the manifest: the first levels, and the target's promises."""
    promises = manifest["promises"].get(manifest["target"]["quality"])
    pack = manifest["pack"]["uri"], beginning_of(manifest)
    if page.is_file():
        text = page.read_text(encoding="utf-8")
        write_text(page, with_files(text, pack, promises and promises["uri"]))


def write_documents(folder: Path, contents: Contents) -> BundleSizes:
    """Write everything but the viewer and the increments, which must be there; the manifest last."""
    manifest, promises = documents(contents, (folder / THIRD_PARTY).exists())
    if contents.chunks and not contents.live:
        manifest["pack"] = write_pack(folder, manifest["labels"], pack_order(contents))
        _name_files(folder / PAGE, manifest)
    for quality, content in promises.items():
        (folder / manifest["promises"][quality]["uri"]).write_bytes(content)
    write_text(folder / SCHEMA, files("sagesplat.viewer").joinpath(SCHEMA).read_text(encoding="utf-8"))
    write_text(folder / "LICENSES.txt", LICENSES)
    if contents.looks is not None:
        (folder / LOOKS).write_bytes(contents.looks[1])
    text = dumped(manifest)
    write_text(folder / MANIFEST, text.decode())
    total = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    chunks = sum(chunk.nbytes for chunk in contents.chunks)
    return BundleSizes(len(text), sum(map(len, promises.values())), chunks, total)


def check_target(out: Path) -> None:
    """RunError unless a bundle may be written to `out`."""
    if out.is_dir() and not any(out.iterdir()):
        return
    if out.exists() and not is_bundle(out):
        raise RunError(f"{out}: neither empty nor a bundle of sagesplat; name a new folder")
    if strange := sorted(path.name for path in out.glob("*") if not _OWN.fullmatch(path.name)):
        raise RunError(f"{out / strange[0]}: no part of a bundle, which is replaced as a whole; move it away")


def is_bundle(folder: Path) -> bool:
    """Whether a folder holds a bundle's manifest."""
    return (known_json(folder / MANIFEST, dict) or {}).get("format") == FORMAT


def verified_files(contents: Contents) -> Iterator[tuple[str, bytes]]:
    """The name and the content of each file that increments are in.

    DataError where one is missing or not what the index says: the increments in it, one after the other, and
    before those of a file of streams maybe their palette.
    """
    # streams of a category's cells take turns in its file where some replace what is below
    chunks = sorted(contents.chunks, key=lambda chunk: (chunk.uri, chunk.offset))
    for uri, some in groupby(chunks, key=lambda chunk: chunk.uri):
        path = contents.folder / uri
        try:
            content = path.read_bytes()
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror}); {_CURE}") from None
        at = end_of_palette(content, name=str(path)) if uri.endswith(STREAM) else 0
        if at and hashlib.sha256(content).hexdigest()[:12] not in uri:  # no chunk covers the palette
            raise DataError(f"{path}: not the chunk that was written; {_CURE}")
        for chunk in some:
            part = content[at : at + chunk.nbytes]
            if chunk.offset != at or hashlib.sha256(part).hexdigest() != chunk.sha256:
                raise DataError(f"{path}: not the chunk that was written; {_CURE}")
            at += len(part)
        if at != len(content):
            raise DataError(f"{path}: not the chunk that was written; {_CURE}")
        yield uri, content
