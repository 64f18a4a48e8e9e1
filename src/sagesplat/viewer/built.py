"""The built viewer of this package: its folder and its page."""

import re
from importlib.resources import files
from pathlib import Path

from sagesplat.core.errors import SageError

PAGE, POSTER = "index.html", "poster.jpg"
_NAMED = re.compile(r'<!-- pack -->|<meta name="pack" content="[^"]*" />(<link rel="preload" [^>]*>)?')


def package_viewer() -> Path:
    """The folder of the package's built viewer, which may be missing."""
    return Path(str(files("sagesplat"))) / "viewer" / "static"


def check_viewer(viewer: Path) -> None:
    """SageError unless the viewer is built."""
    if not (viewer / PAGE).is_file():
        raise SageError(f"{viewer}: viewer not built: run `make web` (installed packages have it)")


def has_viewer(folder: Path, viewer: Path) -> bool:
    """Whether a bundle has this viewer, by its page, which names all scripts by content hash."""
    pages = [path / PAGE for path in (folder, viewer)]
    if not all(page.is_file() for page in pages):
        return False
    mine, page = (with_files(page.read_text(encoding="utf-8"), None) for page in pages)
    return mine in (page, with_poster(page))


def with_poster(page: str) -> str:
    """The page with a picture that is shown until its scripts are loaded."""
    return page.replace("<!-- poster -->", f'<img id="poster" src="{POSTER}" alt="" />')


def with_files(page: str, pack: tuple[str, int] | None, promises: str | None = None) -> str:
    """The page with what is asked for with the manifest: so many bytes of the pack, and promises."""
    tag = "<!-- pack -->" if pack is None else f'<meta name="pack" content="{pack[0]} {pack[1]}" />'
    if pack and promises:
        tag += f'<link rel="preload" href="{promises}" as="fetch" crossorigin />'
    return _NAMED.sub(lambda _: tag, page, count=1)
