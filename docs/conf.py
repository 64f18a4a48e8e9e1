"""How Sphinx builds the site: `make docs` writes it to build/site."""

import sys
from pathlib import Path

import sagesplat

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "sagesplat"
author = "The sagesplat authors"
copyright = "the sagesplat authors, Apache-2.0"
version = release = sagesplat.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "command_line", "gallery"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_ext", "_static"]

nitpicky = True  # a name that leads nowhere is a warning, and `make docs` makes errors of warnings
nitpick_ignore_regex = [("py:.*", r".*")]  # types of other packages and of private modules in signatures
default_role = "code"  # docstrings have Markdown's backticks
myst_enable_extensions = ["colon_fence", "deflist", "attrs_block", "attrs_inline"]
myst_heading_anchors = 4  # links to titles, as GitHub has them
highlight_language = "text"
smartquotes = False  # of "--flag" it makes a dash

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 88
napoleon_numpy_docstring = False

html_theme = "furo"
html_title = "sagesplat"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_search_summary = False  # is fetched, which browsers refuse from the disk
