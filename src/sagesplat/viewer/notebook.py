"""A bundle's single page in the cell of a notebook."""

from dataclasses import dataclass, field
from html import escape

_HEIGHTS = 100, 10_000  # px


@dataclass(frozen=True)
class NotebookViewer:
    """What a notebook shows as the viewer: a frame with the whole page in it, which asks nobody for anything.

    The page is in `srcdoc`, not at an address, so it is shown by Jupyter and VS Code alike, and again where a
    saved notebook is opened and trusted.
    """

    page: str = field(repr=False)  # as `write_single_file` writes it
    height: int  # px
    title: str  # for people who cannot see it

    def __post_init__(self) -> None:
        low, high = _HEIGHTS
        if not low <= self.height <= high:
            raise ValueError(f"a height of {self.height} px cannot be used; choose {low} to {high}")

    def __repr__(self) -> str:
        return f"<viewer of {self.title}, {len(self.page) / 1e6:.1f} MB; a notebook shows it>"

    def _repr_html_(self) -> str:
        """What IPython asks for."""
        style = f"width:100%;height:{self.height}px;border:0"
        allow = "fullscreen; xr-spatial-tracking; clipboard-write"
        return (
            f'<iframe title="{escape(self.title)}" style="{style}" allow="{allow}" '
            f'srcdoc="{escape(self.page)}"></iframe>'
        )
