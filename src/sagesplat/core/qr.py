"""QR codes of addresses, for phones."""

import io

from sagesplat.core.errors import BackendUnavailable

_MISSING = "a QR code needs segno; pip install 'sagesplat[view]'"


def qr_text(url: str) -> str:
    """A QR code for a terminal with a dark background, of block characters.

    Raises:
        BackendUnavailable: Without the package segno.
    """
    out = io.StringIO()
    _code(url).terminal(out, border=2, compact=True)
    return out.getvalue().rstrip("\n")


def qr_address(url: str) -> str:
    """A QR code as the data address of an SVG, black on white.

    Raises:
        BackendUnavailable: Without the package segno.
    """
    return _code(url).svg_data_uri(scale=4, border=3, light="#fff")


def _code(url: str):  # type: ignore[no-untyped-def]
    try:
        import segno
    except ImportError:
        raise BackendUnavailable(_MISSING) from None
    return segno.make(url, micro=False)
